"""Description of an object for a simulator, independent of the format.

The object is a frame that carries the outline, and below it one link per cell. A cell touches the table at one point below its centre; the
outline is slightly above the table, so that only the pusher touches it. Cells on vertical joints carry their own weight, as in the model;
the frame then moves in the plane only (x, y, yaw). Fixed cells form one rigid body that moves freely in space, and the engine distributes
its weight over them.

A file represents the effects that its format can express. A comment in the file gives equation and values of the others.
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

CLEARANCE = 1e-3
"""Height of the outline above the table [m]."""
DEFAULT_HEIGHT = 0.03
"""Default height of an object [m]."""


@dataclass(frozen=True, slots=True)
class ObjectDescription:
    """One object as links and joints. Everything in the object frame: origin on the table, z up."""

    name: str
    """Name of the object frame, `object_<id>`."""
    centres: Float64Array
    """Feet of the cells [m], shape (n_cells, 2)."""
    mass: Float64Array
    """Mass of each cell [kg], shape (n_cells,)."""
    friction: Float64Array
    """Friction coefficient of each cell on the table, shape (n_cells,)."""
    inertia: Float64Array
    """Inertia of each cell about its centre of mass, (I_xx, I_yy, I_zz) [kg m^2], shape (n_cells, 3), as a square plate of its area."""
    frame_mass: float
    """Mass of each link other than a cell [kg]: most engines require one, and an inertia, for a moving link."""
    frame_inertia: float
    """Inertia of such a link about each axis [kg m^2]."""
    pieces: tuple[Float64Array, ...]
    """Convex polygons whose union is the outline, counter-clockwise [m], each shape (n, 2)."""
    pusher_friction: float
    """Friction coefficient of the pusher, including an effect on it."""
    effects: Mapping[str, tuple[float, ...]]
    """Values of the identified effects, by name."""
    height: float
    """Height of the top of the outline [m]."""
    foot_radius: float
    """Radius of the sphere under each cell [m]: small, so that it lies within the outline also under cells at its edge."""
    sliding: bool
    """Whether each cell has its own vertical joint."""
    provenance: str
    """One line: source and version of the program."""

    def exported(self, part: ExportAs) -> tuple[float, ...] | None:
        """Sum of the values of the effects that `part` of a file represents; None if there are none."""
        values_of_part = [values for name, values in self.effects.items() if EFFECTS[name].export is part]
        return tuple(map(sum, zip(*values_of_part, strict=True))) if len(values_of_part) > 1 else next(iter(values_of_part), None)

    @property
    def cell_names(self) -> list[str]:
        """Names of the links of the cells, in their order."""
        return [f"{self.name}_cell_{i}" for i in range(len(self.mass))]

    @property
    def cell_height(self) -> float:
        """Height of the centre of mass of every cell [m]."""
        return self.height / 2

    @property
    def prisms(self) -> list[Float64Array]:
        """The pieces as prisms: bottom corners, then top corners [m], each shape (2 n, 3)."""
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

    Invalid characters of its id become `_` in the name of its frame. A push in the plane does not depend on the height [m]. `source` is
    named in a comment.

    Raises:
        InputError: a height within the clearance of the outline, or an outline that is no simple polygon.
    """
    if not (np.isfinite(height) and height > 2 * CLEARANCE):
        raise InputError(f"The height is {height} m, expected more than {2 * CLEARANCE} m, twice the gap below the outline.")
    acting = effect_values(effects)
    cells, total = model.shape.cells, model.total_mass
    across = model.mass * (cells.areas + height**2) / 12
    arms = cells.centres - model.mass @ cells.centres / total
    return ObjectDescription(
        name="object_" + "".join(c if c.isascii() and (c.isalnum() or c in "_.-") else "_" for c in object_id),
        centres=cells.centres,
        mass=model.mass,
        friction=model.friction,
        inertia=np.column_stack([across, across, model.mass * cells.areas / 6]),
        frame_mass=1e-10 * total,
        frame_inertia=1e-10 * float(model.mass @ (np.sum(arms**2, axis=1) + cells.areas / 6)),
        pieces=tuple(convex_pieces(model.shape.outline)),
        pusher_friction=changed_friction(acting, model.pusher_friction)[0],
        effects={name: tuple(map(float, acting.values[acting.slice_of(name)])) for name in acting.names},
        height=height,
        foot_radius=0.125 * cells.size,
        sliding=sliding,
        provenance=f"Object {object_id} of {source}, exported by push_ident {__version__}.",
    )


def effect_notes(description: ObjectDescription, carried: Mapping[ExportAs, str]) -> list[str]:
    """One line for each effect. `carried`: place in the file of each part that represents an effect; it represents no other effects."""
    lines = []
    for name, values in description.effects.items():
        effect = EFFECTS[name]
        sizes = ", ".join(f"{p.name} = {value:.6g} {p.unit}".rstrip() for p, value in zip(effect.parameters, values, strict=True))
        position = carried.get(effect.export) if effect.export else None
        where = f"is in {position}." if position else f"is NOT in this file. {effect.what} {effect.equation}"
        lines.append(f"Effect {name} ({sizes}) {where}")
    return lines


def numbers(*values: float) -> str:
    """Numbers for an attribute, with enough digits to reproduce each float exactly."""
    return " ".join(repr(float(value)) for value in values)


def add_comment(root: ElementTree.Element, *lines: str) -> None:
    """Append a comment. Its lines may contain any characters."""
    # XML allows neither two hyphens nor unprintable characters in a comment.
    text = [printable(line).replace("--", "- -") for line in lines]
    root.append(ElementTree.Comment("\n    " + "\n    ".join(text) + "\n  "))


def printable(line: str) -> str:
    """The line with `?` in place of unprintable characters, such as line breaks."""
    return "".join(c if c.isprintable() else "?" for c in line)
