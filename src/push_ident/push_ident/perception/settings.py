"""Settings of perception."""

from __future__ import annotations

from dataclasses import dataclass, field

from push_ident.errors import InputError
from push_ident.types import CameraAccuracy


@dataclass(frozen=True, slots=True)
class TableSettings:
    """What counts as the plane of the table."""

    search_height: float = 0.05
    """Points within this height of the expected plane are candidates for the table [m]."""
    max_tilt: float = 0.06
    """A larger correction of tilt means wrong extrinsics [rad]."""
    max_offset: float = 0.03
    """A larger correction of height means wrong extrinsics [m]."""
    min_share: float = 0.2
    """Fraction of the points in the workspace that must lie on the plane."""
    max_noise: float = 0.006
    """A larger deviation of the points from their plane is no flat table [m]: a Kinect has 5 mm at 1.8 m (Nguyen et al., 2012)."""
    under: float = 0.01
    """Points that are further below the plane lie under the table [m], unless noise is larger."""
    max_share_under: float = 0.1
    """Largest fraction of the points in the workspace that may lie under the table: more is a reflection, or a rim taken for the table."""
    calmer: float = 0.67
    """A table with less than this share of the noise that its plane was fitted with is less noisy [-]: by three deviations of a deviation
    that the median of 125 points gives, the least number of a plane."""
    moved: float = 0.0015
    """A table plane whose height differs by more at a corner of the workspace replaces the one in use [m]."""


@dataclass(frozen=True, slots=True)
class TrackingSettings:
    """When a fitted pose is accepted, and when a lost object is found again."""

    max_jump: tuple[float, float] = (0.02, 0.2)
    """Largest distance of a fitted pose from the predicted one [m, rad]: no pushed object moves further between two frames."""
    doubtful: float = 0.02
    """Where more of the pixels contradict a pose, it is checked in every frame whether a part is missing, else once in each search period:
    whole objects have 0.002 of the plain camera."""
    same_area: tuple[float, float] = (0.4, 1.6)
    """Range of the area of a segment that may be a lost object, relative to the area of that object."""
    min_pixels: int = 120
    """Least number of informative pixels in the narrow band."""
    min_share_visible: float = 0.25
    """Least fraction of the pixels in the narrow band that must be informative."""
    max_contradicting: float = 0.2
    """Largest fraction of the pixels away from the edge that may contradict the pose."""
    found_visible: float = 0.7
    """Least fraction of informative pixels in the narrow band where a lost object is found again."""
    found_contradicting: float = 0.08
    """Largest fraction of contradicting pixels where a lost object is found again."""
    min_deviation: tuple[float, float, float] = (6e-5, 6e-5, 3e-4)
    """Least standard deviations of a pose [m, m, rad]: errors of outline and calibration, which no residual shows."""
    max_deviation: tuple[float, float, float] = (0.01, 0.01, 0.2)
    """A pose with larger standard deviations is not used [m, m, rad]."""


@dataclass(frozen=True, slots=True)
class SegmentSettings:
    """When a segment is visible as a whole, and when its shape is accepted."""

    shadow: float = 0.05
    """Width up to which unmeasured pixels may surround an object [m]: the shadow that the projector or the second imager of a depth camera
    leaves is baseline * height / (distance - height), 5 cm for an object of 0.4 m seen from 1 m at a baseline of 75 mm."""
    unmeasured: float = 0.15
    """Largest fraction of the surrounding pixels beside which nothing is measured for further than that: half of one of four sides."""
    on_another: float = 0.6
    """Fraction of the surrounding pixels that show other things from which something stands on one of them: things beside it are on one
    side, in a corner on two of four."""
    same_area: float = 0.15
    """Largest relative difference of the areas of a segment at rest in two frames."""
    min_covered: float = 0.85
    """Least fraction of the points of a segment that its traced outline must cover. Of 65 right outlines of two kinds of camera the least
    is 0.90; of bottles, whose cap is traced, 0.67 and 0.78."""
    max_unseen: float = 0.06
    """Largest fraction of the inside of an outline's edge at which nothing was measured. Of 45 right outlines of two kinds of camera the
    largest is 0.03; of outlines with tips 0.17 and more."""
    must_fit: bool = True
    """Whether an object is taken in only if its outline holds what is seen of it, and a pose fit finds it where it was traced. False only
    to look at images whose focal length may be wrong: their walls do not fit any outline."""


@dataclass(frozen=True, slots=True)
class FurtherCameraSettings:
    """When the view of a further camera is used for the shape of an object."""

    time_margin: float = 0.05
    """Frames up to this long before or after the rest still belong to it, as the cameras are not synchronised [s]."""
    needed: float = 1 / 3
    """Frames needed during a rest, as a fraction of those of the main camera."""
    area: tuple[float, float] = (0.7, 1.4)
    """Range of the area of the segment, relative to that of the object."""
    max_shift: float = 0.005
    """A larger distance from the position that the main camera measured means wrong extrinsics [m]."""
    max_turn: float = 0.05
    """A larger difference of yaw means wrong extrinsics [rad]."""
    max_contradicting: float = 0.08
    """Largest fraction of the lines of sight away from the edge that may contradict the outline of the main camera."""
    max_growth: float = 0.0012
    """Largest difference of the radius of the object from that of the main camera [m]. With two exact cameras differences up to 0.75 mm
    were measured, from parts hidden from one of them; from 1.2 mm on the second camera made some outlines worse."""


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

    table: TableSettings = field(default_factory=TableSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    segments: SegmentSettings = field(default_factory=SegmentSettings)
    further_camera: FurtherCameraSettings = field(default_factory=FurtherCameraSettings)
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
