"""`push-ident`: the command line of the package."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from push_ident import __version__
from push_ident.cli.bench import bench_command
from push_ident.cli.demo import demo_command
from push_ident.cli.diagnose import diagnose_command
from push_ident.cli.experiment import experiment_command
from push_ident.cli.export import export_command
from push_ident.cli.faults import faults_command
from push_ident.cli.fleet import fleet_command
from push_ident.cli.fuzz import fuzz_command
from push_ident.cli.identify import identify_command
from push_ident.cli.importing import import_app
from push_ident.cli.live import doctor_command, replay_command, up_command
from push_ident.cli.look import look_command
from push_ident.cli.output import console, warn
from push_ident.cli.predict import predict_command
from push_ident.cli.push_to import push_to_command
from push_ident.cli.simulate import simulate_command
from push_ident.errors import PushIdentError

__all__ = ["app", "main"]

app = typer.Typer(name="push-ident", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


def _show_version(asked: bool) -> None:
    if asked:
        console.print(f"push-ident {__version__}", highlight=False)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")] = False,
) -> None:
    """Identify mass and friction of an unknown object by pushing it."""


app.command("look")(look_command)
app.command("identify")(identify_command)
app.command("predict")(predict_command)
app.command("diagnose")(diagnose_command)
app.command("fleet")(fleet_command)
app.command("export")(export_command)
app.command("replay")(replay_command)
app.add_typer(import_app, name="import")
app.command("up")(up_command)
app.command("push-to")(push_to_command)
app.command("experiment")(experiment_command)
app.command("simulate")(simulate_command)
app.command("bench")(bench_command)
app.command("faults")(faults_command)
app.command("fuzz")(fuzz_command)
app.command("demo")(demo_command)
app.command("doctor")(doctor_command)


@app.command("salvage")
def salvage_command(
    bag: Annotated[Path, typer.Argument(help="A damaged MCAP bag.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="New bag.", show_default=False)],
) -> None:
    """Copy all readable messages of a truncated or damaged bag into a new bag."""
    from push_ident.bags.salvage import salvage

    report = salvage(bag, out)
    console.print(f"{report.total} messages recovered into {out}", highlight=False, soft_wrap=True)


def main() -> None:
    """Run the command line: expected errors end in one line and exit status 1, Ctrl-C in status 130."""
    try:
        app(standalone_mode=True)
    except PushIdentError as error:
        warn(f"push-ident: {error}")
        sys.exit(1)
