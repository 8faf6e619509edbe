"""Objects that stand on a bed of springs: their loads are not the weight of their cells. Does identification find what matters?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.solvers import DEFAULT_SOLVER
from push_ident.physics.support import GRAVITY
from push_ident_sim.engines.planar import PlanarWorld
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import TruthSettings, true_model
from push_ident_sim.studies.blind.cases import Scenario, Truth, make_records
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
from push_ident_sim.studies.common.measuring import error_row, fit_errors, grouped, micrometres, pooled, solve_row

__all__ = ["STUDY"]

_N_TRAIN = 4
_N_TEST = 12
_MODELS = {
    "uniform": "equal cells, nominal values",
    "scalar": "equal cells, fitted scalars",
    "identified": "identified",
    "weight": "true maps, load is weight",
    "truth": "true maps and loads",
}
_NO_EFFECT = Truth(Scenario("planar", "null"), InjectedEffects(), ())


def _run(case: Case, settings: CaseSettings) -> Json:
    thing, n_pushes = make_object(case.object_name, case.model), _N_TRAIN + _N_TEST
    records = make_records(_NO_EFFECT, case.object_name, case.model, n_pushes, settings.noise)
    exact = replace(settings.noise, position_std=1e-9, yaw_std=1e-9)
    clean = make_records(_NO_EFFECT, case.object_name, case.model, n_pushes, exact)
    test = records[_N_TRAIN:]
    result, values = fit_errors(records[:_N_TRAIN], test, thing, DEFAULT_SOLVER, settings)
    model, loads = true_model(thing), PlanarWorld(thing, TruthSettings().pushes.pusher_radius).cell_loads()
    # The model's load of a cell is its weight: its friction takes up the rest.
    loaded = replace(model, friction=model.friction * loads / (model.mass * GRAVITY))
    errors = values["errors_m"]
    errors |= {"weight": errors["truth"], "truth": micrometres(held_out_errors(loaded, test))}
    return values | predicted_ends(result.posterior, test, [record.poses.pose[-1] for record in clean[_N_TRAIN:]])


def _summarise(results: Sequence[CaseResult]) -> Json:
    return {name: _row(own) for name, own in grouped(results, "object_name").items()} | {"all": _row(results)}


def _row(results: Sequence[CaseResult]) -> Json:
    return {
        "objects": len(results),
        "errors": {model: error_row(results, model) for model in _MODELS},
        "errors_m": {model: pooled(results, model) for model in _MODELS},
        "calibration": calibration_row(results),
        "solve": solve_row(results),
    }


def _tables(summary: Json) -> str:
    errors = [[name, *(mean_in_millimetres(own["errors"][m]) for m in _MODELS)] for name, own in summary.items()]
    rest = [
        [
            name,
            *(f"{100 * own['calibration'][key]:.0f} %" for key in ("within_90", "beyond_3")),
            *(millimetres(own["calibration"][key]) for key in ("expected_m", "actual_m")),
            str(own["calibration"]["pushes"]),
            f"{own['solve']['median_time_s']:.2f}",
            ", ".join(f"{n} {status.replace('_', ' ')}" for status, n in own["solve"]["statuses"].items()),
        ]
        for name, own in summary.items()
    ]
    head = ["", "true end within the 90 % region", "error above 3 times the expected", "error expected [mm]", "error found [mm]", "pushes"]
    return "\n\n".join(
        [
            markdown_table(["mean cell error on held-out pushes [mm]", *_MODELS.values()], errors),
            "Predicted ends of the held-out pushes; errors are root mean squares against the true ends:",
            markdown_table([*head, "median solve [s]", "how the solves ended"], rest),
        ]
    )


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (ax,) = new_figure(1, width=8.0, height=4.4)
    colours = COLOURS | {"identified": COLOURS[DEFAULT_SOLVER], "weight": COLOURS["finite_differences"]}
    for i, own in enumerate(summary.values()):
        for j, (model, label) in enumerate(_MODELS.items()):
            dots(ax, i + 0.16 * (j - 2), own["errors_m"][model], colours[model], width=0.13, label=None if i else label)
    ax.set_xticks(range(len(summary)), list(summary))
    log_millimetres(ax, "cell error on held-out pushes [mm]")
    label_below(ax, 3)
    save(figure, folder / "loads.png")
    return {"loads.png": "Every dot is one held-out push, bars are the means."}


STUDY = Experiment(
    name="loads",
    place=47,
    title="Objects with loads of their own",
    question=(
        "How well are random pushes predicted, when a cell does not bear its own weight? The planar engine of the blind check "
        "pushes the five objects without any effect. They stand on a bed of equal springs, so that the loads balance the weight but "
        "differ from that of each cell. There are 4 random training pushes, with the noise of the other experiments, and 12 "
        "held-out pushes."
    ),
    variants=(f"{_N_TRAIN}-pushes",),
    needs_truth=False,
    stages=("geometry", "physics", "identification", "pushing"),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
)
