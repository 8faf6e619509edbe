"""One object that is pushed to goals in Bullet, one after another and without ever being put back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.identification.identify import identify
from push_ident.identification.result import prior_posterior
from push_ident.planning.belief import Belief
from push_ident.planning.goal import Goal
from push_ident.planning.planner import GoalPlanner, GoalPush, PlanStatus
from push_ident.pushing.push import PushPlan2D
from push_ident.pushing.sampling import sample_push
from push_ident.types import Float64Array, ObjectModel, PushRecord
from push_ident_sim.engines.bullet.push_world import PushWorld
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, observe_motion, path_of_plan, true_model
from push_ident_sim.studies.common.plate import plate_in_bullet

__all__ = ["LEVELS", "GoalOutcome", "PushedObject", "random_goal", "reach"]

LEVELS = {"20mm_0.1rad": (0.02, 0.1), "10mm_5deg": (0.01, np.radians(5.0)), "5mm_2deg": (0.005, np.radians(2.0))}
"""Tolerances of position [m] and yaw [rad], from the first to the last: every goal is reached at the first, then held to the next."""
_MAX_PUSHES = 20
"""Of one goal, all tolerances together."""
_EXPLORING = 3
"""Random pushes before the first goal."""
_LEARNED = 10
"""Pushes that identification learns from, at most: later ones add little to what is known."""
_LASTING = np.array([7e-4, 7e-4, 6e-3])
"""Standard deviation of the errors of a pose at rest that no further frame lessens [m, m, rad]: perception in the simulated cell
(`CameraPolicy.floor_position`, `floor_yaw`)."""
_REACH, _TABLE = 0.15, np.array([0.8, 0.7])
"""Half the sides of the square that goals are drawn from, and of the table [m]."""
_REST = 0.4
"""Before and after each push [s]."""


def random_goal(rng: np.random.Generator) -> Float64Array:
    """A pose anywhere in the middle of the table, in any heading, shape (3,)."""
    return np.array([*rng.uniform(-_REACH, _REACH, 2), rng.uniform(-np.pi, np.pi)])


class PushedObject:
    """An object in Bullet, observed by a camera, and what a model of one kind says of it.

    Args:
        model: the true one.
        kind: `uniform` (equal cells, nothing learned), `identified` (learned from the pushes) or `truth`.
        rng: of exploring pushes and of noise.
    """

    def __init__(self, model: ObjectModel, kind: str, rng: np.random.Generator) -> None:
        self._settings, self._noise, self._rng, self._kind = TruthSettings(), CameraNoise(), rng, kind
        thing = plate_in_bullet(model)
        self._world = PushWorld(thing, self._settings.pushes.pusher_radius, time_step=self._settings.time_step)
        self._truth = true_model(thing)
        self.pose: Float64Array = np.zeros(3)
        """The true one, shape (3,)."""
        self._records: list[PushRecord] = []
        self.belief = Belief.certain(self._truth) if kind == "truth" else Belief.of(prior_posterior(self._truth.shape))
        self.planner = GoalPlanner(self._truth.shape, self._settings.pushes)
        if kind == "identified":
            for _ in range(_EXPLORING):
                self._record(self._move(sample_push(self._truth.shape, self.pose, rng, self._settings.pushes)))
            self._learn()

    def close(self) -> None:
        """Free the engine."""
        self._world.close()

    def observe(self) -> tuple[Float64Array, Float64Array]:
        """Pose as perceived at rest, shape (3,), and its covariance, shape (3, 3)."""
        n = int(_REST * self._noise.rate)
        frame = np.array([self._noise.position_std, self._noise.position_std, self._noise.yaw_std])
        std = np.hypot(frame / np.sqrt(n), _LASTING)
        return self.pose + std * self._rng.normal(size=3), np.diag(std**2)

    def push(self, plan: PushPlan2D) -> float:
        """Make a push and learn from it. Returns its duration with the rests [s]."""
        motion = self._move(plan)
        if self._kind == "identified" and len(self._records) < _LEARNED:
            self._record(motion)
            self._learn()
        return float(motion.time[-1]) + 2 * _REST

    @property
    def has_fallen(self) -> bool:
        """Whether the centre of mass is beyond the table."""
        centre = self._truth.mass @ self._truth.shape.cells.centres / self._truth.total_mass
        return bool(np.any(np.abs(transform_points(self.pose, centre[None])[0]) > _TABLE))

    def _move(self, plan: PushPlan2D) -> TrueMotion:
        motion = self._world.push(self.pose, path_of_plan(plan, self._settings), pushes_done=len(self._records))
        self.pose = motion.pose[-1]
        return motion

    def _record(self, motion: TrueMotion) -> None:
        observed = observe_motion(motion, self._settings.pushes.pusher_radius, self._noise, self._rng)
        self._records.append(PushRecord("o1", self._truth.shape, *observed))

    def _learn(self) -> None:
        result = identify(self._records)
        if not result.status.is_failure:
            self.belief = Belief.of(result.posterior)


@dataclass(slots=True)
class GoalOutcome:
    """What became of one goal."""

    reached: dict[str, bool] = field(default_factory=dict)
    """By level: whether the object was said to be there, and was."""
    pushes: dict[str, int] = field(default_factory=dict)
    """By level: pushes until then, from the start."""
    time: dict[str, float] = field(default_factory=dict)
    """By level: time of the pushes with their rests until then [s]."""
    chances: list[tuple[float, bool]] = field(default_factory=list)
    """Of each push: the chance that was expected of it, and whether the object was at the goal then."""
    ends: list[str] = field(default_factory=list)
    """How planning ended, level by level."""
    fell: bool = False


def reach(pushed: PushedObject, pose: Float64Array, levels: Sequence[str] = tuple(LEVELS)) -> GoalOutcome:
    """Push an object to a goal, shape (3,), to one tolerance after the other."""
    outcome, pushes, time = GoalOutcome(), 0, 0.0
    for level in levels:
        goal = Goal(pose, *LEVELS[level])
        while True:
            plan: GoalPush = pushed.planner.plan(pushed.belief, *pushed.observe(), goal)
            if plan.plan is None or pushes >= _MAX_PUSHES or outcome.fell:
                break
            time += pushed.push(plan.plan)
            pushes += 1
            outcome.chances.append((plan.chance, bool(goal.relative_error(pushed.pose) <= 1.0)))
            outcome.fell |= pushed.has_fallen
        outcome.reached[level] = plan.status is PlanStatus.ARRIVED and bool(goal.relative_error(pushed.pose) <= 1.0)
        outcome.pushes[level], outcome.time[level] = pushes, time
        outcome.ends.append(plan.status.name)
    return outcome
