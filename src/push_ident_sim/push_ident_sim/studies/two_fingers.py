"""Recorded pushes with two fingers: ends predicted from other runs, and two supports of one rectangle told apart or not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from push_ident.bags.importers.cmu_fingers import (
    FINGER_SHAPES,
    FingerOptions,
    finger_logs,
    import_cmu_fingers,
    published_shape,
    pushes_of_logs,
    registration_of,
)
from push_ident.errors import InputError
from push_ident.files import finite
from push_ident.geometry.cells import cell_error
from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.unknowns.prior import Prior
from push_ident.offline.loading import load_pushes
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.types import ObjectModel, PushRecord
from push_ident_sim.studies.common.measuring import grouped, mean_of
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import markdown_table, millimetres

_TRAIN: Final = 5
"""Runs that a model is fitted to; 10 to 11 others are predicted."""
_FEET: Final[dict[str, int]] = {"whole-base": 0, "three-feet": 3}
"""Variants: number of feet of the fitted model, 0 for friction maps of the whole base."""
_MODELS: Final = ("identified", "scalar", "uniform")
_RIM: Final = 0.6
"""Part of the outline, about its middle, inside which a model with its load at the rim has none [-]."""


@dataclass(frozen=True, slots=True)
class Split:
    """Runs of one set, the poses registered to the hand by those that train."""

    train: tuple[PushRecord, ...]
    test: tuple[PushRecord, ...]


def find_finger_sets(folder: Path) -> dict[str, Path]:
    """Folders of logs of an object whose outline is published, by their names. Raises InputError where there is none."""
    known = tuple(name for name, outline in FINGER_SHAPES.items() if outline is not None)
    sets = {path.parent.parent.name: path.parent.parent for path in sorted(folder.rglob("log*.txt"))}
    sets = {name: path for name, path in sets.items() if name.startswith(known)}
    if not sets:
        raise InputError(f"{folder}: no folder {' or '.join(known)}* of logs in it; give --recordings DIR, such as `robot_exp_logs`.")
    return sets


@cache
def split_runs(folder: Path, draw: int) -> Split:
    """Random runs of a set to train on, and the others."""
    files = finger_logs([folder])
    order = np.random.default_rng([draw]).permutation(len(files))
    train, test = ([files[i] for i in np.sort(part)] for part in (order[:_TRAIN], order[_TRAIN:]))
    registration = registration_of(pushes_of_logs(train), published_shape(files))
    read = [_records(part, FingerOptions(registration=registration, ends_only=True)) for part in (train, test)]
    return Split(*read)


def _records(files: Sequence[Path], options: FingerOptions) -> tuple[PushRecord, ...]:
    with TemporaryDirectory() as folder:
        import_cmu_fingers(files, Path(folder) / "bag", options=options)
        return tuple(load_pushes([Path(folder) / "bag"]).records)


def _run(case: Case, settings: CaseSettings) -> Json:
    sets = find_finger_sets(settings.recordings)
    own = split_runs(sets[case.object_name], case.model)
    result = identify(list(own.train), Prior(feet=_FEET[case.variant]), budget=settings.budget)
    models = dict(zip(_MODELS, (result.model, result.scalar, result.uniform), strict=True))
    values: Json = {
        "status": result.status.name.lower(),
        "pushes": [len(own.train), len(own.test)],
        "moved_m": float(np.mean([_moved(record) for record in own.test])),
        "pusher_friction": result.scalar.pusher_friction,
        "errors_m": {name: _mean_error(model, own.test) for name, model in models.items()},
        "pressure_m": pressure_span(result.scalar, own.test),
    }
    # Another set shows the same outline on another support: this model against the one that was fitted there, on the same pushes.
    same = [name for name in sets if name != case.object_name and name.split("_")[0] == case.object_name.split("_")[0]]
    values["elsewhere_m"] = {name: _mean_error(result.model, split_runs(sets[name], case.model).test) for name in same}
    return finite(values)


def pressure_span(model: ObjectModel, pushes: Sequence[PushRecord]) -> float:
    """Distance of the ends [m] that two loads of equal sum predict, one at the rim and one in the middle of the base; mean over the pushes.

    What the poses of a push can show of the pressure is less than this.
    """
    centres = model.shape.cells.centres
    far = np.abs(centres / np.abs(model.shape.outline).max(axis=0)).max(axis=1) > _RIM
    spans = []
    for push in pushes:
        ends = []
        for loaded in (far, ~far):
            weight = np.where(loaded, 1.0, 1e-3)
            friction = model.friction.mean() * weight / np.average(weight, weights=model.mass)
            scenario = PushScenario(push.pusher, push.poses.pose[0], push.poses.time[-1:])
            ends.append(simulate(replace(model, friction=friction), scenario).pose[0])
        spans.append(cell_error(model.shape.cells, *ends))
    return float(np.mean(spans))


def _mean_error(model: ObjectModel, pushes: Sequence[PushRecord]) -> float:
    return float(np.mean(held_out_errors(model, list(pushes))))


def _moved(record: PushRecord) -> float:
    return cell_error(record.shape.cells, record.poses.pose[0], record.poses.pose[-1])


# --- all cases


def _summarise(results: Sequence[CaseResult]) -> Json:
    summary: Json = {"predicted": {}, "told_apart": {}}
    for variant, cases in grouped(results, "variant").items():
        by_set = {name: [case.values for case in some] for name, some in grouped(cases, "object_name").items()}
        own = {(case.case.object_name, case.case.model): case.values["errors_m"]["identified"] for case in cases}
        for name, values in by_set.items():
            summary["predicted"][f"{name}, {variant}"] = {
                "draws": len(values),
                "pushes": values[0]["pushes"],
                "moved_m": mean_of((v["moved_m"] for v in values), 6),
                "pusher_friction": mean_of((v["pusher_friction"] for v in values), 3),
                "pressure_m": mean_of((v["pressure_m"] for v in values), 6),
                **{model: mean_of((v["errors_m"][model] for v in values), 6) for model in _MODELS},
            }
        differences = _differences(cases, own)
        summary["told_apart"].update({f"{pair}, {variant}": row for pair, row in differences.items()})
    return summary


def _differences(cases: Sequence[CaseResult], own: Mapping[tuple[str, int], float]) -> Json:
    """Errors on a set of models fitted elsewhere less those of models fitted there, on the same pushes [m]: mean and standard error."""
    found: dict[str, list[float]] = {}
    for result in cases:
        for other, error in result.values["elsewhere_m"].items():
            if (other, result.case.model) in own:
                found.setdefault(f"fitted on {result.case.object_name}, predicts {other}", []).append(error - own[other, result.case.model])
    return {
        pair: {"draws": len(d), "mean_m": round(float(np.mean(d)), 6), "error_m": round(float(np.std(d, ddof=1) / np.sqrt(len(d))), 6)}
        for pair, d in found.items()
        if len(d) > 1
    }


def _tables(summary: Json) -> str:
    head = ["set", "draws", "pushes fitted, predicted", "object moves [mm]", *_MODELS, "between pressures [mm]", "finger friction"]
    rows = [
        [
            name, str(row["draws"]), " and ".join(map(str, row["pushes"])), millimetres(row["moved_m"], 0),
            *(millimetres(row[model]) for model in _MODELS), millimetres(row["pressure_m"]), f"{row['pusher_friction']:.2f}",
        ]
        for name, row in summary["predicted"].items()
    ]  # fmt: skip
    parts = [markdown_table(head, rows)]
    if summary["told_apart"]:
        rows = [
            [name, str(row["draws"]), f"{1e3 * row['mean_m']:+.3f} ± {1e3 * row['error_m']:.3f}"]
            for name, row in summary["told_apart"].items()
        ]
        parts.append(markdown_table(["model", "draws", "error more than that of the model fitted there [mm]"], rows))
    return "\n\n".join(parts)


def _answer(summary: Json) -> str:
    rows = {name.split(", ")[0]: row for name, row in summary["predicted"].items() if name.endswith(next(iter(_FEET)))}
    errors = ", ".join(f"{name} {millimetres(row['identified'])} ({millimetres(row['scalar'])}) mm" for name, row in rows.items())
    told = sum(row["mean_m"] > 2.0 * row["error_m"] for row in summary["told_apart"].values())
    return f"Ends (equal cells): {errors}. A model of the other support predicts worse in {told} of {len(summary['told_apart'])} cases."


STUDY = Experiment(
    name="two-fingers",
    title="Are pushes with two fingers predicted, and what do they show of the pressure?",
    question=(
        "Logs of stable pushes with two fingers of a gripper ([import](../how-to/import-recordings.md#cmu-two-fingers)) in "
        "`--recordings DIR`: 61 runs of two or three pushes, one rectangle on three points and on a ridge, and a triangle; the butterfly "
        f"lacks its outline. Each seed draws {_TRAIN} runs of a set. They register camera and hand by the contacts of the fingers, and fit "
        "the model, from the poses before and after each push only; the pushes of the other runs are predicted. Errors are mean cell "
        "errors. identified: friction maps of the whole base, or three feet of unknown place; scalar: equal cells with fitted values; "
        "uniform: with nominal ones. between pressures: by how much the predictions differ where all of the load is at the rim, and where "
        "it is in the middle; what pushes can show of the pressure is less. Last table: a model is fitted to one support and predicts "
        "the held-out pushes on the other, against the model that was fitted there."
    ),
    objects=(),
    find_objects=lambda folder: tuple(find_finger_sets(folder)),
    variants=tuple(_FEET),
    stages=("geometry", "physics", "identification", "bags", "offline", "pushing"),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
)
