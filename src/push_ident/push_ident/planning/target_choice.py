"""Target of a goal: its pose, or one at an edge that is chosen when a model is known; exploring pushes that keep to the table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from push_ident.errors import PlanningError
from push_ident.geometry.se2 import transform_points
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.physics.overhang import TableEdge
from push_ident.planning.edge_goal import EdgeGoal
from push_ident.planning.goal import Goal, Target
from push_ident.planning.goal_ports import GoalPorts, KnownModel, UnderWay
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.pushing.sampling import sample_push
from push_ident.types import Float64Array, ObjectShape


def push_on_table(
    shape: ObjectShape,
    pose: Float64Array,
    seed: int,
    settings: PushSettings,
    edges: Sequence[TableEdge],
    obstacles: Sequence[Float64Array] = (),
    *,
    n_draws: int = 200,
    clearance: float = 0.01,
) -> PushPlan2D:
    """A random push after which the object, moved along all of it, is on the table; where it is not now, nearer to that.

    The outline may turn out over the edge; the centre of mass may not: no push moves it further than the tool goes.

    Args:
        shape: of the object.
        pose: of it, shape (3,), table frame.
        seed: of the push.
        settings: limits of pushes.
        edges: of the table.
        obstacles: outlines of other objects, table frame [m], each of shape (n_vertices, 2).
        n_draws: random pushes that are tried.
        clearance: least distance of the outline from the edge after the push [m]: it slides on by up to 2.5 mm, and poses have errors.

    Raises:
        PlanningError: UNREACHABLE where no such push is found.
    """
    outline, rng = transform_points(pose, shape.outline), np.random.default_rng(seed)
    # Where it overhangs already, the push must lead back by the clearance.
    allowed = [max(-clearance, float(np.max(edge.beyond(outline))) - clearance) for edge in edges]
    for _ in range(n_draws):
        push = sample_push(shape, pose, rng, settings, obstacles)
        after = outline + push.distance * push.heading
        if all(float(np.max(edge.beyond(after))) <= most for edge, most in zip(edges, allowed, strict=True)):
            return push
    raise PlanningError(PushCode.UNREACHABLE, f"none of {n_draws} random pushes keeps the object on the table; move it away from the edge.")


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
        """At an edge another pose may be chosen."""
        if self.is_at_edge:
            self.target = None

    def begin(self, model: KnownModel, observed: TrackedObject) -> UnderWay[Target] | None:
        """Begin to choose or judge with a model; None if that is not needed. The result is for `take`."""
        if not isinstance(self._goal, EdgeGoal) or (self.target is not None and self._judged_by is model.posterior):
            return None
        return self._ports.begin_target(model, observed, self._goal, self.edges(), self.target)

    def take(self, target: Target, model: KnownModel) -> None:
        """Keep what came of `begin` with the same model."""
        self.target, self._judged_by = target, model.posterior

    def random_push(self, observed: TrackedObject, seed: int) -> PushPlan2D | int:
        """An exploring push; its seed where the executor may choose it. Beside an edge it may not: it knows of none.

        Raises:
            PlanningError: no random push keeps the object on the table.
        """
        settings = self._ports.push_settings()
        if not self.is_at_edge or settings is None:
            return seed
        return push_on_table(observed.shape, observed.pose, seed, settings, self.edges(), self._ports.obstacles(observed.object_id))

    def is_off_table(self, outline: Float64Array, pose: Float64Array) -> bool:
        """Whether all of an outline, shape (n, 2), object frame, lies beyond the edge of the target at a pose, shape (3,)."""
        hold = None if self.target is None else self.target.hold
        return hold is not None and float(np.min(hold.edge.beyond(transform_points(pose, outline)))) > 0.0

    def overhangs(self, outline: Float64Array, poses: Iterable[Float64Array]) -> bool:
        """Whether an outline, shape (n, 2), object frame, overhangs the edge of the target at one of some poses, each of shape (3,)."""
        target = self.target
        return target is not None and any(target.overhang(transform_points(pose, outline)) > 0.0 for pose in poses)
