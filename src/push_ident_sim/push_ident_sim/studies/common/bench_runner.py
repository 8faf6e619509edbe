"""Run benchmarks, every piece in a fresh process with one thread; write their files and the page made of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path
from typing import Any

from push_ident.errors import InputError, PushIdentError
from push_ident_sim.studies.common.benchmark import Benchmark, Json, Settings
from push_ident_sim.studies.common.drawing import markdown_table
from push_ident_sim.studies.common.runner import write_json
from push_ident_sim.workers import describe_machine, single_threads

__all__ = ["run_benchmark", "write_page", "write_results"]

Progress = Callable[[str, int, int], None]
"""Told what is under way, and how many of how many pieces are done."""

_HEAD = """# Benchmarks

Every number and picture below is made by `make bench`. All is measured in the same run, every piece in a fresh process with one
thread; what is compared is timed by turns. Times are processor seconds, medians with their quartiles, unless the wall clock is named.
Lengths called cell error are means over the cells of the distance between two places of a cell.
"""


def run_benchmark(benchmark: Benchmark, settings: Settings, on_progress: Progress | None = None) -> Json:
    """Measure one benchmark.

    Returns:
        What the run was (`benchmark, seed, quick, machine`), and the benchmark's `summary`.

    Raises:
        PushIdentError: a piece could not be measured.
    """
    report = on_progress or (lambda what, done, total: None)
    machine, pieces = describe_machine(benchmark.jobs), benchmark.pieces(settings)
    with single_threads(benchmark.jobs, fresh=True) as pool:
        futures: list[Future[Json]] = [pool.submit(piece.measure, *piece.arguments) for piece in pieces]
        pending: set[Future[Json]] = set(futures)
        while pending:
            under_way = next(piece.label for piece, future in zip(pieces, futures, strict=True) if not future.done())
            report(f"{benchmark.name}: {under_way}", len(pieces) - len(pending), len(pieces))
            finished, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in finished:
                future.result()
    report(benchmark.name, len(pieces), len(pieces))
    machine["load_after"] = describe_machine(benchmark.jobs)["load"]
    summary = benchmark.summarise([future.result() for future in futures])
    return {"benchmark": benchmark.name, "seed": settings.seed, "quick": settings.quick, "machine": machine, "summary": summary}


def write_results(result: Json, page: Path) -> None:
    """Write what `run_benchmark` gave into the folder that is called as the page."""
    write_json(page.with_suffix("") / f"{result['benchmark']}.json", result)


def write_page(benchmarks: Sequence[Benchmark], page: Path) -> list[Path]:
    """Write `page` (Markdown) and its pictures from the JSON files in the folder that is called as the page.

    Returns:
        What was written.

    Raises:
        InputError: no file is there, or one cannot be read.
    """
    folder = page.with_suffix("")
    found = [(benchmark, _read(path)) for benchmark in benchmarks if (path := folder / f"{benchmark.name}.json").is_file()]
    if not found:
        raise InputError(f"There is no result in {folder}; run `push-ident bench --page {page}` first.")
    targets = [target for benchmark, run in found for target in benchmark.targets(run["summary"])]
    rows = [[target.what, target.aim, target.measured, "yes" if target.met else "no"] for target in targets]
    parts, written = [_HEAD, "## Targets\n\n" + markdown_table(["what", "aim", "measured", "met"], rows) + "\n"], [page]
    for benchmark, run in found:
        pictures = benchmark.draw(run["summary"], folder)
        written += [folder / name for name in pictures]
        images = [f"![{caption}]({folder.name}/{name})\n\n{caption}" for name, caption in pictures.items()]
        parts.append(
            "\n\n".join([f"## {benchmark.title}", benchmark.question, benchmark.tables(run["summary"]), *images, _origin(run)]) + "\n"
        )
    try:
        page.write_text("\n".join(parts), encoding="utf-8")
    except OSError as error:
        raise PushIdentError(f"Cannot write {page}: {error.strerror}; choose a place that can be written to.") from None
    return written


def _origin(run: dict[str, Any]) -> str:
    machine = run["machine"]
    quick = " With --quick: too few and too small cases to measure anything." if run["quick"] else ""
    return (
        f"`push-ident bench {run['benchmark']}`, seed {run['seed']}: {machine['processor']}, {machine['cores']} cores, "
        f"{machine['jobs']} at work, load {machine['load']} before and {machine['load_after']} after, Python {machine['python']}.{quick}"
    )


def _read(path: Path) -> Json:
    try:
        content: Json = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read {path}: {error}; run the benchmark again.") from None
    return content
