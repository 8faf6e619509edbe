"""One object that is pushed along paths in Bullet, with the tool steered while it moves."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.planning.curved_planner import CurvedPathPlanner, CurvedPush
from push_ident.planning.path_follower import FollowStatus
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_planner import PathStatus
from push_ident.types import Float64Array
from push_ident_sim.studies.common.pushed import PushedObject
from push_ident_sim.studies.paths.run import MOST_CONTACTS, PathOutcome, measure, named_path

__all__ = ["PERIOD", "Knock", "follow_steered"]

PERIOD = 1.0 / 30.0
"""Of the camera [s]."""
_TOLERANCE = 0.003, float(np.radians(2.0))
"""Errors that are aimed at [m], [rad]."""
_SLOWEST = 4.0
"""A contact may take so many times as long as the path at its speed [1]."""
_DISPLACED, _TURNED = 0.040, 0.117
"""By a knock [m], [rad]."""
_BACK = np.array([0.005, np.radians(4.0)])
"""Nearer to the path than this the object is back [m, rad]."""


@dataclass(slots=True)
class Knock:
    """Someone displaces the object half-way."""

    at: float = np.inf
    """When, since the beginning, rests included [s]."""
    back: float = np.inf
    """When it was back on the path for the first time [s]."""
    contacts: int = 0
    """That were begun before it was back, the one that was under way not counted."""
    pending: bool = True


@dataclass(slots=True)
class _Run:
    """What is under way."""

    pushed: PushedObject
    planner: CurvedPathPlanner
    path: PathGoal
    outcome: PathOutcome
    knock: Knock | None
    done: float = 0.0
    way: list[Float64Array] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)
    """Of each correction [s]."""
    processor: list[float] = field(default_factory=list)


def follow_steered(pushed: PushedObject, planner: CurvedPathPlanner, name: str, speed: float, knock: Knock | None = None) -> PathOutcome:
    """Push an object, put at the start of a path, along it."""
    path = replace(named_path(name, speed), position=_TOLERANCE[0], yaw=_TOLERANCE[1])
    run, plans = _Run(pushed, planner, path, PathOutcome(name, speed), knock), 0
    pushed.pose = path.poses[0].copy()
    while True:
        begun = time.process_time()
        plan = planner.plan(pushed.belief, pushed.observe()[0], path, run.done)
        run.outcome.planning_s, plans = run.outcome.planning_s + time.process_time() - begun, plans + 1
        run.done = plan.done
        if plan.status is not PathStatus.PUSH or run.outcome.contacts >= MOST_CONTACTS:
            break
        _one_contact(run, plan)
    outcome = run.outcome
    outcome.planning_s /= plans
    outcome.end = plan.status.name if plan.status is not PathStatus.PUSH else "MAX_CONTACTS"
    if run.wall:
        outcome.correction_median_s, outcome.correction_p99_s = (float(v) for v in np.quantile(run.wall, [0.5, 0.99]))
        outcome.correction_processor_s = float(np.mean(run.processor))
    if run.way:
        measure(outcome, path, np.concatenate(run.way))
    return outcome


def _one_contact(run: _Run, plan: CurvedPush) -> None:
    pushed, path = run.pushed, run.path
    assert plan.time is not None and plan.tool is not None and plan.corridor is not None
    pose, covariance = pushed.observe()
    follower = run.planner.follower(pushed.belief, path, plan.corridor, PERIOD)
    follower.begin(plan.time, plan.tool, pose, covariance, run.done, plan.expected_error)
    pushed.touch(plan.tool[0])
    now = np.ceil(plan.time[1] / PERIOD) * PERIOD
    pushed.lead(plan.time, plan.tool, now)
    last = now + _SLOWEST * path.length / path.speed
    while now < last:
        seen = pushed.frame()
        begun, of_processor = time.perf_counter(), time.process_time()
        correction = follower.correct(now, *seen)
        run.wall.append(time.perf_counter() - begun)
        run.processor.append(time.process_time() - of_processor)
        run.done = correction.done
        if correction.status is not FollowStatus.GOING:
            run.outcome.ends.append(correction.status.name)
            break
        now += PERIOD
        pushed.lead(correction.time, correction.tool, now)
        if run.knock is not None:
            _knock(run, run.knock, correction.tool[1], now)
    if run.knock is not None and not run.knock.pending and not np.isfinite(run.knock.back):
        run.knock.contacts += 1
    motion = pushed.let_go()
    run.way.append(motion.pose[::4])
    run.outcome.contacts += 1
    run.outcome.time_s += pushed.duration(motion)


def _knock(run: _Run, knock: Knock, tool: Float64Array, now: float) -> None:
    """Displace the object half-way, and see when it is back."""
    clock, pushed = run.outcome.time_s + now, run.pushed
    if knock.pending and run.done > 0.5 * run.path.length:
        knock.pending, knock.at = False, clock
        pushed.knock(_displaced(run, tool))
    elif not knock.pending and not np.isfinite(knock.back):
        _, error = run.path.error(pushed.pose, run.done, 0.1)
        if np.all(error < _BACK):
            knock.back = clock


def _displaced(run: _Run, tool: Float64Array) -> Float64Array:
    """To the side of the path, where the tool is not in the way."""
    pushed, direction = run.pushed, float(run.path.direction(run.done))
    for angle in np.radians([90.0, -90.0, 60.0, -60.0, 30.0, -30.0, 0.0]):
        along = direction + angle
        pose = pushed.pose + np.array([_DISPLACED * np.cos(along), _DISPLACED * np.sin(along), np.sign(angle) * _TURNED])
        gap = signed_distance(tool[None], transform_points(pose, pushed.truth.shape.outline))[0] - pushed.settings.pusher_radius
        if gap > 1e-3:
            return pose
    raise AssertionError("a tool behind an object is not in front of it")
