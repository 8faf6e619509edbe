"""Plates known by the end poses of slow pushes: does identification find how they stand on the table?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from push_ident.geometry.cells import cell_error
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import observe_push
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.results.result import Identification
from push_ident.identification.solvers import DEFAULT_SOLVER
from push_ident.physics.scenario import PushScenario
from push_ident.types import PushRecord
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.calibration import calibration_row, predicted_ends
from push_ident_sim.studies.common.drawing import (
    COLOURS,
    dots,
    label_below,
    log_millimetres,
    markdown_table,
    mean_in_millimetres,
    millimetres,
    new_figure,
    save,
)
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import error_row, grouped, micrometres, pooled, solve_row, solve_values
from push_ident_sim.studies.supports.plates import KINDS, Plate, SimulatedPush, make_plate, make_push, simulate_known_supports

__all__ = ["STUDY"]

_NUMBERS = (2, 5, 10)
"""Of training pushes."""
_N_TEST = 16
_MODELS = {
    "uniform": "equal cells, nominal values",
    "scalar": "equal cells, fitted scalars",
    "identified": "identified",
    "truth": "true supports",
}
_TICKS = (0.5, 1, 2, 5, 10, 20)
"""Of errors in the picture [mm]."""
_KINDS = {"tripod": "three feet", "base": "whole base"}


def _run(case: Case, settings: CaseSettings) -> Json:
    plate = make_plate(case.object_name, case.model)
    train = [_push(case.object_name, case.model, number).record for number in range(int(case.variant.split("-")[0]))]
    held_out = [_push(case.object_name, case.model, max(_NUMBERS) + number) for number in range(_N_TEST)]
    result = identify(train, budget=settings.budget)
    observed, exact = [push.record for push in held_out], [push.exact for push in held_out]
    ends = predicted_ends(result.posterior, observed, [record.poses.pose[-1] for record in exact])
    return (
        solve_values(result)
        | ends
        | {
            "errors_m": _errors(plate, result, observed),
            "exact_errors_m": _errors(plate, result, exact),
            "plate": _described(plate),
        }
    )


@lru_cache(maxsize=2 * (max(_NUMBERS) + _N_TEST))
def _push(kind: str, seed: int, number: int) -> SimulatedPush:
    """As `make_push`. The cases of one plate, which follow each other, share its pushes."""
    return make_push(make_plate(kind, seed), number)


def _errors(plate: Plate, result: Identification, test: Sequence[PushRecord]) -> dict[str, list[float | None]]:
    """Cell errors of `_MODELS` at the end of each push [m]."""
    models = {"uniform": result.uniform, "scalar": result.scalar, "identified": result.model}
    errors = {name: micrometres(held_out_errors(model, test)) for name, model in models.items()}
    return errors | {"truth": micrometres([_known_supports_error(plate, record) for record in test])}


def _known_supports_error(plate: Plate, record: PushRecord) -> float:
    """Cell error [m] at the end of a push, with the plate simulated from its observed first pose as in `held_out_errors`."""
    observed = observe_push(record)
    end = simulate_known_supports(plate, PushScenario(record.pusher, observed.pose[0], observed.time[-1:])).pose[-1]
    return cell_error(record.shape.cells, end, observed.pose[-1])


def _described(plate: Plate) -> Json:
    return {
        "form": plate.form,
        "mass_kg": round(plate.body.mass, 4),
        "friction": round(plate.body.friction, 4),
        "pusher_friction": round(plate.body.pusher_friction, 4),
        "pusher_radius_m": plate.pusher_radius,
        "position_std_m": round(float(plate.pose_std[0]), 6),
    }


def _summarise(results: Sequence[CaseResult]) -> Json:
    return {
        kind: {str(n): _row(own) for n in _NUMBERS if (own := [r for r in of_kind if r.case.variant.startswith(f"{n}-")])}
        for kind, of_kind in grouped(results, "object_name").items()
    }


def _row(results: Sequence[CaseResult]) -> Json:
    exact = [replace(r, values={"errors_m": r.values["exact_errors_m"]}) for r in results]
    means = {model: [own for r in results if (own := _mean(r, model)) is not None] for model in _MODELS}
    return {
        "objects": len(results),
        "errors": {model: error_row(results, model) for model in _MODELS},
        "exact_errors": {model: error_row(exact, model) for model in _MODELS},
        "objects_m": {model: micrometres(own) for model, own in means.items()},
        "better_than_scalar": sum((_mean(r, "identified") or np.inf) < (_mean(r, "scalar") or np.inf) for r in results),
        "calibration": calibration_row(results),
        "solve": solve_row(results),
    }


def _mean(result: CaseResult, model: str) -> float | None:
    """Mean error over the held-out pushes of one object [m]; None where none could be simulated."""
    errors = pooled([result], model)
    return float(np.mean(errors)) if errors else None


def _tables(summary: Json) -> str:
    rows = [(f"{_KINDS[kind]}, {n} pushes", own) for kind, numbers in summary.items() for n, own in numbers.items()]
    errors = [
        [name, *(mean_in_millimetres(own["errors"][m]) for m in _MODELS), f"{own['better_than_scalar']} of {own['objects']}"]
        for name, own in rows
    ]
    exact = [[name, *(mean_in_millimetres(own["exact_errors"][m]) for m in _MODELS)] for name, own in rows]
    return "\n\n".join(
        [
            markdown_table(["mean cell error on held-out pushes [mm]", *_MODELS.values(), "better than fitted scalars"], errors),
            "With the true poses of the held-out pushes, so that only the models differ:",
            markdown_table(["mean cell error on held-out pushes [mm]", *_MODELS.values()], exact),
            "Predicted ends of the held-out pushes; errors are root mean squares against the true ends:",
            markdown_table(
                [
                    "",
                    "true end within the 90 % region",
                    "error above 3 times the expected",
                    "error expected [mm]",
                    "error found [mm]",
                    "pushes",
                ],
                [[name, *_calibration(own["calibration"])] for name, own in rows],
            ),
            "Solves:",
            markdown_table(
                ["", "median [s]", "longest [s]", "how they ended", "most probable prior"],
                [[name, *_solve(own["solve"])] for name, own in rows],
            ),
        ]
    )


def _calibration(row: Json) -> list[str]:
    shares = [f"{100 * row[key]:.0f} %" for key in ("within_90", "beyond_3")]
    return [*shares, *(millimetres(row[key]) for key in ("expected_m", "actual_m")), str(row["pushes"])]


def _solve(row: Json) -> list[str]:
    counts = [", ".join(f"{n} {name.replace('_', ' ')}" for name, n in row[key].items()) for key in ("statuses", "priors")]
    return [f"{row['median_time_s']:.2f}", f"{row['max_time_s']:.2f}", *counts]


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, panels = new_figure(len(summary), width=5.6, height=4.4)
    colours = COLOURS | {"identified": COLOURS[DEFAULT_SOLVER]}
    for ax, (kind, numbers) in zip(panels, summary.items(), strict=True):
        for j, (model, label) in enumerate(_MODELS.items()):
            places = [i + 0.2 * (j - 1.5) for i in range(len(numbers))]
            for place, own in zip(places, numbers.values(), strict=True):
                dots(ax, place, own["objects_m"][model], colours[model], width=0.14, label=label if place == places[0] else None)
            means = [1e3 * own["errors"][model]["mean_m"] for own in numbers.values()]
            ax.plot(places, means, color=colours[model], linewidth=1, alpha=0.7)
        ax.set_xticks(range(len(numbers)), list(numbers))
        ax.set_xlabel("training pushes")
        log_millimetres(ax, "mean cell error on held-out pushes [mm]", low=0.3, high=30.0)
        ax.set_yticks(_TICKS)
        ax.set_title(_KINDS[kind], fontsize=10)
        label_below(ax, 2)
    save(figure, folder / "supports.png")
    return {"supports.png": "Every dot is one plate, bars are the means over plates."}


STUDY = Experiment(
    name="supports",
    place=45,
    title="Plates on feet and on whole bases",
    question=(
        "How well are slow pushes of plates predicted, when training knows only the pose before and after each of 2, 5 or 10 "
        "pushes? The plates resemble those of the recordings of Zhou et al. (2016) and Yu et al. (2016): six shapes of 90 to 160 mm "
        "and 0.1 to 2 kg, half of them on three feet, half on a whole base with an even or a smoothly uneven pressure. A disc of 2 "
        "or 4.75 mm radius pushes them by 16 to 30 mm at 10 to 50 mm/s; poses have a noise of 0.3 to 1 mm and 0.3 to 1.1 degrees. "
        "The motion comes from the planar engine, on feet and cells of its own; identification knows the outline, cut into about "
        "100 cells. The same 16 further pushes of each plate test all models. Their poses have the same noise, so that no "
        "model reaches an error of zero. `true supports`: the true feet or pressure and the true frictions in the engine of "
        "identification."
    ),
    objects=KINDS,
    variants=tuple(f"{n}-pushes" for n in _NUMBERS),
    needs_truth=False,
    stages=("geometry", "physics", "identification", "pushing"),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
)
