"""Recorded pushes of others: predicted and diagnosed set by set, and compared with the friction that their authors measured.

A set is a bag of the contract, or files of a format that an importer reads."""

from __future__ import annotations

import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.bags.importers import ImportReport, import_cmu_icra16, import_cmu_mocap, import_mit, mit_sets
from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.errors import InputError
from push_ident.files import finite
from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.unknowns.prior import Prior
from push_ident.offline.loading import load_pushes
from push_ident.physics.effects import EFFECTS
from push_ident.types import PushRecord
from push_ident_sim.studies.common.measuring import ends_of, grouped, mean_of
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import causes_text, markdown_table, millimetres, number

_KNOWN: Final = "known.json"
"""Beside the recordings: what their authors measured."""
_BAG_FILES: Final = (".mcap", ".db3")


@dataclass(frozen=True, slots=True)
class RecordedSet:
    """Pushes of one object on one surface."""

    name: str
    """Its place in the folder, such as `plywood-rect1`."""
    paths: tuple[Path, ...]
    """A bag, or files in order of their names."""
    read: Callable[[tuple[Path, ...], Path], ImportReport] | None = None
    """Makes a bag of such paths; None where they are a bag."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """Some pushes of a set, in the order in which they were made."""

    records: list[PushRecord]
    n_all: int
    """Pushes, or files, of the set."""
    mass: float | None
    """Of the object, where it was published [kg]."""


def find_sets(folder: Path) -> dict[str, RecordedSet]:
    """All sets in a folder and the folders in it, by name.

    A folder with a file of a ROS 2 bag is one set, and so is each file `*.txt` (CMU, ICRA 2016) and `*.bag` (CMU, motion capture). Files of
    the MIT pushing dataset are one set for each object on each surface.

    Raises InputError where there is none.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give --recordings DIR, the folder of the recordings.")
    bags = sorted({path.parent for path in folder.rglob("*") if path.suffix in _BAG_FILES})
    sets = [RecordedSet(_name(bag, folder), (bag,)) for bag in bags]
    for suffix, read in ((".txt", import_cmu_icra16), (".bag", import_cmu_mocap)):
        sets += [RecordedSet(_name(path, folder), (path,), _of_one_file(read)) for path in sorted(folder.rglob(f"*{suffix}"))]
    sets += [RecordedSet(f"{surface}-{shape}", paths, import_mit) for (surface, shape), paths in mit_sets(folder).items()]
    if not sets:
        raise InputError(f"{folder}: no recording in it; expected bags, files *.txt or *.bag of CMU, or files of the MIT pushing dataset.")
    return {one.name: one for one in sets}


def draw_pushes(recorded: RecordedSet, n: int, rng: np.random.Generator, *, ends_only: bool = False, with_forces: bool = True) -> Drawn:
    """`n` random pushes of a set, or all where it has fewer, with the poses at rest alone, or without forces, where that is requested.

    Raises PushIdentError where the set cannot be read.
    """
    is_one_file = len(recorded.paths) == 1
    paths = recorded.paths if is_one_file else _some(recorded.paths, n, rng)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        report = None if recorded.read is None else recorded.read(paths, bag)
        loaded = load_pushes([paths[0] if report is None else bag]).records
    records = list(_some(tuple(loaded), n, rng)) if is_one_file else loaded
    if ends_only:
        records = [ends_of(record) for record in records]
    if not with_forces:
        records = [replace(record, wrench=None) for record in records]
    return Drawn(records, len(loaded) if is_one_file else len(recorded.paths), None if report is None else report.mass)


def known_of(folder: Path, name: str) -> dict[str, Any]:
    """What the authors of a recording measured, by `known.json` in its folder: an object that has patterns of names as keys, and for each
    `friction` and `source`, as far as they are known. Empty where it says nothing of a set.

    Raises InputError for a file of another form.
    """
    file = folder / _KNOWN
    if not file.is_file():
        return {}
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: cannot be read as JSON ({error}).") from None
    if not isinstance(content, dict) or not all(isinstance(value, dict) for value in content.values()):
        raise InputError(f"{file}: expected an object of objects, a pattern of set names as each key.")
    return next((value for pattern, value in content.items() if fnmatch(name, pattern)), {})


def _name(path: Path, folder: Path) -> str:
    parts = path.relative_to(folder).with_suffix("").parts
    return "-".join(parts) or folder.resolve().name


def _some(items: tuple[Any, ...], n: int, rng: np.random.Generator) -> tuple[Any, ...]:
    """At most `n` of them, in their order."""
    return tuple(items[i] for i in np.sort(rng.permutation(len(items))[:n]))


def _of_one_file(read: Callable[[Path, Path], ImportReport]) -> Callable[[tuple[Path, ...], Path], ImportReport]:
    return lambda paths, bag: read(paths[0], bag)


_DIAGNOSED: Final[dict[str, tuple[int, bool, bool]]] = {
    "14-pushes": (14, False, True),
    "14-poses": (14, False, False),
    "30-ends": (30, True, False),
}
"""Variants of a diagnosis: number of pushes, whether only their ends are known, and whether measured forces are used."""
_PREDICTED: Final[dict[str, int]] = {"predict-2": 2, "predict-5": 5, "predict-10": 10}
"""Variants in which all other pushes are predicted from some: how many."""
_MODELS: Final = ("identified", "scalar", "uniform")


def _run(case: Case, settings: CaseSettings) -> Json:
    rng = np.random.default_rng([case.model])
    recorded = find_sets(settings.recordings)[case.object_name]
    if case.variant in _PREDICTED:
        return _predict(draw_pushes(recorded, 100, rng), _PREDICTED[case.variant], rng)  # some sets have thousands
    n, ends_only, with_forces = _DIAGNOSED[case.variant]
    # All variants draw the same pushes, as far as they take as many.
    drawn = draw_pushes(recorded, n, rng, ends_only=ends_only, with_forces=with_forces)
    start = time.process_time()
    diagnosis = diagnose(drawn.records, DiagnosisSettings(prior=prior_of(drawn)))
    seconds = time.process_time() - start
    known = known_of(settings.recordings, case.object_name)
    return finite({"n": len(drawn.records), "n_all": drawn.n_all, **_outcome(diagnosis), "seconds": seconds, "known": known})


def prior_of(drawn: Drawn) -> Prior:
    """The default one, with the mass of the object where it was published."""
    return Prior() if drawn.mass is None else Prior(total_mass=drawn.mass, total_mass_std=0.0)


def _predict(drawn: Drawn, n_train: int, rng: np.random.Generator) -> Json:
    """Mean cell errors [m] on the pushes that were not trained on."""
    order = rng.permutation(len(drawn.records))
    train, test = ([drawn.records[i] for i in part] for part in (order[:n_train], order[n_train:]))
    if not test:
        return {}
    result = identify(train, prior_of(drawn))
    models = zip(_MODELS, (result.model, result.scalar, result.uniform), strict=True)
    return finite({f"{name}_m": float(np.mean(held_out_errors(model, test))) for name, model in models})


def _outcome(diagnosis: Diagnosis) -> Json:
    probabilities, gap, fit = diagnosis.probabilities, diagnosis.gap, diagnosis.fit
    model = None if fit is None else fit.posterior.model
    return {
        "verdict": diagnosis.verdict.value,
        "refused": [gate.finding for gate in diagnosis.gates if not gate.passed],
        "effects": [{"name": e.name, "parameters": e.parameters} for e in diagnosis.effects],
        "something_else": None if probabilities is None else probabilities.something_else,
        "gap": None if gap is None else {f"{key}_m": float(np.mean(getattr(gap, key))) for key in ("before", "after", "noise")},
        # Mean over the cells, by their loads.
        "friction": None if model is None else float(model.mass @ model.friction / model.mass.sum()),
    }


# --- all cases


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_set = {name: grouped(cases, "variant") for name, cases in grouped(results, "object_name").items()}
    summary: Json = {"diagnosed": {}, "predicted": {}}
    for name, variants in by_set.items():
        for variant, cases in variants.items():
            values = [case.values for case in cases if case.values]
            if variant in _DIAGNOSED:
                summary["diagnosed"][f"{name}, {variant}"] = _row(values)
            elif values:
                summary["predicted"][f"{name}, {_PREDICTED[variant]}"] = {"draws": len(values)} | {
                    model: mean_of((v[f"{model}_m"] for v in values), 6) for model in _MODELS
                }
    return summary


def _row(values: Sequence[Json]) -> Json:
    named: dict[str, list[Json]] = {}
    for effect in (effect for v in values for effect in v["effects"]):
        named.setdefault(effect["name"], []).append(effect["parameters"])
    gaps = [v["gap"] for v in values if v["gap"] is not None]
    return {
        "draws": len(values),
        "pushes": [max(v[key] for v in values) for key in ("n", "n_all")],
        "verdicts": dict(Counter(v["verdict"] for v in values)),
        "named": {name: {"n": len(sizes), "mean": _mean_sizes(name, sizes)} for name, sizes in named.items()},
        "something_else": mean_of(v["something_else"] for v in values),
        "refused": sorted({reason for v in values for reason in v["refused"]}),
        "gap": {key: mean_of((gap[key] for gap in gaps), 6) for key in ("before_m", "after_m", "noise_m")},
        "friction": mean_of(v["friction"] for v in values),
        "known": values[0]["known"],
        "seconds": float(np.median([v["seconds"] for v in values])),
    }


def _mean_sizes(name: str, sizes: Sequence[Json]) -> Json:
    """Mean of each parameter that has a size, over the draws in which the effect was named."""
    return {p.name: mean_of((size[p.name] for size in sizes), 6) for p in EFFECTS[name].parameters if not p.shape}


def _tables(summary: Json) -> str:
    parts = []
    if summary["diagnosed"]:
        head = [
            "set",
            "draws × pushes",
            "verdict",
            "named",
            "something else",
            "held-out error, after it, noise [mm]",
            "friction",
            "measured",
        ]
        rows = [
            [
                name,
                f"{row['draws']} × {row['pushes'][0]} of {row['pushes'][1]}",
                causes_text(row["verdicts"]),
                "; ".join(_named_text(effect, found) for effect, found in row["named"].items()) or "–",
                number(row["something_else"], "{:.2f}"),
                ", ".join(millimetres(value, 1) for value in row["gap"].values()),
                number(row["friction"], "{:.3f}"),
                number(row["known"].get("friction"), "{:.3f}"),
                f"{row['seconds']:.0f}",
            ]
            for name, row in summary["diagnosed"].items()
        ]
        parts.append(markdown_table([*head, "processor [s]"], rows))
        parts += [f"{name} was refused: {reason}" for name, row in summary["diagnosed"].items() for reason in row["refused"]]
    if summary["predicted"]:
        rows = [[name, str(row["draws"]), *(millimetres(row[m]) for m in _MODELS)] for name, row in summary["predicted"].items()]
        parts.append(markdown_table(["mean cell error [mm], trained on", "draws", *_MODELS], rows))
    return "\n\n".join(parts)


def _named_text(name: str, found: Json) -> str:
    """Such as `wear 1×, -0.02`."""
    units = {p.name: p.unit for p in EFFECTS[name].parameters}
    sizes = ", ".join(f"{value:.2g} {units[parameter]}".strip() for parameter, value in found["mean"].items())
    return f"{name} {found['n']}×, {sizes}"


def _answer(summary: Json) -> str:
    verdicts: Counter[str] = Counter()
    for row in summary["diagnosed"].values():
        verdicts.update(row["verdicts"])
    return f"Verdicts on {sum(verdicts.values())} draws of recorded pushes: {causes_text(dict(verdicts.most_common()))}."


STUDY = Experiment(
    name="recorded",
    title="What does it find in recordings of others?",
    question=(
        "Recordings of `--recordings DIR`, set by set: one object on one surface. The folder may hold unpacked archives of the "
        "[MIT pushing dataset](../how-to/import-recordings.md#mit-pushing-dataset), text files of CMU's ICRA 2016 set, bags of "
        "CMU's motion capture, and bags of the contract. Each seed is a random draw of the pushes of a set. `14-pushes`: "
        "diagnosed with measured forces; `14-poses`: without them; `30-ends`: 30 pushes known by their poses before and after "
        "only; `predict-N`: the other pushes predicted from N. Friction that the authors measured is read from `known.json` "
        'beside the recordings: `{"plywood-*": {"friction": 0.28}}`. No decision was set on these recordings. scalar: equal '
        "cells with fitted values; uniform: with nominal ones."
    ),
    objects=(),
    find_objects=lambda folder: tuple(find_sets(folder)),
    variants=(*_DIAGNOSED, *_PREDICTED),
    stages=("geometry", "physics", "identification", "diagnosis", "bags", "offline", "pushing"),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
)
