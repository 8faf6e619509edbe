"""Learned maps of mass times friction beside the truth (Song & Boularias 2020, Fig. 4 a)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from push_ident.identification.solvers import DEFAULT_SOLVER
from push_ident.types import ObjectModel
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import load_truth, true_model
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import draw_cells, markdown_table, millimetres, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import fit_errors, grouped

__all__ = ["STUDY"]

_N_TRAIN = 4


def _shares(model: ObjectModel) -> NDArray[np.float64]:
    """Mass times friction of each cell over the mean of all: what slow pushes determine, independent of the weight of the object."""
    product = model.mass * model.friction
    return np.asarray(product / product.mean())


def _run(case: Case, settings: CaseSettings) -> Json:
    train, test, thing = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, settings.noise)
    result, values = fit_errors(train[:_N_TRAIN], test, thing, DEFAULT_SOLVER, settings)
    truth, learned, posterior = true_model(thing), result.model, result.posterior
    product, total = learned.mass * learned.friction, posterior.total_mass
    # The deviation at a known total mass: the total is one factor of all cells, and poses do not determine it.
    deviation = np.sqrt(np.maximum((posterior.mass_friction_std / product) ** 2 - (total.std / total.value) ** 2, 0.0))
    true_share, share = _shares(truth), _shares(learned)
    centre = truth.centre_of_friction
    return values | {
        "correlation": round(float(np.corrcoef(true_share, share)[0, 1]), 4),
        "share_error": round(float(np.mean(np.abs(share - true_share))), 4),
        "uniform_share_error": round(float(np.mean(np.abs(1.0 - true_share))), 4),
        "centre_error_m": round(float(np.linalg.norm(learned.centre_of_friction - centre)), 6),
        "uniform_centre_error_m": round(float(np.linalg.norm(result.uniform.centre_of_friction - centre)), 6),
        "pusher_friction_error": round(learned.pusher_friction - truth.pusher_friction, 4),
        "share": np.round(share, 4).tolist(),
        "true_share": np.round(true_share, 4).tolist(),
        "deviation": np.round(deviation, 4).tolist(),
    }


def _summarise(results: Sequence[CaseResult]) -> Json:
    summary: Json = {"objects": {}}
    for name, own in grouped(results, "object_name").items():
        first = own[0]
        summary["objects"][name] = {
            key: [r.values[key] for r in own]
            for key in (
                "correlation",
                "share_error",
                "uniform_share_error",
                "centre_error_m",
                "uniform_centre_error_m",
                "pusher_friction_error",
            )
        } | {"picture": {"model": first.case.model, **{key: first.values[key] for key in ("share", "true_share", "deviation")}}}
    return summary


def _tables(summary: Json) -> str:
    head = [
        "mean over the ground truths",
        "correlation",
        "error of a cell's share",
        "of equal cells",
        "error of the centre of friction [mm]",
        "of equal cells [mm]",
        "error of the pusher friction",
    ]
    rows = []
    for name, own in summary["objects"].items():
        mean = {
            key: float(np.mean(np.abs(values) if key == "pusher_friction_error" else values))
            for key, values in own.items()
            if key != "picture"
        }
        rows.append(
            [
                name,
                f"{mean['correlation']:.2f}",
                f"{mean['share_error']:.2f}",
                f"{mean['uniform_share_error']:.2f}",
                millimetres(mean["centre_error_m"]),
                millimetres(mean["uniform_centre_error_m"]),
                f"{mean['pusher_friction_error']:.3f}",
            ]
        )
    return markdown_table(head, rows)


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, panels = new_figure(3, rows=len(summary["objects"]), width=4.4, height=2.5)
    for row, (name, own) in enumerate(summary["objects"].items()):
        picture = own["picture"]
        thing = make_object(name, picture["model"])
        most = max(*picture["share"], *picture["true_share"])
        for ax, key, title, top in (
            (panels[3 * row], "true_share", f"{name}: truth", most),
            (panels[3 * row + 1], "share", "learned", most),
            (panels[3 * row + 2], "deviation", "relative deviation", max(picture["deviation"])),
        ):
            draw_cells(ax, thing.cells, thing.cell_size, picture[key], top, title)
    save(figure, folder / "maps.png")
    return {
        "maps.png": "Mass times friction of each cell over the mean of all cells: the truth, learned from 4 pushes, "
        "and the deviation that the result states."
    }


STUDY = Experiment(
    name="maps",
    place=20,
    title="Maps of mass times friction",
    question=(
        "Where does the model learned from 4 pushes place mass times friction? Maps are compared as shares (a cell over the mean of "
        "all cells), since the poses of pushes do not determine the total weight. The error of a share is the mean over the cells of "
        "its distance to the truth."
    ),
    variants=("four-pushes",),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
)
