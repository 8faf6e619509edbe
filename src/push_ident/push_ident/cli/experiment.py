"""`push-ident experiment`: experiments on simulated ground truth, those of the paper included, and the pages of their results."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

from push_ident.cli.checks import above_zero, writable_folder
from push_ident.cli.output import Description, JsonOption, console, say, warn
from push_ident.errors import InputError

_LIST, _REPORT = "list", "report"
_FOLDER = Path("out/experiments")
_RESULTS = Path("docs/results")
_NameArgument = Annotated[
    str,
    typer.Argument(help="Experiment; `list` lists all, `report` writes the pages of their results.", show_default=False),
]
_ObjectsOption = Annotated[
    str, typer.Option(metavar="A,B|N", help="Objects, or a number of random ones for `goals`. Default: all.", show_default=False)
]
_OutOption = Annotated[
    Path,
    typer.Option(metavar="DIR", callback=writable_folder, help="Folder of single results; an interrupted run continues from them."),
]
_TruthOption = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR", callback=writable_folder, help="Folder of the ground-truth pushes. Default: truth/ in --out.", show_default=False
    ),
]
_ResultsOption = Annotated[
    Path,
    typer.Option(metavar="DIR", callback=writable_folder, help="Folder in which `report` writes a page for each JSON file of a result."),
]


def experiment_command(
    name: _NameArgument,
    objects: _ObjectsOption = "",
    models: Annotated[int, typer.Option(min=1, help="Number of ground truths of each object.")] = 10,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first ground truth; the others follow it.")] = 0,
    variants: Annotated[str, typer.Option(metavar="A,B", help="Variants of the experiment. Default: all.", show_default=False)] = "",
    seconds: Annotated[float, typer.Option(callback=above_zero, help="Budget of one solve [s].")] = 30.0,
    jobs: Annotated[int, typer.Option(min=1, help="Number of processes, each with one thread.")] = 2,
    out: _OutOption = _FOLDER,
    truth: _TruthOption = None,
    recordings: Annotated[Path, typer.Option(metavar="DIR", help="Recorded pushes (`recorded`, `held-out`).")] = Path("../shared/data"),
    goals: Annotated[int, typer.Option(min=1, help="Goals or starts of each object, for `goals`, `edge` and `pusht`.")] = 4,
    stop_after: Annotated[
        float | None,
        typer.Option(
            callback=above_zero, help="Begin no case later than this, and summarise those that are finished [min].", show_default=False
        ),
    ] = None,
    json: JsonOption = None,
    results: _ResultsOption = _RESULTS,
) -> None:
    """Run one of the experiments on simulated ground truth, or write the pages of all results."""
    known = sim_module("push_ident_sim.studies.registry").EXPERIMENTS
    if name == _LIST:
        say("\n".join(f"{study.name}: {study.title}" for study in known.values()))
        return
    if name == _REPORT:
        pages = sim_module("push_ident_sim.studies.common.pages")
        written = pages.write_experiments(known.values(), results, "push-ident experiment report")
        say("written: " + ", ".join(str(path) for path in written))
        return
    if name not in known:
        raise InputError(f"There is no experiment `{name}`; choose one of {', '.join(known)}, or {_REPORT}.")
    runner = sim_module("push_ident_sim.studies.common.runner")
    options = runner.RunOptions(
        folder=out,
        truth_folder=truth or out / "truth",
        objects=() if objects.isdigit() else _words(objects),
        n_models=int(objects) if objects.isdigit() else models,
        seed=seed,
        variants=_words(variants),
        jobs=jobs,
        max_seconds=seconds,
        recordings=recordings,
        goals=goals,
        stop_after=math.inf if stop_after is None else stop_after,
    )
    content = _with_progress(runner, known[name], options)
    say(known[name].tables(content["summary"]))
    studies = sim_module("push_ident_sim.studies.common.study")
    for text in studies.failures(content):
        warn(f"push-ident: {text}")
    if json is not None:
        studies.write_json(json, content)
        say(f"written: {json}")


def _with_progress(runner: ModuleType, study: Any, options: Any) -> dict[str, Any]:
    columns = (Description(), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(study.name)
        content: dict[str, Any] = runner.run_experiment(
            study, options, lambda what, done, total: progress.update(task, description=what, completed=done, total=total)
        )
    return content


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())


def sim_module(name: str) -> ModuleType:
    """A module of `push_ident_sim`. Only this function imports that package: the core works without it."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        remedy = "run `make setup` in a clone of the repository"
        raise InputError(f"This needs the simulated cell, but {error.name} is not installed; {remedy}.") from None
