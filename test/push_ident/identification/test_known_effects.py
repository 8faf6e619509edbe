"""Effects that are known from elsewhere in the model of an object: they act, pushes count once, and what contradicts them is refused."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.diagnosis import NOISE, TRUTH, simulated_pushes
from push_ident.errors import InputError
from push_ident.identification.identify import identify
from push_ident.identification.online.session import ObjectSession, SessionOptions
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.results.known_effects import KnownEffect, effects_in_use, effects_text
from push_ident.planning.belief import Belief
from push_ident.types import PushRecord

TILT = np.array([0.04, -0.02])
"""Of the table on which all pushes are made [rad]."""
PUSHES = simulated_pushes(6, 2, {"table_tilt": TILT.tolist()}, noise=0.3 * NOISE)
KNOWN = KnownEffect("table_tilt", TILT + 0.002, np.array([0.004, 0.004]))


def session_of(records: Sequence[PushRecord] = (), **options: object) -> ObjectSession:
    session = ObjectSession("o1", TRUTH.shape, SessionOptions(**options))  # type: ignore[arg-type]
    for record in records:
        session.finish(record)
    return session


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a session that has learned three pushes."""
    folder = tmp_path_factory.mktemp("learned")
    session_of(PUSHES[:3], folder=folder)
    return folder


@pytest.fixture
def learned(kept: Path, tmp_path: Path) -> ObjectSession:
    shutil.copytree(kept, tmp_path, dirs_exist_ok=True)
    session = session_of(folder=tmp_path)
    assert session.restored and session.n_pushes == 3
    return session


def test_a_diagnosed_effect_joins_the_model_its_predictions_and_plans_and_outlives_a_restart(learned: ObjectSession) -> None:
    before = held_out_errors(learned.posterior.model, PUSHES[4:]).mean()
    learned.use_effects([KNOWN], n_pushes=3)  # all three were diagnosed, and count once: nothing is known beside them
    alone = identify([replace(record, order=i) for i, record in enumerate(PUSHES[:3])], effects=["table_tilt"]).posterior
    np.testing.assert_allclose(learned.posterior.effects.values, alone.effects.values, rtol=0.05, atol=2e-3)
    np.testing.assert_allclose(learned.posterior.effects_std, alone.effects_std, rtol=0.1)
    (found,) = effects_in_use(learned.posterior)
    assert found.name == "table_tilt" and np.all(np.abs(found.value - TILT) < 4 * found.std) and np.all(found.std < 0.02)
    assert held_out_errors(learned.posterior.model, PUSHES[4:], effects=learned.posterior.effects).mean() < 0.6 * before
    assert Belief.of(learned.posterior).mean.effects.names == ("table_tilt",)
    assert effects_text(learned.posterior).startswith("table_tilt x 0.0") and "rad" in effects_text(learned.posterior)
    again = session_of(folder=learned.options.folder)
    (known,) = again.online.state.known
    assert np.array_equal([known.value, known.std], [KNOWN.value, KNOWN.std]) and np.array_equal(again.posterior.z, learned.posterior.z)
    again.finish(PUSHES[3])
    # A diagnosis that had it in its base model says nothing of it; one that names nothing takes it out again.
    again.use_effects([], n_pushes=4, keep={"table_tilt"})
    assert effects_text(again.posterior)
    again.use_effects([], n_pushes=4)
    assert not effects_text(again.posterior) and again.n_pushes == 4
    learned.use_effects([KNOWN], n_pushes=3, until=float(PUSHES[0].poses.time[0]))  # none of the three was diagnosed
    assert np.all(learned.posterior.effects_std < 1.3 / np.sqrt(1 / alone.effects_std**2 + 1 / KNOWN.std**2))


def test_without_a_push_what_is_known_is_all_there_is() -> None:
    session = session_of()
    session.use_effects([KNOWN], n_pushes=4)
    session.refine_shape(replace(TRUTH.shape, outline=1.001 * TRUTH.shape.outline))
    (found,) = effects_in_use(session.posterior)
    np.testing.assert_allclose([found.value, found.std], [KNOWN.value, KNOWN.std], rtol=1e-9)
    assert session.is_new
    session.finish(PUSHES[0])
    (found,) = effects_in_use(session.posterior)
    assert np.all(found.std <= KNOWN.std) and np.all(np.abs(found.value - TILT) < 3 * KNOWN.std)


def test_pushes_that_were_summed_up_without_the_effect_count_no_more() -> None:
    session = session_of(PUSHES[:2], window=1)
    session.use_effects([KNOWN], n_pushes=2)
    assert session.n_pushes == 1 and session.online.state.past is None
    session.finish(PUSHES[2])
    assert session.online.state.records[-1].order == 2
    assert session.online.state.past is not None and effects_text(session.posterior)


def test_an_effect_that_the_pushes_contradict_is_refused_and_the_model_stays(learned: ObjectSession) -> None:
    before = learned.posterior
    with pytest.raises(InputError, match="pushes of this model show table_tilt"):
        learned.use_effects([KnownEffect("table_tilt", np.array([-0.06, 0.06]), np.array([0.004, 0.004]))], n_pushes=3)
    assert learned.posterior is before
    with pytest.raises(InputError, match="fits no effects"):
        session_of(method="fast_gradient").use_effects([KNOWN], n_pushes=3)
    for name, value, std, why in (
        ("table_tilt", [0.1], [0.1], "expected 2 of each"),
        ("table_tilt", [np.nan, 0.0], [0.1, 0.1], "x = nan"),
        ("table_tilt", [0.1, 0.0], [0.1, 0.0], "positive"),
        ("pusher_lag", [-1.0], [0.1], "expected a number from"),
    ):
        with pytest.raises(InputError, match=why):
            KnownEffect(name, np.array(value), np.array(std))
