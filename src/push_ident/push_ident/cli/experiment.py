"""`push-ident experiment`: the paper's experiments on simulated ground truth, and the page of their results."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from push_ident.cli.output import JsonOption, console, warn
from push_ident.errors import InputError

__all__ = ["experiment_command", "sim_module"]

_REPORT = "report"
_FOLDER = Path("out/experiments")
_PAGE = Path("docs/results/experiments.md")


def experiment_command(
    name: Annotated[
        str,
        typer.Argument(
            help="convergence, maps, training, real-protocol, coverage, next-push, online, live, cell, perception, pushing, settle, "
            "blind; "
            "`report` writes the page of their results.",
            show_default=False,
        ),
    ],
    objects: Annotated[str, typer.Option(metavar="A,B", help="Objects. Default: all five.", show_default=False)] = "",
    models: Annotated[int, typer.Option(help="Ground truths of each object.")] = 10,
    seed: Annotated[int, typer.Option(help="Of the first ground truth.")] = 0,
    variants: Annotated[str, typer.Option(metavar="A,B", help="Variants of the experiment. Default: all.", show_default=False)] = "",
    seconds: Annotated[float, typer.Option(help="Budget of one solve [s].")] = 30.0,
    jobs: Annotated[int, typer.Option(help="Processes, each with one thread.")] = 2,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Of single results; a run that was cut off goes on from them.")] = _FOLDER,
    truth: Annotated[Path | None, typer.Option(metavar="DIR", help="Of the pushes. Default: truth/ in --out.", show_default=False)] = None,
    recordings: Annotated[Path, typer.Option(metavar="DIR", help="Recorded scenes, for `perception`.")] = Path("../shared/data"),
    json: JsonOption = None,
    page: Annotated[Path, typer.Option(metavar="FILE", help="Of `report`; reads the JSON files in the folder of the same name.")] = _PAGE,
) -> None:
    """Run one of the paper's experiments on simulated ground truth, or write the page of all results."""
    known = sim_module("push_ident_sim.studies").EXPERIMENTS
    if name == _REPORT:
        written = sim_module("push_ident_sim.studies.common.report").write_report(known, page, "push-ident experiment report")
        console.print("written: " + ", ".join(str(path) for path in written), highlight=False, soft_wrap=True)
        return
    if name not in known:
        raise InputError(f"There is no experiment `{name}`; choose one of {', '.join(known)}, or {_REPORT}.")
    running = sim_module("push_ident_sim.studies.common.runner")
    options = running.RunOptions(
        folder=out,
        truth_folder=truth or out / "truth",
        **({"objects": _words(objects)} if objects else {}),
        n_models=models,
        seed=seed,
        variants=_words(variants),
        jobs=jobs,
        max_seconds=seconds,
        recordings=recordings,
    )
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(name)
        content = running.run_experiment(
            known[name], options, lambda what, done, total: progress.update(task, description=what, completed=done, total=total)
        )
    console.print(known[name].tables(content["summary"]), highlight=False, markup=False, soft_wrap=True)
    for failure in content["failed"]:
        warn(f"push-ident: {failure['case']}: {failure['error']}")
    if json is not None:
        running.write_json(json, content)
        console.print(f"written: {json}", highlight=False, soft_wrap=True)


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())


def sim_module(name: str) -> ModuleType:
    """Part of the simulated cell, which stands beside this package and is looked up only here: the core works without it."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise InputError(f"This needs the simulated cell, but {error.name} is not installed; run `make setup`.") from None
