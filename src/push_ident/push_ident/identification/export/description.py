"""What a simulator needs to know of an object, whatever the format.

The object is a frame that carries the outline, and below it one link per cell. A cell stands on the table on one point below its
centre; the outline hovers over the table, so that it meets the pusher alone. Cells that slide along the vertical each rest on their
own weight, as the model has it; the frame then moves in the plane only (x, y, yaw). Cells that are fixed make one rigid body that moves
freely in space, and leave to the engine how they share its weight.

Effects that were identified beside the maps go into what a format has for them; those it has nothing for stand in a comment, with their
equation and values.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from push_ident import __version__
from push_ident.errors import InputError
from push_ident.geometry.convex import convex_pieces
from push_ident.physics.effect import ExportAs
from push_ident.physics.effect_values import EffectValues, changed_friction, effect_values
from push_ident.physics.effects import EFFECTS
from push_ident.types import Float64Array, ObjectModel

__all__ = ["CLEARANCE", "DEFAULT_HEIGHT", "ObjectDescription", "add_comment", "describe", "effect_notes", "numbers", "printable"]

CLEARANCE = 1e-3
"""Of the outline over the table [m]."""
DEFAULT_HEIGHT = 0.03
"""Of an object whose height nobody gave [m]."""
_FOOT_RADIUS = 0.125
"""Of the ball that a cell stands on, in cells: small, so that it stays within the outline under cells at its edge."""
_FRAME_SHARE = 1e-10
"""Mass and inertia of a link that is no cell, as a share of the object's: most engines refuse a moving link without."""


@dataclass(frozen=True, slots=True)
class ObjectDescription:
    """One object as links and joints. Everything in the object frame: origin on the table, z up."""

    name: str
    """Of the object frame, `object_<id>`."""
    centres: Float64Array
    """Feet of the cells [m], shape (n_cells, 2)."""
    mass: Float64Array
    """[kg], shape (n_cells,)."""
    friction: Float64Array
    """Of each cell on the table, shape (n_cells,)."""
    inertia: Float64Array
    """Of each cell about its own centre of mass, (I_xx, I_yy, I_zz) [kg m^2], shape (n_cells, 3): a square plate of the object's height."""
    frame_mass: float
    """Of each link that is no cell [kg]."""
    frame_inertia: float
    """The same about each axis [kg m^2]."""
    pieces: tuple[Float64Array, ...]
    """Convex polygons whose union is the outline, counter-clockwise [m], each shape (n, 2)."""
    pusher_friction: float
    """With the effect on it, where there is one."""
    effects: Mapping[str, tuple[float, ...]]
    """Values of the effects that act beside the maps, by name."""
    height: float
    """Of the top of the outline [m]."""
    foot_radius: float
    """[m]"""
    sliding: bool
    """Whether each cell is on a vertical joint of its own."""
    provenance: str
    """One line: what it was made from and by what."""

    def exported(self, part: ExportAs) -> tuple[float, ...] | None:
        """Values of the effects that `part` of a file carries, added up; None where there are none."""
        own = [values for name, values in self.effects.items() if EFFECTS[name].export is part]
        return tuple(map(sum, zip(*own, strict=True))) if len(own) > 1 else next(iter(own), None)

    @property
    def cell_names(self) -> list[str]:
        """Names of the links of the cells, in their order."""
        return [f"{self.name}_cell_{i}" for i in range(len(self.mass))]

    @property
    def cell_height(self) -> float:
        """Of the centre of mass of every cell [m]."""
        return self.height / 2

    @property
    def prisms(self) -> list[Float64Array]:
        """The pieces as solids: their corners at the bottom, then at the top [m], each shape (2 n, 3)."""
        return [np.array([[x, y, z] for z in (CLEARANCE, self.height) for x, y in piece]) for piece in self.pieces]


def describe(
    model: ObjectModel,
    *,
    object_id: str,
    source: str,
    height: float = DEFAULT_HEIGHT,
    sliding: bool = True,
    effects: EffectValues | None = None,
) -> ObjectDescription:
    """Describe an object for a simulator.

    Args:
        model: the maps.
        object_id: gives the frame its name, `object_<id>`; characters that names cannot have become `_`.
        source: file the model comes from, for the reader.
        height: of the object [m]; a push in the plane does not depend on it.
        sliding: each cell on a vertical joint of its own; else one rigid body.
        effects: that act beside the maps.

    Raises:
        InputError: a height within the clearance of the outline, or an outline that is no simple polygon.
    """
    if not (np.isfinite(height) and height > 2 * CLEARANCE):
        raise InputError(f"The height is {height} m, expected more than {2 * CLEARANCE} m, twice the gap below the outline.")
    acting = effect_values(effects)
    size, total = model.shape.cells.size, model.total_mass
    across = model.mass * (size**2 + height**2) / 12
    arms = model.shape.cells.centres - model.mass @ model.shape.cells.centres / total
    return ObjectDescription(
        name="object_" + "".join(c if c.isascii() and (c.isalnum() or c in "_.-") else "_" for c in object_id),
        centres=model.shape.cells.centres,
        mass=model.mass,
        friction=model.friction,
        inertia=np.column_stack([across, across, model.mass * size**2 / 6]),
        frame_mass=_FRAME_SHARE * total,
        frame_inertia=_FRAME_SHARE * float(model.mass @ (np.sum(arms**2, axis=1) + size**2 / 6)),
        pieces=tuple(convex_pieces(model.shape.outline)),
        pusher_friction=changed_friction(acting, model.pusher_friction)[0],
        effects={name: tuple(map(float, acting.values[acting.slice_of(name)])) for name in acting.names},
        height=height,
        foot_radius=_FOOT_RADIUS * size,
        sliding=sliding,
        provenance=f"Object {object_id} of {source}, exported by push_ident {__version__}.",
    )


def effect_notes(thing: ObjectDescription, carried: Mapping[ExportAs, str]) -> list[str]:
    """A line for each effect.

    Args:
        thing: the object.
        carried: by kind of effect, where it stands in the file; effects of no such kind are not in the file.
    """
    lines = []
    for name, values in thing.effects.items():
        effect = EFFECTS[name]
        sizes = ", ".join(f"{p.name} = {value:.6g} {p.unit}".rstrip() for p, value in zip(effect.parameters, values, strict=True))
        place = carried.get(effect.export) if effect.export else None
        where = f"stands in {place}." if place else f"is NOT in this file. {effect.what} {effect.equation}"
        lines.append(f"Effect {name} ({sizes}) {where}")
    return lines


def numbers(*values: float) -> str:
    """Numbers for an attribute, each with all the digits that bring back the same float."""
    return " ".join(repr(float(value)) for value in values)


def add_comment(root: ElementTree.Element, *lines: str) -> None:
    """Append a comment of some lines, whatever stands in them."""
    # XML has no two hyphens within a comment, and none of the characters that do not print.
    text = [printable(line).replace("--", "- -") for line in lines]
    root.append(ElementTree.Comment("\n    " + "\n    ".join(text) + "\n  "))


def printable(line: str) -> str:
    """The line with `?` for characters that do not print, such as line breaks."""
    return "".join(c if c.isprintable() else "?" for c in line)
