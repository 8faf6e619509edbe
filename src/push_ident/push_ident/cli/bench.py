"""`push-ident bench`: times and errors of the engine and of identification, and the page of the results."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from push_ident.cli.output import console
from push_ident.errors import InputError

__all__ = ["bench_command"]

_PAGE = Path("out/benchmarks.md")
_TRUTH = Path("out/experiments/truth")


def bench_command(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="engine, autograd, bullet, solve, methods. Default: all.", show_default=False),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Few and small cases: to see that everything runs.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of maps, pushes and noise.")] = 0,
    page: Annotated[
        Path, typer.Option(metavar="FILE", help="Report; JSON files and pictures go into the folder of the same name.")
    ] = _PAGE,
    truth: Annotated[Path, typer.Option(metavar="DIR", help="Of ground-truth pushes, shared with the experiments.")] = _TRUTH,
) -> None:
    """Measure time and error of the engine, of its rivals and of identification; about six minutes."""
    known = _module("push_ident_sim.studies").BENCHMARKS
    running = _module("push_ident_sim.studies.common.bench_runner")
    settings = _module("push_ident_sim.studies.common.benchmark").Settings(truth, quick, seed)
    if unknown := [name for name in names or () if name not in known]:
        raise InputError(f"There is no benchmark `{unknown[0]}`; choose some of {', '.join(known)}.")
    with Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), console=console) as progress:
        for name in names or known:
            task = progress.add_task(name)
            result = running.run_benchmark(
                known[name],
                settings,
                lambda what, done, total, task=task: progress.update(task, description=what, completed=done, total=total),
            )
            running.write_results(result, page)
    written = running.write_page(list(known.values()), page)
    console.print(page.read_text(encoding="utf-8"), highlight=False, markup=False, soft_wrap=True)
    console.print("written: " + ", ".join(str(path) for path in written), highlight=False, soft_wrap=True)


def _module(name: str) -> ModuleType:
    """Part of the simulated cell, which stands beside this package and is looked up only here: the core works without it."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise InputError(f"Benchmarks need the simulated cell, but {error.name} is not installed; run `make setup`.") from None
