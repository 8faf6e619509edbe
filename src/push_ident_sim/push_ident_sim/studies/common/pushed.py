"""One object that is pushed in Bullet from one goal to the next, as a camera sees it, and what a model of one kind says of it."""

from __future__ import annotations

from collections.abc import Callable

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
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import SimObject
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, observe_motion, path_of_plan, true_model

__all__ = ["GREEDY", "IDENTIFIED", "KINDS", "REST", "TABLE", "TRUTH", "UNIFORM", "PushedObject"]

KINDS = UNIFORM, IDENTIFIED, TRUTH, GREEDY = ("uniform", "identified", "truth", "greedy")
"""What is known: nothing (equal cells, nothing learned), what pushes have shown, everything. `greedy`: what pushes have shown, by a planner
that looks one push ahead."""
TABLE = np.array([0.8, 0.7])
"""Half the sides of the table [m]."""
_EXPLORING = 3
"""Random pushes before the first goal."""
_MOST_EXPLORING = 6
"""Random pushes of one object."""
_LEARNED = 10
"""Pushes that identification learns from, at most: later ones add little to what is known."""
_LASTING = np.array([7e-4, 7e-4, 6e-3])
"""Standard deviation of the errors of a pose at rest that no further frame lessens [m, m, rad]: perception in the simulated cell
(`CameraPolicy.floor_position`, `floor_yaw`)."""
REST = 0.4
"""Before and after each push [s]."""
_LONGEST_REST = 1.0
"""For which the tool stands after a steered push [s]."""
_LONGEST_LEARNED = 5.0
"""Of a steered push [s]: longer ones take long to learn from."""


class PushedObject:
    """An object in Bullet, observed by a camera, and what a model of one kind says of it.

    Args:
        thing: the true one.
        kind: one of `KINDS`.
        rng: of exploring pushes and of noise.
        rigid: one body that may tilt and fall, instead of cells that each rest on their own weight.
        pushes: limits of the pushes; by default those of the paper's experiments.
        effects: of the world, on motion and tool. Who knows everything knows them.
        exploring: random pushes before the first goal.
        names_effects: gives the names of effects that are fitted with the maps, from the exploring pushes; by default none are.
    """

    def __init__(
        self,
        thing: SimObject,
        kind: str,
        rng: np.random.Generator,
        *,
        rigid: bool = False,
        pushes: PushSettings | None = None,
        effects: InjectedEffects | None = None,
        exploring: int = _EXPLORING,
        names_effects: Callable[[list[PushRecord]], tuple[str, ...]] | None = None,
    ) -> None:
        self._truth_settings, self._noise, self._rng, self._kind = TruthSettings(), CameraNoise(), rng, kind
        self.settings = pushes or self._truth_settings.pushes
        self._world = PushWorld(thing, self.settings.pusher_radius, time_step=self._truth_settings.time_step, effects=effects, rigid=rigid)
        self.truth = true_model(thing)
        self.centre: Float64Array = self.truth.mass @ self.truth.shape.cells.centres / self.truth.total_mass
        """True centre of mass [m], shape (2,), object frame."""
        self.pose: Float64Array = np.zeros(3)
        """The true one, shape (3,)."""
        self._records: list[PushRecord] = []
        self._steered: list[tuple[Float64Array, Float64Array, Float64Array]] = []
        self._knocked, self._lasting = False, np.zeros(3)
        self.named: tuple[str, ...] = ()
        """Effects that are fitted with the maps."""
        acting = effects.as_dict() if effects else {}
        self.belief = Belief.certain(self.truth, acting) if kind == TRUTH else Belief.of(prior_posterior(self.truth.shape))
        self.planner = GoalPlanner(self.truth.shape, self.settings, greedy=kind == GREEDY)
        if self._learns:
            for _ in range(exploring):
                # As on the paper's table, wherever later pushes may go.
                self._record(self._move(sample_push(self.truth.shape, self.pose, rng, self._truth_settings.pushes)))
            if names_effects is not None:
                self.named = names_effects(self._records)
            self._learn()
        self._explored = exploring

    @property
    def _learns(self) -> bool:
        return self._kind in (IDENTIFIED, GREEDY)

    def explore(self, pushes: PushSettings) -> TrueMotion | None:
        """Make one more random push, and learn from it; None where all that are allowed were made, or nothing is learned."""
        if not self._learns or self._explored >= _MOST_EXPLORING:
            return None
        self._explored += 1
        motion = self._move(sample_push(self.truth.shape, self.pose, self._rng, pushes))
        self._record(motion)
        self._learn()
        return motion

    def close(self) -> None:
        """Free the engine."""
        self._world.close()

    def observe(self) -> tuple[Float64Array, Float64Array]:
        """Pose as perceived at rest, shape (3,), and its covariance, shape (3, 3)."""
        n = int(REST * self._noise.rate)
        frame = np.array([self._noise.position_std, self._noise.position_std, self._noise.yaw_std])
        std = np.hypot(frame / np.sqrt(n), _LASTING)
        return self.pose + std * self._rng.normal(size=3), np.diag(std**2)

    def push(self, plan: PushPlan2D, edge: TableEdge | None = None) -> TrueMotion:
        """Make a push and learn from it; not where the object overhangs an edge, which identification knows nothing of."""
        motion = self._move(plan)
        outlines = transform_points(motion.pose[[0, -1]], self.truth.shape.outline)
        on_table = edge is None or bool(np.all(edge.beyond(outlines) <= 0.0))
        if self._learns and on_table and len(self._records) < _LEARNED:
            self._record(motion)
            self._learn()
        return motion

    def touch(self, tool: Float64Array) -> None:
        """Begin a push whose tool is steered while it moves, with its axis at `tool` [m], shape (2,)."""
        self._world.begin(self.pose, tool, pushes_done=len(self._records))
        self._steered = [(self.pose, tool, np.zeros(2))]
        self._knocked, self._lasting = False, _LASTING * self._rng.normal(size=3)

    @property
    def clock(self) -> float:
        """Since the steered push began [s]."""
        return (len(self._steered) - 1) * self._truth_settings.time_step

    def lead(self, time: Float64Array, tool: Float64Array, until: float) -> None:
        """Move the tool until a time [s]: its axis is at `tool` [m], shape (n, 2), at `time`, shape (n,), of the `clock`."""
        step = self._truth_settings.time_step
        for _ in range(round((until - self.clock) / step)):
            now = self.clock + step
            self._steered.append(self._world.advance(np.array([np.interp(now, time, column) for column in tool.T])))
        self.pose = self._steered[-1][0]

    def frame(self) -> tuple[Float64Array, Float64Array]:
        """Pose as one frame shows it while the object moves, shape (3,), and its covariance, shape (3, 3)."""
        frame = np.array([self._noise.position_std, self._noise.position_std, self._noise.yaw_std])
        return self.pose + self._lasting + frame * self._rng.normal(size=3), np.diag(frame**2 + _LASTING**2)

    def knock(self, pose: Float64Array) -> None:
        """Someone displaces the object to a pose, shape (3,), clear of the tool."""
        self._world.displace(pose)
        self.pose, self._knocked = np.array(pose), True

    def let_go(self) -> TrueMotion:
        """The tool stands until the object rests; what it did since `touch`. Learns from it, unless it was knocked or took too long."""
        tool, last = self._steered[-1][1], self.clock + _LONGEST_REST
        while not self._world.is_still() and self.clock < last:
            self._steered.append(self._world.advance(tool))
        pose, pusher, force = (np.array(column) for column in zip(*self._steered, strict=True))
        motion = TrueMotion(np.arange(len(pose)) * np.float64(self._truth_settings.time_step), pose, pusher, pusher, force)
        self.pose = pose[-1]
        if self._learns and not self._knocked and self.clock < _LONGEST_LEARNED and len(self._records) < _LEARNED:
            self._record(motion)
            self._learn()
        return motion

    @staticmethod
    def duration(motion: TrueMotion) -> float:
        """Of a push with the rests before and after it [s]."""
        return float(motion.time[-1]) + 2 * REST

    @property
    def has_fallen(self) -> bool:
        """Whether the object tipped over an edge, or its centre of mass is beyond the table."""
        return self._world.has_fallen or bool(np.any(np.abs(transform_points(self.pose, self.centre[None])[0]) > TABLE))

    def _move(self, plan: PushPlan2D) -> TrueMotion:
        path = path_of_plan(plan, self._truth_settings)
        motion = self._world.push(self.pose, path, pushes_done=len(self._records))
        self.pose = motion.pose[-1]
        return motion

    def _record(self, motion: TrueMotion) -> None:
        observed = observe_motion(motion, self.settings.pusher_radius, self._noise, self._rng)
        self._records.append(PushRecord("o1", self.truth.shape, *observed))

    def _learn(self) -> None:
        result = identify(self._records, effects=self.named)
        if not result.status.is_failure:
            self.belief = Belief.of(result.posterior)
