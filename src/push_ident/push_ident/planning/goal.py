"""Goals of pushing: a pose with tolerances, what holds the object there, and how pushing to it ends."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.se2 import wrap_angle
from push_ident.planning.hold import EdgeHold
from push_ident.types import Float64Array


class GoalCode(IntEnum):
    """How pushing to a goal ended; the numbers are those of the result of action/PushToGoal, which calls success NONE: no error."""

    SUCCESS = 0
    NONE = SUCCESS
    INVALID_GOAL = -1
    UNKNOWN_OBJECT = -2
    OUTSIDE_WORKSPACE = -3
    UNREACHABLE = -4
    TOLERANCE = -5
    NOTHING_KNOWN = -6
    OBJECT_LOST = -7
    PUSH_FAILED = -8
    ARM_SILENT = -9
    TIME_LIMIT = -10
    MAX_PUSHES = -11
    CANCELED = -12
    PREEMPTED = -13
    MODEL = -14
    EDGE_UNKNOWN = -15
    NOT_HELD = -16
    FELL = -17


class GoalRefusedError(InputError):
    """A goal that no push can reach; `code` is the `GoalCode`."""

    def __init__(self, code: GoalCode, text: str) -> None:
        super().__init__(text)
        self.code = code


CERTAIN: Final = 0.9
"""Chance of being at the goal from which the object counts as there [1]."""


@dataclass(frozen=True, slots=True)
class Goal:
    """A pose with tolerances.

    Raises:
        InputError: a pose that is not three finite numbers, or a tolerance that is not positive.
    """

    pose: Float64Array
    """Of the object frame in the table frame (x, y, yaw), shape (3,)."""
    position: float = 0.02
    """Largest distance of the object frame's origin from the goal [m]."""
    yaw: float = 0.1
    """Largest angle to the goal [rad]."""

    def __post_init__(self) -> None:
        pose = np.array(self.pose, dtype=np.float64)
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise InputError(f"The goal is {self.pose}, expected three finite numbers (x, y, yaw) in metres and radians.")
        for name, unit in (("position", "m"), ("yaw", "rad")):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"The tolerance of the {name} is {value}, expected a positive number [{unit}].")
        pose.setflags(write=False)
        object.__setattr__(self, "pose", pose)

    @property
    def tolerance(self) -> Float64Array:
        """(x, y, yaw) [m, m, rad], shape (3,)."""
        return np.array([self.position, self.position, self.yaw])

    def error(self, pose: Float64Array) -> Float64Array:
        """Distance [m] and angle [rad] of poses, shape (..., 3), from the goal, shape (..., 2)."""
        difference = np.asarray(pose) - self.pose
        return np.stack([np.linalg.norm(difference[..., :2], axis=-1), np.abs(wrap_angle(difference[..., 2]))], axis=-1)

    def relative_error(self, pose: Float64Array) -> Float64Array:
        """The larger of both errors of poses, shape (..., 3), in units of its tolerance; 1 and less is there. Shape (...)."""
        return np.asarray(np.max(self.error(pose) / [self.position, self.yaw], axis=-1))

    def chance(self, pose: Float64Array, covariance: Float64Array) -> float:
        """Probability of being there at a pose, shape (3,), known with a covariance, shape (3, 3)."""
        value, vector = np.linalg.eigh(covariance)
        root = vector * np.sqrt(np.maximum(value, 0.0))
        n = 2000  # the standard error of the chance is 1 % at most
        drawn = pose + np.random.default_rng(0).normal(size=(n, 3)) @ root.T
        return float(np.mean(self.relative_error(drawn) <= 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A pose with tolerances, and the edge that the object overhangs there."""

    goal: Goal
    hold: EdgeHold | None = None
    """None away from edges."""
    cells: Float64Array = field(default_factory=lambda: np.empty((0, 2)))
    """Centres of the object's cells [m], shape (n_cells, 2), object frame; with a hold only."""
    centres: Float64Array = field(default_factory=lambda: np.empty((0, 2)))
    """Of mass, by models that may be true [m], shape (n_models, 2), object frame; with a hold only."""

    def margin(self, pose: Float64Array) -> float:
        """Expected distance of the centre of mass from the border of its support at a pose, shape (3,) [m]; NaN without a hold."""
        if self.hold is None:
            return float("nan")
        return float(np.mean(self.hold.margins(self.cells, self.centres, np.tile(pose, (len(self.centres), 1)))))

    def overhang(self, outline: Float64Array) -> float:
        """How far an outline, shape (n, 2), table frame, reaches beyond the edge [m]; NaN without one."""
        return float("nan") if self.hold is None else float(np.max(self.hold.edge.beyond(outline)))

    def is_reached(self, pose: Float64Array, covariance: Float64Array) -> bool:
        """Whether the object is there, and held, at a pose, shape (3,), known with a covariance, shape (3, 3)."""
        if self.goal.chance(pose, covariance) < CERTAIN:
            return False
        return self.hold is None or self.hold.chance(self.cells, self.centres, pose, covariance) >= CERTAIN
