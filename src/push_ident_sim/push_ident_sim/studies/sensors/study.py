"""How exactly models of depth sensors show an object to perception, and what that costs identification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.optimize import least_squares

from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.types import Float64Array, PushRecord
from push_ident_sim.cell.sensors import SENSORS
from push_ident_sim.objects import OBJECT_NAMES, make_object
from push_ident_sim.studies.common.measuring import error_row, grouped, micrometres, root_mean_square, solve_values
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import markdown_table, mean_millimetres, millimetres
from push_ident_sim.studies.sensors.filmed import FilmedObject

__all__ = ["N_PUSHES", "N_TEST", "STUDY", "outline_errors", "unit_of"]

N_PUSHES: Final = 4
N_TEST: Final = 8
_REST: Final = 20
"""Frames before and after each push: long enough for a better outline."""
_SPACING: Final = 5e-4
"""Of points along an outline [m]."""


def unit_of(object_name: str, seed: int) -> int:
    """Seed of the unit of a sensor in the case of an object: no two cases share one, since five objects before one badly calibrated unit
    would count as five."""
    return len(OBJECT_NAMES) * seed + OBJECT_NAMES.index(object_name)


def _run(case: Case, settings: CaseSettings) -> Json:
    seed = [case.model, OBJECT_NAMES.index(case.object_name)]
    sim_object, unit = make_object(case.object_name, case.model), unit_of(case.object_name, case.model)
    filmed = FilmedObject(sim_object, [*seed, 8], sensor=case.variant, unit=unit, rest=_REST)
    try:
        first = filmed.shape
        rng = np.random.default_rng([*seed, 9])
        records = [filmed.execute(filmed.true_push(rng)) for _ in range(N_PUSHES)]
        test = filmed.test_pushes(N_TEST, np.random.default_rng([*seed, 10]))
    finally:
        filmed.close()
    # As the node does it: pushes are fitted again with a better outline.
    perceived = identify([replace(push, shape=filmed.shape) for push in records], budget=settings.budget)
    exact = identify([replace(push, shape=filmed.exact_shape) for push in filmed.exact], budget=settings.budget)
    truth = filmed.exact_shape.outline
    return solve_values(perceived) | {
        # With the offset of the surface from the outline that the pushes show, as every prediction of the package has it.
        "errors_m": {
            name: micrometres(held_out_errors(result.model, test, effects=result.posterior.effects))
            for name, result in (("perceived", perceived), ("exact", exact))
        },
        "outlines": {name: outline_errors(outline, truth) for name, outline in (("first", first.outline), ("last", filmed.shape.outline))},
        "poses_m": micrometres(_pose_errors(records, filmed.exact)),
    }


def outline_errors(outline: Float64Array, truth: Float64Array) -> Json:
    """Root mean square distance of an outline from the true one [m]: `outline_m` where it is, `placed_m` after the best rigid motion.

    Args:
        outline, truth: In one frame [m], shapes (n, 2) and (m, 2).
    """
    points = _points_along(outline)

    def distance(motion: Float64Array) -> Float64Array:
        return signed_distance(transform_points(motion, points), truth)

    placed = least_squares(distance, np.zeros(3), x_scale=(1e-3, 1e-3, 1e-2)).x
    return {name: round(float(np.sqrt(np.mean(distance(at) ** 2))), 6) for name, at in (("outline_m", np.zeros(3)), ("placed_m", placed))}


def _points_along(polygon: Float64Array) -> Float64Array:
    parts = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        n = max(1, int(np.linalg.norm(b - a) / _SPACING))
        parts.append(a + np.linspace(0.0, 1.0, n, endpoint=False)[:, None] * (b - a))
    return np.concatenate(parts)


def _pose_errors(records: Sequence[PushRecord], exact: Sequence[PushRecord]) -> list[float]:
    """Root mean square over the outline of its displacement by the error of the poses, one value a push [m]."""
    errors = []
    for record, true in zip(records, exact, strict=True):
        displacements = [
            transform_points(a, record.shape.outline) - transform_points(b, record.shape.outline)
            for a, b in zip(record.poses.pose, true.poses.pose, strict=True)
        ]
        errors.append(float(np.sqrt(np.mean(np.sum(np.square(displacements), axis=2)))))
    return errors


def _summarise(results: Sequence[CaseResult]) -> Json:
    return {"sensors": {name: _row(cases) for name, cases in grouped(results, "variant").items()}}


def _row(results: Sequence[CaseResult]) -> Json:
    values = [r.values for r in results]
    return {
        "cases": len(results),
        "errors": {name: error_row(results, name) for name in ("perceived", "exact")},
        **{
            f"{name}_{key}": root_mean_square(v["outlines"][name][key] for v in values)
            for name in ("first", "last")
            for key in ("outline_m", "placed_m")
        },
        "poses_m": root_mean_square(error for v in values for error in v["poses_m"]),
    }


def _tables(summary: Json) -> str:
    head = [
        "sensor",
        "cases",
        "outline, one view [mm]",
        "after the pushes",
        "the same, placed",
        "poses [mm]",
        "cell error [mm]",
        "with exact outline and poses",
    ]
    rows = [
        [
            name,
            str(row["cases"]),
            *(millimetres(row[key]) for key in ("first_outline_m", "last_outline_m", "last_placed_m", "poses_m")),
            *(mean_millimetres(row["errors"][name]) for name in ("perceived", "exact")),
        ]
        for name, row in summary["sensors"].items()
    ]
    return markdown_table(head, rows)


def _answer(summary: Json) -> str:
    errors = {name: row["errors"]["perceived"]["mean_m"] for name, row in summary["sensors"].items()}
    best, worst = min(errors, key=errors.__getitem__), max(errors, key=errors.__getitem__)
    return f"Held-out pushes are predicted to {millimetres(errors[best], 1)} mm ({best}) to {millimetres(errors[worst], 1)} mm ({worst})."


STUDY = Experiment(
    name="sensors",
    title="How exact are perception and predictions through depth sensors?",
    question=(
        "The camera stands where the sensor sees the workspace; each case has another unit, and perception gets the pose, the "
        f"intrinsics and the accuracy that the unit publishes. The object is pushed {N_PUSHES} times by a rod that hides a part of "
        f"it, with {_REST} frames at rest before and after each push, in which the outline gets better. placed: after the best "
        f"rigid motion. Errors of outlines and poses are root mean squares. The poses of the {N_TEST} held-out pushes have the "
        "error of the extrinsics and no other."
    ),
    variants=tuple(SENSORS),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    stages=("geometry", "perception", "physics", "identification"),
)
