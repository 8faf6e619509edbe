"""`push-ident faults`: the fault suite against live nodes, and the table of its results."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text

from push_ident.cli.experiment import sim_module
from push_ident.cli.output import JsonOption, OutOption, console
from push_ident.errors import InputError

__all__ = ["faults_command"]


def faults_command(
    only: Annotated[str, typer.Option(metavar="N,..", help="Numbers or names of faults. Default: all.", show_default=False)] = "",
    fast: Annotated[bool, typer.Option("--fast", help="Only the faults that are part of the tests.")] = False,
    list_them: Annotated[bool, typer.Option("--list", help="List the faults and inject none.")] = False,
    repeat: Annotated[int, typer.Option(min=1, max=100, help="How often each fault is injected.")] = 1,
    out: OutOption = None,
    json: JsonOption = None,
) -> None:
    """Inject faults into live nodes and check what holds; the page of the results is written beside the JSON. Needs root for some."""
    chosen = _chosen(sim_module("push_ident_sim.faults.registry").FAULTS, only, fast)
    if list_them:
        for fault in chosen:
            console.print(f"{fault.number:3d} {fault.name}: {fault.what}", highlight=False, markup=False, soft_wrap=True)
        return
    report, began, done = sim_module("push_ident_sim.faults.report"), time.monotonic(), 0

    def show(result: Any) -> None:
        nonlocal done
        done += 1
        _show(result, done, len(chosen) * repeat, time.monotonic() - began)

    folder = out or Path(tempfile.mkdtemp(prefix="push_ident_faults_"))
    results = sim_module("push_ident_sim.faults.run").run_faults(chosen * repeat, folder, show)
    content = report.result_json(results)
    console.print(
        f"{content['passed']} held, {content['failed']} did not, {content['skipped']} could not be injected; "
        f"{content['time_s']:.0f} s; logs in {folder}",
        highlight=False,
        soft_wrap=True,
    )
    if json is not None:
        written = report.write_results(json, content)
        console.print("written: " + ", ".join(str(path) for path in written), highlight=False, soft_wrap=True)
    if content["failed"]:
        raise typer.Exit(1)


def _chosen(faults: tuple[Any, ...], only: str, fast: bool) -> tuple[Any, ...]:
    wanted = [word.strip() for word in only.split(",") if word.strip()]
    known = {str(fault.number) for fault in faults} | {fault.name for fault in faults}
    if unknown := [word for word in wanted if word not in known]:
        raise InputError(f"There is no fault {unknown[0]!r}; `push-ident faults --list` names them.")
    return tuple(f for f in faults if (not wanted or str(f.number) in wanted or f.name in wanted) and (f.fast or not fast))


def _show(result: Any, done: int, n: int, seconds: float) -> None:
    """One line a fault, and one for each reason."""
    word, style = ("held", "green") if result.passed else ("skipped", "yellow") if result.impossible else ("FAILED", "bold red")
    hold = "" if result.hold is None or result.hold.seconds is None else f", arm stood after {1e3 * result.hold.seconds:.0f} ms"
    line = f"[{seconds:5.0f} s] {done}/{n}  {result.fault.number:3d} {result.fault.name}: "
    console.print(Text.assemble(line, (word, style), hold), soft_wrap=True)
    for reason in (*result.failures, *([result.impossible] if result.impossible else [])):
        console.print(Text(f"            {reason}", style=style), soft_wrap=True)
