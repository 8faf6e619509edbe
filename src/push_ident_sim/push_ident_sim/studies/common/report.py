"""The page that holds all experiments: tables and pictures made of the summaries' files, nothing typed by hand."""

from __future__ import annotations

import json
from pathlib import Path

from push_ident.errors import InputError, PushIdentError
from push_ident_sim.studies.common.experiment import Experiment, Json

__all__ = ["write_report"]

_HEAD = """# Experiments

Every number and picture below is made by one command, `{command}`, from the JSON files in `{folder}/`; these come from
`make experiments`.

Ground truth is another engine than the one that identifies: PyBullet, where every cell of the object stands on the table with its own
load and a disc of 8 mm radius pushes the outline. Five objects (hammer, wrench, crimp, toolbox, book) of 76 to 96 cells, each with
several ground truths (other masses, other frictions). Pushes are drawn as in the paper: contact uniform over the outline, direction
within 40 degrees of its normal, 0.1 to 0.2 m/s, 6 to 10 cm, the object anywhere on the table in any heading; those that hardly move it
are drawn again. A camera sees 30 poses a second with 1 mm and 0.5 degrees of noise. What is identified knows the outline and the cells,
not the masses, frictions, weight or friction of the pusher.

**Cell error**: mean over the cells of the distance between predicted and observed cell centre at the end of a push; the observed pose is
the mean of the frames at rest. Errors are means over pushes ± the standard error over ground truths. Times are those of the
processor, one thread.
"""


def write_report(experiments: dict[str, Experiment], page: Path, command: str) -> list[Path]:
    """Write `page` (Markdown) and its pictures from the JSON files in the folder that is called as the page.

    A file may hold a `remark`, a sentence for its reader, such as what has changed since.

    Args:
        experiments: by name; those without a file are left out.
        page: such as `docs/results/experiments.md`, for the files `docs/results/experiments/NAME.json`.
        command: that makes the page, for its reader.

    Returns:
        What was written.

    Raises:
        InputError: no file is there, or one cannot be read.
    """
    folder = page.with_suffix("")
    found = [(experiment, _read(path)) for experiment in experiments.values() if (path := folder / f"{experiment.name}.json").is_file()]
    if not found:
        raise InputError(f"There is no result in {folder}; run `push-ident experiment NAME --json {folder}/NAME.json` first.")
    parts, written = [_HEAD.format(command=command, folder=folder.name)], [page]
    for experiment, run in found:
        pictures = experiment.draw(run["summary"], folder)
        written += [folder / name for name in pictures]
        images = [f"![{caption}]({folder.name}/{name})\n\n{caption}" for name, caption in pictures.items()]
        parts.append(
            "\n\n".join([f"## {experiment.title}", experiment.question, experiment.tables(run["summary"]), *images, _origin(run)]) + "\n"
        )
    try:
        page.write_text("\n".join(parts), encoding="utf-8")
    except OSError as error:
        raise PushIdentError(f"Cannot write {page}: {error.strerror}; choose a place that can be written to.") from None
    return written


def _origin(run: Json) -> str:
    machine = run["machine"]
    objects = ", ".join(run["objects"])
    failed = (
        f" {len(run['failed'])} cases failed: " + "; ".join(f"{f['case']} ({f['error']})" for f in run["failed"]) + "."
        if run["failed"]
        else ""
    )
    return (
        f"`push-ident experiment {run['experiment']} --seed {run['seed']} --models {run['models']}`: {objects}; {run['models']} ground "
        f"truths each, from seed {run['seed']}; at most {run['max_seconds']:g} s of the processor a solve. "
        f"{machine['processor']}, {machine['cores']} cores, {machine['jobs']} processes, Python {machine['python']}.{failed}"
        + (f" {run['remark']}" if run.get("remark") else "")
    )


def _read(path: Path) -> Json:
    try:
        content: Json = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read {path}: {error}; run the experiment again.") from None
    return content
