"""MJCF, the format of MuJoCo: one file, the outline included."""

from __future__ import annotations

from typing import Final
from xml.etree.ElementTree import Element, SubElement

from push_ident.identification.export.description import ObjectDescription, add_comment, effect_notes, numbers
from push_ident.physics.effect import ExportAs
from push_ident.physics.support import GRAVITY

_NOTE = (
    "The friction of cells and outline (priority 1) overrides that of the table and the pusher.",
    "A model to which this one is attached needs the options as well; with longer steps and softer contact it is faster, and less exact.",
    "The table can have MuJoCo's default contype and conaffinity; with 2 for both a pusher touches only the outline.",
)
_CARRIED = {
    ExportAs.PUSHER_FRICTION: "the friction of the outline",
    ExportAs.GRAVITY: "the option gravity, which a model to which this one is attached needs as well",
}
TIME_STEP: Final = 5e-4
"""[s]"""
SOLREF: Final = (2e-3, 1.0)
"""Time constant [s], which has to be 2 steps at least, and damping ratio of a contact. With MuJoCo's default of 20 ms the outline yields to
the pusher."""
IMPRATIO: Final = 10.0
"""Of friction to normal force [1]: with MuJoCo's default of 1, a contact that sticks creeps."""


def mjcf(description: ObjectDescription) -> Element:
    """The object as a model without table and pusher, to be included or attached."""
    root = Element("mujoco", model=description.name)
    add_comment(root, description.provenance, *_NOTE, *effect_notes(description, _CARRIED))
    # With the default pyramid, friction is stronger along some directions of the table than along others.
    option = SubElement(root, "option", cone="elliptic", impratio=numbers(IMPRATIO), timestep=numbers(TIME_STEP))
    if slope := description.exported(ExportAs.GRAVITY):
        slope_x, slope_y = slope
        option.set("gravity", numbers(GRAVITY * slope_x, GRAVITY * slope_y, -GRAVITY))
    if description.effects:
        custom = SubElement(root, "custom")
        for name, values in description.effects.items():
            SubElement(custom, "numeric", name=f"{description.name}_{name}", data=numbers(*values))
    _add_defaults(SubElement(root, "default"), description)
    asset = SubElement(root, "asset")
    meshes = [f"{description.name}_outline_{i}" for i in range(len(description.pieces))]
    for mesh, prism in zip(meshes, description.prisms, strict=True):
        SubElement(asset, "mesh", name=mesh, vertex=numbers(*prism.ravel()))

    frame = SubElement(SubElement(root, "worldbody"), "body", name=description.name)
    if description.sliding:
        for joint, kind, axis in (("x", "slide", "1 0 0"), ("y", "slide", "0 1 0"), ("yaw", "hinge", "0 0 1")):
            SubElement(frame, "joint", name=f"{description.name}_{joint}", type=kind, axis=axis)
    else:
        SubElement(frame, "freejoint", name=f"{description.name}_free")
    SubElement(frame, "inertial", pos="0 0 0", mass=numbers(description.frame_mass), diaginertia=numbers(*[description.frame_inertia] * 3))
    for mesh in meshes:
        SubElement(frame, "geom", {"name": mesh, "class": f"{description.name}_outline", "mesh": mesh})
    rows = zip(description.cell_names, description.centres, description.mass, description.inertia, description.friction, strict=True)
    for name, (x, y), mass, inertia, friction in rows:
        cell = SubElement(frame, "body", name=name, pos=numbers(x, y, 0))
        if description.sliding:
            SubElement(cell, "joint", name=f"{name}_z", type="slide", axis="0 0 1")
        SubElement(cell, "inertial", pos=numbers(0, 0, description.cell_height), mass=numbers(mass), diaginertia=numbers(*inertia))
        SubElement(cell, "geom", {"name": name, "class": f"{description.name}_cell", "friction": numbers(friction, 0, 0)})
    return root


def _add_defaults(default: Element, description: ObjectDescription) -> None:
    contact = {"condim": "3", "priority": "1", "solref": numbers(*SOLREF)}
    cell = SubElement(default, "default", {"class": f"{description.name}_cell"})
    # Cells collide only with geoms whose contype has bit 1: not with a pusher on bit 2, and not with each other.
    attributes = {
        "size": numbers(description.foot_radius),
        "pos": numbers(0, 0, description.foot_radius),
        "contype": "0",
        "conaffinity": "1",
    }
    SubElement(cell, "geom", {"type": "sphere", **attributes, **contact})
    outline = SubElement(default, "default", {"class": f"{description.name}_outline"})
    attributes = {"friction": numbers(description.pusher_friction, 0, 0), "contype": "3", "conaffinity": "3"}
    SubElement(outline, "geom", {"type": "mesh", **attributes, **contact})
