"""A scene of MuJoCo as a simulator of pushes: the tool follows the recorded path, whatever moves it in the scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.errors import InputError
from push_ident.extras import need
from push_ident.files import write_whole
from push_ident.geometry.se2 import compose, inverse, quaternion_of_yaw, rotation, transform_points, yaw_of_quaternion
from push_ident.identification.export.description import ObjectDescription, describe
from push_ident.identification.export.mjcf import IMPRATIO, SOLREF, TIME_STEP
from push_ident.physics.effect import ExportAs
from push_ident.physics.effect_values import EffectValues
from push_ident.simulators.measured import outline_offset
from push_ident.simulators.protocol import CONTACT, OBJECT
from push_ident.types import Float64Array, ObjectModel, PusherPath

_HEAVY: Final = 1e3
"""Mass and inertia of the tool [kg, kg m^2]: its speed is set in each step, and no contact changes it within one."""
_SETTLE: Final = 0.5
"""Time in which the object comes to rest on the table before a push [s]."""
_TABLE: Final = 1 << 29
"""Bit of the contact type of the table, once the object stands on feet of its own."""
_TOOL: Final = 1 << 30
"""Bit of tool and outline."""
_FRAME: Final = 1e-6
"""Mass and inertia of a body that only carries cells, relative to theirs [1]."""
_MOST_MOVES: Final = 20
"""By which an object leaves a tool that is recorded inside it, each by the deepest contact [1]: one is enough at a flat side."""
_LEAST: Final = 1e-12
"""Mass and inertia of a cell [kg, kg m^2]: MuJoCo refuses bodies that weigh nothing, as parts of cells cut at the outline may."""
_TILT: Final = 1e-3
"""Of an axis that counts as upright [1]."""

Edit = Callable[[Any], None]
"""Changes an `MjSpec`."""


@dataclass(frozen=True)
class MujocoScene:
    """A scene in an MJCF file whose z axis points up and whose world frame is `table_in_world`.

    The object has a free joint, or slide joints along x and y and a hinge about z. The tool has to be a child of the world: its joints are
    replaced by two slide joints that follow the recorded path with the recorded speed.
    """

    path: Path
    object_body: str
    tool_body: str
    table_in_world: Float64Array = field(default_factory=lambda: np.zeros(3))
    """(x, y, yaw) [m, m, rad]."""
    object_in_body: Float64Array = field(default_factory=lambda: np.zeros(3))
    """Frame of the recorded poses in the frame of the body (x, y, yaw) [m, m, rad]."""
    edits: tuple[Edit, ...] = ()
    """Changes to the scene, in their order."""

    def __post_init__(self) -> None:
        need("mujoco")
        self._compiled()

    @property
    def name(self) -> str:
        """The name of the file."""
        return self.path.name

    def write(self, path: Path) -> list[Path]:
        """Write the scene with its changes as MJCF, and read it again; its tool moves as in the file.

        Raises InputError where it cannot be read there, as beside relative mesh files.
        """
        spec = self._spec(driven=False)
        _compile(spec, self.path)
        write_whole(path, str(spec.to_xml()), "the scene")
        replace(self, path=path, edits=())
        return [path]

    @property
    def in_threads(self) -> bool:
        """As of `CorrectableSimulator`: MuJoCo keeps a simulation in its own `MjData`."""
        return True

    @property
    def words(self) -> Mapping[str, str]:
        """As of `CorrectableSimulator`."""
        return {
            OBJECT: "mass and friction of its geoms",
            CONTACT: "geom friction of the tool, option cone, impratio and timestep, solref",
            ExportAs.GRAVITY.value: "option gravity",
            ExportAs.PUSHER_FRICTION.value: "geom friction of the tool",
        }

    @property
    def contact_settings(self) -> str:
        """For people: gravity and contact of this scene."""
        option = self._compiled()[0].opt
        gravity = " ".join(f"{value:.4f}" for value in option.gravity)
        cone = "elliptic" if option.cone else "pyramidal"
        return (
            f'option gravity="{gravity}" cone="{cone}" impratio="{option.impratio:g}" timestep="{option.timestep:g}", solref of all geoms'
        )

    def with_object(self, model: ObjectModel, effects: EffectValues | None = None) -> MujocoScene:
        """The same scene in which the object stands on a foot under each cell with its mass and friction, and keeps its own shape for the
        tool; a tilt of the table is in the gravity, and a round tool as much thicker as the surface lies further out.

        The body then moves in the plane. Its geoms carry nothing any more: what they weighed is in the cells.
        """
        description = describe(model, object_id=self.object_body, source="the identification", effects=effects)

        def edit(spec: Any) -> None:
            _add_feet(spec, self, description)
            _widen(spec.body(self.tool_body), 0.0 if effects is None else outline_offset(effects))
            if slope := description.exported(ExportAs.GRAVITY):
                down = rotation(self.table_in_world[2]) @ np.array(slope)
                strength = float(np.linalg.norm(spec.option.gravity))
                spec.option.gravity = [*(strength * down), -strength]

        return replace(self, edits=(*self.edits, edit))

    def with_precise_contact(self, pusher_friction: float) -> MujocoScene:
        """The same scene with elliptic friction cones, stiff contact that does not creep, short steps, and a friction coefficient of the
        pusher, where the object stands on feet of its own."""
        return replace(self, edits=(*self.edits, partial(_make_precise, pusher_friction)))

    def simulate(self, first_pose: Float64Array, tool_path: PusherPath, times: Float64Array) -> Float64Array:
        """As of `PushSimulator`. Raises InputError where the simulation becomes unstable."""
        import mujoco

        model, placed = self._compiled()
        joints = [model.joint(_joint(self.tool_body, axis)) for axis in "xy"]
        places, speeds = ([int(getattr(joint, kind)[0]) for joint in joints] for kind in ("qposadr", "dofadr"))
        data = mujoco.MjData(model)
        body = model.body(self.object_body).id
        path = np.asarray(compose(self.table_in_world, np.column_stack([tool_path.position, np.zeros(len(tool_path.time))])))[:, :2]
        start = compose(compose(self.table_in_world, first_pose), inverse(self.object_in_body))
        placed(data, start)
        for _ in range(int(_SETTLE / model.opt.timestep)):
            data.qpos[places], data.qvel[speeds] = path[0], 0.0  # nothing but the path moves the tool: no gravity of a tilted table
            mujoco.mj_step(model, data)
        placed(data, start)
        data.qpos[places], data.qvel[speeds] = path[0], 0.0
        _move_out(model, data, lambda away: placed(data, start + np.array([*away, 0.0])), body, model.body(self.tool_body).id)
        step = model.opt.timestep
        ticks = np.arange(tool_path.time[0], max(tool_path.time[-1], times[-1]) + step, step)
        ways = np.column_stack([np.interp(ticks, tool_path.time, path[:, axis]) for axis in (0, 1)])
        poses = np.empty((len(ticks), 3))
        for k, here in enumerate(ways):
            data.qpos[places] = here
            data.qvel[speeds] = (ways[min(k + 1, len(ways) - 1)] - here) / step
            mujoco.mj_step(model, data)
            poses[k] = _pose(data, body)  # a step leaves the places of bodies as they were at its start
        if not np.all(np.isfinite(poses)) or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            raise InputError(f"{self.path} became unstable within a push; give it a shorter time step or softer contacts.")
        poses[:, 2] = np.unwrap(poses[:, 2])
        at_times = np.column_stack([np.interp(times, ticks, poses[:, column]) for column in range(3)])
        return np.asarray(compose(inverse(self.table_in_world), compose(at_times, self.object_in_body)))

    def _spec(self, *, driven: bool = True) -> Any:
        import mujoco

        try:
            spec = mujoco.MjSpec.from_file(str(self.path))
        except ValueError as error:
            raise InputError(f"MuJoCo cannot read {self.path}: {error}") from None
        for body in (self.object_body, self.tool_body):
            if spec.body(body) is None:
                names = ", ".join(one.name for one in spec.bodies if one.name) or "none with a name"
                raise InputError(f"{self.path} has no body `{body}`; it has {names}.")
        if driven:
            _drive(spec, self.path, self.tool_body)
        for edit in self.edits:
            edit(spec)
        return spec

    def _compiled(self) -> tuple[Any, Callable[[Any, Float64Array], None]]:
        """The model, and the function that puts the object to rest at a pose in the world."""
        model = _compile(self._spec(), self.path)
        return model, _placing(model, self.path, self.object_body)


def _compile(spec: Any, path: Path) -> Any:
    """The model of a scene. Raises InputError where MuJoCo refuses it, as for a mesh file that is missing."""
    try:
        return spec.compile()
    except ValueError as error:
        raise InputError(f"MuJoCo cannot compile {path}: {error}") from None


def _move_out(model: Any, data: Any, displace: Callable[[Float64Array], None], pushed: int, tool: int) -> None:
    """Move the object out of a tool that is recorded inside it, along the normals of their contacts: stiff contact would throw it away."""
    import mujoco

    of_object, of_tool = _with_descendants(model, pushed), _with_descendants(model, tool)
    away = np.zeros(2)
    for _ in range(_MOST_MOVES):
        mujoco.mj_forward(model, data)
        moves = []
        for contact in data.contact:
            first, second = model.geom_bodyid[contact.geom]
            # A normal points from the first geom of a contact to the second.
            sign = 1.0 if first in of_tool and second in of_object else -1.0 if first in of_object and second in of_tool else 0.0
            moves.append(sign * max(-contact.dist, 0.0) * contact.frame[:2])
        deepest = max(moves, key=np.linalg.norm, default=np.zeros(2))
        if not np.any(deepest):
            return
        away = away + deepest
        displace(away)


def _with_descendants(model: Any, body: int) -> set[int]:
    bodies = {body}
    for child in range(body + 1, model.nbody):
        if model.body_parentid[child] in bodies:
            bodies.add(child)
    return bodies


def _joint(body: str, axis: str) -> str:
    return f"{body}_recorded_{axis}"


def _drive(spec: Any, path: Path, name: str) -> None:
    """Let a body follow a path in the plane."""
    import mujoco

    body = spec.body(name)
    if body.parent.name != "world":
        raise InputError(
            f"The tool `{name}` of {path} hangs on `{body.parent.name}`; expected a body of the world, whose path can be prescribed. "
            "Copy its geoms to one, or give a Python function as simulator."
        )
    body.mocap = False
    for joint in list(body.joints):
        spec.delete(joint)
    for axis, direction in zip("xy", _world_axes(spec, path, name)[:2], strict=True):
        body.add_joint(name=_joint(name, axis), type=mujoco.mjtJoint.mjJNT_SLIDE, axis=direction)
    # The path is that of the origin of the body.
    body.pos = [0, 0, body.pos[2]]
    body.explicitinertial, body.mass, body.inertia, body.ipos = True, _HEAVY, [_HEAVY] * 3, [0, 0, 0]


def _placing(model: Any, path: Path, name: str) -> Callable[[Any, Float64Array], None]:
    """The function that puts an object to rest at (x, y, yaw) in the world, at its height and with its tilt."""
    import mujoco

    body = model.body(name)
    joints = [model.joint(int(body.jntadr[0]) + k) for k in range(int(body.jntnum[0]))]
    kinds = [int(joint.type[0]) for joint in joints]
    slide, hinge = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
    if kinds == [int(mujoco.mjtJoint.mjJNT_FREE)]:
        at, dof = int(joints[0].qposadr[0]), int(joints[0].dofadr[0])
        upright = np.array(model.qpos0[at + 3 : at + 7])

        def place(data: Any, pose: Float64Array) -> None:
            turn = quaternion_of_yaw(pose[2] - yaw_of_quaternion(upright[[1, 2, 3, 0]]))[[3, 0, 1, 2]]
            data.qpos[at : at + 2] = pose[:2]
            mujoco.mju_mulQuat(data.qpos[at + 3 : at + 7], turn, upright)
            data.qvel[dof : dof + 6] = 0.0

        return place
    along = [_rotation_matrix(body.quat) @ joint.axis for joint in joints]
    if kinds == [slide, slide, hinge] and np.allclose(along, np.eye(3), atol=_TILT):
        places, dofs = [int(joint.qposadr[0]) for joint in joints], [int(joint.dofadr[0]) for joint in joints]
        offset = np.array([*body.pos[:2], yaw_of_quaternion(np.array(body.quat)[[1, 2, 3, 0]])])

        def place_in_plane(data: Any, pose: Float64Array) -> None:
            data.qpos[places] = pose - offset
            data.qvel[dofs] = 0.0

        return place_in_plane
    raise InputError(
        f"The object `{name}` of {path} has {len(joints)} joints, expected a free joint, or slides along x and y of the world and a hinge "
        "about z, in this order."
    )


def _world_axes(spec: Any, path: Path, name: str) -> Float64Array:
    """The axes of the world in the frame of a body as it stands in the file, one a row, shape (3, 3)."""
    return _rotation_matrix(_compile(spec.copy(), path).body(name).quat)


def _rotation_matrix(quaternion: Float64Array) -> Float64Array:
    """Of a quaternion (w, x, y, z), shape (3, 3)."""
    import mujoco

    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def _pose(data: Any, body: int) -> Float64Array:
    """(x, y, yaw) of a body in the world, shape (3,)."""
    turn = data.xmat[body]
    return np.array([*data.xpos[body, :2], np.arctan2(turn[3], turn[0])])


def _make_precise(pusher_friction: float, spec: Any) -> None:
    import mujoco

    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = max(spec.option.impratio, IMPRATIO)
    spec.option.timestep = min(spec.option.timestep, TIME_STEP)
    for geom in spec.geoms:
        geom.solref = list(SOLREF)
        if geom.contype == _TOOL:
            geom.friction, geom.priority = [pusher_friction, geom.friction[1], geom.friction[2]], 1


def _add_feet(spec: Any, scene: MujocoScene, description: ObjectDescription) -> None:
    """Let the object stand on a foot under each cell, and meet only the tool with its own geoms."""
    import mujoco

    name = scene.object_body
    body, axes = spec.body(name), _world_axes(spec, scene.path, name)
    if not np.allclose(axes[2], [0, 0, 1], atol=_TILT):
        raise InputError(f"The z axis of `{name}` does not point up in the scene; give the object a body frame whose z axis does.")
    height = float(body.pos[2])
    _remove_feet(spec, scene)
    for joint in list(body.joints):
        spec.delete(joint)
    slide, hinge, sphere = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtGeom.mjGEOM_SPHERE
    for axis, kind, direction in zip(("x", "y", "yaw"), (slide, slide, hinge), axes, strict=True):
        body.add_joint(name=f"{name}_{axis}", type=kind, axis=direction)
    # Written files have six digits behind the point, and a moving body needs a mass.
    inertia_of_cells = float(description.mass @ np.sum(description.centres**2, axis=1))
    body.explicitinertial, body.mass, body.inertia = True, _FRAME * float(description.mass.sum()), [_FRAME * inertia_of_cells] * 3
    body.ipos = [0, 0, 0]
    for geom in spec.geoms:
        # Feet meet all that meets anything, but for object and tool, which have another bit below.
        if geom.contype or geom.conaffinity:
            geom.contype |= _TABLE
    for geom in (*_geoms_below(body), *_geoms_below(spec.body(scene.tool_body))):
        geom.contype, geom.conaffinity, geom.condim, geom.mass = _TOOL, _TOOL, 3, 0.0
    centres = transform_points(scene.object_in_body, description.centres)
    rows = zip(description.cell_names, centres, description.mass, description.inertia, description.friction, strict=True)
    for label, (x, y), mass, inertia, friction in rows:
        cell = body.add_body(name=label, pos=[x, y, -height])
        cell.add_joint(name=f"{label}_z", type=slide, axis=[0, 0, 1])
        cell.explicitinertial, cell.mass, cell.ipos = True, max(mass, _LEAST), [0, 0, description.cell_height]
        cell.inertia = [max(value, _LEAST) for value in inertia]
        foot = cell.add_geom(name=label, type=sphere, size=[description.foot_radius, 0, 0], pos=[0, 0, description.foot_radius])
        foot.contype, foot.conaffinity, foot.priority, foot.friction = 0, _TABLE, 1, [friction, 0.0, 0.0]


def _widen(tool: Any, by: float) -> None:
    """Make the round geoms of the tool thicker [m]."""
    import mujoco

    kinds = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER
    for geom in (one for one in _geoms_below(tool) if one.type in kinds):
        geom.size = [max(geom.size[0] + by, 1e-4), *geom.size[1:]]


def _remove_feet(spec: Any, scene: MujocoScene) -> None:
    """Take away the feet of an earlier correction; what else hangs on the object has to be fixed to it, and weighs nothing any more.

    Raises InputError for an object with other joints in it: it is not rigid.
    """
    import mujoco

    for child in _bodies_below(spec.body(scene.object_body)):
        if [joint.type for joint in child.joints] == [mujoco.mjtJoint.mjJNT_SLIDE] and len(child.geoms) == 1 and not child.bodies:
            spec.delete(child)
        elif child.joints:
            raise InputError(f"`{child.name}` of {scene.path} moves against `{scene.object_body}`; the object has to be rigid.")
        else:
            child.explicitinertial, child.mass, child.inertia = False, 0.0, [0.0] * 3


def _bodies_below(body: Any) -> list[Any]:
    return [below for child in body.bodies for below in (child, *_bodies_below(child))]


def _geoms_below(body: Any) -> list[Any]:
    """Geoms of a body and of all that hang on it."""
    return [*body.geoms, *(geom for child in body.bodies for geom in _geoms_below(child))]
