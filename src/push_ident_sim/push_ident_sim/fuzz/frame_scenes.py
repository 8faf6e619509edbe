"""Depth images that are mutated: objects on a table seen by every model of a sensor, and recorded tables where they are on this machine."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.offline.depth_images import read_cloud
from push_ident.perception.calibration import camera_over_table
from push_ident.types import CameraIntrinsics, DepthFrame, Float64Array
from push_ident_sim.cell.camera import DepthCamera, Placed, look_at
from push_ident_sim.cell.sensor_unit import Sensor
from push_ident_sim.cell.sensors import PLAIN, SENSOR_NAMES, SENSORS, suitable_pose
from push_ident_sim.objects import OBJECT_NAMES, make_object

__all__ = ["RECORDED", "WIDTHS", "FrameScene", "scene_of", "scenes_here"]

RECORDED: Final = "recorded "
"""Begin of the name of a scene from a file; the rest is the name of the file."""
WIDTHS: Final = (160, 320, 0)
"""Images are thinned out to about this width [px]; 0: all pixels."""
_DATA: Final = Path(os.environ.get("PUSH_IDENT_DATA", Path(__file__).resolve().parents[5] / "shared" / "data")) / "kinect_tabletop"
_READINGS: Final = 4
"""Images of the scene at rest, each with its own noise."""
_PUSH: Final = ((0.02, 0.0, 0.1), (0.04, 0.01, 0.2), (0.06, 0.01, 0.3), (0.1, 0.02, 0.6))
"""How far the object is pushed in the images after those at rest: x, y [m], yaw [rad]."""
_CAMERA_MOVES: Final = ((0.03, 0.0, 0.02), (-0.2, 0.3, 0.1))
"""How far the camera is displaced in the images after those [m], as when somebody touches it; it looks at the middle of the table again."""
_NOISE: Final = 0.001
"""Added to the readings of a recorded image, of which there is one [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameScene:
    """Clean images of one table."""

    name: str
    intrinsics: CameraIntrinsics
    camera_in_table: Float64Array
    """As perception has it, shape (4, 4)."""
    at_rest: tuple[NDArray[np.float32], ...]
    """Readings of the scene at rest [m], shape (height, width)."""
    changed: tuple[NDArray[np.float32], ...]
    """The same with the object pushed, or with the camera displaced."""
    other: NDArray[np.float32]
    """Another scene before the same camera."""

    @property
    def views(self) -> tuple[NDArray[np.float32], ...]:
        """All but the other scene, those at rest first."""
        return (*self.at_rest, *self.changed)


def scenes_here() -> tuple[str, ...]:
    """Names of all scenes: every sensor of the simulated cell, and the recorded images that are here."""
    return (*SENSOR_NAMES, *(RECORDED + path.name for path in sorted(_DATA.glob("*.pcd"))))


@lru_cache(maxsize=4)
def scene_of(name: str, width: int) -> FrameScene:
    """The scene with this name, thinned out to about `width` pixels; 0: not at all."""
    whole = _whole(name)
    step = max(1, whole.intrinsics.width // width) if width else 1
    camera = whole.intrinsics

    def thin(depth: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.ascontiguousarray(depth[::step, ::step])

    height, columns = thin(whole.other).shape
    return FrameScene(
        name,
        CameraIntrinsics(columns, height, camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step),
        whole.camera_in_table,
        tuple(thin(depth) for depth in whole.at_rest),
        tuple(thin(depth) for depth in whole.changed),
        thin(whole.other),
    )


@lru_cache(maxsize=2)
def _whole(name: str) -> FrameScene:
    return _recorded(name) if name.startswith(RECORDED) else _rendered(name)


def _rendered(name: str) -> FrameScene:
    number = SENSOR_NAMES.index(name)
    rng = np.random.default_rng(number)
    sensor, pose = Sensor(name), suitable_pose(name)
    thing = make_object(OBJECT_NAMES[number % len(OBJECT_NAMES)])
    beside = make_object(OBJECT_NAMES[(number + 2) % len(OBJECT_NAMES)])
    at = np.array([0.0, -0.05, 0.4])

    def image(camera: DepthCamera, *placed: tuple[object, ArrayLike]) -> NDArray[np.float32]:
        things = [Placed(own, where) for own, where in placed]  # type: ignore[arg-type]
        seen = camera.render_scene(things, {}) if name == PLAIN else camera.view(things, {}, SENSORS[name].second)
        return np.asarray(sensor.read(seen, rng), dtype=np.float32)

    fixed = sensor.camera(thing, pose)
    moved = [sensor.camera(thing, look_at(pose[:3, 3] + by, (0.0, 0.0, 0.0))) for by in np.array(_CAMERA_MOVES)]
    return FrameScene(
        name,
        sensor.intrinsics,
        pose,
        tuple(image(fixed, (thing, at)) for _ in range(_READINGS)),
        (*(image(fixed, (thing, at + by)) for by in np.array(_PUSH)), *(image(camera, (thing, at)) for camera in moved)),
        image(fixed, (beside, (0.05, 0.2, 1.0)), (thing, (-0.15, 0.0, 2.0))),
    )


def _recorded(name: str) -> FrameScene:
    rng = np.random.default_rng(0)
    path = _DATA / name.removeprefix(RECORDED)
    frame = read_cloud(path).frame
    others = [other for other in sorted(_DATA.glob("*.pcd")) if other != path] or [path]

    def reading(frame: DepthFrame) -> NDArray[np.float32]:
        return np.asarray(frame.depth + _NOISE * rng.standard_normal(frame.depth.shape, dtype=np.float32), dtype=np.float32)

    pushed = [np.roll(reading(frame), by, axis=1) for by in (3, 6, 9, 15)]
    return FrameScene(
        name,
        frame.intrinsics,
        camera_over_table(frame)[0],
        tuple(reading(frame) for _ in range(_READINGS)),
        (*pushed, *(np.roll(reading(frame), by, axis=0) for by in (4, 40))),
        reading(read_cloud(others[0]).frame),
    )
