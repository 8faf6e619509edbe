"""Where the object of a goal shall be: the pose of the goal, or one at an edge, chosen when a model is there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.physics.overhang import TableEdge
from push_ident.planning.edge_goal import EdgeGoal
from push_ident.planning.explore import push_on_table
from push_ident.planning.goal import Goal
from push_ident.planning.goal_ports import GoalPorts, KnownModel, UnderWay
from push_ident.planning.target import Target
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushPlan2D
from push_ident.types import Float64Array

__all__ = ["TargetChoice"]


class TargetChoice:
    """The target of one goal.

    At an edge it is chosen once, and again only after `forget`; what holds the object there is judged anew with each newer model.

    Args:
        goal: as requested.
        ports: of the cell.

    Attributes:
        target: None before it was chosen.
        tolerance: the tolerances of the goal, about any pose.
    """

    def __init__(self, goal: Goal | EdgeGoal, ports: GoalPorts) -> None:
        self._goal, self._ports = goal, ports
        self.target = Target(goal) if isinstance(goal, Goal) else None
        self.tolerance = goal if isinstance(goal, Goal) else Goal(np.zeros(3), goal.position, goal.turn)
        self._judged_by: ModelPosterior | None = None

    @property
    def is_at_edge(self) -> bool:
        """Whether the goal is at an edge."""
        return isinstance(self._goal, EdgeGoal)

    def edges(self) -> Sequence[TableEdge]:
        """The edge of the goal, else those of the table."""
        given = self._goal.edge if isinstance(self._goal, EdgeGoal) else None
        return self._ports.known_edges() if given is None else [given]

    def forget(self) -> None:
        """At an edge another place may be chosen."""
        if self.is_at_edge:
            self.target = None

    def begin(self, model: KnownModel, seen: TrackedObject) -> UnderWay[Target] | None:
        """Begin to choose or judge with a model; None where nothing is to be done. What comes of it is for `take`."""
        if not isinstance(self._goal, EdgeGoal) or (self.target is not None and self._judged_by is model.posterior):
            return None
        return self._ports.begin_target(model, seen, self._goal, self.edges(), self.target)

    def take(self, target: Target, model: KnownModel) -> None:
        """Keep what came of `begin` with the same model."""
        self.target, self._judged_by = target, model.posterior

    def random_push(self, seen: TrackedObject, seed: int) -> PushPlan2D | int:
        """An exploring push; its seed where the executor may choose it. Beside an edge it may not: it knows of none.

        Raises:
            PlanningError: no random push keeps the object on the table.
        """
        settings = self._ports.push_settings()
        if not self.is_at_edge or settings is None:
            return seed
        return push_on_table(seen.shape, seen.pose, seed, settings, self.edges(), self._ports.obstacles(seen.object_id))

    def is_off_table(self, outline: Float64Array, pose: Float64Array) -> bool:
        """Whether all of an outline, shape (n, 2), object frame, lies beyond the edge of the target at a pose, shape (3,)."""
        hold = None if self.target is None else self.target.hold
        return hold is not None and float(np.min(hold.edge.beyond(transform_points(pose, outline)))) > 0.0

    def overhangs(self, outline: Float64Array, poses: Iterable[Float64Array]) -> bool:
        """Whether an outline, shape (n, 2), object frame, overhangs the edge of the target at one of some poses, each of shape (3,)."""
        target = self.target
        return target is not None and any(target.overhang(transform_points(pose, outline)) > 0.0 for pose in poses)
