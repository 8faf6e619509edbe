"""Models of depth sensors that triangulate, and the table of the sensors that the simulated cell can have.

What a unit of a model (`sensor_unit.py`) does to a perfect view, in this order:

1. A pixel reads nothing where the projector or the second imager does not see its surface (shadow), where that imager's picture ends,
   out of range, and, with a probability, at grazing incidence and on dark surfaces.
2. At a depth edge the nearer surface is widened or narrowed, since the matcher compares windows and not pixels; the edge is ragged.
3. Some pixels of an edge read nothing, some a mix of both surfaces.
4. Depth gets noise, correlated over the window of the matcher, in part the same in every frame.
5. Disparity has whole steps, depth whole units.

Two further errors stand still: a radial distortion that the published intrinsics do not have, and the error of the extrinsics.

Sources, named by author below:

- Nguyen, Izadi & Lovell 2012, "Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking": axial noise
  0.0012 m + 0.0019 / m (z - 0.4 m)^2, beyond 60 degrees of incidence more by 0.0001 m^1.5 z^-1/2 theta^2 / (pi/2 - theta)^2; edges are
  displaced by 0.8 px (standard deviation); no measurement beyond about 80 degrees.
- Khoshelham & Oude Elberink 2012, "Accuracy and Resolution of Kinect Depth Data for Indoor Mapping Applications": baseline 75 mm,
  disparity in eighths of a pixel, range 0.5 m to 5 m.
- Konolige & Mihelich 2011, "Technical description of Kinect calibration" (ROS wiki): focal length of the infrared image 580 px, window of
  the correlation 9 px.
- Gschwandtner, Kwitt, Uhl & Pree 2011, "BlenSor": the same window, as simulated by others.
- Boehm 2012, "Natural user interface sensors for human body measurement": the Xtion has the same circuit as the Kinect, baseline 75 mm.
- Mallick, Das & Majumdar 2014, "Characterizations of Noise in Kinect Depth Images": kinds of holes: shadows, edges, grazing and dark
  surfaces.
- Intel RealSense D400 series datasheet: baselines 50 mm (D435) and 55 mm (D415), fields of view, depth computed for the left imager, so
  that the left edge of the image has no depth ("invalid depth band"); unit 1 mm.
- Grunnet-Jepsen, Sweetser & Woodfill, "Tuning depth cameras for best performance": root mean square of depth = subpixel z^2 / (f B);
  subpixel about 0.08 px of a well calibrated camera (the same author, librealsense issue 3904); 126 disparities, hence the nearest range.
- Grunnet-Jepsen et al., "Subpixel linearity improvement": disparity in 32nds of a pixel, field of view 90 degrees (D435), 65 (D415).
- Keselman, Woodfill, Grunnet-Jepsen & Bhowmik 2017, "Intel RealSense Stereoscopic Depth Cameras": window of 7 px.
- Photoneo, data of the PhoXi 3D Scanner M: range 0.458 m to 1.118 m, noise 0.1 mm. Its focal length is that of a calibration file of
  others (GQ-CNN: 552.5 px at a width of 516).

All other figures are estimates, marked as such.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Final

import cv2
import numpy as np

from push_ident.errors import InputError
from push_ident.types import CameraIntrinsics, Float64Array
from push_ident_sim.cell.camera import INTRINSICS, DepthImage, look_at

PLAIN: Final = "plain"
"""Name of the sensor without a model: `DepthNoise` at 600 px."""
_STEEP: Final = np.radians(60.0)
"""Incidence beyond which axial noise grows with the angle (Nguyen)."""
_STEEPEST: Final = np.radians(85.0)
"""The law of that growth is not used beyond; it has a pole at 90 degrees."""
_PLAIN_POSITION: Final = (0.55, 0.0, 0.85)
"""Of the plain sensor [m], `table` frame; suitable poses lie in its direction."""
_INSIDE: Final = (1.4, 0.85)
"""A suitable pose has the middle of the table between these multiples of the nearest and of the farthest depth: the workspace is deep."""


@dataclass(frozen=True, slots=True)
class AxialNoise:
    """Standard deviation of a depth z [m]: `constant` + `quadratic` (z - `origin`)^2, and more at grazing incidence."""

    constant: float = 0.0
    """[m]"""
    quadratic: float = 0.0
    """[1/m]"""
    origin: float = 0.0
    """[m]"""
    grazing: float = 0.0
    """Beyond 60 degrees of incidence theta: this [m^1.5] theta^2 / (pi/2 - theta)^2 / sqrt(z)."""

    @classmethod
    def of_disparity(cls, subpixel: float, focal: float, baseline: float) -> AxialNoise:
        """Noise of a disparity with the standard deviation `subpixel` [px]; focal length [px], baseline [m]."""
        return cls(quadratic=subpixel / (focal * baseline))

    def deviation(self, depth: DepthImage, cosine: DepthImage) -> DepthImage:
        """[m], same shape as `depth` [m] and the cosine of the incidence."""
        deviation = np.float32(self.constant) + np.float32(self.quadratic) * (depth - np.float32(self.origin)) ** 2
        if self.grazing > 0:
            angle = np.minimum(np.arccos(np.minimum(cosine, np.float32(1.0))), np.float32(_STEEPEST))
            more = np.float32(self.grazing) * (angle / (np.float32(np.pi / 2) - angle)) ** 2 / np.sqrt(depth)
            deviation = deviation + np.where(angle > _STEEP, more, np.float32(0.0))
        return np.asarray(deviation, dtype=np.float32)


@dataclass(frozen=True, slots=True)
class SensorModel:
    """A depth sensor that triangulates between its imager and a projector or a second imager. Without further values it has no error.

    The module's docstring has the order in which the errors act. Angles are those between ray and normal of the surface.
    """

    name: str
    intrinsics: CameraIntrinsics
    """That it publishes, and without the errors of lens and extrinsics those that it has."""
    baseline: float = 0.0
    """Distance to the projector or the second imager [m]; 0: nothing casts a shadow, and there are no disparities."""
    side: int = 1
    """On which side that is: 1 for +x of the optical frame (right in the image), -1 for -x. Shadows lie on the other side of a thing."""
    matching_focal: float | None = None
    """Focal length of the image in which disparities are found [px]; None: that of the intrinsics."""
    common_field: bool = False
    """Whether a second imager with the same field of view must see a surface: the edge of the image on its side then has no depth."""
    depth_range: tuple[float, float] = (0.0, np.inf)
    """Nearest and farthest depth [m]."""
    noise: AxialNoise = field(default_factory=AxialNoise)
    static_share: float = 0.0
    """Share of the variance of noise and of the raggedness of edges that is the same in every frame: the pattern stands still."""
    window: int = 1
    """Edge of the window of the matcher [px], over which noise is correlated; 1: pixels are independent."""
    fattening: float = 0.0
    """Mean displacement of a depth edge away from the nearer surface, in halves of the window; negative: the nearer surface erodes."""
    edge_jitter: float = 0.0
    """Standard deviation of that displacement [px]."""
    edge_dropout: float = 0.0
    """Share of the pixels at an edge that read nothing."""
    flying: float = 0.0
    """Share of the pixels at an edge that read a disparity between those of both surfaces."""
    grazing: tuple[float, float] = (np.pi / 2, np.pi / 2)
    """Angles of incidence from which the first pixels read nothing, and from which none reads [rad]; linear between."""
    signal: tuple[float, float] = (0.0, 0.0)
    """Signals below which no pixel reads, and above which all do [1/m^2]; linear between. A signal is albedo x cosine / depth^2."""
    disparity_step: float = 0.0
    """[px]; 0: none."""
    depth_unit: float = 1e-3
    """[m]"""
    distortion: float = 0.0
    """Coefficient of the radial distortion that the published intrinsics do not have [-], as of `DepthCamera`."""
    rotation_std: float = 0.0
    """Standard deviation of the error of the extrinsics, about each axis of the optical frame [rad]."""
    translation_std: float = 0.0
    """The same along each axis [m]."""

    def __post_init__(self) -> None:
        shares = ("static_share", "edge_dropout", "flying")
        if any(not 0.0 <= getattr(self, name) <= 1.0 for name in shares) or self.edge_dropout + self.flying > 1.0:
            raise InputError(f"Sensor {self.name}: {', '.join(shares)} must be shares, and those of an edge at most 1 together.")
        if self.side not in (-1, 1) or self.window < 1 or self.baseline < 0 or self.depth_unit <= 0:
            raise InputError(f"Sensor {self.name}: expected side 1 or -1, window >= 1, baseline >= 0 and depth_unit > 0.")
        if self.grazing[0] > self.grazing[1] or self.signal[0] > self.signal[1] or self.depth_range[0] >= self.depth_range[1]:
            raise InputError(f"Sensor {self.name}: expected the lower bounds of grazing, signal and depth_range first.")
        if self.disparity_step > 0 and self.baseline == 0:
            raise InputError(f"Sensor {self.name}: steps of disparity need a baseline.")

    @property
    def second(self) -> float:
        """x of the projector or the second imager in the optical frame [m]."""
        return self.side * self.baseline

    @property
    def halo(self) -> float:
        """Mean displacement of an edge [px], positive where the nearer surface grows."""
        return self.fattening * self.window / 2

    def extrinsics_error(self, seed: int) -> Float64Array:
        """True pose of the optical frame in the reported one, shape (4, 4), of the unit with this seed."""
        rng = np.random.default_rng([seed, zlib.crc32(self.name.encode()), 1])
        error = np.eye(4)
        error[:3, :3] = cv2.Rodrigues(self.rotation_std * rng.standard_normal(3))[0]
        error[:3, 3] = self.translation_std * rng.standard_normal(3)
        return error


def suitable_pose(name: str) -> Float64Array:
    """Pose in `table`, shape (4, 4), from which the sensor with this name sees the workspace as large as it can, within its range.

    Raises InputError: No sensor has that name.
    """
    check_name(name)
    position = np.array(_PLAIN_POSITION)
    if name in SENSORS:
        camera, (nearest, farthest) = SENSORS[name].intrinsics, SENSORS[name].depth_range
        # At the middle of the table the image shows 0.8 m from top to bottom: the workspace.
        distance = np.clip(2.0 * 0.4 * camera.fy / camera.height, _INSIDE[0] * nearest, _INSIDE[1] * farthest)
        position *= distance / np.linalg.norm(position)
    return look_at(position, (0.0, 0.0, 0.0))


def check_name(name: str) -> None:
    """Raise InputError where no sensor has that name."""
    if name not in SENSOR_NAMES:
        raise InputError(f"Sensor {name!r} is not known, expected one of {', '.join(SENSOR_NAMES)}.")


def _pinhole(width: int, height: int, focal: float) -> CameraIntrinsics:
    return CameraIntrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _residual(camera: CameraIntrinsics, pixels: float) -> float:
    """Coefficient of a radial distortion that displaces the corner of the image by so many pixels."""
    return float(pixels * camera.fx**2 / np.hypot(camera.cx, camera.cy) ** 3)


_ROTATION: Final = 1e-3
"""Error of extrinsics about each axis [rad]. An estimate: half a pixel between the ends of a board that fills the image."""
_TRANSLATION: Final = 1e-3
"""Error of extrinsics along each axis [m]. An estimate: that of a board measured by hand or by an arm."""


def _primesense(name: str, camera: CameraIntrinsics, depth_range: tuple[float, float]) -> SensorModel:
    """Kinect and Xtion: a fixed pattern of dots, matched with the picture of the infrared camera."""
    return SensorModel(
        name,
        camera,
        baseline=0.075,  # Khoshelham; Boehm
        side=1,  # the projector is on the right of the infrared camera, as the camera looks; shadows lie left
        matching_focal=580.0,  # Konolige
        depth_range=depth_range,
        noise=AxialNoise(0.0012, 0.0019, 0.4, grazing=0.0001),  # Nguyen
        static_share=0.5,  # estimate: pattern and camera stand still
        window=9,  # Konolige; Gschwandtner
        fattening=0.25,  # estimate: about 1 px
        edge_jitter=0.8,  # Nguyen
        edge_dropout=0.25,  # Mallick describes such holes; the share is an estimate
        grazing=(float(np.radians(75.0)), float(np.radians(85.0))),  # about the 80 degrees of Nguyen
        signal=(0.01, 0.03),  # all reads down to white (albedo 0.8) at the 5 m of Khoshelham; the lower bound is an estimate
        disparity_step=0.125,  # Khoshelham
        distortion=_residual(camera, 0.5),  # estimate
        rotation_std=_ROTATION,
        translation_std=_TRANSLATION,
    )


def _d400(name: str, camera: CameraIntrinsics, baseline: float) -> SensorModel:
    """RealSense D400: two imagers, a projector for texture only; depth is that of the left imager."""
    return SensorModel(
        name,
        camera,
        baseline=baseline,
        side=1,  # the datasheet: depth of the left imager
        common_field=True,  # the datasheet: invalid depth band
        depth_range=(camera.fx * baseline / 126.0, 10.0),  # Grunnet-Jepsen: 126 disparities; the datasheet: about 10 m
        noise=AxialNoise.of_disparity(0.08, camera.fx, baseline),  # Grunnet-Jepsen
        static_share=0.5,  # estimate: pattern and camera stand still
        window=7,  # Keselman
        fattening=0.25,  # estimate: about 1 px; edge-preserving matching (Keselman) widens less than half a window
        edge_jitter=1.0,  # estimate
        edge_dropout=0.2,  # estimate
        flying=0.3,  # estimate; the disparity is interpolated across edges
        grazing=(float(np.radians(70.0)), float(np.radians(85.0))),  # estimate
        signal=(0.002, 0.008),  # white (albedo 0.8) at 10 m; the lower bound is an estimate
        disparity_step=1.0 / 32.0,  # Grunnet-Jepsen et al.
        distortion=_residual(camera, 0.3),  # estimate: the residual of a calibration
        rotation_std=_ROTATION,
        translation_std=_TRANSLATION,
    )


def _phoxi() -> SensorModel:
    """PhoXi 3D Scanner M at half resolution. It takes a good quarter of a second for a scan: things must stand still."""
    camera = _pinhole(1032, 772, 1105.0)  # GQ-CNN
    return SensorModel(
        "phoxi",
        camera,
        baseline=0.27,  # estimate, from the length of its case of 416 mm
        side=1,  # estimate
        depth_range=(0.458, 1.118),  # Photoneo
        noise=AxialNoise(constant=1e-4),  # Photoneo
        edge_jitter=0.3,  # estimate: each pixel is decoded by itself
        edge_dropout=0.3,  # estimate: codes of both surfaces mix
        flying=0.05,  # estimate
        grazing=(float(np.radians(70.0)), float(np.radians(85.0))),  # estimate
        signal=(0.02, 0.06),  # estimate: black plastic (albedo 0.05) at 1 m has holes
        depth_unit=1e-4,  # as fine as its noise
        distortion=_residual(camera, 0.1),  # estimate
        rotation_std=0.3 * _ROTATION,  # estimate: its points are as good as those of the board
        translation_std=0.3 * _TRANSLATION,
    )


SENSORS: Final = {
    model.name: model
    for model in (
        SensorModel("ideal", INTRINSICS),
        _primesense("kinect_v1", _pinhole(640, 480, 525.0), (0.5, 5.0)),  # drivers of ROS publish 525 px for the registered image
        _primesense("xtion", _pinhole(640, 480, 577.0), (0.8, 3.5)),  # data sheet of Asus: 58 x 45 degrees, 0.8 m to 3.5 m
        # Focal lengths of D435 units, as users report them (librealsense issue 3314, realsense-ros issue 2788): 638, 424, 384 px.
        _d400("realsense_d435_640x480", _pinhole(640, 480, 384.0), 0.050),
        _d400("realsense_d435_848x480", _pinhole(848, 480, 424.0), 0.050),
        _d400("realsense_d435_1280x720", _pinhole(1280, 720, 640.0), 0.050),
        # Of the D415 from the fields of view in the datasheet: 65 degrees across 1280 and 848 pixels, 40 degrees along 480.
        _d400("realsense_d415_640x480", _pinhole(640, 480, 659.0), 0.055),
        _d400("realsense_d415_848x480", _pinhole(848, 480, 666.0), 0.055),
        _d400("realsense_d415_1280x720", _pinhole(1280, 720, 1005.0), 0.055),
        _phoxi(),
    )
}
"""All models, by name. `ideal` has no error but whole millimetres."""
SENSOR_NAMES: Final = (PLAIN, *SENSORS)
"""All names that a sensor can have."""
