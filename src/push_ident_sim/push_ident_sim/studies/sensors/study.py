"""How well an object is identified when each model of a depth sensor sees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import observe_push
from push_ident.identification.predicting.prediction import CHI2_90, held_out_errors, predict
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.perception.outline.fusion import with_edges_moved
from push_ident.physics.effects import EFFECTS
from push_ident.physics.scenario import PushScenario
from push_ident.types import Float64Array, ObjectShape, PushRecord
from push_ident_sim.cell.sensors import SENSORS
from push_ident_sim.objects import OBJECT_NAMES, make_object
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import (
    COLOURS,
    dots,
    log_millimetres,
    markdown_table,
    mean_in_millimetres,
    millimetres,
    new_figure,
    save,
)
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.filmed import FilmedObject
from push_ident_sim.studies.common.measuring import error_row, grouped, micrometres, pooled, solve_values
from push_ident_sim.studies.common.seeing import outline_errors, unit_of

__all__ = ["N_PUSHES", "N_TEST", "STUDY"]

_IDEAL: Final = "ideal"
N_PUSHES: Final = 4
N_TEST: Final = 8
_REST: Final = 20
"""Frames before and after each push: long enough for a better outline."""
_KNOWN: Final = {
    "perceived": "outline and poses perceived",
    "exact_poses": "poses with the error of the extrinsics only",
    "exact_outline": "exact outline, poses perceived",
    "exact": "exact outline, error of the extrinsics only",
}
"""What identification gets, and how the tables call it. Exact outlines have no deviations, so that their offset is not fitted."""
_SEEN: Final = {
    "first_outline_m": "outline, one view",
    "first_placed_m": "the same, placed",
    "last_outline_m": "outline after the pushes",
    "last_placed_m": "the same, placed",
    "touched_placed_m": "with the identified offset, placed",
    "poses_m": "poses",
}
"""What the camera saw, and how the table calls it."""
_MARGIN: Final = 1.2
"""Error of a sensor over that of the ideal camera that is aimed at [-]."""


def _run(case: Case, settings: CaseSettings) -> Json:
    own = [case.model, OBJECT_NAMES.index(case.object_name)]
    thing, unit = make_object(case.object_name, case.model), unit_of(case.object_name, case.model)
    filmed = FilmedObject(thing, [*own, 8], sensor=case.variant, unit=unit, rest=_REST)
    try:
        first = filmed.shape
        rng = np.random.default_rng([*own, 9])
        records = [filmed.execute(filmed.true_push(rng)) for _ in range(N_PUSHES)]
        test = filmed.test_pushes(N_TEST, np.random.default_rng([*own, 10]), as_perceived=False)
    finally:
        filmed.close()
    inputs: dict[str, tuple[list[PushRecord], ObjectShape]] = {
        "perceived": (records, filmed.shape),
        "exact_poses": (filmed.exact, filmed.shape),
        "exact_outline": (records, filmed.exact_shape),
        "exact": (filmed.exact, filmed.exact_shape),
    }
    errors, values, touched = {}, {}, first.outline
    for name, (pushes, shape) in inputs.items():
        # As the node does it: pushes are fitted again with a better outline.
        result = identify([replace(push, shape=shape) for push in pushes], budget=settings.budget)
        # With the offset of the surface from the outline that the pushes show, as every prediction of the package has it.
        errors[name] = micrometres(held_out_errors(result.model, test, effects=result.posterior.effects))
        if name == "perceived":
            touched = _touched(result.posterior)
            values = solve_values(result) | {"in_region": [_is_in_region(result.posterior, push) for push in test]}
    truth = filmed.exact_shape.outline
    seen = {"first": first.outline, "last": filmed.shape.outline, "touched": touched}
    outlines = {name: outline_errors(outline, truth) for name, outline in seen.items()}
    return values | {"errors_m": errors, "outlines": outlines, "poses_m": micrometres(_pose_errors(records, filmed.exact))}


def _touched(posterior: ModelPosterior) -> Float64Array:
    """Where the pushes show the surface: the outline moved by the identified offset [m], shape (n, 2)."""
    shape, effects = posterior.model.shape, posterior.effects
    outline = shape.outline
    for name in effects.names:
        if not EFFECTS[name].moves_outline:
            continue
        outline = with_edges_moved(outline, np.full(len(outline), effects.values[effects.slice_of(name)][0]))
    return outline


def _is_in_region(posterior: ModelPosterior, record: PushRecord) -> bool:
    """Whether the end of a push lies in the 90 % region of its prediction."""
    observed = observe_push(record)
    predicted = predict(posterior, PushScenario(record.pusher, observed.pose[0], observed.time[-1:]), first_covariance=1e-8 * np.eye(3))
    error = observed.pose[-1] - predicted.pose[-1]
    return bool(error @ np.linalg.solve(predicted.covariance[-1], error) < CHI2_90)


def _pose_errors(records: Sequence[PushRecord], exact: Sequence[PushRecord]) -> list[float]:
    """Root mean square over the outline of the displacement by the error of the poses, one value a push [m]."""
    errors = []
    for record, true in zip(records, exact, strict=True):
        moved = [
            transform_points(a, record.shape.outline) - transform_points(b, record.shape.outline)
            for a, b in zip(record.poses.pose, true.poses.pose, strict=True)
        ]
        errors.append(float(np.sqrt(np.mean(np.sum(np.square(moved), axis=2)))))
    return errors


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_sensor = grouped(results, "variant")
    return {
        "sensors": {name: _row(own) for name, own in by_sensor.items()},
        "objects": {
            name: {thing: error_row(cases, "perceived") for thing, cases in grouped(own, "object_name").items()}
            for name, own in by_sensor.items()
        },
        "errors_m": {name: pooled(own, "perceived") for name, own in by_sensor.items()},
    }


def _row(results: Sequence[CaseResult]) -> Json:
    row: Json = {"cases": len(results), "errors": {name: error_row(results, name) for name in _KNOWN}}
    for name in ("first", "last", "touched"):
        for key in ("outline_m", "placed_m"):
            values = [r.values["outlines"][name][key] for r in results]
            row[f"{name}_{key}"] = round(float(np.sqrt(np.mean(np.square(values)))), 6)
    row["poses_m"] = round(float(np.sqrt(np.mean(np.square([v for r in results for v in r.values["poses_m"]])))), 6)
    row["in_region"] = round(float(np.mean([v for r in results for v in r.values["in_region"]])), 4)
    row["not_converged"] = sum(r.values["status"] != "converged" for r in results)
    return row


def _tables(summary: Json) -> str:
    sensors = summary["sensors"]
    ideal = sensors.get(_IDEAL, {}).get("errors", {}).get("perceived", {}).get("mean_m")
    head = [
        "mean cell error on held-out pushes [mm]",
        "cases",
        *_KNOWN.values(),
        "of the ideal camera's",
        "90 % of pushes",
        "ends in the 90% region",
    ]
    errors = [
        [
            name,
            str(row["cases"]),
            *(mean_in_millimetres(row["errors"][what]) for what in _KNOWN),
            f"{row['errors']['perceived']['mean_m'] / ideal:.2f}" if ideal else "–",
            millimetres(row["errors"]["perceived"]["q90_m"]),
            f"{row['in_region']:.0%}",
        ]
        for name, row in sensors.items()
    ]
    things = list(next(iter(summary["objects"].values())))
    objects = [
        [name, *(mean_in_millimetres(own[thing]) if thing in own else "–" for thing in things)] for name, own in summary["objects"].items()
    ]
    seen = [[name, *(millimetres(row[key]) for key in _SEEN)] for name, row in sensors.items()]
    return "\n\n".join(
        [
            markdown_table(head, errors),
            "By object, outline and poses perceived:",
            markdown_table(["mean cell error [mm]", *things], objects),
            "Outlines where they are in the object frame, and placed as well as a rigid motion can; poses as the motion of the outline:",
            markdown_table(["RMS [mm]", *_SEEN.values()], seen),
        ]
    )


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (axes,) = new_figure(1, width=9.0, height=4.2)
    names = list(summary["errors_m"])
    for place, name in enumerate(names):
        dots(axes, place, summary["errors_m"][name], COLOURS["gauss_newton"])
    if _IDEAL in summary["sensors"]:
        mean = summary["sensors"][_IDEAL]["errors"]["perceived"]["mean_m"]
        axes.axhline(1e3 * _MARGIN * mean, color=COLOURS["truth"], lw=1.0, ls=":")
    axes.set_xticks(range(len(names)), [name.replace("realsense_", "").replace("_", "\n") for name in names], fontsize=8)
    log_millimetres(axes, "cell error on held-out pushes [mm]")
    save(figure, folder / "sensors.png")
    return {"sensors.png": "Every dot a held-out push, bars the means; dotted: the mean of the ideal camera and a fifth more."}


STUDY = Experiment(
    name="sensors",
    place=75,
    title="Identification over models of depth sensors",
    question=(
        "How well are unseen pushes predicted when a model of a real depth sensor sees the object? The camera stands where the "
        "sensor sees the workspace, each case has another unit, and perception gets the pose and the intrinsics that the unit "
        f"publishes, and how well units of its model are calibrated. The object is taken in at rest, then pushed {N_PUSHES} times "
        f"by a rod that hides a part of it, with {_REST} frames at rest before and after each push, and put back by hand when it "
        "nears the edge. Outlines get better at those rests. All pushes are then fitted with the latest outline. The poses of the "
        f"{N_TEST} held-out pushes are the true ones in the table frame of the camera: they have the error of its extrinsics, as "
        "all poses that it reports, and no other. True motion and pushes are the same before every camera. For comparison: what "
        "remains of the error with poses that have no other error either, with the exact outline, and with both."
    ),
    variants=tuple(SENSORS),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "perception", "physics", "identification"),
)
