"""One object that is pushed in Bullet from one goal to the next, as a camera observes it, and what is known of it."""

from __future__ import annotations

from typing import Final

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.identification.identify import identify
from push_ident.identification.results.posterior import prior_posterior
from push_ident.physics.overhang import TableEdge
from push_ident.planning.belief import Belief
from push_ident.planning.planner import GoalPlanner
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.pushing.sampling import sample_push
from push_ident.types import Float64Array, PushRecord
from push_ident_sim.engines.bullet.push_world import PushWorld
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.objects import SimObject
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, observe_motion, path_of_plan, true_model

KINDS = UNIFORM, IDENTIFIED, TRUTH = ("uniform", "identified", "truth")
"""What is known of the mechanics: nothing (equal cells), what pushes have shown, everything."""
TABLE: Final = np.array([0.8, 0.7])
"""Half the sides of the table [m]."""
_EXPLORING: Final = 3
"""Random pushes before the first goal."""
SYSTEMATIC_STD: Final = np.array([7e-4, 7e-4, 6e-3])
"""Standard deviation of the errors of a pose at rest that no further frame lessens [m, m, rad]: perception in the simulated cell,
where it is worst."""
REST: Final = 0.4
"""Before and after each push [s]."""


class PushedObject:
    """An object in Bullet, observed by a camera, and what is known of it.

    `kind`: one of `KINDS`; `rng`: of exploring pushes and of noise; `rigid`: one body that may tilt and fall, instead of cells that each
    rest on their own weight; `pushes`: limits, by default those of the paper's experiments.
    """

    def __init__(
        self, sim_object: SimObject, kind: str, rng: np.random.Generator, *, rigid: bool = False, pushes: PushSettings | None = None
    ) -> None:
        self._truth_settings, self._noise, self._rng, self._kind = TruthSettings(), CameraNoise(), rng, kind
        self.settings = pushes or self._truth_settings.pushes
        self.world = PushWorld(sim_object, self.settings.pusher_radius, time_step=self._truth_settings.time_step, rigid=rigid)
        """In which it is pushed."""
        self._number = 0
        self.truth = true_model(sim_object)
        self.centre: Float64Array = self.truth.mass @ self.truth.shape.cells.centres / self.truth.total_mass
        """True centre of mass [m], shape (2,), object frame."""
        self.pose: Float64Array = np.zeros(3)
        """The true one, shape (3,)."""
        self._records: list[PushRecord] = []
        self._steered: list[tuple[Float64Array, Float64Array, Float64Array]] = []
        self._displaced, self._systematic = False, np.zeros(3)
        self.belief = Belief.certain(self.truth) if kind == TRUTH else Belief.of(prior_posterior(self.truth.shape))
        self.planner = GoalPlanner(self.truth.shape, self.settings)
        self._explored = _EXPLORING
        if kind == IDENTIFIED:
            for _ in range(_EXPLORING):
                # As on the paper's table, wherever later pushes may go.
                self._record(self._move(sample_push(self.truth.shape, self.pose, rng, self._truth_settings.pushes)))
            self._learn()

    def explore(self, pushes: PushSettings) -> TrueMotion | None:
        """Make one more random push, and learn from it; None where all that are allowed were made, or nothing is learned."""
        if self._kind != IDENTIFIED or self._explored >= 6:
            return None
        self._explored += 1
        motion = self._move(sample_push(self.truth.shape, self.pose, self._rng, pushes))
        self._record(motion)
        self._learn()
        return motion

    def enter(self, world: PushWorld, number: int) -> None:
        """Go on in another engine, in which it has a number; its own one is freed."""
        if world is not self.world:
            self.world.close()
        self.world, self._number = world, number
        self.pose = world.pose_of(number)

    def close(self) -> None:
        """Free the engine."""
        self.world.close()

    def observe(self) -> tuple[Float64Array, Float64Array]:
        """Pose as perceived at rest, shape (3,), and its covariance, shape (3, 3)."""
        std = np.hypot(self._frame_std / np.sqrt(int(REST * self._noise.rate)), SYSTEMATIC_STD)
        return self.pose + std * self._rng.normal(size=3), np.diag(std**2)

    def push(self, plan: PushPlan2D, edge: TableEdge | None = None) -> TrueMotion:
        """Make a push and learn from it; not where the object overhangs an edge, which identification knows nothing of."""
        motion = self._move(plan)
        outlines = transform_points(motion.pose[[0, -1]], self.truth.shape.outline)
        on_table = edge is None or bool(np.all(edge.beyond(outlines) <= 0.0))
        if on_table:
            self._record_and_learn(motion)
        return motion

    def touch(self, tool: Float64Array) -> None:
        """Begin a push whose tool is steered while it moves, with its axis at `tool` [m], shape (2,)."""
        self.world.begin(self.pose, tool, pushes_done=len(self._records))
        self._steered = [(self.pose, tool, np.zeros(2))]
        self._displaced, self._systematic = False, SYSTEMATIC_STD * self._rng.normal(size=3)

    @property
    def clock(self) -> float:
        """Since the steered push began [s]."""
        return (len(self._steered) - 1) * self._truth_settings.time_step

    def lead(self, time: Float64Array, tool: Float64Array, until: float) -> None:
        """Move the tool until a time [s]: its axis is at `tool` [m], shape (n, 2), at `time`, shape (n,), of the `clock`."""
        step = self._truth_settings.time_step
        for _ in range(round((until - self.clock) / step)):
            now = self.clock + step
            self._steered.append(self.world.advance(np.array([np.interp(now, time, column) for column in tool.T])))
        self.pose = self._steered[-1][0]

    def frame(self) -> tuple[Float64Array, Float64Array]:
        """Pose as one frame shows it while the object moves, shape (3,), and its covariance, shape (3, 3)."""
        noise = self._frame_std * self._rng.normal(size=3)
        return self.pose + self._systematic + noise, np.diag(self._frame_std**2 + SYSTEMATIC_STD**2)

    def displace(self, pose: Float64Array) -> None:
        """Someone displaces the object to a pose, shape (3,), clear of the tool."""
        self.world.displace(pose)
        self.pose, self._displaced = np.array(pose), True

    def let_go(self) -> TrueMotion:
        """The tool stands until the object rests; what it did since `touch`. Learns from it, unless it was displaced or took too long."""
        tool, last = self._steered[-1][1], self.clock + 1.0
        while not self.world.is_still() and self.clock < last:
            self._steered.append(self.world.advance(tool))
        pose, pusher, force = (np.array(column) for column in zip(*self._steered, strict=True))
        motion = TrueMotion(np.arange(len(pose)) * np.float64(self._truth_settings.time_step), pose, pusher, pusher, force)
        self.pose = pose[-1]
        if not self._displaced and self.clock < 5.0:  # longer ones take long to learn from
            self._record_and_learn(motion)
        return motion

    @staticmethod
    def duration(motion: TrueMotion) -> float:
        """Of a push with the rests before and after it [s]."""
        return float(motion.time[-1]) + 2 * REST

    @property
    def has_fallen(self) -> bool:
        """Whether the object tipped over an edge, or its centre of mass is beyond the table."""
        return self.world.has_fallen or bool(np.any(np.abs(transform_points(self.pose, self.centre[None])[0]) > TABLE))

    @property
    def _frame_std(self) -> Float64Array:
        """Of the noise of one frame [m, m, rad]."""
        return np.array([self._noise.position_std, self._noise.position_std, self._noise.yaw_std])

    def _move(self, plan: PushPlan2D) -> TrueMotion:
        self.world.turn_to(self._number)
        motion = self.world.push(self.pose, path_of_plan(plan, self._truth_settings), pushes_done=len(self._records))
        self.pose = motion.pose[-1]
        return motion

    def _record_and_learn(self, motion: TrueMotion) -> None:
        if self._kind == IDENTIFIED and len(self._records) < 10:  # later ones add little to what is known
            self._record(motion)
            self._learn()

    def _record(self, motion: TrueMotion) -> None:
        observed = observe_motion(motion, self.settings.pusher_radius, self._noise, self._rng)
        self._records.append(PushRecord("o1", self.truth.shape, *observed))

    def _learn(self) -> None:
        result = identify(self._records)
        if not result.status.is_failure:
            self.belief = Belief.of(result.posterior)
