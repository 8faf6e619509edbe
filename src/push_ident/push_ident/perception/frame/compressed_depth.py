"""Depth images that image_transport compressed: `compressedDepth`, and 16-bit PNG of `compressed`.

`compressedDepth` puts a header of 12 bytes before the image: the number of a format and two floats a, b. Depths of 16UC1 are stored as they
are. Of 32FC1 the image has a whole number q = a / z + b for each depth z, whose steps grow with z^2 as the errors of stereo do; 0 is none.
"""

from __future__ import annotations

import struct
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.errors import FrameError
from push_ident.limits import LIMITS, plain_text
from push_ident.perception.frame.depth_image import ACCEPTED_ENCODINGS, unit_of

_HEADER: Final = struct.Struct("<iff")
_PNG: Final = b"\x89PNG\r\n\x1a\n"
_SIZE_IN_PNG: Final = struct.Struct(">II")
"""Width and height, 16 bytes after the begin of a PNG."""


def is_depth_format(text: str) -> bool:
    """Whether the format of a sensor_msgs/CompressedImage may be that of a depth image."""
    return "compressedDepth" in text or text.split(";")[0].strip() in ACCEPTED_ENCODINGS


def depth_from_compressed(text: str, data: bytes, unit: float | None = None) -> NDArray[np.float32]:
    """Depth along the optical axis [m], shape (height, width), NaN where nothing was measured, of a sensor_msgs/CompressedImage.

    Args:
        text: its format, as `16UC1; compressedDepth png`.
        data: its data.
        unit: metres per unit; None: by the encoding, as `depth_from_buffer`.

    Raises FrameError: another compression than PNG, another kind of image, or damaged data.
    """
    if not is_depth_format(text):
        raise FrameError(f"Compressed image has the format {plain_text(text)[:60]!r}, expected depth, as '16UC1; compressedDepth png'.")
    start = _HEADER.size if "compressedDepth" in text else 0
    png = data[start:]
    if not png.startswith(_PNG) or len(png) < 24:
        form = plain_text(text)[:60]
        raise FrameError(f"Compressed depth image ({form!r}) holds no PNG, expected one after {start} bytes; record it as PNG, not RVL.")
    width, height = _SIZE_IN_PNG.unpack_from(png, 16)
    for side in (width, height):
        LIMITS.IMAGE_SIDE.check(side, "Compressed depth image", error=FrameError)
    LIMITS.IMAGE_PIXELS.check(width * height, "Compressed depth image", error=FrameError)
    try:
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.ndim != 2 or image.dtype != np.uint16:
        got = "cannot be decoded" if image is None else f"has pixels of {image.dtype} in {image.ndim - 1} dimensions"
        raise FrameError(f"Compressed depth image {got}, expected one number of 16 bits a pixel; 8 bits and colours hold no depth.")
    encoding = text.split(";")[0].strip()
    a, b = _HEADER.unpack_from(data)[1:] if start else (0.0, 0.0)
    # Older versions name no encoding; only real depths have numbers in the header.
    is_inverse = encoding == "32FC1" or (encoding != "16UC1" and a != 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(a) / (image.astype(np.float32) - np.float32(b)) if is_inverse else image.astype(np.float32)
    depth[(image == 0) | ~np.isfinite(depth) | (depth <= 0)] = np.nan
    return np.asarray(depth * np.float32(unit_of("32FC1" if is_inverse else "16UC1") if unit is None else unit))
