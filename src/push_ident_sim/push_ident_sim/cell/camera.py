"""Depth camera of the simulated cell: rays through pixel centres, then the errors of a real sensor.

Camera frame as REP 103 has it for optical frames: z forward, x right, y down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree as ET

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from push_ident.errors import InputError
from push_ident.limits import plain_text
from push_ident.types import CameraIntrinsics, Float64Array
from push_ident_sim.cell.robot import robot_description
from push_ident_sim.engines.bullet.bullet_object import TABLE
from push_ident_sim.objects import SimObject

DepthImage = NDArray[np.float32]
Mesh = tuple[Float64Array, NDArray[np.int64]]
"""Vertices [m], shape (n, 3), and the three vertices of each triangle, shape (m, 3)."""
_NOTHING: Final = 1e36
"""Depth that no hit has [m]: a ray that hits nothing reads 1e37. Rays are one metre of depth long, so the length of a hit is its depth."""
_DEVICE: Final = EmbreeDevice()
_UNIT_BOX: Final = np.array(list(product((-0.5, 0.5), repeat=3)))

INTRINSICS = CameraIntrinsics(width=640, height=480, fx=600.0, fy=600.0, cx=319.5, cy=239.5)
ALBEDO = 0.5
"""Share of the light that a surface scatters back where nothing else is given; an estimate between black
plastic and white paper."""


def look_at(position: ArrayLike, target: ArrayLike) -> Float64Array:
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
            edges = _at_edge(depth, self.edge_step + 4.0 * float(np.nanmedian(sigma[::8, ::8])))
            depth[edges & (rng.random(depth.shape, dtype=np.float32) < self.edge_dropout)] = np.nan
            if self.disparity_step > 0:
                steps = np.float32(43.5 / self.disparity_step)  # of a Kinect: 580 px x 0.075 m
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


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Something before the camera."""

    item: SimObject | Mesh
    pose: ArrayLike
    """Of its frame in `table`: (x, y, yaw) [m, m, rad], or homogeneous, shape (4, 4)."""
    albedo: float = ALBEDO
    """Share of the light of the sensor that it scatters back, 0 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What lies before each pixel, without errors; all of shape (height, width)."""

    depth: DepthImage
    """Along the optical axis [m], NaN where no surface is."""
    cosine: DepthImage
    """Of the angle between the ray and the normal of the surface, 0 to 1; 1 where no surface is."""
    albedo: DepthImage
    """Of the surface, 0 to 1."""
    lit: NDArray[np.bool_]
    """Whether the second viewpoint sees the surface as well."""


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """All things but the table, for rays."""

    embree: Any
    """`embreex.rtcore_scene.EmbreeScene`."""
    vertices: list[Float64Array]
    """Of each thing in it [m], shape (n, 3), `table` frame."""
    covered: NDArray[np.bool_]
    """Pixels that a thing may cover, shape (height, width)."""


class DepthCamera:
    """Renders table, objects and robot. One instance may be used by one thread at a time."""

    def __init__(
        self,
        sim_object: SimObject,
        pose_camera_in_table: Float64Array,
        intrinsics: CameraIntrinsics = INTRINSICS,
        distortion: float = 0.0,
        description: str | None = None,
    ) -> None:
        """`sim_object` lies before it; the pose (4, 4) and the intrinsics are those that it really has.

        Args:
            distortion: Coefficient k of a radial distortion [-]: the ray of a pixel at the distance r from the principal point, both in
                focal lengths, is that of a camera without distortion at r (1 + k r^2).
            description: URDF of the arm before it; None: the iiwa.
        """
        self.intrinsics = intrinsics
        self.pose_camera_in_table = np.array(pose_camera_in_table, dtype=np.float64)
        self._rays = _pixel_rays(self.pose_camera_in_table, intrinsics, distortion)
        self._table = _table_depth(self._rays)
        corner = np.hypot(max(intrinsics.cx, intrinsics.width - intrinsics.cx), max(intrinsics.cy, intrinsics.height - intrinsics.cy))
        # Pixels by which the distortion moves the corner of the image.
        self._slack = int(np.ceil(abs(distortion) * corner**3 / intrinsics.fx**2))
        self._meshes: dict[int, tuple[SimObject, Mesh]] = {}
        self.sim_object = sim_object
        self._links = _robot_meshes(description or robot_description())

    def set_table(self, bounds: Sequence[float]) -> None:
        """Another table: x_min, x_max, y_min, y_max [m]. Beside it no surface is."""
        self._table = _table_depth(self._rays, bounds)

    @property
    def sim_object(self) -> SimObject:
        """What lies before the camera."""
        return self._sim_object

    @sim_object.setter
    def sim_object(self, thing: SimObject) -> None:
        """Place another object before the camera."""
        self._sim_object = thing
        self._meshes.clear()

    def render(self, pose_object: ArrayLike, robot_link_poses: dict[str, Float64Array]) -> DepthImage:
        """Perfect depth along the optical axis [m], shape (height, width), NaN where no surface is.

        Args:
            pose_object: (x, y, yaw) of the object frame in `table`, or homogeneous, shape (4, 4).
            robot_link_poses: homogeneous pose in `table` by link name; a link without a pose is not drawn.
        """
        return self.render_scene([Placed(self._sim_object, pose_object)], robot_link_poses)

    def render_scene(self, items: Sequence[Placed], robot_link_poses: dict[str, Float64Array]) -> DepthImage:
        """As `render`, with any number of things on the table."""
        scene = self._scene(self._positioned(items, robot_link_poses))
        rays, depth = self._rays[scene.covered], self._table.copy()
        hit = scene.embree.run(rays[:, :3], rays[:, 3:], query="DISTANCE")
        depth[scene.covered] = np.fmin(depth[scene.covered], np.where(hit < _NOTHING, hit, np.float32(np.nan)))
        return depth

    def view(self, items: Sequence[Placed], robot_link_poses: dict[str, Float64Array], second: float = 0.0) -> View:
        """All that a model of a sensor needs to know.

        Args:
            second: Where the projector or the second imager is: x in the frame of the camera [m]; 0: there is none.
        """
        placed = self._positioned(items, robot_link_poses)
        scene = self._scene(placed)
        covered = self._rays[scene.covered]
        hits = scene.embree.run(covered[:, :3], covered[:, 3:], output=True)
        depth, cosine = self._table.copy(), self._cosine_of_table()
        albedo = np.full(depth.shape, ALBEDO, dtype=np.float32)
        # A ray that hits a thing and the table at the same depth shows the thing.
        nearer = (hits["tfar"] < _NOTHING) & ~(hits["tfar"] > depth[scene.covered])
        shown = np.zeros(depth.shape, dtype=bool)
        shown[scene.covered] = nearer
        depth[shown] = hits["tfar"][nearer]
        rays, normals = covered[nearer, 3:], hits["Ng"][nearer]
        lengths = np.linalg.norm(rays, axis=-1) * np.linalg.norm(normals, axis=-1)
        cosine[shown] = np.abs(np.sum(rays * normals, axis=-1)) / lengths
        of_item = np.array([albedo for _, _, albedo in placed], dtype=np.float32)
        if len(of_item):
            albedo[shown] = of_item[hits["geomID"][nearer]]
        cosine[~np.isfinite(depth)] = 1.0
        return View(depth, cosine, albedo, self._lit(scene, depth, second))

    def _lit(self, scene: _Scene, depth: DepthImage, second: float) -> NDArray[np.bool_]:
        """Which pixels show a surface that a second viewpoint at (second, 0, 0) of the camera frame [m] sees as well."""
        lit = np.ones(depth.shape, dtype=bool)
        if second == 0.0 or not scene.vertices:
            return lit
        asked = np.zeros(depth.shape, dtype=bool)
        for vertices in scene.vertices:
            asked[self._window(vertices, second)] = True
        asked &= np.isfinite(depth)
        viewpoint = self.pose_camera_in_table[:3, 3] + second * self.pose_camera_in_table[:3, 0]
        rays = self._rays[asked]
        points = rays[:, :3] + depth[asked][:, None] * rays[:, 3:]
        towards = viewpoint.astype(np.float32) - points
        # The ray is as long as the distance to the viewpoint. It begins 0.3 mm off the surface at 1 m, so that rounding does not let a
        # surface hide itself.
        start, length = np.float32(3e-4), np.full(len(points), 1.0 - 3e-4, dtype=np.float32)
        hidden = scene.embree.run(points + start * towards, towards, length, query="OCCLUDED")
        lit[asked] = hidden < 0
        return lit

    def _cosine_of_table(self) -> DepthImage:
        directions = self._rays[..., 3:]
        return np.asarray(np.abs(directions[..., 2]) / np.linalg.norm(directions, axis=-1), dtype=np.float32)

    def _positioned(self, items: Sequence[Placed], robot_link_poses: dict[str, Float64Array]) -> list[tuple[Mesh, Float64Array, float]]:
        """Mesh, homogeneous pose in `table` and albedo of everything but the table."""
        robot = [(mesh, robot_link_poses[name], ALBEDO) for name, mesh in self._links.items() if name in robot_link_poses]
        return [(self._mesh(placed.item), _homogeneous(placed.pose), placed.albedo) for placed in items] + robot

    def _mesh(self, item: SimObject | Mesh) -> Mesh:
        if not isinstance(item, SimObject):
            return item
        # The object is kept as well, so that no other one gets its id.
        if id(item) not in self._meshes:
            self._meshes[id(item)] = item, _object_mesh(item)
        return self._meshes[id(item)][1]

    def _scene(self, placed: list[tuple[Mesh, Float64Array, float]]) -> _Scene:
        embree = EmbreeScene(_DEVICE)
        covered = np.zeros(self._table.shape, dtype=bool)
        corners = []
        for (points, triangles), pose, _ in placed:
            vertices = points @ pose[:3, :3].T + pose[:3, 3]
            TriangleMesh(embree, vertices.astype(np.float32), triangles.astype(np.int32))
            covered[self._window(vertices)] = True
            corners.append(vertices)
        return _Scene(embree, corners, covered)

    def _window(self, vertices: Float64Array, second: float = 0.0) -> tuple[slice, slice]:
        """Rows and columns of the image that hold all of `vertices` [m], shape (n, 3), `table` frame, and their shadow.

        Args:
            second: x of the viewpoint from which the shadow is cast, in the frame of the camera [m].
        """
        camera = self.intrinsics
        x, y, z = ((vertices - self.pose_camera_in_table[:3, 3]) @ self.pose_camera_in_table[:3, :3]).T
        if z.min() < 0.05:  # what comes so near may cover all of the image [m]
            return slice(None), slice(None)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        # On a background at infinity the shadow lies beside the thing by its whole disparity.
        shadow = u - camera.fx * second / z
        low, high = min(u.min(), shadow.min()) - self._slack, max(u.max(), shadow.max()) + self._slack
        rows = slice(max(0, int(v.min()) - self._slack), max(0, int(v.max()) + 2 + self._slack))
        return rows, slice(max(0, int(low)), max(0, int(high) + 2))


def _homogeneous(pose: ArrayLike) -> Float64Array:
    """Of a planar pose (x, y, yaw), or of a homogeneous one, which stays as it is."""
    given = np.asarray(pose, dtype=np.float64)
    if given.shape == (4, 4):
        return given
    x, y, yaw = given
    whole = np.eye(4)
    whole[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    whole[:2, 3] = x, y
    return whole


def _pixel_rays(pose: Float64Array, intrinsics: CameraIntrinsics, distortion: float) -> DepthImage:
    """Origin and direction of the ray through each pixel centre, one metre of depth long, shape (height, width, 6), `table` frame."""
    u, v = np.meshgrid(np.arange(intrinsics.width), np.arange(intrinsics.height))
    x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
    outwards = 1.0 + distortion * (x**2 + y**2)
    in_camera = np.stack([x * outwards, y * outwards, np.ones(u.shape)], axis=-1)
    rays = np.concatenate([np.broadcast_to(pose[:3, 3], in_camera.shape), in_camera @ pose[:3, :3].T], axis=-1)
    return np.asarray(rays, dtype=np.float32)


def _table_depth(rays: DepthImage, bounds: Sequence[float] = TABLE) -> DepthImage:
    """Depth of the empty table within `bounds`, x_min, x_max, y_min, y_max [m], along `rays` [m], shape (height, width), NaN beside it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -rays[..., 2] / rays[..., 5]
        at = rays[..., :2] + depth[..., None] * rays[..., 3:5]
    low, high = np.array(bounds)[[0, 2]], np.array(bounds)[[1, 3]]
    return np.where((depth > 0) & np.all((at >= low) & (at <= high), axis=-1), depth, np.float32(np.nan))


def _merge(meshes: list[Mesh]) -> Mesh:
    offsets = np.cumsum([0] + [len(points) for points, _ in meshes[:-1]])
    return np.concatenate([p for p, _ in meshes]), np.concatenate([f + o for (_, f), o in zip(meshes, offsets, strict=True)])


def _object_mesh(sim_object: SimObject) -> Mesh:
    size, (unit, triangles) = sim_object.cell_size, _convex_hull(_UNIT_BOX)
    return _merge(
        [
            (unit * (size, size, height) + (x, y, 0.5 * height), triangles)
            for (x, y), height in zip(sim_object.cells, sim_object.height, strict=True)
        ]
    )


def _robot_meshes(description: str) -> dict[str, Mesh]:
    """Collision geometry of each link in its frame, meshes as convex hulls."""
    links = {}
    for link in ET.fromstring(description).iter("link"):
        meshes = [_solid_mesh(collision) for collision in link.iter("collision")]
        if meshes:
            links[link.attrib["name"]] = _merge(meshes)
    return links


def _convex_hull(points: Float64Array) -> Mesh:
    hull = ConvexHull(points)
    return points[hull.vertices], np.searchsorted(hull.vertices, hull.simplices)


def _mesh_points(file: Path) -> Float64Array:
    """The outermost vertices of a mesh file in directions that cover the sphere: a coarse hull, since it is cast anew with each frame."""
    import coal

    if not file.is_file():
        raise InputError(f"The robot description has the mesh {plain_text(str(file))}, which is no file; install the package that has it.")
    points = np.array(coal.MeshLoader().load(str(file), np.ones(3)).vertices())
    return points[np.unique(np.argmax(points @ _sphere(16).T, axis=0))]


def _sphere(n: int) -> Float64Array:
    """Points of a unit sphere: n on each circle of latitude, the circles as far apart as they, and the poles; n is even."""
    circles = [np.column_stack([y * _round(n), np.full(n, x)]) for x, y in _round(n)[1 : n // 2]]
    return np.concatenate([*circles, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])


def _round(n: int) -> Float64Array:
    """Points of a unit circle, shape (n, 2)."""
    angle = 2.0 * np.pi * np.arange(n) / n
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _solid_points(solid: ET.Element) -> Float64Array:
    """Points whose convex hull is the geometry of a collision element, its frame [m], shape (n, 3)."""
    if solid.tag == "box":
        return _UNIT_BOX * np.array(solid.attrib["size"].split(), dtype=np.float64)
    if solid.tag == "cylinder":
        circle, half = float(solid.attrib["radius"]) * _round(32), 0.5 * float(solid.attrib["length"])
        return np.concatenate([np.column_stack([circle, np.full(len(circle), z)]) for z in (-half, half)])
    if solid.tag == "sphere":
        return float(solid.attrib["radius"]) * _sphere(20)
    if solid.tag == "mesh":
        return _mesh_points(Path(solid.attrib["filename"])) * np.array(solid.attrib.get("scale", "1 1 1").split(), dtype=np.float64)
    raise InputError(f"The robot description has a {solid.tag}, expected box, cylinder, sphere or mesh.")


def _solid_mesh(collision: ET.Element) -> Mesh:
    solid = collision.find("geometry/*")
    if solid is None:
        raise InputError("A collision element of the robot description has no geometry.")
    vertices, triangles = _convex_hull(_solid_points(solid))
    origin = collision.find("origin")
    if origin is not None:
        turned = Rotation.from_euler("xyz", [float(v) for v in origin.attrib.get("rpy", "0 0 0").split()])
        vertices = turned.apply(vertices) + [float(v) for v in origin.attrib.get("xyz", "0 0 0").split()]
    return vertices, triangles
