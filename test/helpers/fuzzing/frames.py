"""Depth frames that are changed: what cameras, drivers and mix-ups do to them, and what nobody thought of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from hypothesis import strategies as st
from numpy.random import Generator
from numpy.typing import NDArray

from push_ident.limits import LIMITS
from push_ident.types import DepthFrame

Image = NDArray[np.float32]
SPECIAL = (np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 1e-30, 1e-6, 0.001, 65.535, 1e4, 3e38, -3e38)
"""Depths that are none [m], and the ends of what an image can hold."""
FACTORS = (0.0, -1.0, 0.5, 0.9, 1.1, 2.0, 1e-3, 1e3, 1e-9, 1e9, 1e-300, 1e300, np.nan, np.inf)
"""Of the intrinsics."""


class Step(NamedTuple):
    view: int
    """Number of the clean image."""
    gap: float
    """Time since the frame before [s]."""
    changes: tuple[tuple[str, int], ...] = ()
    """Name and seed of each; none: the image stays clean."""


def window(depth: Image, rng: Generator) -> tuple[slice, slice]:
    rows, columns = depth.shape
    v, u = int(rng.integers(rows)), int(rng.integers(columns))
    return slice(v, v + 1 + int(rng.integers(rows))), slice(u, u + 1 + int(rng.integers(columns)))


def some(depth: Image, rng: Generator) -> NDArray[np.bool_]:
    """Random pixels: one in a thousand to almost all."""
    return np.asarray(rng.random(depth.shape) < 10 ** rng.uniform(-3, -0.02))


def block(depth: Image, rng: Generator, other: Image) -> None:
    for _ in range(int(rng.integers(1, 6))):
        depth[window(depth, rng)] = rng.choice(SPECIAL)


def salt(depth: Image, rng: Generator, other: Image) -> None:
    chosen = some(depth, rng)
    n = int(chosen.sum())
    depth[chosen] = rng.uniform(0.0, 5.0, n) if rng.random() < 0.5 else rng.choice(SPECIAL, n)


def shift(depth: Image, rng: Generator, other: Image) -> Image:
    """Some pixels, as when the camera is touched; nothing is measured where the image ends."""
    rows, columns = (float(value) for value in rng.normal(0.0, 10.0, 2))
    matrix = np.array([[1.0, 0.0, columns], [0.0, 1.0, rows]])
    return np.asarray(cv2.warpAffine(depth, matrix, depth.shape[::-1], flags=cv2.INTER_NEAREST, borderValue=np.nan))


def mix(depth: Image, rng: Generator, other: Image) -> Image | None:
    """With the image of another scene."""
    if other.shape != depth.shape:
        return None
    if (kind := int(rng.integers(3))) < 2:
        return np.asarray((other, 0.5 * (depth + other))[kind], dtype=np.float32)
    return np.asarray(np.where(some(depth, rng), other, depth), dtype=np.float32)


def unit(depth: Image, rng: Generator, other: Image) -> Image:
    return depth * np.float32(rng.choice([1e3, 1e-3, 0.1, 10.0, 0.0254, 0.25, 0.9, 1.1, 1.02, -1.0]))


def constant(depth: Image, rng: Generator, other: Image) -> None:
    depth[:] = rng.choice([*SPECIAL, 0.3, 0.5, 0.8, 1.0, 2.0])


def tilt(depth: Image, rng: Generator, other: Image) -> Image:
    """A plane in its place, or added to it."""
    v, u = np.mgrid[-1 : 1 : depth.shape[0] * 1j, -1 : 1 : depth.shape[1] * 1j]
    plane = rng.normal() * v + rng.normal() * u
    if rng.random() < 0.5:
        return np.asarray(depth + 10 ** rng.uniform(-3, 0) * plane, dtype=np.float32)
    return np.asarray(rng.uniform(0.3, 2.0) + rng.uniform(0.0, 1.0) * plane, dtype=np.float32)


def noise(depth: Image, rng: Generator, other: Image) -> Image:
    return depth + np.float32(10 ** rng.uniform(-3, 0.5)) * rng.standard_normal(depth.shape, dtype=np.float32)


def bumps(depth: Image, rng: Generator, other: Image) -> None:
    """Things on the table that were not there: small, large, thin, of any height."""
    for _ in range(int(rng.integers(1, 20))):
        rows, columns = (int(rng.integers(1, 1 + max(1, side // int(rng.choice([2, 8, 30]))))) for side in depth.shape)
        v, u = int(rng.integers(depth.shape[0])), int(rng.integers(depth.shape[1]))
        depth[v : v + rows, u : u + columns] -= np.float32(10 ** rng.uniform(-2.5, -0.5))


def size(frame: DepthFrame, rng: Generator) -> DepthFrame:
    """An image of another size, with the intrinsics of that size or, sometimes, without."""
    rows, camera, factor = frame.depth.shape[0], frame.intrinsics, 1
    kind = int(rng.integers(4))
    if kind == 0:  # a corner
        depth = frame.depth[: int(rng.choice([1, 2, 3, 5, rows])), : int(rng.choice([1, 2, 3, 5, 40]))]
    elif kind == 1:
        factor = int(rng.integers(2, 5))
        depth = np.repeat(np.repeat(frame.depth, factor, axis=0), factor, axis=1)
    elif kind == 2:  # a long strip
        depth = np.resize(frame.depth, (int(rng.choice([1, 2, 4])), int(rng.integers(100, LIMITS.IMAGE_SIDE.value))))
        depth = depth if rng.random() < 0.5 else depth.T
    else:
        depth = frame.depth[::3, ::2]
    depth = np.ascontiguousarray(depth)
    if rng.random() < 0.1:
        return replace(frame, depth=depth)
    scaled = {name: getattr(camera, name) * factor for name in ("fx", "fy", "cx", "cy")}
    return replace(frame, depth=depth, intrinsics=replace(camera, width=depth.shape[1], height=depth.shape[0], **scaled))


def intrinsics(frame: DepthFrame, rng: Generator) -> DepthFrame:
    names = rng.permutation(["fx", "fy", "cx", "cy"])[: int(rng.integers(1, 5))]
    numbers = {str(name): float(getattr(frame.intrinsics, name) * rng.choice(FACTORS)) for name in names}
    return replace(frame, intrinsics=replace(frame.intrinsics, **numbers))


def stamp(frame: DepthFrame, rng: Generator) -> DepthFrame:
    now = frame.stamp
    choices = (now - 1e-9, now - 0.1, now - 100.0, 0.0, np.nextafter(now, np.inf), now + 3600.0)
    return replace(frame, stamp=max(0.0, float(rng.choice(choices))))


OF_DEPTH: dict[str, Callable[[Image, Generator, Image], Image | None]] = {
    change.__name__: change for change in (block, salt, shift, mix, unit, constant, tilt, noise, bumps)
}
OF_FRAME: dict[str, Callable[[DepthFrame, Generator], DepthFrame]] = {change.__name__: change for change in (size, intrinsics, stamp)}


def changed(frame: DepthFrame, name: str, seed: int, other: Image) -> DepthFrame:
    rng = np.random.default_rng(seed)
    if name in OF_FRAME:
        return OF_FRAME[name](frame, rng)
    depth = np.array(frame.depth, dtype=np.float32)
    with np.errstate(all="ignore"):
        result = OF_DEPTH[name](depth, rng, other)
    return replace(frame, depth=depth if result is None else np.asarray(result, dtype=np.float32))


def sequences(n_views: int) -> st.SearchStrategy[list[Step]]:
    """Changed and clean frames in any order."""
    change = st.tuples(st.sampled_from([*OF_DEPTH, *OF_FRAME]), st.integers(0, 2**31 - 1))
    changes = st.just(()) | st.lists(change, min_size=1, max_size=3).map(tuple)
    return st.lists(
        st.builds(Step, st.integers(0, n_views - 1), st.sampled_from((1 / 30, 0.1, 0.3, 1.1)), changes), min_size=1, max_size=12
    )
