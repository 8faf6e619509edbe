"""Depth camera of the simulated cell: rays through pixel centres, then the errors of a real sensor.

Camera frame as REP 103 has it for optical frames: z forward, x right, y down.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike, NDArray

from push_ident.errors import InputError
from push_ident.types import CameraIntrinsics
from push_ident_sim.cell.robot import robot_description
from push_ident_sim.objects import SimObject

__all__ = ["INTRINSICS", "DepthCamera", "DepthNoise", "look_at"]

FloatArray = NDArray[np.float64]
DepthImage = NDArray[np.float32]

INTRINSICS = CameraIntrinsics(width=640, height=480, fx=600.0, fy=600.0, cx=319.5, cy=239.5)
_TABLE_HALF = (0.8, 0.7)
"""Half edges of the table [m]."""
_TRIANGLES_PER_LINK = 200
_FOCAL_BASELINE = 43.5
"""Of a Kinect [px m]: 580 px x 0.075 m."""
_SPARSE = 8
"""Every so many pixels are enough for the usual noise of an image."""
_NEAREST = 0.05
"""What comes nearer to the camera may cover all of the image [m]."""


def look_at(position: ArrayLike, target: ArrayLike) -> FloatArray:
    """Pose (4, 4) of an optical frame at `position` that looks at `target`, image upright; both [m], shape (3,)."""
    position = np.asarray(position, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - position
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9 * max(float(np.linalg.norm(forward)), 1e-9):
        raise InputError("The camera looks straight up or down, or nowhere: `up` in the image is undefined; give the pose as a quaternion.")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = position
    return pose


@dataclass(frozen=True, slots=True)
class DepthNoise:
    """Errors of a structured-light sensor (Kinect).

    Axial noise that grows with range: Nguyen, Izadi & Lovell, "Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking"
    (2012), 0.0012 m + 0.0019 (z - 0.4 m)^2. Whole steps of disparity: Khoshelham & Oude Elberink, "Accuracy and Resolution of Kinect Depth
    Data" (2012). Holes along depth edges, where the pattern is hidden from the sensor. Whole millimetres, as 16UC1 has them.
    """

    scale: float = 1.0
    """Of the axial noise; 0 is a perfect sensor but for the millimetres."""
    edge_step: float = 0.015
    """A jump of depth between neighbours that makes an edge [m]."""
    edge_dropout: float = 0.5
    """Share of the pixels at an edge that read nothing."""
    disparity_step: float = 0.125
    """[px], with focal length x baseline = 43.5 px m; 0 leaves it out, as does `scale` = 0. At 0.85 m a step is 2 mm of depth."""

    def apply(self, depth: DepthImage, rng: np.random.Generator) -> DepthImage:
        """Noisy depth [m], whole millimetres, NaN where there is no measurement; `depth` has shape (height, width)."""
        if self.scale > 0:
            sigma = self.scale * (np.float32(0.0012) + np.float32(0.0019) * (depth - np.float32(0.4)) ** 2)
            depth = depth + sigma * rng.standard_normal(depth.shape, dtype=np.float32)
            edges = _at_edge(depth, self.edge_step + 4.0 * float(np.nanmedian(sigma[::_SPARSE, ::_SPARSE])))
            depth[edges & (rng.random(depth.shape, dtype=np.float32) < self.edge_dropout)] = np.nan
            if self.disparity_step > 0:
                steps = np.float32(_FOCAL_BASELINE / self.disparity_step)
                depth = np.asarray(steps / np.round(steps / depth), dtype=np.float32)
        return np.round(depth * np.float32(1000.0)) * np.float32(0.001)


def _at_edge(depth: DepthImage, step: float) -> NDArray[np.bool_]:
    edges = np.zeros(depth.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        for axis in (0, 1):
            jump = np.abs(np.diff(depth, axis=axis)) > step
            first, second = (edges[:-1], edges[1:]) if axis == 0 else (edges[:, :-1], edges[:, 1:])
            first |= jump
            second |= jump
    return edges


class DepthCamera:
    """Renders table, object and robot. One instance may be used by one thread at a time."""

    def __init__(self, sim_object: SimObject, pose_camera_in_table: FloatArray, intrinsics: CameraIntrinsics = INTRINSICS) -> None:
        """`sim_object` lies before it; the pose (4, 4) and the intrinsics are those that it really has."""
        self.intrinsics = intrinsics
        self.pose_camera_in_table = np.array(pose_camera_in_table, dtype=np.float64)
        self._rays = _pixel_rays(self.pose_camera_in_table, intrinsics)
        self._table = _table_depth(self._rays)
        self.sim_object = sim_object
        self._links = _robot_meshes(robot_description())

    @property
    def sim_object(self) -> SimObject:
        """What lies before the camera."""
        return self._sim_object

    @sim_object.setter
    def sim_object(self, thing: SimObject) -> None:
        """Place another object before the camera."""
        self._sim_object = thing
        self._object = _object_mesh(thing)

    def render(self, pose_object: ArrayLike, robot_link_poses: dict[str, FloatArray]) -> DepthImage:
        """Perfect depth along the optical axis [m], shape (height, width), NaN where no surface is.

        Args:
            pose_object: (x, y, yaw) of the object frame in `table`.
            robot_link_poses: homogeneous pose in `table` by link name; a link without a pose is not drawn.
        """
        import open3d

        x, y, yaw = np.asarray(pose_object, dtype=np.float64)
        object_in_table = np.eye(4)
        object_in_table[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        object_in_table[:2, 3] = x, y
        placed = [(self._object, object_in_table)]
        placed += [(mesh, robot_link_poses[name]) for name, mesh in self._links.items() if name in robot_link_poses]
        scene = open3d.t.geometry.RaycastingScene()
        covered = np.zeros(self._table.shape, dtype=bool)
        for (points, triangles), pose in placed:
            vertices = points @ pose[:3, :3].T + pose[:3, 3]
            scene.add_triangles(_tensor(vertices.astype(np.float32)), _tensor(triangles.astype(np.uint32)))
            covered[self._window(vertices)] = True
        depth = self._table.copy()
        # The rays advance by one metre of depth per unit, so that the distance of a hit is its depth.
        hit = scene.cast_rays(_tensor(self._rays[covered]))["t_hit"].numpy()
        depth[covered] = np.fmin(depth[covered], np.where(np.isfinite(hit), hit, np.float32(np.nan)))
        return depth

    def _window(self, vertices: FloatArray) -> tuple[slice, slice]:
        """Rows and columns of the image that hold all of `vertices` [m], shape (n, 3), `table` frame."""
        camera = self.intrinsics
        x, y, z = ((vertices - self.pose_camera_in_table[:3, 3]) @ self.pose_camera_in_table[:3, :3]).T
        if z.min() < _NEAREST:
            return slice(None), slice(None)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        return slice(max(0, int(v.min())), max(0, int(v.max()) + 2)), slice(max(0, int(u.min())), max(0, int(u.max()) + 2))


def _tensor(array: NDArray[Any]) -> Any:
    import open3d

    # Its stubs know no array as first argument.
    return open3d.core.Tensor(array)  # type: ignore[call-overload]


def _pixel_rays(pose: FloatArray, intrinsics: CameraIntrinsics) -> DepthImage:
    """Origin and direction of the ray through each pixel centre, one metre of depth long, shape (height, width, 6), `table` frame."""
    u, v = np.meshgrid(np.arange(intrinsics.width), np.arange(intrinsics.height))
    in_camera = np.stack([(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones(u.shape)], axis=-1)
    rays = np.concatenate([np.broadcast_to(pose[:3, 3], in_camera.shape), in_camera @ pose[:3, :3].T], axis=-1)
    return np.asarray(rays, dtype=np.float32)


def _table_depth(rays: DepthImage) -> DepthImage:
    """Depth of the empty table along `rays` [m], shape (height, width), NaN beside it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -rays[..., 2] / rays[..., 5]
        at = rays[..., :2] + depth[..., None] * rays[..., 3:5]
    return np.where((depth > 0) & np.all(np.abs(at) <= _TABLE_HALF, axis=-1), depth, np.float32(np.nan))


Mesh = tuple[FloatArray, NDArray[np.int64]]


def _merge(meshes: list[Mesh]) -> Mesh:
    offsets = np.cumsum([0] + [len(points) for points, _ in meshes[:-1]])
    return np.concatenate([p for p, _ in meshes]), np.concatenate([f + o for (_, f), o in zip(meshes, offsets, strict=True)])


def _object_mesh(thing: SimObject) -> Mesh:
    import open3d

    size, meshes = thing.cell_size, []
    for (x, y), height in zip(thing.cells, thing.height, strict=True):
        box = open3d.geometry.TriangleMesh.create_box(size, size, float(height))
        box.translate((x - size / 2, y - size / 2, 0.0))
        meshes.append((np.asarray(box.vertices), np.asarray(box.triangles).astype(np.int64)))
    return _merge(meshes)


def _robot_meshes(description: str) -> dict[str, Mesh]:
    """Collision geometry of each link in its frame, meshes as coarse convex hulls."""
    links = {}
    for link in ET.fromstring(description).iter("link"):
        meshes = [_solid_mesh(collision) for collision in link.iter("collision")]
        if meshes:
            links[link.attrib["name"]] = _merge(meshes)
    return links


def _solid_mesh(collision: ET.Element) -> Mesh:
    import open3d

    solid = collision.find("geometry/*")
    if solid is None:
        raise InputError("A collision element of the robot description has no geometry.")
    if solid.tag == "box":
        edges = np.array(solid.attrib["size"].split(), dtype=np.float64)
        mesh: Any = open3d.geometry.TriangleMesh.create_box(*edges).translate(-edges / 2)
    elif solid.tag == "cylinder":
        mesh = open3d.geometry.TriangleMesh.create_cylinder(
            float(solid.attrib["radius"]), float(solid.attrib["length"]), resolution=32, split=1
        )
    elif solid.tag == "mesh":
        hull, _ = open3d.io.read_triangle_mesh(Path(solid.attrib["filename"])).compute_convex_hull()
        mesh = hull.simplify_quadric_decimation(_TRIANGLES_PER_LINK)
    else:
        raise InputError(f"The robot description has a {solid.tag}, expected box, cylinder or mesh.")
    origin = collision.find("origin")
    placed = np.eye(4)
    if origin is not None:
        roll, pitch, yaw = (float(v) for v in origin.attrib.get("rpy", "0 0 0").split())
        placed[:3, :3] = open3d.geometry.get_rotation_matrix_from_zyx((yaw, pitch, roll))
        placed[:3, 3] = [float(v) for v in origin.attrib.get("xyz", "0 0 0").split()]
    mesh.transform(placed)
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)
