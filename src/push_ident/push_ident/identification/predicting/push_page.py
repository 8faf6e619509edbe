"""The page of planned pushes: a drawing of each, with its command."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.identification.predicting.push_sequence import PushSequence
from push_ident.pages.outline_chart import Placed, outline_panels
from push_ident.pages.page import FigureSection, write_page
from push_ident.types import Float64Array

_CIRCLE: Final = np.linspace(0.0, 2.0 * np.pi, 37)[:-1]
_NOTE: Final = (
    "From above, each where the object is expected to lie then. Grey: before the push; dashed: where the expected object ends; "
    "circles: the tool at contact and, dashed, at the end."
)


def write_push_page(path: Path, sequence: PushSequence, commands: Sequence[str]) -> None:
    """Write the page (HTML). Raises InputError where it cannot be written."""
    drawings = [_drawing(sequence, number) for number in range(len(sequence.pushes))]
    errors = [f"{1e3 * error:.1f}" for error in sequence.errors]
    context = {
        "title": f"{len(drawings)} pushes for an object that nobody has pushed yet",
        "lead": f"Expected error of other pushes: {errors[0]} mm before the first one, {errors[-1]} mm after the last.",
        "section": FigureSection("The pushes, one after the other", outline_panels(drawings), _NOTE),
        "commands": commands,
    }
    write_page(path, __package__, "pushes.html.j2", context)


def _drawing(sequence: PushSequence, number: int) -> tuple[str, list[Placed]]:
    push, plan = sequence.pushes[number], sequence.pushes[number].plan
    assert plan is not None, "candidates have a plan"
    outline, radius = sequence.shape.outline, push.pusher.radius
    tool = [plan.tool_at_contact, plan.tool_end]
    placed = [
        Placed(transform_points(push.pose_object_in_table, outline), "before", "before"),
        Placed(transform_points(sequence.ends[number], outline), "predicted", "expected after it"),
        Placed(np.array(tool), "pusher", "way of the tool", closed=False),
        Placed(_disc(tool[0], radius), "pusher", "the tool at contact"),
        Placed(_disc(tool[1], radius), "other", "the tool at the end"),
    ]
    error = 1e3 * float(sequence.errors[number + 1])
    caption = f"{number + 1}: {1e3 * plan.distance:.0f} mm at {plan.speed:.2f} m/s; then {error:.1f} mm expected"
    return caption, placed


def _disc(centre: Float64Array, radius: float) -> Float64Array:
    return np.asarray(centre + radius * np.column_stack([np.cos(_CIRCLE), np.sin(_CIRCLE)]))
