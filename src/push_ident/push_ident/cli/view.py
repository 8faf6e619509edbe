"""`push-ident view`: a bag in the viewer Rerun."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from push_ident.cli.checks import writable_file
from push_ident.cli.identify import MapOption, read_options
from push_ident.cli.output import say
from push_ident.extras import need
from push_ident.offline.bag_view import write_bag_view


def view_command(
    bag: Annotated[Path, typer.Argument(help="Bag in MCAP: a folder or a file.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Recording of Rerun.", callback=writable_file)] = Path("out/view.rrd"),
    map_: MapOption = None,
) -> None:
    """Write a bag with a layout for the viewer Rerun: table with objects and pusher, depth, forces, positions, and every other topic."""
    need("viewer")
    out.parent.mkdir(parents=True, exist_ok=True)
    views = write_bag_view(bag, out, read_options(map_, None))
    say(f"written: {out} ({', '.join(views)}); open it with `rerun --bind 127.0.0.1 {out}`")
