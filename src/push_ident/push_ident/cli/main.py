"""`push-ident`: the command line of the package."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from push_ident import __version__
from push_ident.cli.lazy import LazyGroup
from push_ident.cli.output import console, warn
from push_ident.errors import PushIdentError
from push_ident.extras import how_to_get

__all__ = ["app", "main"]

LazyGroup.places = {
    name: f"push_ident.cli.{place}"
    for name, place in {
        "look": "look:look_command",
        "identify": "identify:identify_command",
        "predict": "predict:predict_command",
        "diagnose": "diagnose:diagnose_command",
        "fleet": "fleet:fleet_command",
        "export": "export:export_command",
        "replay": "live:replay_command",
        "import": "importing:import_app",
        "up": "live:up_command",
        "push": "push:push_command",
        "push-to": "push_to:push_to_command",
        "experiment": "experiment:experiment_command",
        "simulate": "simulate:simulate_command",
        "bench": "bench:bench_command",
        "faults": "faults:faults_command",
        "fuzz": "fuzz:fuzz_command",
        "demo": "demo:demo_command",
        "doctor": "live:doctor_command",
        "salvage": "salvage:salvage_command",
    }.items()
}
app = typer.Typer(
    name="push-ident",
    cls=LazyGroup,
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["--help", "-h"]},
)


def _show_version(asked: bool) -> None:
    if asked:
        console.print(f"push-ident {__version__}", highlight=False)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")] = False,
) -> None:
    """Identify mass and friction of an unknown object by pushing it."""


def main() -> None:
    """Run the command line: expected errors end in one line and exit status 1, Ctrl-C in status 130."""
    try:
        app(standalone_mode=True)
    except PushIdentError as error:
        warn(f"push-ident: {error}")
        sys.exit(1)
    except ModuleNotFoundError as error:
        remedy = how_to_get(error.name or "")
        if remedy is None:
            raise
        warn(f"push-ident: {remedy}")
        sys.exit(1)
