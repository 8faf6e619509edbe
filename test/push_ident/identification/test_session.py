"""An object while it is pushed: predicted before, scored after, and remembered through kills, loops and exchanges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.objects import hammer, random_records
from push_ident.errors import InputError
from push_ident.geometry.outline import edge_normals
from push_ident.identification.identify import identify
from push_ident.identification.online.session import ObjectSession, SessionOptions
from push_ident.identification.online.state_file import load_state, save_state
from push_ident.identification.predicting.scoring import PushScore, RunningRecord, summarise_scores
from push_ident.physics.accuracy import MAX_LEVEL, at_level
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.pushing.push import PushSettings
from push_ident.pushing.sampling import check_push
from push_ident.types import CellGrid, ObjectShape, PoseTrack, PusherPath, PushRecord

TRUTH = hammer(3)
RECORDS = random_records(TRUTH, 6, 3)


def test_each_push_is_predicted_by_the_model_fitted_to_those_before_it() -> None:
    session = _session()
    scores = [session.finish(record) for record in RECORDS]
    assert [s.number for s in scores if s] == [1, 2, 3, 4, 5, 6]
    first, *later = session.record.latest
    # Before the first push the prior is all there is.
    assert first.cell_error == pytest.approx(first.uniform_cell_error, rel=0.5)
    assert np.mean([s.cell_error for s in later[1:]]) < 0.5 * np.mean([s.uniform_cell_error for s in later[1:]])
    assert all(s.expected_cell_error > 0 for s in session.record.latest)
    assert session.record.summary == summarise_scores([s for s in scores if s])
    assert session.record.summary.n == 6


def test_killed_at_any_push_the_maps_are_those_of_the_uninterrupted_run(tmp_path: Path) -> None:
    """The bag is played again from its start after each kill: known pushes are left out."""
    lived, records = _session(tmp_path / "lived"), RECORDS[:5]
    for record in records:
        lived.finish(record)
    for n_before in (1, 4):
        folder = tmp_path / f"killed-{n_before}"
        killed = _session(folder)
        for record in records[:n_before]:
            killed.finish(record)
        killed.update(records[n_before])  # in the middle of a push
        del killed
        again = _session(folder)
        assert again.restored
        for record in records:
            again.finish(record)
        assert again.n_known_again == n_before
        assert np.array_equal(again.posterior.z, lived.posterior.z)
        assert again.record == lived.record


def test_the_latest_pushes_are_known_in_memory_of_fixed_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("push_ident.identification.online.session.REMEMBERED_PUSHES", 2)
    session = _session()
    for record in RECORDS[:3]:
        session.finish(record)
    assert [session.knows(record) for record in RECORDS[:4]] == [False, True, True, False]


def test_another_object_under_the_same_id_begins_anew_and_the_first_is_put_aside(tmp_path: Path) -> None:
    session = _session(tmp_path)
    session.finish(RECORDS[0])
    other = _moved(TRUTH.shape)
    session = session.replaced_by(other)
    assert session.n_pushes == 0
    assert load_state(tmp_path / "o1-before-1.state.json").state.n_pushes == 1
    session.finish(replace(RECORDS[1], shape=other))
    # The process comes back and meets the first object again: the file is of the other one.
    assert not ObjectSession("o1", TRUTH.shape, SessionOptions(folder=tmp_path)).restored
    assert (tmp_path / "o1-before-2.state.json").exists()


def test_prediction_of_an_unfinished_push_follows_the_pusher() -> None:
    session = _session()
    for record in RECORDS[:3]:
        session.finish(record)
    record = RECORDS[3]
    driving = np.linalg.norm(np.diff(record.pusher.position, axis=0), axis=1) > 1e-6
    middle = float(record.pusher.time[np.flatnonzero(driving)[-1]]) - 0.25
    before, moved = record.poses.time <= middle, record.pusher.time <= middle
    partial = PushRecord(
        "o1",
        record.shape,
        PoseTrack(record.poses.time[before], record.poses.pose[before], record.poses.covariance[before]),
        PusherPath(record.pusher.time[moved], record.pusher.position[moved], record.pusher.radius),
    )
    assert session.update(partial) is not None
    prediction = session.predict_under_way(partial, 0.2)
    later = np.array([np.interp(middle + 0.2, record.poses.time, record.poses.pose[:, axis]) for axis in range(3)])
    assert np.linalg.norm(prediction.pose[-1][:2] - later[:2]) < 4e-3
    assert prediction.time[-1] == pytest.approx(middle + 0.2, abs=0.02)


def test_next_push_is_suggested_with_its_prediction() -> None:
    session = _session()
    session.finish(RECORDS[0])
    suggestion = session.suggest(np.zeros(3), PushSettings(pusher_radius=0.015), n_candidates=6)
    assert suggestion is not None
    push, prediction = suggestion
    assert push.plan is not None
    check_push(push.plan, session.shape.outline, PushSettings(pusher_radius=0.015))
    np.testing.assert_array_equal(push.pose_object_in_table, np.zeros(3))
    assert prediction.time[0] == push.pusher.time[0] and prediction.time[-1] == push.pusher.time[-1]
    # The push that is expected to teach most moves the object, and its prediction says how.
    scenario = PushScenario(push.pusher, np.zeros(3), push.pusher.time[-1:])
    levels = [at_level(SimulationSettings(), level) for level in range(MAX_LEVEL + 1)]
    ends = [simulate(session.posterior.model, scenario, settings=settings).pose[-1] for settings in levels]
    assert any(np.allclose(prediction.pose[-1], end, atol=1e-9) for end in ends)
    end = prediction.pose[-1]
    assert np.linalg.norm(end[:2]) > 0.01 or abs(end[2]) > 0.1


def test_model_of_another_object_is_refused() -> None:
    first, second = _session(), ObjectSession("o2", _moved(TRUTH.shape), SessionOptions())
    with pytest.raises(InputError, match="another object"):
        second.adopt(first.posterior, "model.json")


def test_score_of_a_push_that_could_not_be_simulated_survives_the_file(tmp_path: Path) -> None:
    session = _session()
    session.finish(RECORDS[0])
    lost = PushScore(2, "push", 1.0, np.nan, np.nan, np.nan, 0.01)
    file = tmp_path / "s.json"
    save_state(file, session.online.state, object_id="o1", record=session.record.add(lost))
    kept = load_state(file).record
    assert kept.latest[0] == session.record.latest[0]
    assert np.isnan(kept.latest[1].cell_error)
    assert kept.summary.n == 1


def test_running_record_means_all_pushes_and_holds_the_latest() -> None:
    scores = [PushScore(n, "push", float(n), 1e-3 * n, 1e-3, 2.0 if n % 2 else 20.0, 0.01) for n in range(1, 501)]
    record = RunningRecord()
    for score in scores:
        record = record.add(score)
    assert record.summary.mean_cell_error == pytest.approx(0.2505)
    assert (record.summary.n, record.summary.share_within_90) == (500, 0.5)
    assert record.latest[0].number > 1
    assert record.latest[-1] is scores[-1]


def _session(folder: Path | None = None) -> ObjectSession:
    return ObjectSession("o1", TRUTH.shape, SessionOptions(folder=folder))


def _moved(shape: ObjectShape) -> ObjectShape:
    shift = np.array([0.03, 0.0])
    return ObjectShape(CellGrid(shape.cells.centres + shift, shape.cells.size), shape.outline + shift)


def _traced(shape: ObjectShape) -> ObjectShape:
    return replace(shape, outline_std=np.full(len(shape.outline), 1e-3))


def test_the_outline_after_the_cells_is_taken_until_a_push_was_learned() -> None:
    session, traced = _session(), _traced(TRUTH.shape)
    session.refine_shape(traced)
    assert session.shape is traced and session.posterior.effects.names == ("outline_error",)
    session.finish(RECORDS[0])
    assert session.posterior.effects.names == ("outline_error",)
    session.refine_shape(TRUTH.shape)
    assert session.shape.outline_std is not None and session.n_pushes == 1


def test_pushes_with_a_better_known_outline_do_not_change_the_unknowns_of_a_model() -> None:
    """As after a restart from a file that was written before outlines had deviations."""
    session = ObjectSession("o1", TRUTH.shape, SessionOptions(window=2))
    for record in RECORDS[:4]:
        assert session.finish(replace(record, shape=_traced(record.shape))) is not None
    assert session.n_pushes == 4 and session.posterior.effects.names == ()


def test_a_model_with_effects_goes_on_with_them_once_adopted() -> None:
    session = _session()
    session.adopt(identify(RECORDS[:2], effects=("outline_error",)).posterior, "model.json")
    session.finish(RECORDS[2])
    assert session.posterior.effects.names == ("outline_error",)
    assert session.posterior.effects_std[0] < 1e-3


def _grown(shape: ObjectShape, distance: float) -> ObjectShape:
    """The outline as a camera may see it: wider by `distance` [m] on each side."""
    normal = edge_normals(shape.outline)
    before = np.roll(normal, 1, axis=0)
    meeting = (normal + before) / (1.0 + np.sum(normal * before, axis=1, keepdims=True))
    return replace(shape, outline=shape.outline + distance * meeting, outline_std=np.full(len(shape.outline), 1e-3))


def test_a_better_outline_is_used_for_the_pushes_before_it_too(tmp_path: Path) -> None:
    wide, traced = _grown(TRUTH.shape, 1.5e-3), _traced(TRUTH.shape)
    session = ObjectSession("o1", wide, SessionOptions(folder=tmp_path))
    for record in RECORDS[:3]:
        session.finish(replace(record, shape=wide))
    (offset_before,) = session.posterior.effects.values
    assert session.refine_shape(traced)
    assert session.n_pushes == 3 and np.array_equal(session.shape.outline, traced.outline)
    (offset,) = session.posterior.effects.values
    assert offset_before < -1e-3 and abs(offset) < 5e-4
    assert all(np.array_equal(record.shape.outline, traced.outline) for record in session.online.state.records)
    # A killed process goes on with it, and so do the pushes from then on.
    again = ObjectSession("o1", traced, SessionOptions(folder=tmp_path))
    assert again.restored and np.array_equal(again.shape.outline, traced.outline)
    assert not again.refine_shape(traced)
    again.finish(replace(RECORDS[3], shape=traced))
    assert again.n_pushes == 4


def test_the_outline_stays_once_pushes_are_summed_up() -> None:
    wide = _grown(TRUTH.shape, 1e-3)
    session = ObjectSession("o1", wide, SessionOptions(window=1))
    for record in RECORDS[:2]:
        session.finish(replace(record, shape=wide))
    assert not session.refine_shape(_traced(TRUTH.shape))
    assert np.array_equal(session.shape.outline, wide.outline)
