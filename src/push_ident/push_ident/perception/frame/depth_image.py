"""Depth images as they come: from raw bytes to metres, and what is refused of them.

No compiled kernels are needed here: what only reads messages of a camera does not load them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from push_ident.errors import FrameError
from push_ident.types import CameraIntrinsics, DepthFrame

ACCEPTED_ENCODINGS: Final[dict[str, tuple[np.dtype[Any], float]]] = {
    "16UC1": (np.dtype(np.uint16), 1e-3),
    "32FC1": (np.dtype(np.float32), 1.0),
}
"""Encoding -> (type of a pixel, metres per unit), as in REP 118."""

_MAX_SIDE: Final = 16384
_MAX_FOCAL: Final = 1e5
"""Largest focal length [px]: one pixel then sees 10 um at 1 m, a tenth of the noise of the finest camera (PhoXi, 0.1 mm)."""
_MAX_TANGENT: Final = 12.0
"""Of the angle between the optical axis and a line of sight [-], 85 degrees; the widest depth cameras reach 60 degrees."""


def unit_of(encoding: str) -> float:
    """Metres per unit of an encoding, also of one that was compressed, as `16UC1; compressedDepth png`."""
    return ACCEPTED_ENCODINGS.get(encoding.split(";")[0].strip(), ACCEPTED_ENCODINGS["16UC1"])[1]


def depth_from_buffer(
    encoding: str, height: int, width: int, step: int, is_bigendian: bool, data: bytes | memoryview, *, unit: float | None = None
) -> NDArray[np.float32]:
    """Decode the pixels of a depth image.

    Args:
        encoding: `16UC1` (millimetres, 0 is no measurement) or `32FC1` (metres; NaN, infinite and <= 0 are none), REP 118.
        height, width: Size [px].
        step: Length of a row in bytes, padding included.
        is_bigendian: Byte order of the pixels.
        data: The rows, `step * height` bytes.
        unit: Metres per unit; None: by the encoding.

    Returns:
        Depth along the optical axis [m], shape (height, width); NaN where nothing was measured.

    Raises FrameError: Another encoding, or sizes that do not fit the data.
    """
    if encoding not in ACCEPTED_ENCODINGS:
        raise FrameError(f"Depth encoding is {encoding[:40]!r}, expected one of {', '.join(ACCEPTED_ENCODINGS)}; publish rectified depth.")
    pixel, own = ACCEPTED_ENCODINGS[encoding]
    unit = own if unit is None else unit
    if not (0 < height <= _MAX_SIDE and 0 < width <= _MAX_SIDE):
        raise FrameError(f"Depth image is {width} x {height} pixels, expected 1 to {_MAX_SIDE} per side.")
    if step < width * pixel.itemsize or step % pixel.itemsize:
        raise FrameError(f"Depth step is {step} bytes, expected at least {width * pixel.itemsize} for {width} pixels of {encoding}.")
    if step * height != len(data):
        raise FrameError(f"Depth data has {len(data)} bytes, expected step * height = {step * height}; the image was cut or mislabelled.")
    raw = np.frombuffer(data, dtype=pixel.newbyteorder(">" if is_bigendian else "<")).reshape(height, step // pixel.itemsize)[:, :width]
    depth = raw.astype(np.float32)
    with np.errstate(invalid="ignore"):
        depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
    return depth if unit == 1.0 else depth * np.float32(unit)


def check_intrinsics(intrinsics: CameraIntrinsics) -> None:
    """Reject a camera matrix that no pinhole camera has.

    Raises FrameError: Focal length not positive or too large, a value not finite, or a line of sight across the optical axis.
    """
    k = (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)
    if not all(math.isfinite(value) for value in k) or intrinsics.fx <= 0 or intrinsics.fy <= 0:
        raise FrameError(f"Camera info has (fx, fy, cx, cy) = {k}, expected finite values and focal lengths > 0; calibrate the camera.")
    largest = max(intrinsics.fx, intrinsics.fy)
    if largest > _MAX_FOCAL:
        raise FrameError(f"Camera info has a focal length of {largest:.3g} px, expected at most {_MAX_FOCAL:.0f}; calibrate the camera.")
    tangent = max(
        max(abs(intrinsics.cx), abs(intrinsics.width - 1 - intrinsics.cx)) / intrinsics.fx,
        max(abs(intrinsics.cy), abs(intrinsics.height - 1 - intrinsics.cy)) / intrinsics.fy,
    )
    if tangent > _MAX_TANGENT:
        raise FrameError(
            f"Camera info has (fx, fy, cx, cy) = {k} for {intrinsics.width} x {intrinsics.height} pixels: a pixel would look "
            f"{math.degrees(math.atan(tangent)):.1f} degrees off the optical axis, expected at most "
            f"{math.degrees(math.atan(_MAX_TANGENT)):.0f}; calibrate the camera."
        )


def check_size(frame: DepthFrame) -> None:
    """Reject an image whose size differs from its camera info: the compiled loops over its pixels would read out of bounds.

    Raises FrameError: The sizes differ.
    """
    expected = (frame.intrinsics.height, frame.intrinsics.width)
    if frame.depth.shape != expected:
        raise FrameError(f"Depth image has shape {frame.depth.shape}, its camera info {expected}; they belong to different cameras.")


def usable_frame(frame: DepthFrame) -> DepthFrame:
    """The frame as perception needs it: depth in single precision, row by row, and NaN in place of all that is no depth.

    Raises FrameError: The size of the image differs from its camera info, or the intrinsics are none.
    """
    check_intrinsics(frame.intrinsics)
    check_size(frame)
    with np.errstate(over="ignore"):
        depth = np.ascontiguousarray(frame.depth, dtype=np.float32)
    if ((depth <= 0) | np.isinf(depth)).any():
        depth = np.where((depth > 0) & np.isfinite(depth), depth, np.float32(np.nan))
    return frame if depth is frame.depth else replace(frame, depth=depth)
