"""Models and states from outside: every number is checked when it is read, what is wrong is said in one line, and old files load."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import push_ident as pi
from helpers.damaged_models import DAMAGE, DAMAGED_TEXT, right_model, unreadable_paths
from push_ident.errors import InputError, ModelFileError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.identification.online.identifier import OnlineIdentifier
from push_ident.identification.online.state_file import load_state, save_state
from push_ident.identification.results.model_file import load_model, model_of_text, save_model
from push_ident.identification.results.posterior import prior_posterior
from push_ident.types import ObjectShape

FILES = Path(__file__).parent / "files"
STATE = json.loads((FILES / "state_2.json").read_text())
LINE = 700
"""Characters of one line: what is repeated of a foreign text, and the text around it."""


def refused(load: Callable[[], object], pattern: str) -> None:
    with pytest.raises(ModelFileError, match=pattern) as caught:
        load()
    text = str(caught.value)
    assert len(text) < LINE and text.isprintable(), text


def written(tmp_path: Path, content: Any) -> Path:
    path = tmp_path / "file.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_model_is_refused_with_what_is_wrong(name: str, tmp_path: Path) -> None:
    change, pattern = DAMAGE[name]
    content = right_model()
    assert load_model(written(tmp_path, content))[1].z.tolist() == content["z"]
    change(content)
    path = written(tmp_path, content)
    refused(lambda: load_model(path), pattern)
    refused(lambda: model_of_text(json.dumps(content), "model of object o1"), pattern)


def test_cells_that_an_outline_cuts_are_read_as_they_were_written_and_refused_where_they_contradict_it(tmp_path: Path) -> None:
    outline = np.array([[0.0, 0.0], [0.15, 0.0], [0.02, 0.1]])
    path, cells = tmp_path / "model.json", cells_in_outline(outline, 0.01)
    save_model(path, prior_posterior(ObjectShape(cells, outline)), object_id="o1")
    read = load_model(path)[1].unknowns.shape.cells
    np.testing.assert_array_equal(read.centres, cells.centres)
    np.testing.assert_array_equal(read.areas, cells.areas)
    content = json.loads(path.read_text())
    content["cells"][0][0] += 0.002
    refused(lambda: load_model(written(tmp_path, content)), "not the centroids of `squares`")


@pytest.mark.parametrize("name", DAMAGED_TEXT)
def test_text_that_is_no_model_is_refused_with_what_is_wrong(name: str, tmp_path: Path) -> None:
    make, pattern = DAMAGED_TEXT[name]
    refused(lambda: load_model(written(tmp_path, make())), pattern)


def test_a_path_that_no_file_can_be_read_from_is_one_line(tmp_path: Path) -> None:
    for path in (*unreadable_paths(tmp_path).values(), tmp_path / "a\0b", tmp_path / "\ud800"):
        for load in (load_model, load_state):
            refused(lambda load=load, path=path: load(path), "Cannot read ")
        with pytest.raises(ModelFileError, match="Cannot read"):
            pi.predict(path, [])


def test_millions_of_wrong_values_take_bounded_memory(tmp_path: Path) -> None:
    path = written(tmp_path, json.dumps(right_model()).replace('"covariance": [', '"covariance": [' + "0," * 7_500_000))
    code = (
        "import sys; from pathlib import Path; from push_ident.errors import ModelFileError\n"
        "from push_ident.identification.results.model_file import load_model\n"
        "try: load_model(Path(sys.argv[1]))\n"
        "except ModelFileError: print(Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])"
    )
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, timeout=120)
    assert int(done.stdout) < 1_000_000, done.stderr  # [kB]: 8 GB where every wrong value is remembered


TILT = {"name": "table_tilt", "value": [0.0, 0.0], "std": [0.1, 0.1]}


def start(name: str, x: list[float], map_prior: list[float] | None) -> dict[str, object]:
    return {"name": name, "x": x, "map_prior": map_prior}


STATE_DAMAGE: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "model of it": (lambda c: c["model"].update(total_mass=-1.0), "The total mass is -1"),
    "pose beyond the table": (lambda c: c["pushes"][0]["pose"].__setitem__(0, [1e6, 0.0, 0.0]), "a coordinate is"),
    "pose known to nothing": (lambda c: c["pushes"][0]["pose_covariance"].__setitem__(0, (1e9 * np.eye(3)).tolist()), "entries over"),
    "asymmetric covariance": (lambda c: c["pushes"][0]["pose_covariance"][0][0].__setitem__(1, 1e-7), "not symmetric"),
    "poses of another day": (lambda c: c["pushes"][0]["pose_time"].__setitem__(-1, 1e6), "after the pusher"),
    "stamps of no clock": (lambda c: c["pushes"][0]["pose_time"].__setitem__(-1, 1e12), "a stamp is"),
    "pusher beyond the table": (lambda c: c["pushes"][0]["pusher"].__setitem__(0, [1e6, 0.0]), "a coordinate is"),
    "path without end": (lambda c: c["pushes"][0]["pusher"].__setitem__(0, [90.0, 0.0]), "path of the pusher"),
    "force beyond any arm": (lambda c: c["pushes"][0].update(wrench_time=[0.0, 0.1], force=[[1.0, 0.0], [1e9, 0.0]]), "a force is"),
    "push without end": (lambda c: c["pushes"][0]["pusher_time"].__setitem__(-1, 3e4), "duration of a push"),
    "radius of another unit": (lambda c: c["pushes"][0].update(radius=8.0), "radius of a pusher"),
    "forces without times": (lambda c: c["pushes"][0].update(force=[[1.0, 0.0]]), "forces without their times"),
    "hessian that is not symmetric": (lambda c: c["past"]["hessian"][0].__setitem__(1, 1e3), "not symmetric"),
    "hessian below zero": (lambda c: c["past"]["hessian"][0].__setitem__(0, -1e3), "eigenvalue"),
    "precision beyond rounding": (lambda c: c["past"]["hessian"][0].__setitem__(0, 1e300), "`hessian` has"),
    "gradient that leads nowhere": (lambda c: c["past"]["gradient"].__setitem__(0, 1e300), "`gradient` changes"),
    "point without meaning": (lambda c: c["past"]["point"].__setitem__(0, 1e300), "`point` changes"),
    "prior of other unknowns": (lambda c: c["prior"].update(feet=3.0), "Its prior has"),
    "prior that is infinite": (lambda c: c["prior"].update(friction=1e300), "a friction coefficient is"),
    "unknown status": (lambda c: c.update(status="SPLENDID"), "`status` is 'SPLENDID'"),
    "errors of no push": (lambda c: c["record"].update(n=0), "Sums of 0 errors"),
    "score of no time": (lambda c: c["record"]["latest"][0].update(start=float("nan")), "start"),
    "unknown format": (lambda c: c.update(format="push_ident/state/99"), "expected `push_ident/state/3`"),
    "start out of reach": (lambda c: c.update(starts=[start("equal", [1e300] * 5, None)]), "The start `equal` has"),
    "start under no prior": (
        lambda c: c.update(starts=[start("uneven load", [0.0] * 5, [0.7, 1e9, 0.7, 0.25])]),
        "The start `uneven load` has",
    ),
    "effect that is none": (lambda c: c.update(known=[{"name": "x", "value": [], "std": [], "share": 1.0}]), "There is no effect"),
    "share beyond all": (lambda c: c.update(known=[{**TILT, "share": 7.0}]), "share of the pushes"),
}


@pytest.mark.parametrize("name", STATE_DAMAGE)
def test_damaged_state_is_refused_with_what_is_wrong(name: str, tmp_path: Path) -> None:
    change, pattern = STATE_DAMAGE[name]
    content = json.loads(json.dumps(STATE))
    change(content)
    refused(lambda: load_state(written(tmp_path, content)), pattern)
    refused(lambda: load_state(written(tmp_path, json.dumps(content)[:2000])), r"file\.json")


def test_model_with_a_singular_covariance_cannot_be_learned_on() -> None:
    """Such a file passes: rounding can make a covariance singular. As information it would be without bound."""
    content = right_model()
    n = len(content["z"])
    content["covariance"] = np.full((n, n), 0.01).tolist()
    posterior = model_of_text(json.dumps(content), "it")
    with pytest.raises(InputError, match="singular"):
        OnlineIdentifier.known(posterior)


# --- files of earlier versions, written before the prior lost its fields on the camera (`outline_std`, `camera_share`)


def test_model_of_an_earlier_version_states_the_same_maps() -> None:
    written = json.loads((FILES / "model_1.json").read_text())
    assert {"outline_std", "camera_share"} < set(written["prior"])
    object_id, posterior = load_model(FILES / "model_1.json")
    assert object_id == "o1" and posterior.model.pusher_friction == written["pusher_friction"]
    assert posterior.model.mass.tolist() == written["mass"] and posterior.model.friction.tolist() == written["friction"]


def test_model_whose_effects_had_another_prior_is_refused() -> None:
    """Its unknowns count in units of that prior: read in others, they would be other values."""
    written = json.loads((FILES / "model_1.json").read_text())
    n = len(written["z"])
    at = n - 2  # effects come before the two scales
    written |= {"effects": ["outline_error"], "effect_values": [4e-4], "z": [*written["z"][:at], 1.0, *written["z"][at:]]}
    written["covariance"] = np.eye(n + 1).tolist()
    refused(lambda: model_of_text(json.dumps(written), "it"), "`effect_values` states 0.0004, expected")
    assert model_of_text(json.dumps(written | {"effect_values": [2e-3]}), "it").effects.values.tolist() == [2e-3]


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
