"""`push-ident fuzz`: mutated messages for every node, and mutated bags for every command that reads one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from push_ident.cli.experiment import sim_module
from push_ident.cli.output import JsonOption, console, warn, write_json
from push_ident.errors import InputError, PushIdentError

__all__ = ["fuzz_command"]

_KINDS = ("messages", "bags")
_OUT = Path("out/fuzz")


def fuzz_command(
    minutes: Annotated[float, typer.Option(min=0.1, help="For all nodes together; 12 are some 100 000 messages on two cores.")] = 12.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the mutations.")] = 0,
    only: Annotated[str, typer.Option(metavar="KIND", help="messages or bags. Default: both.", show_default=False)] = "",
    node: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Executables to fuzz. Default: all of the suite.", show_default=False)
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Logs of the nodes and what they wrote; emptied first.")] = _OUT,
    cases: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Minimised failures: those there are tried first, new ones are written.", show_default=False),
    ] = None,
    json: JsonOption = None,
    page: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the page of the results.", show_default=False)] = None,
) -> None:
    """Send mutated messages to every subscription and service of every node; they must live, answer and still do their work."""
    if only and only not in _KINDS:
        raise InputError(f"--only is {only!r}, expected one of {', '.join(_KINDS)}.")
    run = sim_module("push_ident_sim.fuzz.run")
    settings = run.Settings(minutes=minutes, seed=seed, nodes=run.nodes_of(tuple(node or ())), out=out, cases=cases)
    content = run.fuzz_messages(settings, lambda line: console.print(line, highlight=False, markup=False, soft_wrap=True))
    if json is not None:
        write_json(json, content)
        console.print(f"written: {json}", highlight=False, soft_wrap=True)
    if page is not None:
        sim_module("push_ident_sim.fuzz.page").write_page(page, content)
        console.print(f"written: {page}", highlight=False, soft_wrap=True)
    console.print(f"{content['mutated']} mutated messages in {content['minutes']} minutes, seed {seed}", highlight=False)
    for finding in content["findings"]:
        warn(f"{finding['node']}: {finding['text']} ({finding['file']})")
    if content["findings"]:
        raise PushIdentError(f"{len(content['findings'])} failures of nodes; `push-ident fuzz --cases DIR` tries them again.")
