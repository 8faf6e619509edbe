"""Options of `push-ident push-to`, and what of them goes together."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from push_ident.cli.checks import above_zero, finite
from push_ident.cli.goal_messages import EdgeLine
from push_ident.errors import InputError

__all__ = [
    "EdgeFlag",
    "EdgeLineOption",
    "EdgeOptions",
    "ExploreOption",
    "HeldOption",
    "MaxPushesOption",
    "ObjectOption",
    "OverhangOption",
    "PathOption",
    "PlaceOption",
    "SpacingOption",
    "SpeedOption",
    "TimeLimitOption",
    "ToleranceAngleOption",
    "ToleranceOption",
    "YawOption",
]

PlaceOption = Annotated[
    float | None, typer.Option(callback=finite, help="Goal of the object's origin in the table frame [m].", show_default=False)
]
YawOption = Annotated[
    float | None,
    typer.Option(callback=finite, help="Goal of the object's turn in the table frame [rad]; with --edge not needed.", show_default=False),
]
PathOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Along a path: a line for each pose, x, y, yaw [m, rad].", show_default=False),
]
SpacingOption = Annotated[
    float | None,
    typer.Option(
        "--spacing-mm", min=1.0, callback=above_zero, help="Push to poses on the path this far apart instead [mm].", show_default=False
    ),
]
SpeedOption = Annotated[
    float | None, typer.Option("--speed-mm", min=1.0, callback=above_zero, help="Along a path [mm/s].", show_default="50")
]
EdgeFlag = Annotated[bool, typer.Option("--edge", help="Out over an edge of the table, held on it, instead of to a pose.")]
EdgeLineOption = Annotated[
    str | None,
    typer.Option(
        metavar="X1,Y1,X2,Y2",
        help="Two points of the edge, the table on the left [m]. Default: the nearest edge that the node knows.",
        show_default=False,
    ),
]
OverhangOption = Annotated[
    float | None, typer.Option("--overhang-mm", min=1.0, callback=above_zero, help="Of the object beyond the edge [mm].", show_default="40")
]
HeldOption = Annotated[
    float | None,
    typer.Option(
        "--held-mm",
        min=0.1,
        callback=above_zero,
        help="Least distance of the centre of mass from the border of what supports it, at the edge [mm].",
        show_default="10",
    ),
]
ToleranceOption = Annotated[
    float | None,
    typer.Option(
        "--tolerance-mm", min=0.1, callback=above_zero, help="Largest distance from the goal [mm].", show_default="20; along a path 3"
    ),
]
ToleranceAngleOption = Annotated[
    float | None,
    typer.Option(
        "--tolerance-deg",
        min=0.1,
        callback=above_zero,
        help="Largest angle to the goal [degrees].",
        show_default="5.73; at an edge 15, along a path 2",
    ),
]
ExploreOption = Annotated[int, typer.Option(min=0, help="Random pushes first; 0: use what is known of the object.")]
MaxPushesOption = Annotated[
    int | None,
    typer.Option("--max-pushes", min=1, help="Most pushes for a goal, exploring ones included.", show_default="15; along a path 60"),
]
TimeLimitOption = Annotated[float, typer.Option("--time-limit", min=1.0, callback=above_zero, help="Longest time for a goal [s].")]
ObjectOption = Annotated[str, typer.Option("--object", metavar="ID", help="The object. Default: the only one.", show_default=False)]


class EdgeOptions:
    """The options of the command line for a goal at an edge; None: not given.

    Raises:
        InputError: no goal at an edge, and an option that is only for one; or a goal at an edge, and one that is for another goal.
    """

    def __init__(self, *, edge: bool, line: str | None, overhang_mm: float | None, held_mm: float | None, **others: object) -> None:
        own = {"--edge-line": line, "--overhang-mm": overhang_mm, "--held-mm": held_mm}
        if not edge and (given := [name for name, value in own.items() if value is not None]):
            raise InputError(f"{given[0]} was given without --edge; add --edge.")
        if edge and (given := [f"--{name}" for name, value in others.items() if value is not None]):
            raise InputError(f"--edge was given beside {', '.join(given)}; of a pose only --yaw goes with it.")
        self.line = None if line is None else EdgeLine(line)
        self.overhang_mm, self.held_mm = 40.0 if overhang_mm is None else overhang_mm, 10.0 if held_mm is None else held_mm
