"""The pages of experiments and of benchmarks: tables and pictures made from the files of the summaries, nothing typed by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from push_ident.errors import InputError
from push_ident.files import write_whole
from push_ident_sim.studies.common.base import Json, Study
from push_ident_sim.studies.common.benchmark import Benchmark
from push_ident_sim.studies.common.drawing import markdown_table
from push_ident_sim.studies.common.experiment import Experiment
from push_ident_sim.studies.common.files import read_json

__all__ = ["write_benchmarks", "write_experiments"]

_S = TypeVar("_S", bound=Study)

_EXPERIMENTS = """# Experiments

Every number and picture below is made by one command, `{command}`, from the JSON files in `{folder}/`; these come from
`make experiments`.

Ground truth comes from an engine that identification does not use: PyBullet, where every cell of the object stands on the table with its
own load and a disc of 8 mm radius pushes the outline. Five objects (hammer, wrench, crimp, toolbox, book) of 76 to 96 cells, each with
several ground truths (other masses, other frictions). Pushes are drawn as in the paper: contact uniform over the outline, direction
within 40 degrees of its normal, 0.1 to 0.2 m/s, 6 to 10 cm, the object anywhere on the table in any heading; those that hardly move it
are drawn again. A camera reports 30 poses a second with 1 mm and 0.5 degrees of noise. Identification knows the outline and the cells, not
the masses, frictions, weight or friction of the pusher. Plates, and objects with loads of their own, are pushed by a planar engine instead.

**Cell error**: mean over the cells of the distance between predicted and observed cell centre at the end of a push; the observed pose is
the mean of the frames at rest. Errors are means over pushes ± the standard error over ground truths. Times are those of the
processor, one thread.
"""
_BENCHMARKS = """# Benchmarks

Every number and picture below is made by `make bench`. Every piece runs in a fresh process with one thread, and calls
that are compared take turns in it; pieces may be of different runs, each names its seed and the load of the machine.
Times are processor seconds, medians with their quartiles, unless the wall clock is named.
Lengths called cell error are means over the cells of the distance between two places of a cell.
"""


def write_experiments(experiments: Iterable[Experiment], page: Path, command: str) -> list[Path]:
    """Write the page of the experiments (Markdown) and its pictures from the JSON files in the folder with the name of the page.

    A file may hold a `remark`, a sentence for its reader, such as what has changed since.

    Args:
        experiments: in their order; those without a file are left out.
        page: such as `docs/results/experiments.md`, for the files `docs/results/experiments/NAME.json`.
        command: that makes the page, for its reader.

    Returns:
        What was written.

    Raises:
        InputError: no file is there, or one cannot be read.
    """
    folder = page.with_suffix("")
    found = _found(experiments, folder, f"push-ident experiment NAME --json {folder}/NAME.json")
    return _write(page, [_EXPERIMENTS.format(command=command, folder=folder.name)], found, _origin_of_experiment)


def write_benchmarks(benchmarks: Iterable[Benchmark], page: Path) -> list[Path]:
    """Write the page of the benchmarks in the same way, with a table of all targets before them."""
    found = _found(benchmarks, page.with_suffix(""), f"push-ident bench --page {page}")
    targets = [target for benchmark, run in found for target in benchmark.targets(run["summary"])]
    rows = [[target.what, target.aim, target.measured, "yes" if target.met else "no"] for target in targets]
    table = "## Targets\n\n" + markdown_table(["what", "aim", "measured", "met"], rows) + "\n"
    return _write(page, [_BENCHMARKS, table], found, _origin_of_benchmark)


def _found(studies: Iterable[_S], folder: Path, command: str) -> list[tuple[_S, Json]]:
    """Studies that have a file, with its content."""
    found = [(study, read_json(path)) for study in studies if (path := folder / f"{study.name}.json").is_file()]
    if not found:
        raise InputError(f"There is no result in {folder}; run `{command}` first.")
    return found


def _write(page: Path, head: list[str], found: Sequence[tuple[Study, Json]], origin: Callable[[Any, Json], str]) -> list[Path]:
    folder = page.with_suffix("")
    parts, written = list(head), [page]
    for study, run in found:
        pictures = study.draw(run["summary"], folder)
        written += [folder / name for name in pictures]
        images = [f"![{caption}]({folder.name}/{name})\n\n{caption}" for name, caption in pictures.items()]
        parts.append("\n\n".join([f"## {study.title}", study.question, study.tables(run["summary"]), *images, origin(study, run)]) + "\n")
    write_whole(page, "\n".join(parts), "the page")
    return written


def _origin_of_experiment(experiment: Experiment, run: Json) -> str:
    machine = run["machine"]
    objects = ", ".join(run["objects"])
    stopped = f" {run['finished']} of {run['planned']} planned cases, in their order, until the time was up." if "planned" in run else ""
    failed = (
        f" {len(run['failed'])} cases failed: " + "; ".join(f"{f['case']} ({f['error']})" for f in run["failed"]) + "."
        if run["failed"]
        else ""
    )
    # Files of former runs do not hold their variants.
    left_out = [name for name in experiment.variants if name not in run.get("variants", experiment.variants)]
    chosen = f" --variants {','.join(run['variants'])}" if left_out else ""
    not_run = f" Not run: {', '.join(left_out)}." if left_out else ""
    chosen += f" --goals {run['goals']}" if "goals" in run else ""
    return (
        f"`push-ident experiment {run['experiment']} --seed {run['seed']} --models {run['models']}{chosen}`: {objects}; "
        f"{run['models']} ground truths each, from seed {run['seed']}; at most {run['max_seconds']:g} s of the processor a solve. "
        f"{machine['processor']}, {machine['cores']} cores, {machine['jobs']} processes, Python {machine['python']}."
        f"{not_run}{stopped}{failed}" + (f" {run['remark']}" if run.get("remark") else "")
    )


def _origin_of_benchmark(_: Benchmark, run: Json) -> str:
    machine = run["machine"]
    quick = " With --quick: cases too few and too small to measure anything." if run["quick"] else ""
    return (
        f"`push-ident bench {run['benchmark']}`, seed {run['seed']}: {machine['processor']}, {machine['cores']} cores, "
        f"{machine['jobs']} at work, load {machine['load']} before and {machine['load_after']} after, Python {machine['python']}.{quick}"
        + (f" {run['remark']}" if run.get("remark") else "")
    )
