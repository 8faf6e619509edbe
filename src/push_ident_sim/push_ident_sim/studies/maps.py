"""Learned maps of mass times friction beside the truth (Song & Boularias 2020, Fig. 4 a)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.identification.solvers import DEFAULT_SOLVER
from push_ident.types import Float64Array, ObjectModel
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import load_truth, true_model
from push_ident_sim.studies.common.measuring import N_TRAIN, fit_errors, grouped
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import markdown_table, millimetres, new_figure, save

_COLUMNS: Final = {
    "correlation": "correlation",
    "share_error": "error of a cell's share",
    "uniform_share_error": "of equal cells",
    "centre_error_m": "error of the centre of friction [mm]",
    "uniform_centre_error_m": "of equal cells [mm]",
    "pusher_friction_error": "error of the pusher friction",
}


def _shares(model: ObjectModel) -> Float64Array:
    """Mass times friction of each cell over the mean of all: what slow pushes determine, independent of the weight of the object."""
    product = model.mass * model.friction
    return np.asarray(product / product.mean())


def _run(case: Case, settings: CaseSettings) -> Json:
    train, test, sim_object = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, settings.noise)
    result, values = fit_errors(train[:N_TRAIN], test, sim_object, DEFAULT_SOLVER, settings)
    truth, learned = true_model(sim_object), result.model
    true_share, share = _shares(truth), _shares(learned)
    centre = truth.centre_of_friction
    return values | {
        "correlation": round(float(np.corrcoef(true_share, share)[0, 1]), 4),
        "share_error": round(float(np.mean(np.abs(share - true_share))), 4),
        "uniform_share_error": round(float(np.mean(np.abs(1.0 - true_share))), 4),
        "centre_error_m": round(float(np.linalg.norm(learned.centre_of_friction - centre)), 6),
        "uniform_centre_error_m": round(float(np.linalg.norm(result.uniform.centre_of_friction - centre)), 6),
        "pusher_friction_error": round(abs(learned.pusher_friction - truth.pusher_friction), 4),
        "share": np.round(share, 3).tolist(),
        "true_share": np.round(true_share, 3).tolist(),
    }


def _summarise(results: Sequence[CaseResult]) -> Json:
    objects = {}
    for name, cases in grouped(results, "object_name").items():
        first = cases[0]
        objects[name] = {key: float(np.mean([r.values[key] for r in cases])) for key in _COLUMNS} | {
            "picture": {"model": first.case.model, "share": first.values["share"], "true_share": first.values["true_share"]}
        }
    return {"objects": objects}


def _tables(summary: Json) -> str:
    rows = [
        [name, *(millimetres(row[key]) if key.endswith("_m") else f"{row[key]:.3f}" for key in _COLUMNS)]
        for name, row in summary["objects"].items()
    ]
    return markdown_table(["mean over the ground truths", *_COLUMNS.values()], rows)


def _answer(summary: Json) -> str:
    rows = summary["objects"].values()
    correlations = [row["correlation"] for row in rows]
    centres, uniform = (np.mean([row[key] for row in rows]) for key in ("centre_error_m", "uniform_centre_error_m"))
    return (
        f"Correlation with the true maps {min(correlations):.2f} to {max(correlations):.2f}; centre of friction to "
        f"{millimetres(centres, 1)} mm (equal cells: {millimetres(uniform, 1)} mm)."
    )


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    objects = summary["objects"]
    figure, panels = new_figure(len(objects), rows=2, width=1.9, height=1.7)
    for column, (name, row) in enumerate(objects.items()):
        picture = row["picture"]
        sim_object = make_object(name, picture["model"])
        place = np.round((sim_object.cells - sim_object.cells.min(axis=0)) / sim_object.cell_size).astype(int)
        for line, (key, what) in enumerate((("true_share", "truth"), ("share", "learned"))):
            grid = np.full(place.max(axis=0)[::-1] + 1, np.nan)
            grid[place[:, 1], place[:, 0]] = picture[key]
            ax = panels[line * len(objects) + column]
            ax.imshow(grid, origin="lower", cmap="viridis", vmin=0.0, vmax=max(*picture["share"], *picture["true_share"]))
            ax.set_axis_off()
            ax.set_title(f"{name}: {what}", fontsize=9)
    save(figure, folder / "maps.svg")
    return {"maps.svg": f"Mass times friction of each cell over the mean of all cells: the truth, and learned from {N_TRAIN} pushes."}


STUDY = Experiment(
    name="maps",
    title="Where are mass and friction?",
    question=(
        f"The paper's Fig. 4 a: mass times friction of each cell, learned from {N_TRAIN} pushes, as a share (a cell over the mean "
        "of all), since poses do not determine the weight. The error of a share is the mean over the cells."
    ),
    variants=("four-pushes",),
    needs_truth=True,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    draw=_draw,
)
