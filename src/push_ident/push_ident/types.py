"""The types that the stages of the package exchange.

They are immutable, arrays included. Lengths in metres, angles in radians, masses in kilograms, times in seconds. Frames are named:
`table` (z up, origin in the middle of the workspace) and `object` (fixed in the object, z up). A planar pose is
(x, y, yaw) of the object frame in the table frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from push_ident.errors import InputError

Float64Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def short_repr(owner: Any) -> str:
    """`repr` of a dataclass on one line: of arrays the shape, of more than three items their number, of other results the name."""

    def text(value: Any) -> str:
        if isinstance(value, np.ndarray):
            return f"array{list(value.shape)}"
        if isinstance(value, tuple | list | dict) and (len(value) > 3 or any(hasattr(v, "__dataclass_fields__") for v in value)):
            return f"<{len(value)}>"
        if isinstance(value, Enum):
            return value.name
        if hasattr(value, "__dataclass_fields__"):
            return f"{type(value).__name__}(...)"
        return f"{value:.4g}" if isinstance(value, float) else repr(value)

    shown = ", ".join(f"{field.name}={text(getattr(owner, field.name))}" for field in fields(owner) if field.repr)
    return f"{type(owner).__name__}({shown})"


def _freeze(owner: Any, name: str, shape: tuple[int | str, ...], sizes: dict[str, int]) -> None:
    """Store field `name` of a frozen dataclass as a read-only float64 array, checking its shape and that it is finite.

    Letters in `shape` are sizes that must agree between the fields of one dataclass.
    """
    try:
        array = np.array(getattr(owner, name), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{type(owner).__name__}.{name} is not an array of numbers: {error}") from None
    expected = tuple(sizes.get(n, n) if isinstance(n, str) else n for n in shape)
    if array.ndim != len(expected) or any(isinstance(n, int) and n != got for n, got in zip(expected, array.shape, strict=True)):
        raise InputError(f"{type(owner).__name__}.{name} has shape {array.shape}, expected {expected}.")
    for n, got in zip(shape, array.shape, strict=True):
        if isinstance(n, str):
            sizes[n] = got
    if not np.all(np.isfinite(array)):
        raise InputError(f"{type(owner).__name__}.{name} holds {int(np.sum(~np.isfinite(array)))} values that are not finite.")
    array.setflags(write=False)
    object.__setattr__(owner, name, array)


def _check_increasing(owner: Any, name: str) -> None:
    time = getattr(owner, name)
    if np.any(np.diff(time) <= 0):
        raise InputError(f"{type(owner).__name__}.{name} must increase strictly; sort and drop repeated stamps first.")


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """Pinhole camera without distortion; pixel (u, v) has its centre at integer coordinates (as CameraInfo.k)."""

    width: int
    height: int
    fx: float
    """Focal length [px]."""
    fy: float
    cx: float
    """Principal point [px]."""
    cy: float


@dataclass(frozen=True, slots=True)
class DepthFrame:
    """One depth image, already converted to metres."""

    __repr__ = short_repr

    stamp: float
    """[s]"""
    depth: NDArray[np.float32]
    """Depth along the optical axis [m], shape (height, width); NaN where nothing was measured."""
    intrinsics: CameraIntrinsics
    frame_id: str = "camera_depth_optical_frame"
    unit: float = 1.0
    """Length that a unit of the image was taken for [m]: 0.001 where it came in millimetres."""


@dataclass(frozen=True, slots=True)
class CellGrid:
    """The cells into which an object is divided: squares of one lattice, those at the edge cut at the outline."""

    __repr__ = short_repr

    centres: Float64Array
    """Centroids of the cells [m], shape (n_cells, 2), object frame."""
    size: float
    """Edge of a square [m]."""
    squares: Float64Array = field(default_factory=lambda: np.empty((0, 2)))
    """Centres of the squares [m], shape (n_cells, 2), object frame; left out: `centres`, of cells that are whole squares."""
    areas: Float64Array = field(default_factory=lambda: np.empty(0))
    """[m^2], shape (n_cells,); left out: whole squares."""

    def __post_init__(self) -> None:
        sizes: dict[str, int] = {}
        _freeze(self, "centres", ("n_cells", 2), sizes)
        if len(self.centres) == 0:
            raise InputError("CellGrid.centres is empty; an object needs at least one cell.")
        if not (np.isfinite(self.size) and self.size > 0):
            raise InputError(f"CellGrid.size is {self.size}, expected a positive length in metres.")
        if len(self.areas) == 0:
            object.__setattr__(self, "squares", self.centres)
            object.__setattr__(self, "areas", np.full(len(self.centres), float(self.size) * float(self.size)))
        _freeze(self, "squares", ("n_cells", 2), sizes)
        _freeze(self, "areas", ("n_cells",), sizes)
        if np.any(self.areas <= 0):
            raise InputError(f"CellGrid.areas has {int(np.sum(self.areas <= 0))} cells that are not > 0 m^2.")

    @property
    def parts(self) -> Float64Array:
        """Area of each cell over that of a square [-], shape (n_cells,)."""
        return np.asarray(self.areas / (float(self.size) * float(self.size)))

    @property
    def middle(self) -> Float64Array:
        """Centroid of the area of all cells [m], shape (2,)."""
        parts = self.parts
        return np.asarray(np.mean(parts[:, None] * self.centres, axis=0) / np.mean(parts))

    def __len__(self) -> int:
        return len(self.centres)


@dataclass(frozen=True, slots=True)
class ObjectShape:
    """Geometry of an object: its cells and its contact outline."""

    __repr__ = short_repr

    cells: CellGrid
    outline: Float64Array
    """Simple polygon, counter-clockwise, not closed [m], shape (n_vertices, 2), object frame."""
    outline_std: Float64Array | None = None
    """Standard deviation of the place of each edge along its normal [m], shape (n_vertices,), of the edge from each vertex to the next,
    where a camera traced the outline; None for one that is exact."""

    def __post_init__(self) -> None:
        sizes: dict[str, int] = {}
        _freeze(self, "outline", ("n_vertices", 2), sizes)
        if self.outline_std is not None:
            _freeze(self, "outline_std", ("n_vertices",), sizes)
            if np.any(self.outline_std <= 0):
                raise InputError("ObjectShape.outline_std must be positive; leave it out for an outline that is exact.")
        if len(self.outline) < 3:
            raise InputError(f"ObjectShape.outline has {len(self.outline)} points, expected at least 3.")
        x, y = self.outline.T
        area = 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
        if abs(area) < 1e-12 * float(np.ptp(x) + np.ptp(y)) ** 2 or area == 0.0:
            raise InputError(f"ObjectShape.outline encloses {area:.2g} m^2, expected an area; its points lie on one line or cross over.")
        if area < 0:
            flipped = self.outline[::-1].copy()
            flipped.setflags(write=False)
            object.__setattr__(self, "outline", flipped)
            if self.outline_std is not None:
                # The edge that began at a vertex now ends there.
                flipped = np.roll(self.outline_std[::-1], -1)
                flipped.setflags(write=False)
                object.__setattr__(self, "outline_std", flipped)

    @property
    def outline_error(self) -> float | None:
        """Root mean square of `outline_std` along the outline [m]; None for an outline that is exact."""
        if self.outline_std is None:
            return None
        length = np.linalg.norm(np.roll(self.outline, -1, axis=0) - self.outline, axis=1)
        return float(np.sqrt(np.average(self.outline_std**2, weights=length)))

    def is_same_object(self, other: ObjectShape) -> bool:
        """Whether both are views of one object: the same cells, at the same places to within half a cell."""
        if len(self.cells) != len(other.cells) or not np.isclose(self.cells.size, other.cells.size, rtol=1e-6):
            return False
        distance = np.abs(self.cells.centres - other.cells.centres)
        return bool(np.max(distance) < 0.5 * self.cells.size)


@dataclass(frozen=True, slots=True)
class CameraAccuracy:
    """Standard deviations of where a camera stands over the table, as far as its plane does not show it.

    All poses that the camera measures have this one error: they are those of the object in the table, displaced and turned together.

    Raises:
        InputError: One is negative or not finite.
    """

    position: float = 0.0
    """Of the place at which the origin of the table frame is seen, along x and y [m]."""
    heading: float = 0.0
    """Of the rotation about the normal of the table [rad]."""

    def __post_init__(self) -> None:
        for name, value, unit in (("position", self.position, "m"), ("heading", self.heading, "rad")):
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"The {name} of the camera is known to {value} {unit}, expected a standard deviation of 0 or more.")


@dataclass(frozen=True, slots=True)
class PoseTrack:
    """Observed poses of one object during one push."""

    __repr__ = short_repr

    time: Float64Array
    """[s], shape (n_frames,), strictly increasing."""
    pose: Float64Array
    """(x, y, yaw) [m, m, rad], shape (n_frames, 3), table frame, yaw unwrapped."""
    covariance: Float64Array
    """Covariance of (x, y, yaw), shape (n_frames, 3, 3), table frame; without the error of `camera`."""
    camera: CameraAccuracy = field(default_factory=CameraAccuracy)
    """Of the camera that measured them."""

    def __post_init__(self) -> None:
        sizes: dict[str, int] = {}
        _freeze(self, "time", ("n_frames",), sizes)
        _freeze(self, "pose", ("n_frames", 3), sizes)
        _freeze(self, "covariance", ("n_frames", 3, 3), sizes)
        _check_increasing(self, "time")
        if len(self.time) < 2:
            raise InputError(f"PoseTrack has {len(self.time)} frames, expected at least the two end poses of a push.")
        unwrapped = self.pose.copy()
        unwrapped[:, 2] = np.unwrap(unwrapped[:, 2])
        unwrapped.setflags(write=False)
        object.__setattr__(self, "pose", unwrapped)
        if np.any(np.linalg.eigvalsh(self.covariance)[:, 0] <= 0):
            raise InputError("PoseTrack.covariance must be positive definite; a pose is never known exactly.")


@dataclass(frozen=True, slots=True)
class PusherShape:
    """Outline of the tool that pushes: an upright cylinder, a prism, a plate with round ends, or two round fingers on one frame."""

    __repr__ = short_repr

    radius: float
    """Radius of a cylinder or of each finger, or of the rounding of a polygon [m]; 0: a point, or a polygon with sharp corners."""
    polygon: Float64Array | None = None
    """Convex, counter-clockwise, not closed [m], shape (n_corners, 2), pusher's frame; of two corners a plate, which its `radius` makes
    thick and round at its ends. None for a cylinder, and for fingers."""
    fingers: Float64Array | None = None
    """Axes of two round fingers, held at a fixed distance [m], shape (2, 2), pusher's frame; None for a pusher in one piece."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.radius) and self.radius >= 0):
            raise InputError(f"PusherShape.radius is {self.radius}, expected a length >= 0 in metres.")
        if self.fingers is not None:
            self._check_fingers()
        if self.polygon is not None:
            _freeze(self, "polygon", ("n_corners", 2), {})
            if len(self.polygon) == 2 and self.radius > 0 and np.any(self.polygon[0] != self.polygon[1]):
                return
            edge = np.roll(self.polygon, -1, axis=0) - self.polygon
            following = np.roll(edge, -1, axis=0)
            # A polygon that winds around more than once turns left at every corner too.
            turn = np.arctan2(edge[:, 0] * following[:, 1] - edge[:, 1] * following[:, 0], np.sum(edge * following, axis=1))
            if len(self.polygon) < 3 or np.any(turn <= 0) or abs(np.sum(turn) - 2 * np.pi) > 1e-6:
                raise InputError(
                    f"PusherShape.polygon with {len(self.polygon)} corners is not strictly convex and counter-clockwise; take the corners "
                    "of its convex hull in that order, each once, or the two ends of a plate that has a radius."
                )

    def _check_fingers(self) -> None:
        _freeze(self, "fingers", (2, 2), {})
        assert self.fingers is not None
        if self.polygon is not None:
            raise InputError("PusherShape has both fingers and a polygon, expected one of them; fingers are round.")
        apart = float(np.linalg.norm(self.fingers[1] - self.fingers[0]))
        if not apart > 2.0 * self.radius > 0.0:
            raise InputError(
                f"PusherShape.fingers are {apart:.4g} m apart, expected more than their diameter of {2 * self.radius:.4g} m, which is "
                "above 0; of fingers that touch each other, give the polygon around them."
            )

    @property
    def is_cylinder(self) -> bool:
        """Whether it is one upright cylinder, which has no heading."""
        return self.polygon is None and self.fingers is None

    @property
    def core(self) -> Float64Array:
        """Points that `radius` makes thick [m], shape (n, 2), pusher's frame: each for itself where there are fingers, else their hull."""
        if self.fingers is not None:
            return self.fingers
        return np.zeros((1, 2)) if self.polygon is None else self.polygon

    @property
    def reach(self) -> float:
        """Distance of the furthest point of the pusher from its origin [m]."""
        return float(np.max(np.linalg.norm(self.core, axis=1))) + self.radius


@dataclass(frozen=True, slots=True)
class PusherPath:
    """Path of the pusher during one push."""

    __repr__ = short_repr

    time: Float64Array
    """[s], shape (n_samples,), strictly increasing."""
    position: Float64Array
    """Origin of the pusher's frame [m], shape (n_samples, 2), table frame; of a cylinder its axis."""
    radius: float
    """As `PusherShape.radius` [m]."""
    polygon: Float64Array | None = None
    """As `PusherShape.polygon` [m], shape (n_corners, 2), pusher's frame."""
    yaw: Float64Array | None = None
    """Yaw of the pusher's frame in the table frame [rad], shape (n_samples,), not wrapped; None for a pusher that does not turn."""
    fingers: Float64Array | None = None
    """As `PusherShape.fingers` [m], shape (2, 2), pusher's frame."""

    def __post_init__(self) -> None:
        sizes: dict[str, int] = {}
        _freeze(self, "time", ("n_samples",), sizes)
        _freeze(self, "position", ("n_samples", 2), sizes)
        if self.yaw is not None:
            _freeze(self, "yaw", ("n_samples",), sizes)
        _check_increasing(self, "time")
        if len(self.time) < 2:
            raise InputError(f"PusherPath has {len(self.time)} samples, expected at least 2.")
        shape = self.shape
        object.__setattr__(self, "polygon", shape.polygon)
        object.__setattr__(self, "fingers", shape.fingers)

    @property
    def shape(self) -> PusherShape:
        """Outline of the pusher."""
        return PusherShape(self.radius, self.polygon, self.fingers)


@dataclass(frozen=True, slots=True)
class WrenchTrack:
    """Measured force of the pusher on the object during one push."""

    __repr__ = short_repr

    time: Float64Array
    """[s], shape (n_samples,), strictly increasing."""
    force: Float64Array
    """[N], shape (n_samples, 2), table frame."""

    def __post_init__(self) -> None:
        sizes: dict[str, int] = {}
        _freeze(self, "time", ("n_samples",), sizes)
        _freeze(self, "force", ("n_samples", 2), sizes)
        _check_increasing(self, "time")


@dataclass(frozen=True, slots=True)
class PushRecord:
    """One observed push of one object, the same for a real arm, the simulated cell and a bag."""

    __repr__ = short_repr

    object_id: str
    shape: ObjectShape
    poses: PoseTrack
    """Poses of all frames, or only the two end poses."""
    pusher: PusherPath
    wrench: WrenchTrack | None = None
    source: str = ""
    """Bag and number of the push, for messages and reports."""
    order: int = 0
    """Number of earlier pushes of the object."""


@dataclass(frozen=True, slots=True)
class ObjectModel:
    """Mechanical model of one object: the maps and the friction of the pusher on it."""

    __repr__ = short_repr

    shape: ObjectShape
    mass: Float64Array
    """Cell mass [kg], shape (n_cells,), all > 0."""
    friction: Float64Array
    """Support friction coefficient of each cell [-], shape (n_cells,), all >= 0."""
    pusher_friction: float
    """[-], >= 0."""

    def __post_init__(self) -> None:
        sizes = {"n_cells": len(self.shape.cells)}
        _freeze(self, "mass", ("n_cells",), sizes)
        _freeze(self, "friction", ("n_cells",), sizes)
        if np.any(self.mass <= 0):
            raise InputError(f"ObjectModel.mass has {int(np.sum(self.mass <= 0))} cells that are not > 0 kg.")
        if np.any(self.friction < 0):
            raise InputError(f"ObjectModel.friction has {int(np.sum(self.friction < 0))} cells below 0.")
        if not (np.isfinite(self.pusher_friction) and self.pusher_friction >= 0):
            raise InputError(f"ObjectModel.pusher_friction is {self.pusher_friction}, expected a number >= 0.")

    @property
    def total_mass(self) -> float:
        """Mass of the object [kg]."""
        return float(np.sum(self.mass))

    @property
    def centre_of_friction(self) -> Float64Array:
        """Centre of the support friction forces in pure translation [m], shape (2,), object frame."""
        load = self.mass * self.friction
        total = float(np.sum(load))
        return load @ self.shape.cells.centres / total if total > 0 else self.shape.cells.centres.mean(axis=0)


class SolveStatus(Enum):
    """Outcome of a solve; the value says what to do about it."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "not converged within the iterations allowed; allow more, or start from a nearer model"
    BUDGET_SPENT = "stopped when the budget was spent, at the best point so far; allow more simulations or seconds"
    OUT_OF_REACH = "stopped early: the cost from which the result would matter is out of reach"
    STALLED = "stopped at the best point so far, from which no step lowered the cost; the pushes may contradict each other"
    POOR_FIT = "the fit is far worse than the noise: the pushes contradict each other or the model; look at their poses, or diagnose"
    SIMULATION_FAILED = "the simulation did not converge for this model; check masses, outline and pusher path"
    UNEXPLAINED = "the fit does not explain its own training pushes; check outline, pusher radius, frames, units and clocks"
    NO_CONTACT = "no push touches the object; nothing can be learned from these pushes"

    @property
    def is_failure(self) -> bool:
        """Whether there is no result: the estimate is the prior."""
        return self in (SolveStatus.SIMULATION_FAILED, SolveStatus.UNEXPLAINED, SolveStatus.NO_CONTACT)
