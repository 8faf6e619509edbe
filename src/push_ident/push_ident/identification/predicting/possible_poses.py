"""Poses that no push can have made, before they are learned: single ones are left out, a push that ends in one as a whole.

- **From frame to frame.** Each pose must be within reach of the one before (`pushing/possible_motion.py`). Where one is not, the longest
  sequence of poses is kept in which each can follow the last. What it leaves out is an excursion where it begins and ends with an
  impossible step; where it does not, the object seems to jump and to stay there, and nothing says which side is wrong.
- **From rest to rest.** The end must be one that this path of the pusher can have made.
- **Against the prediction.** Bounds grow with travel, so that half a turn may pass as one that a long push made. So the end must also be
  near that of some object with this outline: drawn from the prior, not from the pushes before, since a model that is wrong is surprised
  by what is true.

A diagnosis gets all poses: it has a gate for those that jump, and effects that act on poses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from push_ident.errors import InputError
from push_ident.identification.observing.observation import rest_frames
from push_ident.identification.results.posterior import ModelPosterior, prior_posterior
from push_ident.identification.unknowns.mechanics import mechanics_at
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.physics.effect_values import true_pose
from push_ident.physics.scenario import PushScenario
from push_ident.pushing.possible_motion import (
    UNDERSTATED,
    Frames,
    PusherTravel,
    displacement,
    moved_text,
    noise_allowance,
    pose_std,
    stop_time,
    travel_in_contact,
    why_impossible,
)
from push_ident.types import BoolArray, Float64Array, PoseTrack, PushRecord, SolveStatus

_TRAVEL_SHARE: Final = 0.5
"""Distance from the end of the nearest drawn object over the travel of the pusher in contact, at most [-]. It was 0.32 at most in 800
simulated pushes, with any effect of the catalogue at up to three times its usual size, and 0.23 in 130 recorded ones."""
_DRAWN_OBJECTS: Final = 32
"""Objects that are drawn before an end counts as one that none has."""


class ImpossiblePosesError(InputError):
    """No push can have made the poses of a push."""


@dataclass(frozen=True, slots=True)
class CheckedPoses:
    """What of a push can be learned."""

    record: PushRecord
    """With the poses that a push can have made; the push as it was where `why` says something."""
    why: str = ""
    """Why the push as a whole is impossible; empty where it is not."""
    n_left_out: int = 0
    """Number of impossible poses that are left out."""
    note: str = ""
    """What is left out and why, as a sentence; empty where nothing is."""


def check_poses(record: PushRecord) -> CheckedPoses:
    """Leave out what this push cannot have made of its object, whatever masses and frictions it has, from frame to frame."""
    steps, n = _Steps(record), len(record.poses.time)
    breaks = 1 + np.flatnonzero(~steps.possible(np.arange(n - 1), np.arange(1, n)))
    if not len(breaks):
        return CheckedPoses(record)
    why = ""
    # Poses that are barely out of reach may break the sequence on one side only: then the two beside a break are looked at one by one.
    for starts in (breaks, np.unique(np.concatenate([breaks - 1, breaks, breaks + 1]))):
        runs = np.split(np.arange(n), starts[(starts > 0) & (starts < n)])
        kept = _longest_chain(steps, runs, record.poses.time)
        why = _why_no_excursions(steps, record, runs, kept)
        if not why:
            return _without_others(steps, record, np.concatenate([runs[k] for k in kept]))
    first = int(breaks[0])
    return CheckedPoses(record, f"its pose {steps.text(first - 1, first)}, and {why}.")


def why_no_object_ends_there(record: PushRecord, known: ModelPosterior, prior: Prior) -> str:
    """Why no object of this outline can have been pushed to where this push ends; empty where one can, or no simulation succeeds.

    The push comes from `check_poses`. An end near the prediction of `known`, the model of this object or of the prior, is possible.
    """
    before, after, _ = rest_frames(record)
    poses, shape, camera = record.poses, record.shape, record.poses.camera
    first, last = (np.median(poses.pose[frames], axis=0) for frames in (before, after))
    of_first, of_last = (np.median(poses.covariance[frames], axis=0) for frames in (before, after))
    end_time, pusher = float(np.median(poses.time[after])), record.pusher
    if why := why_impossible(
        shape, pusher, first, last, covariance_before=of_first, covariance_after=of_last, camera=camera, observed_at=end_time
    ):
        return why
    noise = float(np.linalg.norm(noise_allowance(shape, np.array([of_first, of_last]))))
    possible, nearest = _TRAVEL_SHARE * travel_in_contact(shape, pusher, first, of_first, camera) + noise, np.inf
    # Poses may be older than their stamps.
    time = np.maximum(end_time + np.linspace(-0.5, 0.5, 5), float(pusher.time[0]))
    for ends in _simulated(PushScenario(pusher, first, time, record.order), known, prior):
        nearest = min(nearest, float(np.min(displacement(shape, ends, last))))
        if nearest <= possible:
            return ""
    if not np.isfinite(nearest):
        return ""
    return (
        f"it ends {1e3 * nearest:.0f} mm from where the nearest of {_DRAWN_OBJECTS} objects with its outline would, after "
        f"{moved_text(shape, first, last)}; {1e3 * possible:.0f} mm are possible."
    )


def _simulated(scenario: PushScenario, known: ModelPosterior, prior: Prior) -> Iterator[Float64Array]:
    """Poses of the known object, then of drawn ones, at the times of the scenario, shape (n_times, 3)."""
    for unknowns, z in _objects(known, prior):
        mechanics = mechanics_at(unknowns, z)
        start = true_pose(mechanics.effects, scenario.pose_object_in_table)
        motion = mechanics.simulate(replace(scenario, pose_object_in_table=start))
        if motion.status is not SolveStatus.SIMULATION_FAILED:
            yield motion.pose


def _objects(known: ModelPosterior, prior: Prior) -> Iterator[tuple[UnknownsSpec, Float64Array]]:
    yield known.unknowns, known.z
    unknowns = prior_posterior(known.unknowns.shape, prior).unknowns
    for z in np.random.default_rng(0).normal(size=(_DRAWN_OBJECTS, unknowns.size)):
        yield unknowns, z


class _Steps:
    """Which pose of a push can follow which."""

    def __init__(self, record: PushRecord) -> None:
        self._shape, self._poses = record.shape, record.poses
        noise = noise_allowance(record.shape, record.poses.covariance) * _understatement(record)
        # A pose that is known three times less well than the better quarter of its push must not connect two that contradict each other. It
        # is left out where it does not fit, but is not called impossible.
        most = 3.0 * float(np.quantile(noise, 0.25))
        self.certain: BoolArray = noise <= most
        """Of each pose, whether enough is known to call it impossible, shape (n_frames,)."""
        self._noise, self._travel = np.minimum(noise, most), PusherTravel(record.pusher, record.poses.time)

    def reach(self, one: Frames, other: Frames) -> Float64Array:
        """Distance that is possible from pose `one` to the later `other` [m]."""
        return np.asarray(self._travel.reach(one, other) + np.hypot(self._noise[one], self._noise[other]))

    def possible(self, one: Frames, other: Frames) -> BoolArray:
        """Whether pose `other` can follow pose `one`."""
        return np.asarray(displacement(self._shape, self._poses.pose[one], self._poses.pose[other]) <= self.reach(one, other))

    def text(self, one: int, other: int) -> str:
        """The step for people."""
        time, pose = self._poses.time, self._poses.pose
        return (
            f"moves by {moved_text(self._shape, pose[one], pose[other])} within {time[other] - time[one]:.2f} s at {time[other]:.2f} s, "
            f"where {1e3 * float(self.reach(one, other)):.0f} mm are possible"
        )


def _understatement(record: PushRecord, enough_steps: int = 6, most: float = 10.0) -> float:
    """How much larger the noise of the poses is than what is allowed for, by the median step while the pusher stands; 1 where it is not.

    One excursion makes two large steps, hence `enough_steps`. Beyond `most` times the stated noise, poses are wrong.
    """
    poses, pusher, shape = record.poses, record.pusher, record.shape
    std = pose_std(shape, poses.covariance)
    of_steps = np.hypot(std[1:], std[:-1])
    position = np.column_stack([np.interp(poses.time, pusher.time, pusher.position[:, axis]) for axis in (0, 1)])
    stands = np.linalg.norm(np.diff(position, axis=0), axis=1) <= of_steps
    if np.sum(stands) < enough_steps:
        return 1.0
    ratio = float(np.median(displacement(shape, poses.pose[1:], poses.pose[:-1])[stands] / of_steps[stands]))
    return ratio / UNDERSTATED if UNDERSTATED < ratio < most else 1.0


def _longest_chain(steps: _Steps, runs: list[NDArray[np.intp]], time: Float64Array, longest_excursion: float = 3.0) -> list[int]:
    """Which runs of poses to keep: the most poses in runs that can follow each other.

    After a longer excursion poses are not believed again [s]: an arm may hide the object for that long in a push.
    """
    first, last = np.array([run[0] for run in runs]), np.array([run[-1] for run in runs])
    length, previous = np.array([len(run) for run in runs]), np.full(len(runs), -1)
    for k in range(1, len(runs)):
        near = np.flatnonzero(time[first[k]] - time[last[:k]] <= longest_excursion)
        possible = near[steps.possible(last[near], np.full(len(near), first[k]))]
        if len(possible):
            previous[k] = possible[np.argmax(length[possible])]
            length[k] += length[previous[k]]
    chain = [int(np.argmax(length))]
    while previous[chain[-1]] >= 0:
        chain.append(int(previous[chain[-1]]))
    return chain[::-1]


def _why_no_excursions(steps: _Steps, record: PushRecord, runs: list[NDArray[np.intp]], kept: list[int]) -> str:
    """Why the poses that a chain of runs leaves out are not merely excursions from it; empty where they are."""
    time, frames = record.poses.time, np.concatenate([runs[k] for k in kept])
    if len(frames) < 2:
        return "no other pose confirms either side"
    for one, other in pairwise(kept):
        end, start = runs[one][-1], runs[other][0]
        if start - end > 2 and any(steps.possible(end, run[0]) or steps.possible(run[-1], start) for run in runs[one + 1 : other]):
            return "later poses go on from either side"
    # Where most poses are left out, of the push or of a rest, nothing says which of them show the object.
    certain = np.flatnonzero(steps.certain)
    # The contact is that of the object as it is seen first, or as it is kept: what was never touched has none.
    poses = record.poses
    held = [replace(poses, pose=np.broadcast_to(poses.pose[frame], poses.pose.shape)) for frame in (certain[0], frames[0])]
    before = min((rest_frames(replace(record, poses=track))[0] for track in held), key=len)
    for part, text in (
        (certain, "most poses of the push contradict the others"),
        (np.intersect1d(certain, before) if certain[0] < frames[0] else frames, "most poses before the contact contradict what follows"),
        (certain[time[certain] >= stop_time(record.pusher)] if certain[-1] > frames[-1] else frames, "it stays there to the end"),
    ):
        if 2 * len(np.intersect1d(part, frames)) <= len(part):
            return text
    return ""


def _without_others(steps: _Steps, record: PushRecord, kept: NDArray[np.intp]) -> CheckedPoses:
    """The push with some of its poses only, and what is said of the others."""
    poses, n = record.poses, len(record.poses.time)
    track = PoseTrack(poses.time[kept], poses.pose[kept], poses.covariance[kept], poses.camera)
    impossible = np.setdiff1d(np.flatnonzero(steps.certain), kept)
    if not len(impossible):
        return CheckedPoses(replace(record, poses=track))
    before, after = kept[kept < impossible[0]], kept[kept > impossible[0]]
    step = (before[-1], impossible[0]) if len(before) else (impossible[0], after[0])
    first, last = poses.time[impossible[[0, -1]]]
    note = (
        f"{len(impossible)} of {n} poses, between {first:.2f} s and {last:.2f} s, are left out, since no push can have made them; "
        f"the first {steps.text(*step)}."
    )
    return CheckedPoses(replace(record, poses=track), n_left_out=len(impossible), note=note)
