"""An object while it is pushed: predicted before, scored after, and remembered through kills, loops and exchanges."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.objects import hammer, random_records, with_forces, with_frames
from push_ident.errors import InputError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.outline import edge_normals
from push_ident.identification.identify import identify
from push_ident.identification.online.identifier import OnlineIdentifier, OnlineState
from push_ident.identification.online.session import ObjectSession, SessionOptions
from push_ident.identification.online.state_file import load_state, save_state
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.predicting.scoring import PushScore, RunningRecord, summarise_scores
from push_ident.identification.results.model_file import load_model, save_model
from push_ident.identification.results.posterior import prior_posterior
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.pushing.push import PushSettings
from push_ident.pushing.sampling import check_push
from push_ident.types import CellGrid, ObjectModel, ObjectShape, PushRecord, SolveStatus

TRUTH = hammer(3)
PUSHES = random_records(TRUTH, 12, 3)
RECORDS = [*(with_forces(record, TRUTH) for record in PUSHES[:4]), PUSHES[4]]


def session_in(folder: Path | None = None, shape: ObjectShape = TRUTH.shape, n_pushes: int = 0, window: int = 8) -> ObjectSession:
    """After some pushes of an object of that shape."""
    session = ObjectSession("o1", shape, SessionOptions(folder=folder, window=window))
    for record in PUSHES[:n_pushes]:
        session.finish(replace(record, shape=shape))
    return session


@pytest.fixture(scope="module")
def lived(tmp_path_factory: pytest.TempPathFactory) -> ObjectSession:
    """After all pushes, with a copy of its folder as it was after each of them."""
    session = session_in(tmp_path_factory.mktemp("lived") / "now", window=2)
    for number, record in enumerate(RECORDS, 1):
        session.finish(record)
        shutil.copytree(folder_of(session), folder_of(session).with_name(str(number)))
    return session


def folder_of(session: ObjectSession) -> Path:
    assert session.options.folder is not None
    return session.options.folder


def killed_after(lived: ObjectSession, number: int, tmp_path: Path) -> ObjectSession:
    """A new process with the files of one that was killed after so many pushes."""
    shutil.copytree(folder_of(lived).with_name(str(number)), tmp_path, dirs_exist_ok=True)
    session = session_in(tmp_path, window=2)
    assert session.restored and session.n_pushes == number
    return session


def test_each_push_is_predicted_by_the_model_fitted_to_those_before_it(lived: ObjectSession) -> None:
    first, *later = lived.record.latest
    assert [score.number for score in lived.record.latest] == [1, 2, 3, 4, 5]
    # Before the first push the prior is all there is.
    assert first.cell_error == pytest.approx(first.uniform_cell_error, rel=0.5)
    assert np.mean([s.cell_error for s in later[1:]]) < 0.5 * np.mean([s.uniform_cell_error for s in later[1:]])
    assert all(s.expected_cell_error > 0 for s in lived.record.latest)
    assert lived.record.summary == summarise_scores(lived.record.latest) and lived.record.summary.n == 5


def test_killed_in_any_push_the_maps_are_those_of_the_uninterrupted_run_to_the_last_bit(lived: ObjectSession, tmp_path: Path) -> None:
    """After a SIGKILL only the file is left; the bag is played again from its start, and known pushes are left out."""
    killed_after(lived, 3, tmp_path).update(RECORDS[3])
    again = session_in(tmp_path, window=2)
    assert again.online.state.past is not None
    for record in RECORDS:
        again.finish(record)
    assert again.n_known_again == 3 and again.record == lived.record
    for name in ("z", "covariance"):
        assert np.array_equal(getattr(again.posterior, name), getattr(lived.posterior, name))
    assert again.posterior.total_mass == lived.posterior.total_mass


def test_pushes_that_are_summed_up_keep_what_their_forces_said_and_one_without_goes_on_in_the_same_unknowns(lived: ObjectSession) -> None:
    first, last = load_state(folder_of(lived).with_name("1") / "o1.state.json").state.posterior.total_mass, lived.posterior.total_mass
    assert lived.online.state.past is not None and lived.online.state.past.n_pushes == 3 and lived.online.state.prior.force_offset_std > 0
    assert last.std < 0.7 * first.std and abs(last.value - TRUTH.total_mass) < 3.0 * last.std
    assert lived.posterior.unknowns.blocks["total_mass"].size == 1


def test_the_latest_pushes_are_known_in_memory_of_fixed_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("push_ident.identification.online.session.REMEMBERED_PUSHES", 2)
    session = session_in(n_pushes=3)
    assert [session.knows(record) for record in PUSHES[:4]] == [False, True, True, False]


def moved(shape: ObjectShape) -> ObjectShape:
    shift = np.array([0.03, 0.0])
    return ObjectShape(CellGrid(shape.cells.centres + shift, shape.cells.size), shape.outline + shift)


def test_another_object_under_the_same_id_begins_anew_and_the_first_is_put_aside(lived: ObjectSession, tmp_path: Path) -> None:
    other = moved(TRUTH.shape)
    with pytest.raises(InputError, match="another object"):
        session_in(shape=other).adopt(lived.posterior, "model.json")
    session = killed_after(lived, 1, tmp_path).replaced_by(other)
    assert session.n_pushes == 0
    assert load_state(tmp_path / "o1-before-1.state.json").state.n_pushes == 1
    session.finish(replace(RECORDS[1], shape=other))
    # The process comes back and meets the first object again: the file is of the other one.
    assert not session_in(tmp_path).restored and (tmp_path / "o1-before-2.state.json").exists()


def test_prediction_of_an_unfinished_push_follows_the_pusher(lived: ObjectSession, tmp_path: Path) -> None:
    session, record = killed_after(lived, 3, tmp_path), RECORDS[3]
    poses, pusher = record.poses, record.pusher
    driving = np.linalg.norm(np.diff(pusher.position, axis=0), axis=1) > 1e-6
    middle = float(pusher.time[np.flatnonzero(driving)[-1]]) - 0.25
    partial = with_frames(record, poses.time <= middle, pusher.time <= middle)
    assert session.update(partial) is not None
    prediction = session.predict_under_way(partial, 0.2)
    later = np.array([np.interp(middle + 0.2, poses.time, poses.pose[:, axis]) for axis in range(3)])
    assert np.linalg.norm(prediction.pose[-1][:2] - later[:2]) < 4e-3
    assert prediction.time[-1] == pytest.approx(middle + 0.2, abs=0.02)


def test_next_push_is_suggested_with_its_prediction(lived: ObjectSession, tmp_path: Path) -> None:
    session, settings = killed_after(lived, 1, tmp_path), PushSettings(pusher_radius=0.015)
    suggestion = session.suggest(np.zeros(3), settings, n_candidates=6)
    assert suggestion is not None
    push, prediction = suggestion
    assert push.plan is not None
    check_push(push.plan, session.shape.outline, settings)
    assert prediction.time[[0, -1]].tolist() == push.pusher.time[[0, -1]].tolist()
    # The push that is expected to teach most moves the object, and its prediction says how.
    end = simulate(session.posterior.model, PushScenario(push.pusher, np.zeros(3), push.pusher.time[-1:])).pose[-1]
    np.testing.assert_allclose(prediction.pose[-1], end, atol=5e-3)
    assert np.linalg.norm(prediction.pose[-1][:2]) > 0.01 or abs(prediction.pose[-1][2]) > 0.1


def test_running_record_means_all_pushes_holds_the_latest_and_survives_the_file(lived: ObjectSession, tmp_path: Path) -> None:
    record = RunningRecord()
    for n in range(1, 501):
        record = record.add(PushScore(n, "push", float(n), 1e-3 * n, 1e-3, 2.0 if n % 2 else 20.0, 0.01))
    assert record.summary.mean_cell_error == pytest.approx(0.2505)
    assert (record.summary.n, record.summary.share_within_90) == (500, 0.5)
    assert record.latest[0].number > 1 and record.latest[-1].number == 500
    # One that could not be simulated has no numbers.
    lost = PushScore(501, "push", 1.0, np.nan, np.nan, np.nan, 0.01)
    save_state(tmp_path / "s.json", lived.online.state, object_id="o1", record=record.add(lost))
    kept = load_state(tmp_path / "s.json").record
    assert kept.latest[:-1] == record.latest[1:] and np.isnan(kept.latest[-1].cell_error) and kept.summary == record.summary


# --- outlines that a camera traces


def traced(shape: ObjectShape, wider: float = 0.0) -> ObjectShape:
    """The outline as a camera may see it: wider by a distance [m] on each side."""
    normal = edge_normals(shape.outline)
    before = np.roll(normal, 1, axis=0)
    meeting = (normal + before) / (1.0 + np.sum(normal * before, axis=1, keepdims=True))
    return replace(shape, outline=shape.outline + wider * meeting, outline_std=np.full(len(shape.outline), 1e-3))


def test_pushes_with_a_better_known_outline_do_not_change_the_unknowns_of_a_model() -> None:
    """As after a restart from a file that was written before outlines had deviations."""
    session = session_in(window=2)
    for record in PUSHES[:3]:
        assert session.finish(replace(record, shape=traced(record.shape))) is not None
    assert session.n_pushes == 3 and session.posterior.effects.names == ()


def test_a_better_outline_is_used_for_the_pushes_before_it_too_until_they_are_summed_up(tmp_path: Path) -> None:
    wide, better = traced(TRUTH.shape, 1.5e-3), traced(TRUTH.shape)
    session = session_in(tmp_path, wide, 3)
    (offset_before,) = session.posterior.effects.values
    assert session.refine_shape(better)
    assert session.n_pushes == 3 and np.array_equal(session.shape.outline, better.outline)
    (offset,) = session.posterior.effects.values
    assert offset_before < -0.9e-3 and abs(offset) < 5e-4
    assert all(np.array_equal(record.shape.outline, better.outline) for record in session.online.state.records)
    # A killed process goes on with it.
    again = session_in(tmp_path, better)
    assert again.restored and np.array_equal(again.shape.outline, better.outline) and not again.refine_shape(better)
    summed_up = session_in(None, wide, 2, window=1)
    assert not summed_up.refine_shape(better) and np.array_equal(summed_up.shape.outline, wide.outline)


def test_cells_are_those_that_the_better_outline_cuts_and_a_file_of_the_model_holds_both(tmp_path: Path) -> None:
    wide = replace(shape := traced(TRUTH.shape, 1.5e-3), cells=cells_in_outline(shape.outline, 0.013))
    session = session_in(None, wide, 1)
    assert session.refine_shape(replace(traced(TRUTH.shape), cells=wide.cells))
    assert not np.array_equal(session.shape.cells.centres, wide.cells.centres)
    save_model(tmp_path / "model.json", session.posterior, object_id="1")
    np.testing.assert_allclose(load_model(tmp_path / "model.json")[1].unknowns.shape.cells.centres, session.shape.cells.centres, atol=1e-9)


# --- the estimate: pushes that are summed up, and updates at each frame


def pushed(records: list[PushRecord], window: int = 8) -> OnlineIdentifier:
    online = OnlineIdentifier(OnlineIdentifier.new(TRUTH.shape), window=window)
    for record in records:
        online.add(record)
    return online


@pytest.fixture(scope="module")
def after_two() -> OnlineState:
    return pushed(PUSHES[:2]).state


def mean_error(model: ObjectModel) -> float:
    return float(held_out_errors(model, PUSHES[6:]).mean())


def until(record: PushRecord, end: float) -> PushRecord:
    return with_frames(record, record.poses.time <= end, record.pusher.time <= end)


def test_pushes_summed_up_and_a_model_that_is_added_to_count_as_much_as_pushes_simulated_again() -> None:
    """Window of 3 against all six in one solve: the same predictions and the same certainty."""
    online, batch = pushed(PUSHES[:6], window=3), identify(PUSHES[:6]).posterior
    assert online.n_pushes == 6 and len(online.state.records) == 3
    assert mean_error(online.posterior.model) == pytest.approx(mean_error(batch.model), abs=3e-4)
    assert online.posterior.pusher_friction.std == pytest.approx(batch.pusher_friction.std, rel=0.2)
    assert np.median(online.posterior.mass_friction_std / batch.mass_friction_std) == pytest.approx(1.0, abs=0.25)
    known = OnlineIdentifier(OnlineIdentifier.known(identify(PUSHES[:4]).posterior))
    for record in PUSHES[4:6]:
        known.add(record)
    assert known.n_pushes == 2 and mean_error(known.posterior.model) == pytest.approx(mean_error(batch.model), abs=4e-4)


def test_every_frame_of_a_push_improves_the_estimate_as_the_whole_push_does_and_leaves_no_trace(after_two: OnlineState) -> None:
    online, without, record = OnlineIdentifier(after_two), OnlineIdentifier(after_two), PUSHES[2]
    for end in record.poses.time[5::2]:
        update = online.update(until(record, float(end)))
    assert update is not None and online.n_pushes == 2
    updated, before = mean_error(online.posterior.model), mean_error(after_two.posterior.model)
    for other in (online, without):
        other.add(record)
    assert updated < before and updated == pytest.approx(mean_error(online.posterior.model), abs=1e-3)
    assert np.array_equal(online.posterior.z, without.posterior.z)
    # A push that is left out leaves none either.
    finished = online.posterior
    online.update(PUSHES[3])
    assert online.posterior is not finished
    assert online.drop_update() and online.posterior is finished and not online.drop_update()


@pytest.mark.parametrize("start", ["failed fit", "adopted model"])
def test_cell_by_cell_solver_goes_on_past_its_window_and_from_its_file(start: str, tmp_path: Path) -> None:
    """After a fit that failed, and after a model was adopted: neither leaves unknowns that the next pushes or the file do not have."""
    far = replace(PUSHES[0], pusher=replace(PUSHES[0].pusher, position=PUSHES[0].pusher.position + 1.0))
    state, records = OnlineIdentifier.known(prior_posterior(TRUTH.shape)), PUSHES[1:3]
    if start == "failed fit":
        state, records = OnlineIdentifier.new(TRUTH.shape), [far, *records]
    for record in records:
        online = OnlineIdentifier(state, method="fast_gradient", window=1, max_seconds=0.1)
        assert (online.add(record).status is SolveStatus.NO_CONTACT) == (record is far)
        save_state(tmp_path / "o1.state.json", online.state, object_id="o1", sources=["bag"])
        kept = load_state(tmp_path / "o1.state.json")
        state = kept.state
        assert (kept.object_id, kept.sources) == ("o1", ("bag",)) and np.array_equal(state.posterior.z, online.posterior.z)
    assert state.n_pushes == len(records) and len(state.posterior.z) == 2 * len(TRUTH.shape.cells) + 2
