"""`push-ident bench`: times and errors of the engine and of identification, and the page of the results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

from push_ident.cli.checks import writable_file
from push_ident.cli.experiment import sim_module
from push_ident.cli.output import Description, console, say
from push_ident.errors import InputError

_PAGE = Path("out/benchmarks.md")


def bench_command(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="Benchmarks; an unknown name lists them. Default: all.", show_default=False),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Few and small cases, only to check that everything runs.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of maps, pushes and noise.")] = 0,
    page: Annotated[
        Path,
        typer.Option(
            metavar="FILE", callback=writable_file, help="Page of the results; JSON files and pictures go into the folder of the same name."
        ),
    ] = _PAGE,
) -> None:
    """Measure time and error of engine, planning, identification, perception, scenes and rivals; about half an hour."""
    known = sim_module("push_ident_sim.studies.registry").BENCHMARKS
    runner, pages = sim_module("push_ident_sim.studies.common.runner"), sim_module("push_ident_sim.studies.common.pages")
    settings = sim_module("push_ident_sim.studies.common.study").Settings(quick, seed)
    if unknown := [name for name in names or () if name not in known]:
        raise InputError(f"There is no benchmark `{unknown[0]}`; choose some of {', '.join(known)}.")
    with Progress(Description(), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), console=console) as progress:
        for name in names or known:
            task = progress.add_task(name)
            result = runner.run_benchmark(
                known[name],
                settings,
                lambda what, done, total, task=task: progress.update(task, description=what, completed=done, total=total),
            )
            sim_module("push_ident_sim.studies.common.study").write_json(page.with_suffix("") / f"{name}.json", result)
    written = pages.write_benchmarks(known.values(), page)
    say(page.read_text(encoding="utf-8"))
    say("written: " + ", ".join(str(path) for path in written))
