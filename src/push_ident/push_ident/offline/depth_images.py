"""Depth frames from image files: 16-bit PNG, 32-bit TIFF, NumPy arrays, organised point clouds.

The images are rectified, as `depth/image_rect` is: lens distortion is not applied. The intrinsics come from the caller, from a file
`camera_info.yaml` beside the images, or from the points of a cloud, whose x/z and y/z are linear in the pixel coordinates.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from push_ident.errors import FrameError, InputError, PushIdentError
from push_ident.extras import need
from push_ident.files import read_regular
from push_ident.limits import LIMITS, plain_text
from push_ident.perception.frame.camera_info import CameraInfoFields
from push_ident.perception.frame.depth_image import check_intrinsics, check_size
from push_ident.types import CameraIntrinsics, DepthFrame

_CAMERA_INFO: Final = "camera_info.yaml"
"""File with the intrinsics beside the images, as `camera_calibration` of ROS writes it."""
_SUFFIXES: Final = (".png", ".tif", ".tiff", ".npy", ".pcd")
_PLAUSIBLE: Final = (0.05, 20.0)
"""Range of the median depth of an image of a table [m]: nearer than any depth camera measures, and farther."""


@dataclass(slots=True)
class DepthImages:
    """The depth images of one camera that never moved: a folder of them, in the order of their names, or one file."""

    source: Path
    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy [px]; None: from `camera_info.yaml`, or from the points."""
    unit: float | None = None
    """Metres per unit of an image; None: 0.001 for integers (REP 118), 1 for real numbers. Clouds are in metres."""
    skipped: list[str] = field(default_factory=list)
    """Files that were left out of the folder and why, one line each; filled while frames are read."""

    def frames(self) -> Iterator[DepthFrame]:
        """Frames one by one, 1/30 s apart; a file that is no depth image of this camera is skipped and noted.

        Raises:
            InputError: There is no such file or folder, none of its files is a depth image, or the intrinsics are missing.
            FrameError: The intrinsics belong to another camera, or to none.
        """
        self.skipped.clear()
        first: DepthFrame | None = None
        for path in self._files():
            try:
                frame = self._read(path, 0.0 if first is None else first.stamp)
                if first is not None and frame.intrinsics != first.intrinsics and path.suffix.lower() != ".pcd":
                    raise FrameError(f"{path.name} has other intrinsics or another size than the images before it; keep one camera.")
            except PushIdentError as error:
                if first is None and (self.source.is_file() or isinstance(error, _CameraError | _NoIntrinsicsError)):
                    raise
                self.skipped.append(str(error))
                continue
            first = replace(frame, stamp=0.0 if first is None else first.stamp + 1 / 30)
            yield first
        if first is None:
            why = f"the first: {self.skipped[0]}" if self.skipped else f"it has no {', '.join(_SUFFIXES)}"
            raise InputError(f"{self.source} has no depth image ({why}); give a folder of 16-bit PNG, 32-bit TIFF, .npy or PCD files.")

    def _files(self) -> list[Path]:
        if self.source.is_file():
            return [self.source]
        if not self.source.is_dir():
            raise InputError(f"{self.source} does not exist; give a bag, a folder of depth images, or one image.")
        return sorted((path for path in self.source.iterdir() if path.suffix.lower() in _SUFFIXES and path.is_file()), key=_natural)

    def _read(self, path: Path, stamp: float) -> DepthFrame:
        if path.suffix.lower() == ".pcd":
            depth, intrinsics = _read_cloud(path)
            return DepthFrame(stamp, depth, intrinsics if self.intrinsics is None else self._camera(path, depth.shape))
        image = _array_of(path)
        unit = self.unit if self.unit is not None else 1e-3 if image.dtype.kind in "ui" else 1.0
        depth = _metres(path, image, unit)
        frame = DepthFrame(stamp, depth, self._camera(path, depth.shape), unit=unit)
        try:
            check_intrinsics(frame.intrinsics)
            check_size(frame)
        except FrameError as error:
            raise _CameraError(f"{path}: {error}") from None
        return frame

    def _camera(self, path: Path, shape: tuple[int, ...]) -> CameraIntrinsics:
        if self.intrinsics is not None:
            return CameraIntrinsics(shape[1], shape[0], *self.intrinsics)
        file = path.parent / _CAMERA_INFO
        if not file.exists():
            raise _NoIntrinsicsError(
                f"{path} has no intrinsics: there is no {_CAMERA_INFO} beside it; put that file there, as camera_calibration writes it, "
                "or give --intrinsics fx,fy,cx,cy in pixels."
            )
        return _read_camera_info(file)


class _CameraError(FrameError):
    """The intrinsics do not belong to the image: no other image of the folder helps."""


class _NoIntrinsicsError(InputError):
    """There are no intrinsics: likewise."""


def _read_camera_info(path: Path) -> CameraIntrinsics:
    """Intrinsics of a rectified image from a file of `camera_calibration`, or from a printed message sensor_msgs/CameraInfo.

    The projection matrix is that of the rectified image and is preferred; a file without one has a camera matrix.

    Raises:
        InputError: It cannot be read, or lacks size or matrix.
        FrameError: The matrix is that of no camera.
    """
    import yaml

    try:
        content = yaml.safe_load(read_regular(path, LIMITS.METADATA.value))
        get: Any = content.get
        width, height = int(get("image_width") or get("width")), int(get("image_height") or get("height"))
        projection, matrix = _numbers(get("projection_matrix") or get("p")), _numbers(get("camera_matrix") or get("k") or get("K"))
        distortion = _numbers(get("distortion_coefficients") or get("d") or get("D"))
        binning = (max(int(get("binning_x") or 1), 1), max(int(get("binning_y") or 1), 1))
        part = get("roi") or {}
        roi = [int(part.get(name) or 0) for name in ("x_offset", "y_offset", "width", "height")]
        fields = CameraInfoFields(width, height, matrix, projection, distortion, binning, (roi[0], roi[1], roi[2], roi[3]))
    except (OSError, ValueError, TypeError, AttributeError, IndexError, RecursionError, yaml.YAMLError) as error:
        raise InputError(
            f"{path} gives no intrinsics ({plain_text(' '.join(str(error).split()))}); expected image_width, image_height and "
            "camera_matrix or projection_matrix, as camera_calibration writes them."
        ) from None
    return fields.intrinsics()


def _read_cloud(path: Path) -> tuple[NDArray[np.float32], CameraIntrinsics]:
    """Depth of an organised cloud (PCD) [m], and the intrinsics, which follow from the points themselves.

    Raises:
        InputError: It cannot be read, is not organised, or has too few points.
    """
    need("pcd")
    import open3d

    width, height = _size_of_cloud(path)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        try:
            cloud: Any = open3d.t.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
        except RuntimeError as error:
            raise InputError(f"{path} cannot be read ({' '.join(str(error).split())[-200:]}).") from None
    if height < 2 or "positions" not in cloud.point or len(cloud.point["positions"]) != width * height:
        raise InputError(f"{path} is {width} x {height} points, not organised; expected the rows and columns of an image.")
    points = cloud.point["positions"].numpy().reshape(height, width, 3).astype(np.float64)
    depth = points[..., 2].astype(np.float32)
    with np.errstate(invalid="ignore"):
        depth[~(np.isfinite(points).all(axis=2) & (depth > 0))] = np.nan
    if np.count_nonzero(np.isfinite(depth)) < 100:  # they determine four intrinsics
        raise InputError(f"{path} has {np.count_nonzero(np.isfinite(depth))} measured points, expected at least 100.")
    return depth, _intrinsics(points, depth)


def _size_of_cloud(path: Path) -> tuple[int, int]:
    """Width and height in the head of a PCD file."""
    try:
        with path.open("rb") as file:
            head = file.read(2048).split(b"DATA", 1)[0].decode("ascii", "replace").splitlines()
        words = {line.split()[0]: line.split()[1:] for line in head if line.strip() and not line.startswith("#")}
        width, height = int(words["WIDTH"][0]), int(words["HEIGHT"][0])
    except (OSError, KeyError, IndexError, ValueError) as error:
        raise InputError(f"{path} is no PCD file that can be read ({error}).") from None
    _check_image_size(path, width, height)
    return width, height


def _intrinsics(points: NDArray[np.float64], depth: NDArray[np.float32]) -> CameraIntrinsics:
    """Least squares of u = f x/z + c over the pixels with a measurement, and the same for v."""
    height, width = depth.shape
    measured = np.isfinite(depth)
    v, u = np.nonzero(measured)
    lines = []
    for pixel, side in ((u, 0), (v, 1)):
        ratio = points[..., side][measured] / points[..., 2][measured]
        lines.append(np.polyfit(ratio, pixel, 1))
    (fx, cx), (fy, cy) = lines
    camera = CameraIntrinsics(width, height, float(fx), float(fy), float(cx), float(cy))
    check_intrinsics(camera)
    return camera


def _array_of(path: Path) -> NDArray[Any]:
    """The pixels of an image file or a NumPy file as they are. Raises InputError: none, or not one number a pixel."""
    import cv2

    try:
        content = read_regular(path, LIMITS.MESSAGE.value)
        if path.suffix.lower() == ".npy":
            image = np.load(io.BytesIO(content), allow_pickle=False)
        else:
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
            image = np.empty(0) if image is None else image
    except (OSError, ValueError, EOFError, MemoryError, cv2.error) as error:
        raise InputError(f"{path} cannot be read as an image ({plain_text(' '.join(str(error).split()))}).") from None
    if image.ndim != 2 or image.size == 0:
        shape = " x ".join(map(str, image.shape)) if image.size else "nothing"
        raise InputError(f"{path} holds {shape}, expected one depth for each pixel: it is a picture in colour, or damaged.")
    _check_image_size(path, image.shape[1], image.shape[0])
    return image


def _metres(path: Path, image: NDArray[Any], unit: float) -> NDArray[np.float32]:
    """Depth [m], NaN where nothing was measured. Raises InputError for types and values that are no depths."""
    if image.dtype.kind not in "uif" or image.dtype.itemsize < 2:
        raise InputError(f"{path} has pixels of type {image.dtype}, expected 16-bit integers or 32-bit real numbers; 8 bits hold no depth.")
    depth = np.asarray(image, dtype=np.float32) * np.float32(unit)
    with np.errstate(invalid="ignore"):
        depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
    if not np.isfinite(depth).any():
        raise InputError(f"{path} has 0 valid of {depth.size} pixels, expected depths; check the camera and its range.")
    middle = float(np.nanmedian(depth))
    if not _PLAUSIBLE[0] <= middle <= _PLAUSIBLE[1]:
        raise InputError(
            f"{path} has a median depth of {middle:.3g} m at {unit:g} m a unit, expected {_PLAUSIBLE[0]:g} to {_PLAUSIBLE[1]:g} m; "
            "give the metres per unit with --depth-unit."
        )
    return depth


def _check_image_size(path: Path, width: int, height: int) -> None:
    for side in (width, height):
        LIMITS.IMAGE_SIDE.check(side, str(path))
    LIMITS.IMAGE_PIXELS.check(width * height, str(path))


def _numbers(entry: Any) -> list[float]:
    """The numbers of a matrix: a list of them, or a mapping with `data`."""
    numbers = entry.get("data", []) if isinstance(entry, dict) else entry or []
    return [float(value) for value in numbers]


def _natural(path: Path) -> list[tuple[bool, int, str]]:
    """Key that sorts 2.png before 10.png."""
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in re.split(r"(\d+)", path.name)]
