"""Settings of perception."""

from __future__ import annotations

from dataclasses import dataclass, field

from push_ident.errors import InputError
from push_ident.types import CameraAccuracy

__all__ = ["PerceptionSettings"]


@dataclass(frozen=True, slots=True)
class PerceptionSettings:
    """Settings of `Perception`. The defaults suit a depth camera about 1 m away and objects of 3 to 30 cm."""

    workspace_low: tuple[float, float] = (-0.4, -0.4)
    """Smallest x and y of the workspace [m], table frame."""
    workspace_high: tuple[float, float] = (0.4, 0.4)
    """Largest x and y of the workspace [m], table frame."""
    min_object_height: float = 0.003
    """Anything lower is table [m], as is anything lower than four times the noise of a height, which the table shows."""
    max_object_height: float = 0.5
    """Anything higher is robot, or what stands around the table [m]. Parts of the robot that are lower are known by its pose."""
    min_object_area: float = 4e-4
    """Anything smaller is ignored [m^2]."""
    min_step: float = 0.02
    """Surfaces that meet at a higher step are two objects [m]; steps within one object must be lower."""
    tool_reach: tuple[float, float] = (0.012, 0.092)
    """Heights of the tip and of the upper end of the tool above the table while it pushes [m]: what of an object it can touch."""
    mask_margin: float = 0.006
    """Added to the radius of the tool when it is masked [m]: delay, calibration and noise."""
    rest_frames: int = 10
    """Frames at rest before an object is registered; their median gives its shape."""
    rest_distance: float = 0.002
    """An object whose middle stays this near to its mean over the frames before, or within a pixel of it, is at rest [m]."""
    cell_count: int = 80
    """Approximate number of cells per object."""
    grid_resolution: float = 0.002
    """Edge of a cell of the occupancy grid of the workspace [m]."""
    occupancy_period: float = 1.0
    """Time between two occupancy grids, and between two checks of the table plane [s]."""
    search_period: float = 0.25
    """Time between two searches for new or lost objects once an object is known [s]; until then every frame is searched."""

    camera_accuracy: CameraAccuracy = field(default_factory=lambda: CameraAccuracy(position=2e-3, heading=5e-3))
    """Of the extrinsics: by default that of a calibration by hand, with a mark or a board. Perception does not use it; it is stated with
    the poses, which all have this error."""

    def __post_init__(self) -> None:
        if not (self.workspace_low[0] < self.workspace_high[0] and self.workspace_low[1] < self.workspace_high[1]):
            raise InputError(f"Workspace from {self.workspace_low} to {self.workspace_high} is empty; low must be below high.")
        if not 0 < self.min_object_height < self.max_object_height:
            raise InputError(f"Object heights {self.min_object_height} to {self.max_object_height} m; expected 0 < min < max.")
        if not 0 <= self.tool_reach[0] < self.tool_reach[1]:
            raise InputError(f"tool_reach is {self.tool_reach} m, expected the height of the tip and then that of the upper end.")
        if not self.min_step > 0:
            raise InputError(f"min_step is {self.min_step} m, expected a positive height; steps within one object must be lower.")
        if self.rest_frames < 1 or self.cell_count < 1:
            raise InputError(f"rest_frames {self.rest_frames} and cell_count {self.cell_count} must be at least 1.")
