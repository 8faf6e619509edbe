"""A small exact depth renderer for tests: prisms on a table, rendered for a pinhole camera with the noise of a depth sensor."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from push_ident.geometry.outline import points_in_polygon
from push_ident.geometry.se2 import transform_points
from push_ident.types import CameraIntrinsics, DepthFrame
from push_ident_sim.cell.camera import look_at

INTRINSICS = CameraIntrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)
SMALL = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)


CAMERA = look_at((0.55, 0.0, 0.85), (0.0, 0.0, 0.0))


def rectangle(x0, y0, x1, y1) -> np.ndarray:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], dtype=float)


def circle(radius, n=24) -> np.ndarray:
    angle = 2 * np.pi * np.arange(n) / n
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def hollow(outer, inner, top, floor=0.004) -> list[Prism]:
    """A thing open at the top: walls between two outlines with as many points, and a floor; without floor a ring."""
    after = np.roll(np.arange(len(outer)), -1)
    walls = [Prism(np.array([inner[i], outer[i], outer[j], inner[j]]), top) for i, j in enumerate(after)]
    return [Prism(outer, floor), *walls] if floor else walls


@dataclass(frozen=True)
class Prism:
    polygon: np.ndarray
    top: float
    bottom: float = 0.0

    def at(self, pose) -> Prism:
        return Prism(transform_points(pose, self.polygon), self.top, self.bottom)


# Handle 160 x 22 x 25 mm along x, head 36 x 100 x 35 mm across its end.
HANDLE, HEAD = rectangle(-0.11, -0.011, 0.05, 0.011), rectangle(0.05, -0.05, 0.086, 0.05)
HAMMER = (Prism(HANDLE, 0.025), Prism(HEAD, 0.035))
HAMMER_OUTLINE = np.array(
    [(-0.11, -0.011), (0.05, -0.011), (0.05, -0.05), (0.086, -0.05), (0.086, 0.05), (0.05, 0.05), (0.05, 0.011), (-0.11, 0.011)]
)


def hammer(pose) -> list[Prism]:
    return [prism.at(pose) for prism in HAMMER]


def box(x, y, width, depth, height, yaw=0.0, bottom=0.0) -> Prism:
    return Prism(rectangle(-width / 2, -depth / 2, width / 2, depth / 2), bottom + height, bottom).at((x, y, yaw))


BOX = box(0, 0, 0.2, 0.12, 0.1, 0.4)


def render(prisms, camera=CAMERA, *, rng=None, stamp=0.0, intrinsics=INTRINSICS) -> DepthFrame:
    """Depth of a table at z = 0 with prisms on it; with `rng` noisy and in whole millimetres."""
    scene = tuple((np.asarray(prism.polygon, dtype=float).tobytes(), prism.top, prism.bottom) for prism in prisms)
    depth, noise = _exact(scene, np.asarray(camera, dtype=float).tobytes(), intrinsics)
    if rng is not None:
        depth = np.rint((depth + rng.normal(size=depth.shape) * noise) * 1e3) * 1e-3
    return DepthFrame(stamp, depth.astype(np.float32), intrinsics)


def frames(prisms, camera=CAMERA, n=4, seed=0) -> list[DepthFrame]:
    """Noisy ones of a scene at rest, at 30 Hz."""
    rng = np.random.default_rng(seed)
    return [render(prisms, camera, rng=rng, stamp=i / 30) for i in range(n)]


@lru_cache(maxsize=4)
def _exact(scene, camera, intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Depth without noise and the deviation of the noise [m]; kept, since what rests is rendered again and again."""
    camera = np.frombuffer(camera).reshape(4, 4)
    u, v = np.meshgrid(np.arange(intrinsics.width), np.arange(intrinsics.height))
    rays = np.stack([(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones(u.shape)], axis=-1)
    rays = rays @ camera[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(rays[..., 2] < 0, -camera[2, 3] / rays[..., 2], np.nan)
    for polygon, top, bottom in scene:
        prism = Prism(np.frombuffer(polygon).reshape(-1, 2), top, bottom)
        part = _window(prism, camera, intrinsics)
        depth[part] = _hit(prism, camera[:3, 3], rays[part].reshape(-1, 3), depth[part].ravel()).reshape(depth[part].shape)
    return depth, 0.0012 + 0.0019 * (depth - 0.4) ** 2


def _window(prism, camera, intrinsics) -> tuple[slice, slice]:
    """Rows and columns of the image outside which a prism is not seen."""
    low, high = prism.polygon.min(axis=0), prism.polygon.max(axis=0)
    corners = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (prism.bottom, prism.top)])
    seen = (corners - camera[:3, 3]) @ camera[:3, :3]
    if seen[:, 2].min() <= 0.01:  # beside or behind the camera
        return slice(None), slice(None)
    u = intrinsics.fx * seen[:, 0] / seen[:, 2] + intrinsics.cx
    v = intrinsics.fy * seen[:, 1] / seen[:, 2] + intrinsics.cy
    return tuple(slice(max(int(at.min()) - 1, 0), max(int(at.max()) + 3, 0)) for at in (v, u))


def _hit(prism, centre, ray, depth) -> np.ndarray:
    """Depth of some rays, shapes (n, 3) and (n,), with a prism in their way."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (prism.top - centre[2]) / ray[:, 2]
        inside = points_in_polygon(centre[:2] + t[:, None] * ray[:, :2], prism.polygon)
        best = np.where(inside & (t > 0) & ~(t > depth), t, depth)
        for a, b in zip(prism.polygon, np.roll(prism.polygon, -1, axis=0), strict=True):
            edge = b - a
            cross = ray[:, 0] * edge[1] - ray[:, 1] * edge[0]
            offset = a - centre[:2]
            t = (offset[0] * edge[1] - offset[1] * edge[0]) / cross
            along = (offset[0] * ray[:, 1] - offset[1] * ray[:, 0]) / cross
            z = centre[2] + t * ray[:, 2]
            best = np.where((t > 0) & (along >= 0) & (along <= 1) & (z >= prism.bottom) & (z <= prism.top) & ~(t > best), t, best)
    return best
