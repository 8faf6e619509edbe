"""Fuzz perception with mutated depth frames; failures are made short and stored."""

from __future__ import annotations

import json
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from push_ident_sim.fuzz.frame_runs import IN_A_ROW, FrameMutation, FrameRecipe, SequenceResult, Step, draw_sequence, run_sequence
from push_ident_sim.fuzz.frame_scenes import scenes_here

__all__ = ["FrameFinding", "FrameFuzzSummary", "fuzz_frames", "read_sequence"]

_SINGLE_THREAD: Final = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
_TRIES: Final = 60
"""Largest number of sequences that are run to make a failure shorter."""


@dataclass(frozen=True, slots=True)
class FrameFinding:
    """A sequence of frames after which something did not hold."""

    failure: str
    recipe: FrameRecipe

    def to_json(self) -> dict[str, Any]:
        """Content of a file in the folder of cases."""
        return {"failure": self.failure, **asdict(self.recipe)}


@dataclass(slots=True)
class FrameFuzzSummary:
    """Results of fuzzing with frames."""

    seed: int
    frames: int = 0
    """Mutated frames."""
    sequences: int = 0
    by_scene: Counter[str] = field(default_factory=Counter)
    """Mutated frames of each scene."""
    by_mutation: Counter[str] = field(default_factory=Counter)
    by_width: Counter[str] = field(default_factory=Counter)
    """Mutated frames by the width to which images are thinned out; `all` pixels, or 160 or 320."""
    verdicts: Counter[str] = field(default_factory=Counter)
    """Of the mutated frames: taken, or the type of the error that refused them."""
    worst_seconds: float = 0.0
    """Longest time of the processor for one frame, for 640 x 480 pixels [s]."""
    findings: list[FrameFinding] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """All of it, with the load of the machine."""
        numbers = {name: getattr(self, name) for name in self.__slots__ if name != "findings"}
        return {"load": round(os.getloadavg()[2], 1), **numbers, "findings": [finding.to_json() for finding in self.findings]}

    def add(self, recipe: FrameRecipe, result: SequenceResult) -> None:
        """Count one sequence."""
        self.sequences += 1
        self.frames += result.n_mutated
        self.by_scene[recipe.scene] += result.n_mutated
        self.by_width[str(recipe.width or "all")] += result.n_mutated
        self.by_mutation.update(mutation.name for step in recipe.steps for mutation in step.mutations)
        self.verdicts.update(result.verdicts)
        self.worst_seconds = max(self.worst_seconds, round(result.worst, 3))
        if result.failure:
            self.findings.append(FrameFinding(result.failure, recipe))


def fuzz_frames(
    count: int = 10_000,
    *,
    minutes: float = 60.0,
    seed: int = 0,
    jobs: int = 2,
    cases: Path | None = None,
    on_progress: Callable[[str], None] = lambda line: None,
) -> FrameFuzzSummary:
    """Give at least `count` mutated frames, or as many as `minutes` allow, to perception, in sequences with clean ones.

    `cases`: folder in which the recipe of each failure is stored after it was made as short as it goes.
    """
    deadline = time.monotonic() + 60.0 * minutes
    summary, scenes = FrameFuzzSummary(seed), scenes_here()
    os.environ.update(_SINGLE_THREAD)
    running: list[tuple[int, Future[list[SequenceResult]]]] = []
    batches: Iterator[int] = iter(range(0, 1 << 30, IN_A_ROW))
    while summary.frames < count and time.monotonic() < deadline:
        with _pool(jobs) as pool:
            try:
                while summary.frames < count and time.monotonic() < deadline:
                    while len(running) < jobs + 1:
                        first = next(batches)
                        running.append((first, pool.submit(_run_batch, [draw_sequence(seed, first + k, scenes) for k in range(IN_A_ROW)])))
                    first, done = running[0]
                    for k, result in enumerate(done.result()):
                        summary.add(draw_sequence(seed, first + k, scenes), result)
                    running.pop(0)
                    on_progress(f"{summary.frames} mutated frames, {len(summary.findings)} failures")
            except BrokenProcessPool:
                summary.findings += [FrameFinding("the process ended", recipe) for recipe in _deadly([first for first, _ in running], seed)]
            running.clear()
            pool.shutdown(cancel_futures=True)
    if cases is not None:
        for finding in {finding.failure[:50]: finding for finding in summary.findings}.values():
            _store(cases, _shortened(finding))
    return summary


def _pool(jobs: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"))


def _run_batch(recipes: list[FrameRecipe]) -> list[SequenceResult]:
    return [run_sequence(recipe) for recipe in recipes]


def _ends_process(recipe: FrameRecipe) -> bool:
    with _pool(1) as pool:
        try:
            pool.submit(run_sequence, recipe).result()
        except BrokenProcessPool:
            return True
    return False


def _deadly(batches: list[int], seed: int) -> list[FrameRecipe]:
    """The sequences that end the process, of the batches that were running when one did."""
    scenes = scenes_here()
    return [
        recipe for first in batches for recipe in (draw_sequence(seed, first + k, scenes) for k in range(IN_A_ROW)) if _ends_process(recipe)
    ]


def _shortened(finding: FrameFinding) -> FrameFinding:
    """The same failure with as few frames and mutations as possible; one that ends the process stays as it is."""
    from push_ident_sim.fuzz.minimise import shortest

    kind, recipe, tries = finding.failure[:20], finding.recipe, iter(range(_TRIES))
    if finding.failure == "the process ended":
        return finding

    def fails(steps: list[Step]) -> bool:
        return next(tries, None) is not None and run_sequence(FrameRecipe(recipe.scene, recipe.width, tuple(steps))).failure[:20] == kind

    return FrameFinding(finding.failure, FrameRecipe(recipe.scene, recipe.width, tuple(shortest(recipe.steps, fails))))


def _store(folder: Path, finding: FrameFinding) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    names = "_".join(mutation.name for step in finding.recipe.steps for mutation in step.mutations)
    name = f"{finding.recipe.scene}_{finding.recipe.width}_{names}".replace(" ", "-").replace(".", "-")[:120]
    (folder / f"{name}.json").write_text(json.dumps(finding.to_json(), indent=1) + "\n", encoding="utf-8")


def read_sequence(path: Path) -> FrameRecipe:
    """The recipe of a stored case."""
    content = json.loads(path.read_text(encoding="utf-8"))
    steps = tuple(
        Step(step["view"], step["gap"], step["robot"], tuple(FrameMutation(m["name"], m["seed"]) for m in step["mutations"]))
        for step in content["steps"]
    )
    return FrameRecipe(content["scene"], content["width"], steps)
