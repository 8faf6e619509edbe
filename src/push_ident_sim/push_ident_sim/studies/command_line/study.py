"""How long people wait for the command line: whole processes, from the shell's point of view."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.benchmark import Benchmark, Piece, Settings, Target
from push_ident_sim.studies.common.drawing import markdown_table, millimetres
from push_ident_sim.studies.common.timing import statistics

__all__ = ["STUDY"]

_N_PUSHES = 16
_TRAIN = (0, 1, 2, 3)
_AIMS = {"help": 0.3, "identify": 1.5, "report": 3.0}
"""Wall clock on a machine with two cores that does nothing else [s]: an answer at once, and one before the thought is gone."""
_NAMES = {
    "help": "`push-ident --help`",
    "identify": f"`push-ident identify`, {len(_TRAIN)} of {_N_PUSHES} pushes",
    "report": "the same with `--out`: model and report",
}


def _pieces(settings: Settings) -> list[Piece]:
    return [Piece("commands", _measure, (settings.truth_folder.parent / "command_line", settings.seed, 1 if settings.quick else 7))]


def _measure(folder: Path, seed: int, rounds: int) -> Json:
    """The commands by turns, each once before the clock starts: kernels and bytecode are then in their caches, as on the second day."""
    bag = folder / f"hammer_{seed}"
    if not bag.is_dir():
        _run("simulate", "--pushes", str(_N_PUSHES), "--seed", str(seed), "--out", str(bag))
    train = ",".join(map(str, _TRAIN))
    with TemporaryDirectory() as out:
        result = Path(out) / "result.json"
        commands: dict[str, tuple[str, ...]] = {
            "help": ("--help",),
            "identify": ("identify", str(bag), "--train", train),
            "report": ("identify", str(bag), "--train", train, "--out", out),
        }
        for arguments in commands.values():
            _run(*arguments)
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in commands}
        for _ in range(rounds):
            for name, arguments in commands.items():
                times[name].append(_run(*arguments))
        content = json.loads(result.read_text(encoding="utf-8"))
    return {
        "seed": seed,
        "status": content["status"],
        "identified_m": content["test"]["identified_m"],
        "uniform_m": content["test"]["uniform_m"],
        "commands": {
            name: {"wall": statistics([wall for wall, _ in measured]), "processor": statistics([used for _, used in measured])}
            for name, measured in times.items()
        },
    }


def _run(*arguments: str) -> tuple[float, float]:
    """Wall clock and processor time of one command [s], which must succeed."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, "-m", "push_ident.cli", *arguments], check=True, capture_output=True, env=environment)
    wall, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _targets(summary: Json) -> list[Target]:
    targets = []
    for name, aim in _AIMS.items():
        wall, processor = (summary["commands"][name][clock]["median_s"] for clock in ("wall", "processor"))
        targets.append(Target(_NAMES[name], f"≤ {aim:g} s", f"{wall:.2f} s ({processor:.2f} s of the processor)", wall <= aim))
    return targets


def _tables(summary: Json) -> str:
    rows = [
        [_NAMES[name], *(_seconds(measured[clock]) for clock in ("wall", "processor"))] for name, measured in summary["commands"].items()
    ]
    table = markdown_table(["command", "wall [s]", "of the processor [s]"], rows)
    errors = f"{millimetres(summary['identified_m'])} mm (equal cells with nominal values: {millimetres(summary['uniform_m'])} mm)"
    return f"{table}\n\nThe solve ended {summary['status']}; mean cell error on the {_N_PUSHES - len(_TRAIN)} held-out pushes {errors}."


def _seconds(timing: Json) -> str:
    return f"{timing['median_s']:.2f} ({timing['q25_s']:.2f}–{timing['q75_s']:.2f})"


def _summarise(results: Sequence[Json]) -> Json:
    (measured,) = results
    return dict(measured)


STUDY = Benchmark(
    name="command-line",
    place=45,
    title="The command line",
    question=(
        f"Whole commands as processes of their own, from the call to the end: the list of commands, and `identify` on {len(_TRAIN)} of "
        f"{_N_PUSHES} pushes of the simulated hammer (poses at 30 Hz with 1 mm and 0.5 degrees of noise), with and without a report. "
        "Compiled kernels and bytecode are in their caches. Wall clock and processor time, medians (quartiles) of commands by turns."
    ),
    pieces=_pieces,
    summarise=_summarise,
    targets=_targets,
    tables=_tables,
    draw=lambda summary, folder: {},
)
