"""A planar push, its limits, and the reasons for which one fails."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from push_ident.errors import InputError
from push_ident.types import Float64Array

PUSH_ACCELERATION = 2.0
"""Default acceleration of the tool at both ends of a push [m/s^2]."""


class PushCode(IntEnum):
    """How a push ended; the numbers are those of the result of action/ExecutePush, which calls success NONE: no error."""

    SUCCESS = 0
    NONE = SUCCESS
    UNKNOWN_OBJECT = -1
    INVALID_GOAL = -2
    UNREACHABLE = -3
    LIMIT = -4
    NO_CONTACT = -5
    ARM_SILENT = -6
    CANCELED = -7
    TRACKING = -8
    BUSY = -9
    OBJECT_LOST = -10
    FORCE = -11
    HAND = -12
    RECORDING = -13
    CORRECTION = -14


@dataclass(frozen=True, slots=True)
class PushSettings:
    """Limits of a planar push, and the ranges of random pushes."""

    workspace: tuple[float, float, float, float] = (-0.20, 0.15, -0.25, 0.25)
    """(x_min, x_max, y_min, y_max) of the axis of the lowered tool [m], table frame."""
    pusher_radius: float = 0.018
    """Radius of the cylinder that touches the object [m]."""
    clearance: float = 0.03
    """Travel of the pusher before contact [m]."""
    lowering_gap: float = 0.005
    """Least gap between the pusher and any object where the tool is lowered [m]."""
    distance_range: tuple[float, float] = (0.04, 0.10)
    """Travel after contact of random pushes [m]."""
    speed_range: tuple[float, float] = (0.1, 0.2)
    """Speed of random pushes [m/s]."""
    cone: float = np.pi / 4
    """Random directions lie within this angle of the inward normal [rad]."""
    max_distance: float = 0.25
    """Longest travel after contact that a goal may request [m]."""
    max_speed: float = 0.25
    """Highest speed that a goal may request [m/s]."""
    edge_margin: float = 0.03
    """An object whose outline comes nearer to the edge of the workspace than this is pushed back to the middle [m]."""
    n_draws: int = 1000
    """Random pushes that are tried."""
    max_angle: float = float(np.radians(80.0))
    """Largest angle between a push and the inward normal [rad]: a flatter pusher slides along the outline."""
    n_recentring_contacts: int = 120
    """Contacts along the outline that are tried for a push back to the middle."""
    max_recentring_angle: float = float(np.radians(60.0))
    """Largest angle between a push back to the middle and the direction to the middle [rad]."""
    contact_rounding: float = 1e-4
    """Overlap with the outline that still counts as the planned contact [m]."""
    contact_tolerance: float = 5e-3
    """Distance of a tool from its planned contact [m]: error of a pose that was observed some frames after the one of the plan."""

    def __post_init__(self) -> None:
        x_min, x_max, y_min, y_max = self.workspace
        if not (x_min < x_max and y_min < y_max):
            raise InputError(f"workspace is {self.workspace}, expected x_min < x_max and y_min < y_max in metres.")
        for name in ("distance", "speed"):
            (low, high), largest = getattr(self, f"{name}_range"), getattr(self, f"max_{name}")
            if not 0 < low <= high <= largest:
                raise InputError(f"{name}_range is ({low}, {high}), expected 0 < low <= high <= max_{name} = {largest}.")
        if not 0 <= self.edge_margin < 0.5 * min(x_max - x_min, y_max - y_min):
            raise InputError(
                f"edge_margin is {self.edge_margin} m, expected 0 up to less than half the width of workspace = {self.workspace}."
            )
        if not 0 < self.lowering_gap < self.clearance:
            raise InputError(f"lowering_gap is {self.lowering_gap} m, expected more than 0 and less than clearance = {self.clearance} m.")

    @property
    def middle(self) -> Float64Array:
        """Middle of the workspace [m], shape (2,)."""
        x_min, x_max, y_min, y_max = self.workspace
        return np.array([0.5 * (x_min + x_max), 0.5 * (y_min + y_max)])

    def excess(self, points: Float64Array, margin: float = 0.0) -> float:
        """Largest distance of `points`, shape (n, 2) [m], out of the workspace shrunk by `margin` [m]; 0 when all are inside."""
        x_min, x_max, y_min, y_max = self.workspace
        low, high = np.array([x_min, y_min]) + margin, np.array([x_max, y_max]) - margin
        return float(np.max(np.maximum(low - points, points - high), initial=0.0))


@dataclass(frozen=True, slots=True)
class PushPlan2D:
    """A straight push, not yet checked against an arm. All in the table frame."""

    contact_point: Float64Array
    """First contact of the pusher with the outline [m], shape (2,)."""
    tool_at_contact: Float64Array
    """Axis of the pusher at that moment [m], shape (2,): one radius away along the outward normal."""
    direction: float
    """Heading of the push [rad]."""
    distance: float
    """Travel after contact [m]."""
    speed: float
    """[m/s]"""

    @property
    def heading(self) -> Float64Array:
        """Unit vector of the push, shape (2,)."""
        return np.array([np.cos(self.direction), np.sin(self.direction)])

    @property
    def tool_end(self) -> Float64Array:
        """Axis of the pusher at the end of the push [m], shape (2,)."""
        return self.tool_at_contact + self.distance * self.heading

    def tool_start(self, clearance: float) -> Float64Array:
        """Axis of the pusher where the tool is lowered, `clearance` [m] before contact, shape (2,)."""
        return self.tool_at_contact - clearance * self.heading
