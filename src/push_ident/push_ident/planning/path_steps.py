"""The next push along a path: with the tool steered as long as one contact holds the object on it, else a straight one.

A face holds an object on a path only where the force that the path needs lies within its cone of friction. The planner of steered pushes
decides that by the error of the best contact. Where none holds it within tolerance, straight pushes continue, each from another side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from push_ident.planning.belief import Belief
from push_ident.planning.curved_planner import CurvedPathPlanner, CurvedPush
from push_ident.planning.path_follower import PathFollower
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_planner import PATH_OPTIONS, PathPlanner, PathPush, PathStatus
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.types import Float64Array, ObjectShape


@dataclass(frozen=True, slots=True)
class PathStep:
    """The next push along a path, or why there is none."""

    status: PathStatus
    done: float
    """Length of path that is behind now [m]."""
    steered: CurvedPush | None = None
    """A push whose tool is steered."""
    straight: PathPush | None = None
    """Or a straight one."""
    follower: Callable[[float], PathFollower] | None = None
    """Makes what corrects a steered push, from the time between a frame and the motion that it corrects [s]."""

    @property
    def contact(self) -> PushPlan2D | None:
        """The push, of a steered one its beginning."""
        if self.steered is not None:
            return self.steered.contact
        return None if self.straight is None else self.straight.plan

    @property
    def expected_done(self) -> float:
        """Length of path that is expected to be behind after it [m]; NaN without a push."""
        push = self.steered or self.straight
        return float("nan") if push is None else push.expected_done


class PathSteps:
    """Plans pushes of one object along paths, of either kind; `half_width`: of the corridor of a steered push [m]."""

    def __init__(self, shape: ObjectShape, settings: PushSettings, half_width: float) -> None:
        self._shape, self._settings = shape, settings
        self._curved = CurvedPathPlanner(shape, settings, half_width=half_width)
        self._straight: tuple[float, PathPlanner] | None = None

    def plan(
        self,
        belief: Belief,
        pose: Float64Array,
        path: PathGoal,
        done: float,
        obstacles: Sequence[Float64Array] = (),
        failed: Sequence[PushPlan2D] = (),
        *,
        steers: bool = True,
    ) -> PathStep:
        """The next push; arguments as those of `PathPlanner.plan`. Without `steers`, a straight one."""
        curved = self._curved.plan(belief, pose, path, done, obstacles, failed) if steers else CurvedPush(PathStatus.UNREACHABLE, done)
        if curved.status is PathStatus.ARRIVED:
            return PathStep(curved.status, curved.done)
        if curved.status is not PathStatus.PUSH or curved.expected_error > PATH_OPTIONS.bearable_error:
            straight = self._planner(path.speed).plan(belief, pose, path, done, obstacles, failed)
            if straight.status is PathStatus.PUSH or curved.status is not PathStatus.PUSH:
                return PathStep(straight.status, straight.done, straight=straight if straight.status is PathStatus.PUSH else None)
        corridor = curved.corridor
        assert corridor is not None, "a push has one"
        return PathStep(curved.status, curved.done, curved, follower=lambda period: self._curved.follower(belief, path, corridor, period))

    def _planner(self, speed: float) -> PathPlanner:
        if self._straight is None or self._straight[0] != speed:
            self._straight = speed, PathPlanner(self._shape, self._settings, speed)
        return self._straight[1]


def may_steer_after(step: PathStep, before: float, done: float) -> bool:
    """Whether the push after this one may be steered: where steering brought nothing, a straight push comes first.

    Lengths of path behind [m]: `before` the push that was made, and `done` now.
    """
    return step.steered is None or done > before + PATH_OPTIONS.stuck_progress
