"""The results pages: one for each experiment, one of the benchmarks, and their list, made from the files of the results alone."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final, TypeVar

from push_ident.errors import InputError
from push_ident.files import write_whole
from push_ident_sim.studies.common.study import Benchmark, Experiment, Json, Study, failures, read_json
from push_ident_sim.studies.common.tables import markdown_table, millimetres

_S = TypeVar("_S", bound=Study)

_INDEX: Final = """# Results

`{command}` makes the pages and this list from the JSON that the command at the end of each writes.

{answers}

{elsewhere}

**Ground truth** comes from engines that identification does not use: Bullet, where every cell stands on the table with its own load, and a
planar engine with other laws. Five objects of 76 to 96 cells with several ground truths each, or objects of random shape and maps. Pushes
as in the paper: contact uniform over the outline, direction within 40 degrees of its normal, 0.1 to 0.2 m/s, 6 to 10 cm; poses at 30 Hz
with 1 mm and 0.5 degrees of noise. Identification knows the outline, not the masses, the frictions or the weight.

[Cell errors](../reference/conventions.md) are means over pushes ± the standard error over ground truths; shares have intervals of 95 %,
those of the blind check of 90 %.
"""
_PUSHES: Final = """
## Pushes that are predicted

![Each push is predicted from those before it](../images/pushes.gif)

    push-ident simulate --object hammer --pushes 7 --seed 3 --out out/pushes --truth out/pushes.json
    .venv/bin/python tools/draw_pushes.py out/pushes out/pushes.json docs/images/pushes.gif --json docs/results/pushes.json

{table}
"""
_BENCHMARKS: Final = """# Benchmarks

`make bench` makes this page. Each piece has a fresh process with one thread; calls that are compared take turns. Times are processor
seconds, medians with quartiles, unless the wall clock is named.
"""


def write_experiments(experiments: Iterable[Experiment], folder: Path, command: str) -> list[Path]:
    """Write the page of each experiment that has a file, its figures, and the list of all results; what was written.

    `folder`, such as `docs/results`, has the files `NAME.json`, which may hold a `remark`, a sentence for its reader; `command` makes the
    pages, for their reader. Raises InputError where no file is there, or one cannot be read.
    """
    runs = _runs(experiments, folder, f"push-ident experiment NAME --json {folder}/NAME.json")
    written: list[Path] = []
    for experiment, run in runs:
        body = _section(experiment, run, folder, written, _origin_of_experiment(experiment, run))
        written.append(folder / f"{experiment.name}.md")
        write_whole(written[-1], f"# {experiment.title}\n\n{body}", "the page")
    rows = [
        [experiment.title, f"{experiment.answer(run['summary'])} [{experiment.name}]({experiment.name}.md)"] for experiment, run in runs
    ]
    others = {
        "benchmarks.md": "times of engine, perception, planning and identification",
        "faults.md": "what breaks a cell, and what holds it",
    }
    elsewhere = "\n".join(
        f"- [{name.removesuffix('.md').capitalize()}]({name}): {what}." for name, what in others.items() if (folder / name).exists()
    )
    index = _INDEX.format(command=command, answers=markdown_table(["question", "answer"], rows), elsewhere=elsewhere)
    pushes = folder / "pushes.json"
    written.append(folder / "index.md")
    write_whole(written[-1], index + (_pushes(read_json(pushes)) if pushes.is_file() else ""), "the list of results")
    return written


def write_benchmarks(benchmarks: Iterable[Benchmark], page: Path) -> list[Path]:
    """Write the page of the benchmarks from the files in the folder of the same name, with a table of all targets before them."""
    runs = _runs(benchmarks, page.with_suffix(""), f"push-ident bench --page {page}")
    targets = [target for benchmark, run in runs for target in benchmark.targets(run["summary"])]
    rows = [[target.what, target.aim, target.measured, "yes" if target.met else "no"] for target in targets]
    parts = [_BENCHMARKS, "## Targets\n\n" + markdown_table(["what", "aim", "measured", "met"], rows) + "\n"]
    written = [page]
    for benchmark, run in runs:
        body = _section(benchmark, run, page.with_suffix(""), written, _origin_of_benchmark(run))
        parts.append(f"## {benchmark.title}\n\n{body}")
    write_whole(page, "\n".join(parts), "the page")
    return written


def _runs(studies: Iterable[_S], folder: Path, command: str) -> list[tuple[_S, Json]]:
    runs = [(study, read_json(path)) for study in studies if (path := folder / f"{study.name}.json").is_file()]
    if not runs:
        raise InputError(f"There is no result in {folder}; run `{command}` first.")
    return runs


def _section(study: Study, run: Json, folder: Path, written: list[Path], origin: str) -> str:
    figures = study.draw(run["summary"], folder)
    written += [folder / name for name in figures]
    images = [f"![Figure of the numbers above]({name})\n\n{caption}" for name, caption in figures.items()]
    return "\n\n".join([study.tables(run["summary"]), *images, study.question, origin]) + "\n"


def _pushes(run: Json) -> str:
    rows = [
        [label, *(millimetres(value, 1) for value in run[key])]
        for label, key in (("identified from the pushes before", "errors_m"), ("equal cells, nominal values", "equal_errors_m"))
    ]
    head = ["cell error [mm] at the end of push", *(str(number + 1) for number in range(len(run["errors_m"])))]
    return _PUSHES.format(table=markdown_table(head, rows))


def _origin_of_experiment(experiment: Experiment, run: Json) -> str:
    left_out = [name for name in experiment.variants if name not in run["variants"]]
    command = f"push-ident experiment {run['experiment']} --seed {run['seed']} --models {run['models']}"
    command += f" --variants {','.join(run['variants'])}" if left_out else ""
    command += f" --goals {run['goals']}" if "goals" in run else ""
    machine = run["machine"]
    sentences = [f"`{command}`, {run['date']}; {machine['processor']}, {machine['jobs']} processes."]
    if "planned" in run:
        sentences.append(f"{run['finished']} of {run['planned']} planned cases, in their order, until the time was up.")
    if run["failed"]:
        sentences.append(f"{len(run['failed'])} cases failed: {'; '.join(failures(run))}.")
    if run.get("remark"):
        sentences.append(run["remark"])
    return " ".join(sentences)


def _origin_of_benchmark(run: Json) -> str:
    machine = run["machine"]
    quick = " With --quick: cases too few and too small to measure anything." if run["quick"] else ""
    return (
        f"`push-ident bench {run['benchmark']} --seed {run['seed']}`, {run['date']}; {machine['processor']}, {machine['cores']} cores, "
        f"load {machine['load']} to {machine['load_after']}.{quick}" + (f" {run['remark']}" if run.get("remark") else "")
    )
