"""Planning of pushes along paths in threads of their own."""

from __future__ import annotations

import threading
from typing import Final

import numpy as np

from push_ident.identification.results.posterior import ModelPosterior
from push_ident.nodes.goal_pushing.planner_thread import WorkUnderWay
from push_ident.planning.belief import Belief
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_steps import PathStep, PathSteps
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.types import Float64Array

__all__ = ["PathPlanners"]

_KEPT: Final = 2
"""Objects whose planner is kept: each holds a library of some 3 MB."""


class PathPlanners:
    """The planners of all objects, one plan at a time."""

    def __init__(self) -> None:
        self._one_at_a_time = threading.Lock()
        self._planners: dict[str, tuple[Belief, PushSettings, float, PathSteps]] = {}

    def begin(
        self,
        posterior: ModelPosterior,
        settings: PushSettings,
        half_width: float,
        seen: TrackedObject,
        where: tuple[PathGoal, float],
        around: tuple[list[Float64Array], list[PushPlan2D]],
        steers: bool,
    ) -> WorkUnderWay[PathStep]:
        """Begin to plan the next push.

        Args:
            posterior: what is known of the object.
            settings: limits of the pushes.
            half_width: of the corridor of a steered push [m].
            seen: the object.
            where: the path, and the length of it that is behind [m].
            around: outlines of other objects, and pushes that failed.
            steers: whether the tool may be steered.
        """

        def work() -> PathStep:
            with self._one_at_a_time:
                belief, steps = self._planner(seen.object_id, posterior, settings, half_width)
                return steps.plan(belief, seen.pose, *where, *around, steers=steers)

        return WorkUnderWay(work)

    def _planner(self, object_id: str, posterior: ModelPosterior, settings: PushSettings, half_width: float) -> tuple[Belief, PathSteps]:
        known, shape = self._planners.pop(object_id, None), posterior.unknowns.shape
        if known is None or known[1:3] != (settings, half_width) or not np.array_equal(known[0].shape.outline, shape.outline):
            known = (Belief.of(posterior), settings, half_width, PathSteps(shape, settings, half_width))
        elif known[0].posterior is not posterior:
            known = (Belief.of(posterior), settings, half_width, known[3])
        self._planners[object_id] = known
        while len(self._planners) > _KEPT:
            del self._planners[next(iter(self._planners))]
        return known[0], known[3]
