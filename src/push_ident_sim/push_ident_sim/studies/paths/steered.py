"""One object that is pushed along paths in Bullet as a goal of the cell would be: with the tool steered, or by straight pushes."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.planning.curved_planner import CurvedPush
from push_ident.planning.path_follower import FollowStatus, PathFollower
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_planner import PathPush
from push_ident.planning.path_steps import PathSteps, may_steer_after
from push_ident.types import Float64Array
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.studies.common.pushed import REST, PushedObject
from push_ident_sim.studies.paths.run import MOST_CONTACTS, PathOutcome, measure, named_path

__all__ = ["HALF_WIDTH", "PERIOD", "Knock", "follow_steered"]

PERIOD = 1.0 / 30.0
"""Of the camera [s]."""
HALF_WIDTH = 0.06
"""Of the corridor along a path [m]: the default of `goal_pushing_node`."""
_TOLERANCE = 0.003, float(np.radians(2.0))
"""Errors that are aimed at [m], [rad]."""
_SLOWEST = 4.0
"""A contact may take so many times as long as the path at its speed [1]."""
_HALF = 0.5
"""Share of the path after which the knock comes [1]."""
_SEEN = 4
"""Every so manyth pose of the engine is looked at."""
_DISPLACED, _TURNED = 0.040, 0.117
"""By a knock [m], [rad]."""
_BACK = np.array([0.005, np.radians(4.0)])
"""Nearer to the path than this the object is back [m, rad]."""


@dataclass(slots=True)
class Knock:
    """Someone displaces the object half-way, in a steered push or before a straight one."""

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
    path: PathGoal
    outcome: PathOutcome
    knock: Knock | None
    done: float = 0.0
    way: list[Float64Array] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)
    """Of each correction [s]."""
    processor: list[float] = field(default_factory=list)


def follow_steered(pushed: PushedObject, planner: PathSteps, name: str, speed: float, knock: Knock | None = None) -> PathOutcome:
    """Push an object, put at the start of a path, along it."""
    path = replace(named_path(name, speed), position=_TOLERANCE[0], yaw=_TOLERANCE[1])
    run, plans, steers = _Run(pushed, path, PathOutcome(name, speed), knock), 0, True
    pushed.pose = path.poses[0].copy()
    while True:
        begun = time.process_time()
        plan = planner.plan(pushed.belief, pushed.observe()[0], path, run.done, steers=steers)
        run.outcome.planning_s, plans = run.outcome.planning_s + time.process_time() - begun, plans + 1
        run.done = plan.done
        if plan.contact is None or run.outcome.contacts >= MOST_CONTACTS:
            break
        if plan.straight is not None:
            _straight(run, plan.straight)
        else:
            assert plan.steered is not None and plan.follower is not None
            _steered(run, plan.steered, plan.follower(PERIOD))
        steers = may_steer_after(plan, plan.done, run.done)
    outcome = run.outcome
    outcome.planning_s /= plans
    outcome.end = plan.status.name if plan.contact is None else "MAX_CONTACTS"
    if run.wall:
        outcome.correction_median_s, outcome.correction_p99_s = (float(v) for v in np.quantile(run.wall, [0.5, 0.99]))
        outcome.correction_processor_s = float(np.mean(run.processor))
    if run.way:
        measure(outcome, path, np.concatenate(run.way))
    return outcome


def _steered(run: _Run, plan: CurvedPush, follower: PathFollower) -> None:
    pushed, path = run.pushed, run.path
    assert plan.time is not None and plan.tool is not None
    pose, covariance = pushed.observe()
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
        comes = run.knock is not None and run.knock.pending and run.done > _HALF * path.length
        displaced = _displaced(run, correction.tool[1]) if comes else None
        if run.knock is not None and displaced is not None:
            run.knock.pending, run.knock.at = False, run.outcome.time_s + REST + now
            pushed.knock(displaced)
        else:
            _see(run, now, pushed.pose)
    _end_contact(run, pushed.let_go())


def _straight(run: _Run, plan: PathPush) -> None:
    pushed = run.pushed
    assert plan.plan is not None
    if run.knock is not None and run.knock.pending and run.done > _HALF * run.path.length:
        # Between two contacts: the tool is away.
        displaced = _displaced(run, None)
        assert displaced is not None, "no tool is in the way"
        run.knock.pending, run.knock.at = False, run.outcome.time_s
        pushed.pose = displaced
        return
    motion = pushed.push(plan.plan)
    for now, pose in zip(motion.time[::_SEEN], motion.pose[::_SEEN], strict=True):
        _see(run, float(now), pose)
    _end_contact(run, motion)


def _end_contact(run: _Run, motion: TrueMotion) -> None:
    if run.knock is not None and not run.knock.pending and not np.isfinite(run.knock.back):
        run.knock.contacts += 1
    run.way.append(motion.pose[::4])
    run.outcome.contacts += 1
    run.outcome.time_s += run.pushed.duration(motion)


def _see(run: _Run, now: float, pose: Float64Array) -> None:
    """Whether a displaced object is back."""
    knock = run.knock
    if knock is None or knock.pending or np.isfinite(knock.back):
        return
    _, error = run.path.error(pose, run.done, 0.1)
    if np.all(error < _BACK):
        knock.back = run.outcome.time_s + REST + now


def _displaced(run: _Run, tool: Float64Array | None) -> Float64Array | None:
    """To the side of the path; None while the tool, if it is down, is in the way on both."""
    pushed, direction = run.pushed, float(run.path.direction(run.done))
    for side in (1.0, -1.0):
        along = direction + side * np.pi / 2
        pose = pushed.pose + np.array([_DISPLACED * np.cos(along), _DISPLACED * np.sin(along), side * _TURNED])
        if tool is None:
            return pose
        gap = signed_distance(tool[None], transform_points(pose, pushed.truth.shape.outline))[0] - pushed.settings.pusher_radius
        if gap > 1e-3:
            return pose
    return None
