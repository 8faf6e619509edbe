"""SDF, the format of Gazebo; the outline is a mesh in a second file."""

from __future__ import annotations

import math
from collections.abc import Iterable
from xml.etree.ElementTree import Element, SubElement

from push_ident.identification.export.description import ObjectDescription, add_comment, effect_notes, numbers
from push_ident.physics.effect import ExportAs

_VERSION = "1.9"
_CARRIED = {ExportAs.PUSHER_FRICTION: "the friction of the outline", ExportAs.CELL_ANISOTROPY: "mu, mu2 and fdir1 of the cells"}
_NOTE = (
    "Gazebo uses the smaller of two coefficients of friction: those of table and pusher must be at least those of the object.",
    "The table can have the default collide_bitmask; with 2 the pusher touches only the outline.",
    "PyBullet reads neither friction nor inertia of SDF, and no joint to the world: use the URDF for it.",
)
_NO_LIMIT = 1e6
"""Limit of a joint without limits [m, rad]: the format requires one."""
_CELL_BIT, _OUTLINE_BITS = "1", "3"


def sdf(description: ObjectDescription, mesh: str) -> Element:
    """The object as a model; `mesh` is the file name of its outline. Sliding cells hang on a chain of joints from the world."""
    root = Element("sdf", version=_VERSION)
    add_comment(root, description.provenance, *_NOTE, *effect_notes(description, _CARRIED))
    model = SubElement(root, "model", name=description.name)
    frame_inertia = [description.frame_inertia] * 3
    if description.sliding:
        for link in ("x", "y"):
            _add_inertial(SubElement(model, "link", name=f"{description.name}_{link}"), description.frame_mass, 0.0, frame_inertia)
    frame = SubElement(model, "link", name=description.name)
    _add_inertial(frame, description.frame_mass, 0.0, frame_inertia)
    for element in ("visual", "collision"):
        part = SubElement(frame, element, name="outline")
        _add_text(SubElement(SubElement(part, "geometry"), "mesh"), "uri", mesh)
        if element == "collision":
            _add_surface(part, description.pusher_friction, _OUTLINE_BITS)
    rows = zip(description.cell_names, description.centres, description.mass, description.inertia, description.friction, strict=True)
    for name, (x, y), mass, inertia, friction in rows:
        cell = SubElement(model, "link", name=name)
        _add_text(cell, "pose", numbers(x, y, 0, 0, 0, 0))
        _add_inertial(cell, mass, description.cell_height, inertia)
        foot = SubElement(cell, "collision", name="foot")
        _add_text(foot, "pose", numbers(0, 0, description.foot_radius, 0, 0, 0))
        _add_text(SubElement(SubElement(foot, "geometry"), "sphere"), "radius", numbers(description.foot_radius))
        _add_surface(foot, friction, _CELL_BIT, description.exported(ExportAs.CELL_ANISOTROPY) or (0.0, 0.0))
    if description.sliding:
        _add_joint(model, f"{description.name}_x_joint", "prismatic", "world", f"{description.name}_x", "1 0 0")
        _add_joint(model, f"{description.name}_y_joint", "prismatic", f"{description.name}_x", f"{description.name}_y", "0 1 0")
        _add_joint(model, f"{description.name}_yaw_joint", "continuous", f"{description.name}_y", description.name, "0 0 1")
    for name in description.cell_names:
        if description.sliding:
            _add_joint(model, f"{name}_joint", "prismatic", description.name, name, "0 0 1")
        else:
            _add_joint(model, f"{name}_joint", "fixed", description.name, name, None)
    return root


def _add_text(parent: Element, tag: str, text: str) -> None:
    SubElement(parent, tag).text = text


def _add_joint(model: Element, name: str, kind: str, parent: str, child: str, axis: str | None) -> None:
    joint = SubElement(model, "joint", name=name, type=kind)
    _add_text(joint, "parent", parent)
    _add_text(joint, "child", child)
    if axis is None:
        return
    element = SubElement(joint, "axis")
    _add_text(element, "xyz", axis)
    limit = SubElement(element, "limit")
    _add_text(limit, "lower", numbers(-_NO_LIMIT))
    _add_text(limit, "upper", numbers(_NO_LIMIT))


def _add_inertial(link: Element, mass: float, height: float, inertia: Iterable[float]) -> None:
    inertial = SubElement(link, "inertial")
    _add_text(inertial, "pose", numbers(0, 0, height, 0, 0, 0))
    _add_text(inertial, "mass", numbers(mass))
    tensor = SubElement(inertial, "inertia")
    for tag, value in zip(("ixx", "iyy", "izz"), inertia, strict=True):
        _add_text(tensor, tag, numbers(value))
    for tag in ("ixy", "ixz", "iyz"):
        _add_text(tensor, tag, "0")


def _add_surface(collision: Element, friction: float, bits: str, skew: tuple[float, ...] = (0.0, 0.0)) -> None:
    """`skew`: (a, b) of E = [[a, b], [b, -a]]. Its eigenvalues raise friction along one direction and lower it across that direction."""
    surface = SubElement(collision, "surface")
    ode = SubElement(SubElement(surface, "friction"), "ode")
    strength = math.hypot(*skew)
    for tag, value in (("mu", friction * (1.0 + strength)), ("mu2", friction * (1.0 - strength))):
        _add_text(ode, tag, numbers(value))
    if strength:
        along = 0.5 * math.atan2(skew[1], skew[0])
        _add_text(ode, "fdir1", numbers(math.cos(along), math.sin(along), 0.0))
    _add_text(SubElement(surface, "contact"), "collide_bitmask", bits)
