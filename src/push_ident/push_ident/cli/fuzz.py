"""`push-ident fuzz`: mutated messages for every node, mutated bags for every command that reads one, mutated depth frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from push_ident.cli.checks import above_zero, writable_file, writable_folder
from push_ident.cli.experiment import sim_module
from push_ident.cli.output import JsonOption, console, warn, write_json
from push_ident.errors import InputError, PushIdentError
from push_ident.limits import plain_text

__all__ = ["fuzz_command"]

_KINDS = ("messages", "bags", "frames")
_OUT = Path("out/fuzz")
_NodeOption = Annotated[
    list[str] | None, typer.Option(metavar="NAME", help="Executables to fuzz. Default: all of the suite.", show_default=False)
]
_OutOption = Annotated[
    Path, typer.Option(metavar="DIR", callback=writable_folder, help="Logs of the nodes and what they wrote; emptied first.")
]
_CasesOption = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        callback=writable_folder,
        help="Minimised failures: those there are tried first, new ones are written.",
        show_default=False,
    ),
]
_PageOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        callback=writable_file,
        help="Write the page, and its numbers beside it; those of the other kinds stay.",
        show_default=False,
    ),
]


def fuzz_command(
    minutes: Annotated[
        float, typer.Option(min=0.1, callback=above_zero, help="In all; the same share for messages, bags and frames.")
    ] = 40.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the mutations.")] = 0,
    only: Annotated[str, typer.Option(metavar="KIND", help="messages, bags or frames. Default: all.", show_default=False)] = "",
    node: _NodeOption = None,
    out: _OutOption = _OUT,
    cases: _CasesOption = None,
    json: JsonOption = None,
    page: _PageOption = None,
) -> None:
    """Mutated messages for every node, which must live, answer and still work; mutated bags for every command; mutated depth frames."""
    if only and only not in _KINDS:
        raise InputError(f"--only is {only!r}, expected one of {', '.join(_KINDS)}.")
    kinds = (only,) if only else _KINDS
    content: dict[str, Any] = {"seed": seed}
    if "messages" in kinds:
        run = sim_module("push_ident_sim.fuzz.run")
        settings = run.Settings(minutes=minutes / len(kinds), seed=seed, nodes=run.nodes_of(tuple(node or ())), out=out, cases=cases)
        messages = content["messages"] = run.fuzz_messages(settings, _show)
        _show(f"{messages['mutated']} mutated messages in {messages['minutes']} minutes, seed {seed}")
    if "bags" in kinds:
        summary = sim_module("push_ident_sim.fuzz.bags").fuzz_bags(
            minutes=minutes / len(kinds), seed=seed, cases=cases and cases / "bags", on_progress=_show
        )
        content["bags"] = summary.to_json()
        _show(f"{summary.mutants} mutated bags, seed {seed}")
    if "frames" in kinds:
        frames = sim_module("push_ident_sim.fuzz.frames").fuzz_frames(
            minutes=minutes / len(kinds), seed=seed, cases=cases and cases / "frames", on_progress=_show
        )
        content["frames"] = frames.to_json()
        _show(f"{frames.frames} mutated frames, seed {seed}")
    if json is not None:
        write_json(json, content)
        _show(f"written: {json}")
    if page is not None:
        sim_module("push_ident_sim.fuzz.page").write_page(page, content)
        _show(f"written: {page}")
    failures = [f"{finding['node']}: {finding['text']} ({finding['file']})" for finding in content.get("messages", {}).get("findings", ())]
    failures += [f"{finding['command']}: {finding['failure']}" for finding in content.get("bags", {}).get("findings", ())]
    failures += [f"{finding['scene']}: {finding['failure']}" for finding in content.get("frames", {}).get("findings", ())]
    for failure in failures:
        warn(plain_text(failure))
    if failures:
        raise PushIdentError(f"{len(failures)} failures; `push-ident fuzz --cases DIR` stores them and tries them again.")


def _show(line: str) -> None:
    console.print(line, highlight=False, markup=False, soft_wrap=True)
