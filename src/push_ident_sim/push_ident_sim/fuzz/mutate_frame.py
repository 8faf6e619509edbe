"""Mutations of depth frames: what cameras, drivers and mix-ups do to them, and what nobody thought of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.limits import LIMITS
from push_ident.types import DepthFrame

__all__ = ["FRAME_MUTATIONS", "Around", "mutated"]

Image = NDArray[np.float32]
_SPECIAL: Final = (np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 1e-30, 1e-6, 0.001, 65.535, 1e4, 3e38, -3e38)
"""Depths that are none [m], and the ends of what an image can hold."""


@dataclass(frozen=True, slots=True, eq=False)
class Around:
    """What a mutation may use beside the frame."""

    other: Image
    """An image of another scene before the same camera [m]."""
    latest: float
    """Stamp of the frame before [s]."""


def mutated(frame: DepthFrame, name: str, seed: int, around: Around) -> DepthFrame:
    """The frame with one mutation; the same seed gives the same one."""
    return FRAME_MUTATIONS[name](frame, np.random.default_rng(seed), around)


def _of_depth(
    change: Callable[[Image, np.random.Generator, Around], Any],
) -> Callable[[DepthFrame, np.random.Generator, Around], DepthFrame]:
    """A mutation of the pixels from a function that changes an array or returns another one of the same size."""

    def mutate(frame: DepthFrame, rng: np.random.Generator, around: Around) -> DepthFrame:
        depth = np.array(frame.depth, dtype=np.float32)
        with np.errstate(all="ignore"):
            result = change(depth, rng, around)
        return replace(frame, depth=depth if result is None else np.asarray(result, dtype=np.float32))

    return mutate


def _window(depth: Image, rng: np.random.Generator) -> tuple[slice, slice]:
    """A random part of the image."""
    rows, columns = depth.shape
    v, u = int(rng.integers(rows)), int(rng.integers(columns))
    return slice(v, v + 1 + int(rng.integers(rows))), slice(u, u + 1 + int(rng.integers(columns)))


def _some(depth: Image, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Random pixels: one in a thousand to almost all."""
    return np.asarray(rng.random(depth.shape) < 10 ** rng.uniform(-3, -0.02))


def _block(depth: Image, rng: np.random.Generator, around: Around) -> None:
    for _ in range(int(rng.integers(1, 6))):
        depth[_window(depth, rng)] = rng.choice(_SPECIAL)


def _salt(depth: Image, rng: np.random.Generator, around: Around) -> None:
    chosen = _some(depth, rng)
    n = int(chosen.sum())
    depth[chosen] = rng.uniform(0.0, 5.0, n) if rng.random() < 0.5 else rng.choice(_SPECIAL, n)


def _spikes(depth: Image, rng: np.random.Generator, around: Around) -> None:
    for _ in range(int(rng.integers(1, 30))):
        depth[int(rng.integers(depth.shape[0])), int(rng.integers(depth.shape[1]))] *= np.float32(10 ** rng.uniform(-6, 6))


def _saturate(depth: Image, rng: np.random.Generator, around: Around) -> None:
    limit = np.float32(rng.uniform(0.1, 2.0))
    beyond = depth > limit if rng.random() < 0.7 else depth < limit
    depth[beyond] = rng.choice([float(limit), *_SPECIAL])


def _keep_few(depth: Image, rng: np.random.Generator, around: Around) -> None:
    kept = rng.random(depth.shape) < rng.choice([1.0, 5.0, 130.0, 2000.0]) / depth.size
    depth[~kept] = np.nan


def _stripes(depth: Image, rng: np.random.Generator, around: Around) -> None:
    image = depth if rng.random() < 0.5 else depth.T
    period, width = int(rng.integers(2, 40)), int(rng.integers(1, 20))
    for begin in range(int(rng.integers(period)), len(image), period):
        image[begin : begin + width] = rng.choice([*_SPECIAL, 0.5, 1.0])


def _roll(depth: Image, rng: np.random.Generator, around: Around) -> Image:
    axis = int(rng.integers(2))
    return np.roll(depth, int(rng.integers(1, depth.shape[axis] + 1)), axis=axis)


def _shift(depth: Image, rng: np.random.Generator, around: Around) -> Image:
    """Some pixels, as when the camera is touched; nothing is measured where the image ends."""
    rows, columns = (float(value) for value in rng.normal(0.0, 10.0, 2))
    matrix = np.array([[1.0, 0.0, columns], [0.0, 1.0, rows]])
    return np.asarray(cv2.warpAffine(depth, matrix, depth.shape[::-1], flags=cv2.INTER_NEAREST, borderValue=np.nan))


def _flip(depth: Image, rng: np.random.Generator, around: Around) -> Image:
    return np.flip(depth, axis=((0,), (1,), (0, 1))[int(rng.integers(3))])


def _mix(depth: Image, rng: np.random.Generator, around: Around) -> Image | None:
    if around.other.shape != depth.shape:
        return None
    kind = int(rng.integers(4))
    if kind == 0:
        return around.other
    if kind == 1:
        return np.asarray(0.5 * (depth + around.other), dtype=np.float32)
    chosen = _some(depth, rng)
    if kind == 2:
        chosen = np.zeros(depth.shape, dtype=bool)
        chosen[_window(depth, rng)] = True
    return np.asarray(np.where(chosen, around.other, depth), dtype=np.float32)


def _unit(depth: Image, rng: np.random.Generator, around: Around) -> Image:
    return depth * np.float32(rng.choice([1e3, 1e-3, 0.1, 10.0, 0.0254, 0.25, 0.9, 1.1, 1.02, -1.0]))


def _constant(depth: Image, rng: np.random.Generator, around: Around) -> None:
    depth[:] = rng.choice([*_SPECIAL, 0.3, 0.5, 0.8, 1.0, 2.0])


def _tilt(depth: Image, rng: np.random.Generator, around: Around) -> Image:
    """A plane in its place, or added to it."""
    v, u = np.mgrid[-1 : 1 : depth.shape[0] * 1j, -1 : 1 : depth.shape[1] * 1j]
    plane = rng.normal() * v + rng.normal() * u
    if rng.random() < 0.5:
        return np.asarray(depth + 10 ** rng.uniform(-3, 0) * plane, dtype=np.float32)
    return np.asarray(rng.uniform(0.3, 2.0) + rng.uniform(0.0, 1.0) * plane, dtype=np.float32)


def _noise(depth: Image, rng: np.random.Generator, around: Around) -> Image:
    return depth + np.float32(10 ** rng.uniform(-3, 0.5)) * rng.standard_normal(depth.shape, dtype=np.float32)


def _steps(depth: Image, rng: np.random.Generator, around: Around) -> Image:
    step = np.float32(10 ** rng.uniform(-3, 0))
    return np.round(depth / step) * step


def _bumps(depth: Image, rng: np.random.Generator, around: Around) -> None:
    """Things on the table that were not there: small, large, thin, of any height."""
    for _ in range(int(rng.integers(1, 20))):
        rows, columns = (int(rng.integers(1, 1 + max(1, side // int(rng.choice([2, 8, 30]))))) for side in depth.shape)
        v, u = int(rng.integers(depth.shape[0])), int(rng.integers(depth.shape[1]))
        depth[v : v + rows, u : u + columns] -= np.float32(10 ** rng.uniform(-2.5, -0.5))


def _rows(depth: Image, rng: np.random.Generator, around: Around) -> None:
    """Rows of a torn image: each displaced by its own amount."""
    for row in range(int(rng.integers(depth.shape[0])), depth.shape[0]):
        depth[row] = np.roll(depth[row], int(rng.integers(-20, 21)))


def _resized(frame: DepthFrame, rng: np.random.Generator, around: Around) -> DepthFrame:
    """An image of another size, with the intrinsics of that size or, sometimes, without."""
    rows, columns = frame.depth.shape
    kind = int(rng.integers(4))
    if kind == 0:  # a corner
        depth = frame.depth[: int(rng.choice([1, 2, 3, 5, rows])), : int(rng.choice([1, 2, 3, 5, 40]))]
    elif kind == 1:  # up to 16 times as many pixels
        factor = int(rng.integers(2, 5))
        while rows * columns * factor**2 > LIMITS.IMAGE_PIXELS.value:
            factor -= 1
        depth = np.repeat(np.repeat(frame.depth, factor, axis=0), factor, axis=1)
    elif kind == 2:  # a long strip
        depth = np.resize(frame.depth, (int(rng.choice([1, 2, 4])), int(rng.integers(100, LIMITS.IMAGE_SIDE.value))))
        depth = depth if rng.random() < 0.5 else depth.T
    else:
        depth = frame.depth[::3, ::2]
    depth = np.ascontiguousarray(depth)
    if rng.random() < 0.1:
        return replace(frame, depth=depth)
    scale = depth.shape[1] / columns if kind == 1 else 1.0
    camera = frame.intrinsics
    own = replace(camera, width=depth.shape[1], height=depth.shape[0], fx=camera.fx * scale, fy=camera.fy * scale)
    return replace(frame, depth=depth, intrinsics=replace(own, cx=camera.cx * scale, cy=camera.cy * scale))


def _intrinsics(frame: DepthFrame, rng: np.random.Generator, around: Around) -> DepthFrame:
    camera = frame.intrinsics
    numbers = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    for name in rng.permutation(list(numbers))[: int(rng.integers(1, 5))]:
        factor = rng.choice([0.0, -1.0, 0.5, 0.9, 1.1, 2.0, 1e-3, 1e3, 1e-9, 1e9, 1e-300, 1e300, np.nan, np.inf])
        numbers[str(name)] = float(numbers[str(name)] * factor)
    return replace(frame, intrinsics=replace(camera, **numbers))


def _stamp(frame: DepthFrame, rng: np.random.Generator, around: Around) -> DepthFrame:
    latest = around.latest if np.isfinite(around.latest) else 0.0
    choices = (latest, latest - 1e-9, latest - 0.1, latest - 100.0, 0.0, np.nextafter(latest, np.inf), latest + 3600.0)
    return replace(frame, stamp=max(0.0, float(rng.choice(choices))))


def _layout(frame: DepthFrame, rng: np.random.Generator, around: Around) -> DepthFrame:
    """The same pixels in another order of memory, or not to be written to."""
    depth: Any = frame.depth.copy()
    kind = int(rng.integers(4))
    if kind == 0:
        depth = np.asfortranarray(depth)
    elif kind == 1:
        depth = np.repeat(depth, 2, axis=1)[:, ::2]
    elif kind == 2:
        depth = depth[::-1].copy()[::-1]
    else:
        depth = depth.astype(np.float64)
    depth.setflags(write=False)
    return replace(frame, depth=depth)


FRAME_MUTATIONS: Final[dict[str, Callable[[DepthFrame, np.random.Generator, Around], DepthFrame]]] = {
    **{
        name: _of_depth(change)
        for name, change in {
            "block": _block,
            "salt": _salt,
            "spikes": _spikes,
            "saturate": _saturate,
            "keep few": _keep_few,
            "stripes": _stripes,
            "roll": _roll,
            "shift": _shift,
            "flip": _flip,
            "mix": _mix,
            "unit": _unit,
            "constant": _constant,
            "tilt": _tilt,
            "noise": _noise,
            "steps": _steps,
            "bumps": _bumps,
            "torn rows": _rows,
        }.items()
    },
    "size": _resized,
    "intrinsics": _intrinsics,
    "stamp": _stamp,
    "layout": _layout,
}
"""Name of a mutation -> what it does with a frame."""
