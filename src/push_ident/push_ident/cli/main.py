"""`push-ident`: the command line of the package."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from push_ident import __version__
from push_ident.cli.lazy import LazyCommand, LazyGroup
from push_ident.cli.memory import limit_memory
from push_ident.cli.output import say, warn
from push_ident.errors import PushIdentError
from push_ident.extras import how_to_get

LazyGroup.lazy_subcommands = {
    name: LazyCommand(f"push_ident.cli.{place}", summary)
    for name, place, summary in (
        ("look", "look:look_command", "Find table, noise and objects in depth images"),
        ("view", "view:view_command", "Write a bag for the viewer Rerun"),
        ("identify", "identify:identify_command", "Identify the mass and friction maps from recorded pushes"),
        ("predict", "predict:predict_command", "Predict recorded pushes with a model and compare"),
        ("diagnose", "diagnose:diagnose_command", "Report which missing effect causes a gap, and where"),
        ("fix", "fix:fix_command", "Correct a scene of MuJoCo by recorded pushes"),
        ("selftest", "selftest:selftest_command", "Show what recorded pushes can tell, and what not"),
        ("check-calibration", "check_calibration:check_calibration_command", "Check where camera and tool stand by the contacts of pushes"),
        ("fleet", "fleet:fleet_command", "Identify many bags in parallel"),
        ("plan-pushes", "plan_pushes:plan_pushes_command", "Plan the first pushes of an object from its outline"),
        ("export", "export:export_command", "Write a model for a simulator"),
        ("replay", "live:replay_command", "Play a bag through the live nodes and show the maps"),
        ("import", "importing:import_app", "Convert own tables and bags, or published recordings"),
        ("up", "live:up_command", "Start the node processes of a cell; Ctrl-C stops them"),
        ("push", "push:push_command", "Push an object of a live cell"),
        ("push-to", "push_to:push_to_command", "Push an object of a live cell to a goal or along a path"),
        ("experiment", "experiment:experiment_command", "Run an experiment on simulated ground truth"),
        ("simulate", "simulate:simulate_command", "Push an object in the simulated cell and write a bag"),
        ("bench", "bench:bench_command", "Measure time and error of the engine and of identification"),
        ("demo", "demo:demo_command", "Push, identify and predict an object of the simulated cell"),
        ("doctor", "live:doctor_command", "Report packages, ROS, live topics, and what is missing"),
        ("salvage", "salvage:salvage_command", "Copy the readable messages of a damaged bag"),
    )
}
_READ_FILES = frozenset({"look", "identify", "predict", "diagnose", "fix", "selftest", "check-calibration", "import", "salvage", "view"})
"""Commands that read what others recorded, in this process."""
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
        say(f"push-ident {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")] = False,
) -> None:
    """Identify mass and friction of an unknown object by pushing it."""
    if context.invoked_subcommand in _READ_FILES:
        limit_memory()


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
