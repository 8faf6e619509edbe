"""One object that is pushed along paths in Bullet."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field

import numpy as np

from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_planner import PathPlanner, PathStatus
from push_ident.types import Float64Array
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.pushed import PushedObject

__all__ = ["MOST_CONTACTS", "PATHS", "SPEED", "PathOutcome", "follow", "is_followed", "measure", "named_path"]

SPEED = 0.05
"""Of the tool [m/s]."""
PATHS = ("line", "ahead", "circle", "eight")
_LINE, _RADIUS = 0.25, 0.08
"""Length of the lines, and radius of the circle and of both loops of the eight [m]."""
MOST_CONTACTS = 60
_ANGLES = np.linspace(0.0, 2 * np.pi, 200)
_AHEAD = 0.02
"""How far along the path the object may come between two poses of the engine [m]: many times what it does."""


def named_path(name: str, speed: float = SPEED) -> PathGoal:
    """One of `PATHS`, at a speed [m/s]: the line with one heading beside it, all others with the heading along the path."""
    if name in ("line", "ahead"):
        yaw = 0.5 if name == "line" else 0.0
        return PathGoal(np.array([[-_LINE / 2, 0.0, yaw], [_LINE / 2, 0.0, yaw]]), speed)
    circle = np.column_stack([_RADIUS * np.sin(_ANGLES), _RADIUS * (1.0 - np.cos(_ANGLES)), _ANGLES])
    if name == "circle":
        return PathGoal(circle - [0.0, _RADIUS, 0.0], speed)
    # To the left around one loop, then to the right around the other: the heading is the same at the crossing.
    return PathGoal(np.vstack([circle, (circle * [1.0, -1.0, -1.0])[1:]]), speed)


@dataclass(slots=True)
class PathOutcome:
    """What became of one path."""

    name: str
    speed: float = SPEED
    """Along the path [m/s]."""
    end: str = ""
    """The status of planning, or MAX_CONTACTS."""
    contacts: int = 0
    time_s: float = 0.0
    """Of the pushes with their rests."""
    planning_s: float = 0.0
    """Of the processor, a plan in the mean."""
    rms_m: float = float("nan")
    """Root mean square of the true distance from the path, over the length that was followed."""
    rms_rad: float = float("nan")
    largest_m: float = float("nan")
    """Of all distances, where the object did not come further along the path as well."""
    followed: float = 0.0
    """Share of the path."""
    correction_median_s: float = float("nan")
    """By the wall clock."""
    correction_p99_s: float = float("nan")
    correction_processor_s: float = float("nan")
    """Of the processor, all threads, in the mean."""
    ends: list[str] = field(default_factory=list)
    """Why each contact ended."""
    poses: list[list[float]] = field(default_factory=list)
    """True, every 5 mm or so."""

    def values(self) -> Json:
        """For JSON; numbers that were not measured are null."""
        numbers = {key: round(value, 5) if np.isfinite(value) else None for key, value in asdict(self).items() if isinstance(value, float)}
        return asdict(self) | numbers


def follow(pushed: PushedObject, planner: PathPlanner, name: str) -> PathOutcome:
    """Push an object, put at the start of a path, along it."""
    path, outcome, done, plans = named_path(name), PathOutcome(name), 0.0, 0
    pushed.pose = path.poses[0].copy()
    way: list[Float64Array] = []
    while True:
        begun = time.process_time()
        plan = planner.plan(pushed.belief, pushed.observe()[0], path, done)
        outcome.planning_s, plans, done = outcome.planning_s + time.process_time() - begun, plans + 1, plan.done
        if plan.plan is None or outcome.contacts >= MOST_CONTACTS:
            break
        motion = pushed.push(plan.plan)
        way.append(motion.pose[::4])
        outcome.contacts += 1
        outcome.time_s += pushed.duration(motion)
    outcome.planning_s /= plans
    outcome.end = plan.status.name if plan.plan is None else "MAX_CONTACTS"
    if way:
        measure(outcome, path, np.concatenate(way))
    return outcome


def measure(outcome: PathOutcome, path: PathGoal, poses: Float64Array) -> None:
    """Fill in what was measured of true `poses`, shape (n, 3): errors weighted by the length of path that they last."""
    places, errors = [0.0], []
    for pose in poses:
        place, error = path.error(pose, places[-1], _AHEAD)
        places.append(max(places[-1], float(place)))
        errors.append(error)
    moved, error = np.diff(places), np.array(errors)
    if moved.sum() > 0:
        outcome.rms_m, outcome.rms_rad = (float(v) for v in np.sqrt(moved @ error**2 / moved.sum()))
        outcome.largest_m = float(np.max(error[:, 0]))
    outcome.followed = places[-1] / path.length
    travel = np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]), axis=1))
    kept = np.unique(np.searchsorted(travel, np.arange(0.0, travel[-1] + 5e-3, 5e-3)).clip(max=len(poses) - 1))
    outcome.poses = poses[kept].round(4).tolist()


def is_followed(outcome: Json) -> bool:
    """Whether the object is at the end of the path."""
    return bool(outcome["end"] == PathStatus.ARRIVED.name)
