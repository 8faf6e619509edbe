"""An object of Bullet as a simulator of pushes: a URDF or SDF on a plane, pushed by a ball that follows the recorded path.

Bullet solves friction on the axes of the table, each with its own effective mass: where these differ, as at the ends of a long object, the
direction of a friction force is up to 30 degrees wrong, whatever the parameters are (docs/how-to/own-simulator.md).
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np

from push_ident.errors import InputError
from push_ident.extras import need
from push_ident.geometry.se2 import compose, inverse, quaternion_of_yaw, rotation, yaw_of_quaternion
from push_ident.identification.export.description import ObjectDescription, describe
from push_ident.identification.export.files import write_description
from push_ident.physics.effect import ExportAs
from push_ident.physics.effect_values import EffectValues
from push_ident.physics.support import GRAVITY
from push_ident.simulators.protocol import CONTACT, OBJECT
from push_ident.types import Float64Array, ObjectModel, PusherPath

_HEAVY: Final = 1e3
"""Mass of the tool [kg]: its speed is set in each step, and no contact changes it within one."""
_SETTLE: Final = 0.3
"""Time in which the object comes to rest on the table before a push [s]."""
_STEP: Final = 1.0 / 240.0
"""Time step, Bullet's default [s]. A quarter of it changes less than the error of Bullet's friction (docs/how-to/own-simulator.md)."""
_SWELLING: Final = 1e-3
"""By which Bullet makes a mesh too large [m]."""
_MOST_JOINTS: Final = 120
"""Of an object with sliding cells: PyBullet reports the state of a body with up to 127."""

Place = Callable[[Float64Array], None]
Pose = Callable[[], Float64Array]


@dataclass(frozen=True)
class BulletScene:
    """An object in a URDF or SDF file whose z axis points up, at rest on a plane whose world frame is `table_in_world`.

    Bullet multiplies the friction of two bodies: that of the plane and of the pusher are as in the user's program. Gazebo, whose format SDF
    is, takes the smaller one: with 1 here, that of the object, on a table and against a pusher that are no smoother.
    """

    path: Path
    table_friction: float = 1.0
    """Lateral friction of the plane [1]."""
    pusher_friction: float = 1.0
    """Lateral friction of the pusher [1]."""
    table_in_world: Float64Array = field(default_factory=lambda: np.zeros(3))
    """(x, y, yaw) [m, m, rad]."""
    object_in_body: Float64Array = field(default_factory=lambda: np.zeros(3))
    """Frame of the recorded poses in the frame of the base link (x, y, yaw) [m, m, rad]."""
    identified: ObjectDescription | None = None
    """In place of the object of the file."""
    precise: bool = False

    def __post_init__(self) -> None:
        need("bullet")
        with self._world(0.01):
            pass

    @property
    def name(self) -> str:
        """The name of the file."""
        return self.path.name

    @property
    def gravity(self) -> Float64Array:
        """For `setGravity` [m/s^2], shape (3,): a tilt of the table is in it."""
        slope = None if self.identified is None else self.identified.exported(ExportAs.GRAVITY)
        along = np.zeros(2) if slope is None else rotation(self.table_in_world[2]) @ np.array(slope)
        return np.array([*(GRAVITY * along), -GRAVITY])

    def with_object(self, model: ObjectModel, effects: EffectValues | None = None) -> BulletScene:
        """The same scene with an object that stands on a foot under each cell with its mass and friction, and has the outline of the
        recorded poses' frame with the friction against the pusher of the file; plane and pusher then have a friction of 1."""
        sliding = len(model.mass) <= _MOST_JOINTS
        description = describe(model, object_id=self.path.stem, source="the identification", effects=effects, sliding=sliding)
        description = replace(description, pusher_friction=self._friction_against_pusher())
        return replace(self, identified=description, table_friction=1.0, pusher_friction=1.0, object_in_body=np.zeros(3))

    def with_precise_contact(self, pusher_friction: float) -> BulletScene:
        """The same scene with a friction cone in place of Bullet's pyramid and, where the object was identified, a friction coefficient of
        the pusher."""
        identified = None if self.identified is None else replace(self.identified, pusher_friction=pusher_friction)
        return replace(self, precise=True, identified=identified)

    @property
    def in_threads(self) -> bool:
        """As of `CorrectableSimulator`: PyBullet keeps its clients in one table."""
        return False

    @property
    def words(self) -> Mapping[str, str]:
        """As of `CorrectableSimulator`."""
        if _is_sdf(self.path):
            pusher = "mu and mu2 of the outline"
            return {
                OBJECT: "inertial and surface of its links",
                CONTACT: pusher,
                ExportAs.GRAVITY.value: "gravity of the world",
                ExportAs.PUSHER_FRICTION.value: pusher,
            }
        return {
            OBJECT: "inertial and lateral_friction of its links",
            CONTACT: "lateralFriction of the pusher, enableConeFriction",
            ExportAs.GRAVITY.value: "setGravity",
            ExportAs.PUSHER_FRICTION.value: "lateralFriction of the pusher",
        }

    @property
    def contact_settings(self) -> str:
        """For people: what a program has to set for the gravity and the contact of this scene."""
        if _is_sdf(self.path):
            gravity = " ".join(f"{value:.4f}" for value in self.gravity)
            return (
                f"<gravity>{gravity}</gravity> of the world, table and pusher no smoother than the object; compared in Bullet, "
                "with a cone of friction: Gazebo did not run; a comment in the file names the rest"
            )
        gravity = ", ".join(f"{value:.4f}" for value in self.gravity)
        return (
            f"setGravity({gravity}), setPhysicsEngineParameter(enableConeFriction=1), lateralFriction {self.table_friction:g} of the plane "
            f"and {self.pusher_friction:g} of the pusher, which is 1 mm thinner for the mesh; a comment in the file names the rest"
        )

    def write(self, path: Path) -> list[Path]:
        """Write the identified object with its mesh, as SDF where the suffix says so and else as URDF; the files written. Raises InputError
        where none was identified."""
        if self.identified is None:
            raise InputError(f"{self.path} has no identified object that could be written; correct it first with `with_object`.")
        return write_description(path, self.identified, "sdf" if _is_sdf(path) else "urdf")

    def simulate(self, first_pose: Float64Array, tool_path: PusherPath, times: Float64Array) -> Float64Array:
        """As of `PushSimulator`; a pusher that is no cylinder is refused.

        Raises InputError for that, and where the simulation becomes unstable.
        """
        if not tool_path.shape.is_cylinder:
            raise InputError("A scene of Bullet has a round pusher, and that of these pushes is none; use a scene of MuJoCo.")
        path = np.asarray(compose(self.table_in_world, np.column_stack([tool_path.position, np.zeros(len(tool_path.time))])))[:, :2]
        start = np.asarray(compose(compose(self.table_in_world, first_pose), inverse(self.object_in_body)))
        ticks = np.arange(tool_path.time[0], max(tool_path.time[-1], times[-1]) + _STEP, _STEP)
        ways = np.column_stack([np.interp(ticks, tool_path.time, path[:, axis]) for axis in (0, 1)])
        speeds = np.diff(ways, axis=0, append=ways[-1:]) / _STEP
        poses = np.empty((len(ticks), 3))
        with self._world(tool_path.radius) as (client, tool, place, pose):
            place(start)
            for _ in range(int(_SETTLE / _STEP)):
                client.stepSimulation()
            place(start)
            for k, (here, speed) in enumerate(zip(ways, speeds, strict=True)):
                for axis in (0, 1):
                    client.resetJointState(tool, axis, here[axis], speed[axis])
                client.stepSimulation()
                poses[k] = pose()
        if not np.all(np.isfinite(poses)):
            raise InputError(f"{self.path} became unstable within a push; look at its masses and inertias.")
        poses[:, 2] = np.unwrap(poses[:, 2])
        # A step leaves the bodies at its end.
        at_times = np.column_stack([np.interp(times, ticks + _STEP, poses[:, column]) for column in range(3)])
        return np.asarray(compose(inverse(self.table_in_world), compose(at_times, self.object_in_body)))

    def _friction_against_pusher(self) -> float:
        """Of the object of the file, or of the identified one."""
        client = _connected()
        try:
            body = self._loaded(client)[0]
            outline = 2 if _is_in_plane(client, body) else -1  # the link after the joints along x and y and about z
            return float(client.getDynamicsInfo(body, outline)[1]) * self.pusher_friction
        finally:
            client.disconnect()

    @contextmanager
    def _world(self, radius: float) -> Iterator[tuple[Any, int, Place, Pose]]:
        """Bullet with the plane, the object and the tool, far away; the functions place the object at rest, and tell its pose."""
        import pybullet as bullet

        client = _connected()
        try:
            client.setGravity(*self.gravity)
            client.setTimeStep(_STEP)
            client.setPhysicsEngineParameter(enableConeFriction=int(self.precise))
            plane = client.createMultiBody(0, client.createCollisionShape(bullet.GEOM_PLANE))
            client.changeDynamics(plane, -1, lateralFriction=self.table_friction)
            body, place, pose = self._loaded(client)
            _free_joints(client, body)
            top = max(client.getAABB(body, link)[1][2] for link in range(-1, client.getNumJoints(body)))
            thinner = _SWELLING if self.identified is not None else 0.0
            yield client, _add_tool(client, plane, max(radius - thinner, 1e-4), 0.5 * top, self.pusher_friction), place, pose
        finally:
            client.disconnect()

    def _loaded(self, client: Any) -> tuple[int, Place, Pose]:
        if self.identified is None:
            body = _load(client, self.path)
        else:
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "identified.urdf"
                self.write(file)
                body = _load(client, file)
        return _object_in_plane(client, body) if _is_in_plane(client, body) else _free_object(client, body)


def _is_in_plane(client: Any, body: int) -> bool:
    """Whether a body hangs on joints along x and y and about z, as an exported object with sliding cells."""
    import pybullet as bullet

    in_plane = [bullet.JOINT_PRISMATIC, bullet.JOINT_PRISMATIC, bullet.JOINT_REVOLUTE]
    return [client.getJointInfo(body, joint)[2] for joint in range(min(3, client.getNumJoints(body)))] == in_plane


def _connected() -> Any:
    """A client of Bullet of its own."""
    import pybullet as bullet
    from pybullet_utils.bullet_client import BulletClient

    with _nothing_on_standard_output():
        return BulletClient(connection_mode=bullet.DIRECT)


@contextmanager
def _nothing_on_standard_output() -> Iterator[None]:
    """Bullet says hello and warns there, where results may be written."""
    sys.stdout.flush()
    output = os.dup(1)
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        try:
            yield
        finally:
            os.dup2(output, 1)
            os.close(output)


def _load(client: Any, path: Path) -> int:
    """A body. Raises InputError where Bullet cannot read it."""
    import pybullet as bullet

    try:
        if _is_sdf(path):
            return _load_sdf(client, path)
        return int(client.loadURDF(str(path), flags=bullet.URDF_USE_INERTIA_FROM_FILE))
    except bullet.error as error:
        raise InputError(
            f"Bullet cannot read {path}: {error}. Give a URDF or SDF of the object, with inertias, and mesh paths relative to it."
        ) from None


def _is_sdf(path: Path) -> bool:
    return path.suffix.lower() == ".sdf"


def _load_sdf(client: Any, path: Path) -> int:
    """A model of one body. Bullet reads shapes, masses and fixed joints; inertia and friction are read here, for it takes neither."""
    links = _links_of_sdf(path)
    with _nothing_on_standard_output():
        bodies = client.loadSDF(str(path))
    if len(bodies) != 1:
        raise InputError(f"{path} has {len(bodies)} models, expected one: the object alone.")
    body = int(bodies[0])
    names = [client.getBodyInfo(body)[0], *(client.getJointInfo(body, joint)[12] for joint in range(client.getNumJoints(body)))]
    names = [name.decode("utf-8") for name in names]
    if set(names) != set(links):
        raise InputError(
            f"{path} has the links {sorted(links)}, of which Bullet reads {sorted(names)}; give one model without models in it."
        )
    for number, name in enumerate(names, start=-1):
        friction, inertia = links[name]
        client.changeDynamics(body, number, lateralFriction=friction)
        if inertia is not None:
            client.changeDynamics(body, number, localInertiaDiagonal=inertia)
    return body


def _links_of_sdf(path: Path) -> dict[str, tuple[float, list[float] | None]]:
    """Coefficient of friction [1], 1 where none is given, and moments of inertia [kg m^2] of each link; a push in the plane depends on no
    product of inertia. Raises InputError where it is no XML or a link has more than one coefficient."""
    try:
        links = ElementTree.parse(path).getroot().iter("link")
        read = {}
        for link in links:
            coefficients = {float(one.findtext("surface/friction/ode/mu", "1")) for one in link.iter("collision")}
            if len(coefficients) > 1:
                raise InputError(
                    f"{path}: the collisions of the link `{link.get('name')}` have the coefficients of friction {sorted(coefficients)}, "
                    "expected one, as Bullet has one for a link; make links of them with fixed joints."
                )
            tensor = link.find("inertial/inertia")
            inertia = None if tensor is None else [float(tensor.findtext(tag, "1")) for tag in ("ixx", "iyy", "izz")]
            read[link.get("name", "")] = (next(iter(coefficients), 1.0), inertia)
    except (OSError, ElementTree.ParseError, ValueError) as error:
        raise InputError(f"Cannot read {path}: {error}. Give an SDF of the object.") from None
    return read


def _free_joints(client: Any, body: int) -> None:
    """Bullet brakes joints by motors, and motions by damping."""
    import pybullet as bullet

    joints = range(client.getNumJoints(body))
    if joints:
        client.setJointMotorControlArray(body, joints, bullet.VELOCITY_CONTROL, forces=[0.0] * len(joints))
    for link in (-1, *joints):
        client.changeDynamics(body, link, linearDamping=0, angularDamping=0, jointDamping=0)


def _free_object(client: Any, body: int) -> tuple[int, Place, Pose]:
    """Functions of a body that moves freely in space, at the height at which it stands on the plane."""
    lowest = min(client.getAABB(body, link)[0][2] for link in range(-1, client.getNumJoints(body)))
    (x, y, z), turn = client.getBasePositionAndOrientation(body)
    # Bullet speaks of the centre of mass of the base; the file, of its frame.
    centre, axes = client.getDynamicsInfo(body, -1)[3:5]
    link_in_centre = client.invertTransform(centre, axes)
    height = client.multiplyTransforms((x, y, z), turn, *link_in_centre)[0][2] - lowest

    def place(pose: Float64Array) -> None:
        link = (pose[0], pose[1], height), quaternion_of_yaw(pose[2]).tolist()
        client.resetBasePositionAndOrientation(body, *client.multiplyTransforms(*link, centre, axes))
        client.resetBaseVelocity(body, [0, 0, 0], [0, 0, 0])

    def pose() -> Float64Array:
        position, turn = client.multiplyTransforms(*client.getBasePositionAndOrientation(body), *link_in_centre)
        return np.array([position[0], position[1], yaw_of_quaternion(np.array(turn))])

    return body, place, pose


def _object_in_plane(client: Any, body: int) -> tuple[int, Place, Pose]:
    """Functions of an exported object with sliding cells, which hangs on joints along x, y and about z."""

    def place(pose: Float64Array) -> None:
        for joint in range(client.getNumJoints(body)):
            client.resetJointState(body, joint, float(pose[joint]) if joint < 3 else 0.0, 0.0)

    return body, place, lambda: np.array([state[0] for state in client.getJointStates(body, range(3))])


def _add_tool(client: Any, plane: int, radius: float, height: float, friction: float) -> int:
    """A ball, which upright walls touch at one point, on two sliding joints; far away."""
    import pybullet as bullet

    ball = client.createCollisionShape(bullet.GEOM_SPHERE, radius=radius)
    tool = client.createMultiBody(
        0, linkMasses=[1, _HEAVY], linkCollisionShapeIndices=[-1, ball], linkVisualShapeIndices=[-1, -1],
        linkPositions=[[0, 0, height], [0, 0, 0]], linkOrientations=[[0, 0, 0, 1]] * 2, linkInertialFramePositions=[[0, 0, 0]] * 2,
        linkInertialFrameOrientations=[[0, 0, 0, 1]] * 2, linkParentIndices=[0, 1], linkJointTypes=[bullet.JOINT_PRISMATIC] * 2,
        linkJointAxis=[[1, 0, 0], [0, 1, 0]],
    )  # fmt: skip
    _free_joints(client, tool)
    client.changeDynamics(tool, 1, lateralFriction=friction, restitution=0)
    client.setCollisionFilterPair(plane, tool, -1, 1, 0)
    for axis in (0, 1):
        client.resetJointState(tool, axis, 10.0)
    return int(tool)
