"""URDF with the friction in the elements that Bullet reads; the outline is a mesh in a second file.

URDF has no collision filters: only their positions separate cells and outline (feet within the outline, outline above the table).
"""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement

from push_ident.identification.export.description import ObjectDescription, add_comment, effect_notes, numbers
from push_ident.physics.effect import ExportAs

_NOTE = (
    "Friction is in `contact`, an extension of Bullet. Bullet multiplies the coefficients of two bodies: set 1 for table and pusher.",
    "In PyBullet: loadURDF(flags=URDF_USE_INERTIA_FROM_FILE), setPhysicsEngineParameter(enableConeFriction=1), and for all links",
    "changeDynamics(linearDamping=0, angularDamping=0) and setJointMotorControl2(VELOCITY_CONTROL, force=0).",
    "Bullet grows meshes by 1 mm: make a round pusher 1 mm thinner, and use a capsule instead of a cylinder.",
    "PyBullet cannot report the state of a body with more than 127 joints.",
)
_CARRIED = {ExportAs.PUSHER_FRICTION: "the friction of the outline"}
_NO_LIMIT = 1e6
"""Limit of effort [N], speed [m/s] and travel [m] of a joint without limits: the format requires one."""


def urdf(description: ObjectDescription, mesh: str) -> Element:
    """The object as a robot; `mesh` is the file name of its outline. Sliding cells hang on a chain of joints from the link `table`."""
    root = Element("robot", name=description.name)
    add_comment(root, description.provenance, *_NOTE, *effect_notes(description, _CARRIED))
    if description.sliding:
        table = SubElement(root, "link", name="table")
        # Bullet fixes a link without mass.
        _add_inertial(table, 0.0, 0.0, [0.0, 0.0, 0.0])
        parent = "table"
        chain = [("x", "prismatic", "1 0 0"), ("y", "prismatic", "0 1 0"), ("yaw", "continuous", "0 0 1")]
        for joint, kind, axis in chain:
            child = description.name if joint == "yaw" else f"{description.name}_{joint}"
            _add_joint(root, f"{description.name}_{joint}_joint", kind, parent, child, axis=axis)
            parent = child
        for joint in ("x", "y"):
            _add_inertial(
                SubElement(root, "link", name=f"{description.name}_{joint}"), description.frame_mass, 0.0, [description.frame_inertia] * 3
            )
    frame = SubElement(root, "link", name=description.name)
    _add_inertial(frame, description.frame_mass, 0.0, [description.frame_inertia] * 3)
    _add_friction(frame, description.pusher_friction)
    for element in ("visual", "collision"):
        SubElement(SubElement(SubElement(frame, element), "geometry"), "mesh", filename=mesh)
    rows = zip(description.cell_names, description.centres, description.mass, description.inertia, description.friction, strict=True)
    for name, (x, y), mass, inertia, friction in rows:
        kind = "prismatic" if description.sliding else "fixed"
        _add_joint(root, f"{name}_joint", kind, description.name, name, axis="0 0 1" if description.sliding else None, xyz=numbers(x, y, 0))
        cell = SubElement(root, "link", name=name)
        _add_inertial(cell, mass, description.cell_height, inertia)
        _add_friction(cell, friction)
        collision = SubElement(cell, "collision")
        SubElement(collision, "origin", xyz=numbers(0, 0, description.foot_radius))
        SubElement(SubElement(collision, "geometry"), "sphere", radius=numbers(description.foot_radius))
    return root


def _add_joint(root: Element, name: str, kind: str, parent: str, child: str, *, axis: str | None, xyz: str = "0 0 0") -> None:
    joint = SubElement(root, "joint", name=name, type=kind)
    SubElement(joint, "origin", xyz=xyz)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    if axis is None:
        return
    SubElement(joint, "axis", xyz=axis)
    if kind == "prismatic":
        limits = {"lower": -_NO_LIMIT, "upper": _NO_LIMIT, "effort": _NO_LIMIT, "velocity": _NO_LIMIT}
        SubElement(joint, "limit", {key: numbers(value) for key, value in limits.items()})


def _add_inertial(link: Element, mass: float, height: float, inertia: list[float]) -> None:
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=numbers(0, 0, height))
    SubElement(inertial, "mass", value=numbers(mass))
    diagonal = dict(zip(("ixx", "iyy", "izz"), (numbers(value) for value in inertia), strict=True))
    SubElement(inertial, "inertia", {**diagonal, "ixy": "0", "ixz": "0", "iyz": "0"})


def _add_friction(link: Element, friction: float) -> None:
    SubElement(SubElement(link, "contact"), "lateral_friction", value=numbers(friction))
