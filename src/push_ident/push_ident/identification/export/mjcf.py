"""MJCF, the format of MuJoCo: one file, the outline included."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement

from push_ident.identification.export.description import ObjectDescription, add_comment, effect_notes, numbers
from push_ident.physics.effect import ExportAs
from push_ident.physics.support import GRAVITY

__all__ = ["mjcf"]

_NOTE = (
    "The friction of cells and outline (priority 1) overrides that of the table and the pusher.",
    'A model to which this one is attached needs the option cone="elliptic" as well.',
    "The table can have MuJoCo's default contype and conaffinity; with 2 for both a pusher touches only the outline.",
)
_CARRIED = {
    ExportAs.PUSHER_FRICTION: "the friction of the outline",
    ExportAs.GRAVITY: "the option gravity, which a model to which this one is attached needs as well",
}
_SOLREF = (0.004, 1.0)
"""Time constant [s] and damping ratio of a contact. With MuJoCo's default of 20 ms the outline yields to the pusher."""


def mjcf(thing: ObjectDescription) -> Element:
    """The object as a model without table and pusher, to be included or attached."""
    root = Element("mujoco", model=thing.name)
    add_comment(root, thing.provenance, *_NOTE, *effect_notes(thing, _CARRIED))
    # With the default pyramid, friction is stronger along some directions of the table than along others.
    option = SubElement(root, "option", cone="elliptic")
    if slope := thing.exported(ExportAs.GRAVITY):
        slope_x, slope_y = slope
        option.set("gravity", numbers(GRAVITY * slope_x, GRAVITY * slope_y, -GRAVITY))
    if thing.effects:
        custom = SubElement(root, "custom")
        for name, values in thing.effects.items():
            SubElement(custom, "numeric", name=f"{thing.name}_{name}", data=numbers(*values))
    _add_defaults(SubElement(root, "default"), thing)
    asset = SubElement(root, "asset")
    meshes = [f"{thing.name}_outline_{i}" for i in range(len(thing.pieces))]
    for mesh, prism in zip(meshes, thing.prisms, strict=True):
        SubElement(asset, "mesh", name=mesh, vertex=numbers(*prism.ravel()))

    frame = SubElement(SubElement(root, "worldbody"), "body", name=thing.name)
    if thing.sliding:
        for joint, kind, axis in (("x", "slide", "1 0 0"), ("y", "slide", "0 1 0"), ("yaw", "hinge", "0 0 1")):
            SubElement(frame, "joint", name=f"{thing.name}_{joint}", type=kind, axis=axis)
    else:
        SubElement(frame, "freejoint", name=f"{thing.name}_free")
    SubElement(frame, "inertial", pos="0 0 0", mass=numbers(thing.frame_mass), diaginertia=numbers(*[thing.frame_inertia] * 3))
    for mesh in meshes:
        SubElement(frame, "geom", {"name": mesh, "class": f"{thing.name}_outline", "mesh": mesh})
    rows = zip(thing.cell_names, thing.centres, thing.mass, thing.inertia, thing.friction, strict=True)
    for name, (x, y), mass, inertia, friction in rows:
        cell = SubElement(frame, "body", name=name, pos=numbers(x, y, 0))
        if thing.sliding:
            SubElement(cell, "joint", name=f"{name}_z", type="slide", axis="0 0 1")
        SubElement(cell, "inertial", pos=numbers(0, 0, thing.cell_height), mass=numbers(mass), diaginertia=numbers(*inertia))
        SubElement(cell, "geom", {"name": name, "class": f"{thing.name}_cell", "friction": numbers(friction, 0, 0)})
    return root


def _add_defaults(default: Element, thing: ObjectDescription) -> None:
    contact = {"condim": "3", "priority": "1", "solref": numbers(*_SOLREF)}
    cell = SubElement(default, "default", {"class": f"{thing.name}_cell"})
    # Cells meet only what offers itself to bit 1: not the pusher with bit 2, and not each other.
    attributes = {"size": numbers(thing.foot_radius), "pos": numbers(0, 0, thing.foot_radius), "contype": "0", "conaffinity": "1"}
    SubElement(cell, "geom", {"type": "sphere", **attributes, **contact})
    outline = SubElement(default, "default", {"class": f"{thing.name}_outline"})
    attributes = {"friction": numbers(thing.pusher_friction, 0, 0), "contype": "3", "conaffinity": "3"}
    SubElement(outline, "geom", {"type": "mesh", **attributes, **contact})
