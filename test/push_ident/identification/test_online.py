"""Identification while pushing: summed-up pushes, updates at a frame, and a killed process that continues bit by bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.objects import hammer, random_records
from push_ident.errors import ModelFileError
from push_ident.identification.identify import identify
from push_ident.identification.online.identifier import OnlineIdentifier, OnlineState
from push_ident.identification.online.state_file import load_state, save_state
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.results.posterior import prior_posterior
from push_ident.types import ObjectModel, PoseTrack, PusherPath, PushRecord, SolveStatus, WrenchTrack

TRUTH = hammer(3)
RECORDS = random_records(TRUTH, 18, 3)
TRAIN, TEST = RECORDS[:10], RECORDS[10:]


def test_pushes_summed_up_count_as_much_as_pushes_simulated_again() -> None:
    """Window of 3 against all ten in one solve: the same predictions and the same certainty."""
    online = _pushed(TRAIN, window=3)
    assert online.n_pushes == 10
    assert len(online.state.records) == 3
    batch = identify(TRAIN).posterior
    assert _error(online.posterior.model) == pytest.approx(_error(batch.model), abs=2e-4)
    assert online.posterior.pusher_friction.std == pytest.approx(batch.pusher_friction.std, rel=0.2)
    assert np.median(online.posterior.mass_friction_std / batch.mass_friction_std) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize(("pushes", "near"), [(1, 2e-3), (4, 4e-4)])
def test_every_frame_of_a_push_improves_the_estimate_as_the_whole_push_does(pushes: int, near: float) -> None:
    """Nearly at first: the prior of the maps is set after a push, so that the last frame of the second push leaves something to gain."""
    online = _pushed(TRAIN[:pushes])
    before = _error(online.posterior.model)
    record = TRAIN[pushes]
    for end in record.poses.time[5:]:
        update = online.update(_until(record, float(end)))
    assert online.n_pushes == pushes
    after = _error(update.posterior.model)
    online.add(record)
    finished = _error(online.posterior.model)
    assert after < before
    assert after == pytest.approx(finished, abs=near)


def test_frames_of_a_push_leave_no_trace_in_the_estimate_after_it() -> None:
    with_frames, without = _pushed(TRAIN[:2]), _pushed(TRAIN[:2])
    for end in TRAIN[2].poses.time[5::4]:
        with_frames.update(_until(TRAIN[2], float(end)))
    for online in (with_frames, without):
        online.add(TRAIN[2])
    assert np.array_equal(with_frames.posterior.z, without.posterior.z)


@pytest.mark.parametrize("method", ["gauss_newton", "fast_gradient"])
def test_restored_state_goes_on_bit_by_bit(method: str, tmp_path: Path) -> None:
    """As after a SIGKILL: only the file is left, and the maps after the next pushes are those of the process that was not killed."""
    records = [_with_wrench(record) for record in TRAIN[:6]]
    file = tmp_path / "o1.state.json"
    lived = OnlineIdentifier(OnlineIdentifier.new(TRUTH.shape), method=method, window=2, max_seconds=30.0)
    if method == "fast_gradient":
        records = records[:3]
    for i, record in enumerate(records):
        lived.add(record)
        if i == len(records) - 2:
            save_state(file, lived.state, object_id="o1", sources=["bag"])
    kept = load_state(file)
    assert (kept.object_id, kept.sources) == ("o1", ("bag",))
    restored = OnlineIdentifier(kept.state, method=method, window=2, max_seconds=30.0)
    restored.add(records[-1])
    assert restored.n_pushes == lived.n_pushes
    assert np.array_equal(restored.posterior.z, lived.posterior.z)
    assert np.array_equal(restored.posterior.covariance, lived.posterior.covariance)
    assert restored.posterior.total_mass == lived.posterior.total_mass


def test_known_model_is_added_to() -> None:
    first = _pushed(TRAIN[:4]).posterior
    online = OnlineIdentifier(OnlineIdentifier.known(first))
    for record in TRAIN[4:6]:
        online.add(record)
    together = identify(TRAIN[:6]).posterior
    assert _error(online.posterior.model) == pytest.approx(_error(together.model), abs=4e-4)
    assert online.n_pushes == 2


@pytest.mark.parametrize("start", ["failed fit", "adopted model"])
def test_cell_by_cell_solver_goes_on_past_its_window(start: str) -> None:
    """After a fit that failed, and after a model was adopted: neither leaves unknowns that the next pushes do not have."""
    state = OnlineIdentifier.known(prior_posterior(TRUTH.shape)) if start == "adopted model" else _fresh()
    online = OnlineIdentifier(state, method="fast_gradient", window=1, max_seconds=0.2)
    if start == "failed fit":
        far = replace(TRAIN[0], pusher=replace(TRAIN[0].pusher, position=TRAIN[0].pusher.position + 1.0))
        assert online.add(far).status is SolveStatus.NO_CONTACT
    for record in TRAIN[1:4]:
        online.add(record)
    assert online.n_pushes == (4 if start == "failed fit" else 3)
    assert len(online.posterior.z) == 2 * len(TRUTH.shape.cells) + 2


@pytest.mark.parametrize("damage", ["cut", "bytes", "numbers"])
def test_damaged_state_is_refused(damage: str, tmp_path: Path) -> None:
    file = tmp_path / "o1.state.json"
    save_state(file, _pushed(TRAIN[:1]).state, object_id="o1")
    text = file.read_text()
    file.write_bytes(
        {"cut": text[: len(text) // 2].encode(), "bytes": b"\x80\x04N.", "numbers": text.replace('"z":[', '"z":[1.0,').encode()}[damage]
    )
    with pytest.raises(ModelFileError, match=r"o1\.state\.json"):
        load_state(file)


def _pushed(records: list[PushRecord], window: int = 8) -> OnlineIdentifier:
    online = OnlineIdentifier(_fresh(), window=window)
    for record in records:
        online.add(record)
    return online


def _fresh() -> OnlineState:
    return OnlineIdentifier.new(TRUTH.shape)


def _error(model: ObjectModel) -> float:
    return float(held_out_errors(model, TEST).mean())


def _until(record: PushRecord, end: float) -> PushRecord:
    seen, moved = record.poses.time <= end, record.pusher.time <= end
    poses = PoseTrack(record.poses.time[seen], record.poses.pose[seen], record.poses.covariance[seen])
    return PushRecord(
        record.object_id, record.shape, poses, PusherPath(record.pusher.time[moved], record.pusher.position[moved], record.pusher.radius)
    )


def _with_wrench(record: PushRecord) -> PushRecord:
    from push_ident.physics.scenario import PushScenario
    from push_ident.physics.simulation import simulate

    motion = simulate(TRUTH, PushScenario(record.pusher, record.poses.pose[0], record.poses.time))
    return PushRecord(record.object_id, record.shape, record.poses, record.pusher, WrenchTrack(motion.force_time, 1.2 * motion.force))


def test_push_that_is_left_out_leaves_no_trace() -> None:
    online = _pushed(TRAIN[:2])
    before = online.posterior
    online.update(TRAIN[2])
    assert not np.array_equal(online.posterior.z, before.z)
    assert online.drop_update() and online.posterior is before
    assert not online.drop_update()
