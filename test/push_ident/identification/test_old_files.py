"""Files of earlier versions load, with the numbers that they state.

The files in `files/` were written before the prior lost its fields on the camera (`outline_std`, `camera_share`).
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from push_ident.errors import ModelFileError
from push_ident.identification.online.identifier import OnlineIdentifier
from push_ident.identification.online.state_file import load_state, save_state
from push_ident.identification.results.model_file import load_model

FILES = Path(__file__).parent / "files"


def test_model_of_an_earlier_version_states_the_same_maps() -> None:
    written = json.loads((FILES / "model_1.json").read_text())
    assert {"outline_std", "camera_share"} < set(written["prior"])
    object_id, posterior = load_model(FILES / "model_1.json")
    assert object_id == "o1" and posterior.model.pusher_friction == written["pusher_friction"]
    assert posterior.model.mass.tolist() == written["mass"] and posterior.model.friction.tolist() == written["friction"]


def test_model_whose_effects_had_another_prior_is_refused(tmp_path: Path) -> None:
    """Its unknowns count in units of that prior: read in others, they would be other values."""
    written = json.loads((FILES / "model_1.json").read_text())
    n = len(written["z"])
    at = n - 2  # effects come before the two scales
    written |= {"effects": ["outline_error"], "effect_values": [4e-4], "z": [*written["z"][:at], 1.0, *written["z"][at:]]}
    written["covariance"] = np.eye(n + 1).tolist()
    (tmp_path / "model.json").write_text(json.dumps(written))
    with pytest.raises(ModelFileError, match="`effect_values` states 0.0004, expected"):
        load_model(tmp_path / "model.json")
    written["effect_values"] = [2e-3]
    (tmp_path / "model.json").write_text(json.dumps(written))
    assert load_model(tmp_path / "model.json")[1].effects.values.tolist() == [2e-3]


def test_state_of_an_earlier_version_continues(tmp_path: Path) -> None:
    kept = load_state(FILES / "state_2.json")
    assert (kept.object_id, kept.state.n_pushes, len(kept.state.records)) == ("o1", 2, 1)
    assert kept.record.n == 2 and [score.number for score in kept.record.latest] == [1, 2]
    online = OnlineIdentifier(kept.state, window=1)
    online.add(kept.state.records[0])
    assert online.n_pushes == 3 and online.posterior.pusher_friction.std < kept.state.posterior.pusher_friction.std
    save_state(tmp_path / "again.json", kept.state, object_id=kept.object_id, sources=kept.sources, record=kept.record, pushes=kept.pushes)
    again, written = (json.loads(path.read_text()) for path in (tmp_path / "again.json", FILES / "state_2.json"))
    assert again["starts"] == []  # of a solver that is no more
    assert again["record"] == written["record"]
