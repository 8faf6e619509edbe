"""Identification while pushing: summed-up pushes, updates at a frame, and a killed process that continues bit by bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.objects import hammer, random_records, with_forces
from push_ident.identification.identify import identify
from push_ident.identification.online.identifier import OnlineIdentifier, OnlineState
from push_ident.identification.online.state_file import load_state, save_state
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.results.posterior import prior_posterior
from push_ident.types import ObjectModel, PoseTrack, PusherPath, PushRecord, SolveStatus

TRUTH = hammer(3)
RECORDS = random_records(TRUTH, 12, 3)
TRAIN, TEST = RECORDS[:6], RECORDS[6:]
FRESH = OnlineIdentifier.new(TRUTH.shape)


def pushed(records: list[PushRecord], window: int = 8) -> OnlineIdentifier:
    online = OnlineIdentifier(FRESH, window=window)
    for record in records:
        online.add(record)
    return online


@pytest.fixture(scope="module")
def after_two() -> OnlineState:
    return pushed(TRAIN[:2]).state


def mean_error(model: ObjectModel) -> float:
    return float(held_out_errors(model, TEST).mean())


def until(record: PushRecord, end: float) -> PushRecord:
    poses, pusher = record.poses, record.pusher
    seen, moved = poses.time <= end, pusher.time <= end
    path = PusherPath(pusher.time[moved], pusher.position[moved], pusher.radius)
    return replace(record, poses=PoseTrack(poses.time[seen], poses.pose[seen], poses.covariance[seen]), pusher=path)


def test_pushes_summed_up_and_a_model_that_is_added_to_count_as_much_as_pushes_simulated_again() -> None:
    """Window of 3 against all six in one solve: the same predictions and the same certainty."""
    online, batch = pushed(TRAIN, window=3), identify(TRAIN).posterior
    assert online.n_pushes == 6 and len(online.state.records) == 3
    assert mean_error(online.posterior.model) == pytest.approx(mean_error(batch.model), abs=3e-4)
    assert online.posterior.pusher_friction.std == pytest.approx(batch.pusher_friction.std, rel=0.2)
    assert np.median(online.posterior.mass_friction_std / batch.mass_friction_std) == pytest.approx(1.0, abs=0.25)
    known = OnlineIdentifier(OnlineIdentifier.known(identify(TRAIN[:4]).posterior))
    for record in TRAIN[4:]:
        known.add(record)
    assert known.n_pushes == 2 and mean_error(known.posterior.model) == pytest.approx(mean_error(batch.model), abs=4e-4)


def test_every_frame_of_a_push_improves_the_estimate_as_the_whole_push_does_and_leaves_no_trace(after_two: OnlineState) -> None:
    online, without, record = OnlineIdentifier(after_two), OnlineIdentifier(after_two), TRAIN[2]
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
    online.update(TRAIN[3])
    assert online.posterior is not finished
    assert online.drop_update() and online.posterior is finished and not online.drop_update()


@pytest.mark.parametrize("method", ["gauss_newton", "fast_gradient"])
def test_restored_state_goes_on_bit_by_bit(method: str, tmp_path: Path) -> None:
    """As after a SIGKILL: only the file is left, and the maps after the next pushes are those of the process that was not killed."""
    *first, last = [with_forces(record, TRUTH) for record in TRAIN[: 4 if method == "gauss_newton" else 2]]
    file, window = tmp_path / "o1.state.json", 2 if method == "gauss_newton" else 1
    lived = OnlineIdentifier(FRESH, method=method, window=window)
    for record in first:
        lived.add(record)
    save_state(file, lived.state, object_id="o1", sources=["bag"])
    kept = load_state(file)
    assert (kept.object_id, kept.sources) == ("o1", ("bag",))
    restored = OnlineIdentifier(kept.state, method=method, window=window)
    for online in (lived, restored):
        online.add(last)
    assert restored.n_pushes == lived.n_pushes
    assert np.array_equal(restored.posterior.z, lived.posterior.z)
    assert np.array_equal(restored.posterior.covariance, lived.posterior.covariance)
    assert restored.posterior.total_mass == lived.posterior.total_mass


@pytest.mark.parametrize("start", ["failed fit", "adopted model"])
def test_cell_by_cell_solver_goes_on_past_its_window(start: str) -> None:
    """After a fit that failed, and after a model was adopted: neither leaves unknowns that the next pushes do not have."""
    state = OnlineIdentifier.known(prior_posterior(TRUTH.shape)) if start == "adopted model" else FRESH
    online = OnlineIdentifier(state, method="fast_gradient", window=1, max_seconds=0.1)
    if start == "failed fit":
        far = replace(TRAIN[0], pusher=replace(TRAIN[0].pusher, position=TRAIN[0].pusher.position + 1.0))
        assert online.add(far).status is SolveStatus.NO_CONTACT
    for record in TRAIN[1:3]:
        online.add(record)
    assert online.n_pushes == (3 if start == "failed fit" else 2)
    assert len(online.posterior.z) == 2 * len(TRUTH.shape.cells) + 2
