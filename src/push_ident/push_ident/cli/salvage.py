"""`push-ident salvage`: what can still be read of a damaged bag."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from push_ident.bags.salvage import salvage
from push_ident.cli.checks import new_bag
from push_ident.cli.output import say


def salvage_command(
    bag: Annotated[Path, typer.Argument(help="A damaged MCAP bag.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="New bag.", callback=new_bag, show_default=False)],
) -> None:
    """Copy all readable messages of a truncated or damaged bag into a new bag."""
    report = salvage(bag, out)
    say(f"{report.total} messages recovered into {out}")
    if report.undecodable:
        say(f"{report.undecodable} left out: they are not of the type that the bag states for their topic", style="yellow")
