"""Fuzz the commands that read bags with mutated bags; failures are minimised and stored."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from push_ident_sim.fuzz.bag_runs import COMMANDS, commands_for, judge, run_forked
from push_ident_sim.fuzz.bag_sources import make_sources
from push_ident_sim.fuzz.mutate_bag import Mutation, Recipe, draw, make

__all__ = ["BagFinding", "BagFuzzSummary", "failures_of", "fuzz_bags", "read_recipe"]

_SINGLE_THREAD: Final = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
_EXAMPLE: Final = Path(__file__).resolve().parents[4] / "bags" / "hammer_depth"
_BATCH: Final = 8
"""Mutants that a worker takes at once."""


@dataclass(frozen=True, slots=True)
class BagFinding:
    """A command that failed on a mutated bag."""

    command: str
    failure: str
    recipe: Recipe

    def to_json(self) -> dict[str, Any]:
        """Content of a file in the folder of cases."""
        return {"command": self.command, "failure": self.failure, **asdict(self.recipe)}


@dataclass(slots=True)
class BagFuzzSummary:
    """Results of fuzzing with bags."""

    seed: int
    mutants: int = 0
    by_source: Counter[str] = field(default_factory=Counter)
    by_mutation: Counter[str] = field(default_factory=Counter)
    verdicts: dict[str, Counter[str]] = field(default_factory=dict)
    """Command -> refused, succeeded, or the kind of its failures -> number of runs."""
    worst_seconds: dict[str, float] = field(default_factory=dict)
    """Command -> longest time of the processor [s]."""
    worst_memory: dict[str, int] = field(default_factory=dict)
    """Command -> largest resident memory [kB]."""
    findings: list[BagFinding] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """All of it, with the load of the machine."""
        numbers = {name: getattr(self, name) for name in self.__slots__ if name != "findings"}
        return {"load": round(os.getloadavg()[2], 1), **numbers, "findings": [finding.to_json() for finding in self.findings]}

    def add(self, other: dict[str, Any]) -> None:
        """Count one run: `command, verdict, cpu, memory`."""
        command = other["command"]
        self.verdicts.setdefault(command, Counter())[other["verdict"]] += 1
        self.worst_seconds[command] = max(self.worst_seconds.get(command, 0.0), other["cpu"])
        self.worst_memory[command] = max(self.worst_memory.get(command, 0), other["memory"])


def fuzz_bags(
    count: int = 1000,
    *,
    minutes: float = 60.0,
    seed: int = 0,
    jobs: int = 2,
    cases: Path | None = None,
    on_progress: Callable[[str], None] = lambda line: None,
) -> BagFuzzSummary:
    """Run `count` mutants, or as many as `minutes` allow, through every command that reads one.

    `cases`: folder in which the recipe of each failure is stored after it was made as short as it goes.
    """
    deadline = time.monotonic() + 60.0 * minutes
    summary = BagFuzzSummary(seed)
    os.environ.update(_SINGLE_THREAD)
    with tempfile.TemporaryDirectory(prefix="push_ident_fuzz_") as name:
        work = Path(name)
        _prepare(work)
        batches = [range(at, min(at + _BATCH, count)) for at in range(0, count, _BATCH)]
        with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_import) as pool:
            for results in pool.map(_try_batch, [(work, seed, batch, deadline) for batch in batches]):
                for number, runs in results:
                    _count(summary, draw(seed, number), runs)
                on_progress(f"{summary.mutants} mutated bags, {len(summary.findings)} failures")
            if cases is not None:
                _store(cases, list(pool.map(_minimised, [(work, finding) for finding in _distinct(summary.findings)])))
    return summary


def _prepare(work: Path) -> None:
    """Sources, and the model of an unchanged bag."""
    sources = make_sources(work / "sources", _EXAMPLE)
    code = "from push_ident.cli.main import main; main()"
    subprocess.run(
        [sys.executable, "-c", code, "identify", str(sources["mcap"]), "--out", str(work / "model")],
        check=True,
        capture_output=True,
        timeout=300,
    )


def _import() -> None:
    """Import what the commands need, and run none of it."""
    os.setpgid(0, 0)
    import push_ident.cli.main
    import push_ident.diagnosis.diagnose
    import push_ident.offline.loading  # noqa: F401


def _try_batch(task: tuple[Path, int, range, float]) -> list[tuple[int, list[dict[str, Any]]]]:
    work, seed, numbers, deadline = task
    return [(number, _try(work, draw(seed, number), number)) for number in numbers if time.monotonic() < deadline]


def _try(work: Path, recipe: Recipe, number: int, commands: list[str] | None = None) -> list[dict[str, Any]]:
    """Runs of the commands on one mutant: `command, verdict, cpu, memory`."""
    folder = Path(tempfile.mkdtemp(dir=work))
    try:
        try:
            bag = make(recipe, work / "sources" / recipe.source, folder / "bag")
        except Exception as error:
            # A mutation cannot always be made after others; that is no failure of a command.
            return [{"command": "make", "verdict": f"not made: {type(error).__name__}", "cpu": 0.0, "memory": 0}]
        return [
            _outcome(command, bag, folder / f"out{k}", work) for k, command in enumerate(commands or commands_for(recipe.source, number))
        ]
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _outcome(command: str, bag: Path, out: Path, work: Path) -> dict[str, Any]:
    run = run_forked(command, bag, out, work / "model" / "model.json")
    verdict = judge(run, out) or ("refused" if run.exit_code else "succeeded")
    return {"command": command, "verdict": verdict, "cpu": run.cpu, "memory": run.memory}


def _count(summary: BagFuzzSummary, recipe: Recipe, runs: list[dict[str, Any]]) -> None:
    summary.mutants += 1
    summary.by_source[recipe.source] += 1
    summary.by_mutation.update(f"{mutation.level}: {mutation.name}" for mutation in recipe.mutations)
    for run in runs:
        failure = run["verdict"]
        summary.add({**run, "verdict": failure.partition(":")[0]})
        if failure not in ("refused", "succeeded") and run["command"] != "make":
            summary.findings.append(BagFinding(run["command"], failure, recipe))


def _distinct(findings: list[BagFinding]) -> list[BagFinding]:
    """One finding of each command and text."""
    return list({(finding.command, finding.failure[:60]): finding for finding in findings}.values())


def _minimised(task: tuple[Path, BagFinding]) -> BagFinding:
    """The same failure with as few mutations as possible."""
    from push_ident_sim.fuzz.minimise import shortest

    work, finding = task
    kind = finding.failure.partition(":")[0]

    def fails(mutations: list[Mutation]) -> bool:
        recipe = Recipe(finding.recipe.source, tuple(mutations))
        return any(run["verdict"].startswith(kind) for run in _try(work, recipe, 0, [finding.command]))

    kept = shortest(finding.recipe.mutations, fails)
    return BagFinding(finding.command, finding.failure, Recipe(finding.recipe.source, tuple(kept)))


def _store(folder: Path, findings: list[BagFinding]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for finding in findings:
        mutations = "_".join(f"{m.level}-{m.name}-{m.seed}".replace(" ", "-") for m in finding.recipe.mutations)
        path = folder / f"{finding.command.replace(' ', '-')}_{finding.recipe.source}_{mutations}"[:180]
        Path(f"{path}.json").write_text(json.dumps(finding.to_json(), indent=1) + "\n", encoding="utf-8")


def read_recipe(path: Path) -> tuple[str, Recipe]:
    """Command and recipe of a stored case."""
    content = json.loads(path.read_text(encoding="utf-8"))
    mutations = tuple(Mutation(m["level"], m["name"], m["seed"]) for m in content["mutations"])
    assert content["command"] in COMMANDS
    return content["command"], Recipe(content["source"], mutations)


def failures_of(tasks: list[tuple[str, Recipe]], *, jobs: int = 2) -> list[str]:
    """Failures of these commands on these mutants, one line each; empty where all is well."""
    os.environ.update(_SINGLE_THREAD)
    with tempfile.TemporaryDirectory(prefix="push_ident_fuzz_") as name:
        work = Path(name)
        _prepare(work)
        with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_import) as pool:
            outcomes = list(pool.map(_try_one, [(work, command, recipe) for command, recipe in tasks]))
    return [
        f"{command} on {recipe}: {outcome}"
        for (command, recipe), outcome in zip(tasks, outcomes, strict=True)
        if outcome not in ("refused", "succeeded")
    ]


def _try_one(task: tuple[Path, str, Recipe]) -> str:
    work, command, recipe = task
    return str(_try(work, recipe, 0, [command])[0]["verdict"])
