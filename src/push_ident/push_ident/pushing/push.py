"""A planar push, its limits, and the reasons for which one fails."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.se2 import transform_points
from push_ident.types import Float64Array, PusherShape

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
    """Radius of the cylinder that touches the object, or of each finger, or half the thickness of a plate [m]."""
    finger_distance: float = 0.0
    """Between the axes of two round fingers [m]; 0: a tool in one piece."""
    plate_length: float = 0.0
    """Between the middles of the round ends of a plate [m]; 0: no plate."""
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
        _ = self.tool
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
    def tool(self) -> PusherShape:
        """Outline of the pusher."""
        return tool_shape(self.pusher_radius, self.finger_distance, self.plate_length)

    @property
    def span(self) -> float:
        """Distance of both ends of a tool with two contacts [m]; 0 of a cylinder."""
        return max(self.finger_distance, self.plate_length)

    def ends(self, poses: Float64Array) -> Float64Array:
        """Axes of both ends of the tool [m] with its frame at poses, shape (n, 3): shape (n, 2, 2)."""
        return np.asarray(transform_points(poses, np.array([[0.0, 0.5 * self.span], [0.0, -0.5 * self.span]])))

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


def tool_shape(radius: float, finger_distance: float = 0.0, plate_length: float = 0.0) -> PusherShape:
    """Outline of a tool: a cylinder, two round fingers, or a plate with round ends; both ends on the y axis of its frame.

    Args:
        radius: of the cylinder or of each finger, or half the thickness of the plate [m].
        finger_distance: between the axes of the fingers [m]; 0: none.
        plate_length: between the middles of the round ends of the plate [m]; 0: none.

    Raises InputError: fingers and a plate at once, fingers that are no further apart than they are thick, or a length below 0.
    """
    for name, value, least in (("finger_distance", finger_distance, 2.0 * radius), ("plate_length", plate_length, 0.0)):
        if value != 0.0 and not (np.isfinite(value) and value > least):
            raise InputError(
                f"{name} is {value} m, expected more than {least:g} m, or 0 for a tool without"
                + (": fingers are thinner than their axes are apart; correct it or pusher_radius." if least else "; correct it.")
            )
    if finger_distance and plate_length:
        raise InputError(
            f"finger_distance is {finger_distance} m and plate_length {plate_length} m, expected one of them; take the other out."
        )
    ends = np.array([[0.0, 0.5], [0.0, -0.5]])
    if finger_distance:
        return PusherShape(radius, fingers=finger_distance * ends)
    return PusherShape(radius, polygon=plate_length * ends if plate_length else None)


def tool_sizes(shape: PusherShape) -> dict[str, Any]:
    """The arguments of `tool_shape`, by the names of the fields of `PushSettings`.

    Raises InputError for an outline that `tool_shape` does not make: a polygon of three corners, or ends that are not on the y axis.
    """
    core = shape.core
    is_on_axis = len(core) == 2 and np.allclose(core[:, 0], 0.0, atol=1e-6) and np.isclose(core[0, 1], -core[1, 1], atol=1e-6)
    if not (shape.is_cylinder or is_on_axis):
        raise InputError(
            f"The pusher has {len(core)} points at {np.round(core, 4).tolist()} m, expected a cylinder, or two on the y axis of its frame, "
            "equally far from x."
        )
    span = 0.0 if shape.is_cylinder else float(np.linalg.norm(core[1] - core[0]))
    lengths = {"finger_distance": 0.0, "plate_length": 0.0}
    if span:
        lengths["plate_length" if shape.fingers is None else "finger_distance"] = span
    return {"pusher_radius": shape.radius, **lengths}


@dataclass(frozen=True, slots=True)
class PushPlan2D:
    """A straight push, not yet checked against an arm. All in the table frame.

    A tool with two contacts pushes with one end, the other behind it: whatever is pushed by a straight edge or a corner touches that end
    only, as long as it is pushed at all. Where not stated, `tool` is the axis of this end.
    """

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

    def of_frame(self, span: float) -> PushPlan2D:
        """The same push with the axis in the middle between both ends of a tool, `span` [m] apart."""
        return replace(self, tool_at_contact=self.tool_at_contact - 0.5 * span * self.heading)

    def tool_start(self, clearance: float) -> Float64Array:
        """Axis of the pusher where the tool is lowered, `clearance` [m] before contact, shape (2,)."""
        return self.tool_at_contact - clearance * self.heading
