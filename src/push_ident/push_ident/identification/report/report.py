"""The identification report: one page, the most important results first."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from push_ident import __version__
from push_ident.errors import InputError
from push_ident.files import write_whole
from push_ident.geometry.cut_cells import cell_polygons
from push_ident.identification.predicting.next_push import N_CANDIDATES, propose_push
from push_ident.identification.predicting.prediction import PushErrors
from push_ident.identification.predicting.scoring import PushScore, summarise_scores
from push_ident.identification.results.identifiability import (
    Identifiability,
    Support,
    before_text,
    identifiability,
    supports,
    value_text,
)
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.results.result import Candidate, Identification
from push_ident.pages.chart import BLUES, Arrow, CellPanel, Mark, Row, Series, cell_panel, row_chart
from push_ident.pages.page import FigureSection, page_text
from push_ident.pushing.push import PushPlan2D
from push_ident.types import Float64Array, SolveStatus


@dataclass(frozen=True, slots=True)
class Provenance:
    """Sources of the data."""

    object_id: str
    sources: tuple[str, ...]
    """One line per push of the fit."""
    notes: tuple[str, ...] = ()
    """Missing, dropped or assumed data."""


def write_report(
    path: Path,
    result: Identification,
    train: PushErrors,
    test: PushErrors,
    provenance: Provenance,
    pusher_radius: float,
    record: Sequence[PushScore] = (),
    sections: Sequence[FigureSection] = (),
) -> None:
    """Write the page of `report_text` to `path`. Raises InputError where it cannot be written."""
    write_whole(path, report_text(result, train, test, provenance, pusher_radius, record, sections), "the report", error=InputError)


def report_text(
    result: Identification,
    train: PushErrors,
    test: PushErrors,
    provenance: Provenance,
    pusher_radius: float,
    record: Sequence[PushScore] = (),
    sections: Sequence[FigureSection] = (),
) -> str:
    """The page of an identification, HTML in one file.

    `train`, `test`: errors of the pushes of the fit, and of those held out, which may be none; `pusher_radius`: of the pusher that would
    make the next push [m]; `record`: predictions made before each push, in order; `sections`: further figures.
    """
    posterior = result.posterior
    known = identifiability(posterior)
    context = {
        "title": f"Object {provenance.object_id}: mass and friction",
        "headline": _headline(result, train, test, known) + _record_line(record, test),
        "wrong": result.warnings,
        "warning": "" if result.status is SolveStatus.CONVERGED else f"Do not use these maps without a check: {result.status.value}.",
        "maps": draw_maps(posterior),
        "errors": draw_errors(train, test),
        "n_shown": len(shown_pushes(train, test)),
        "n_pushes": len(train.pushes) + len(test.pushes),
        "error_rows": [_error_row("pushes of the fit", train), _error_row("held-out pushes", test)],
        "held_out": bool(test.pushes),
        "record": _record(record),
        "sections": sections,
        "quantities": [
            {
                "name": q.name,
                "value": value_text(q),
                "before": before_text(q),
                "short": q.knowledge.value.partition(":")[0],
                "verdict": q.knowledge.value,
            }
            for q in known.quantities
        ],
        "legend": dict.fromkeys(q.knowledge.value for q in known.quantities),
        "priors": _candidates(result.candidates),
        "n_combinations": len(known.combinations),
        "n_pinned": known.n_pinned,
        "n_open": known.n_open,
        "next_push": _next_push(posterior, pusher_radius),
        "provenance": _provenance(result, provenance),
    }
    return page_text(__package__ or "", "report.html.j2", context)


def _headline(result: Identification, train: PushErrors, test: PushErrors, known: Identifiability) -> str:
    posterior = result.posterior
    centre = posterior.model.centre_of_friction
    spread = {q.name: q.std for q in known.quantities}
    centre_text = (
        f"the centre of friction is at ({1e3 * centre[0]:z.1f} ± {1e3 * spread['centre of friction x']:.1f}, "
        f"{1e3 * centre[1]:z.1f} ± {1e3 * spread['centre of friction y']:.1f}) mm of the object frame"
    )
    mass = posterior.total_mass
    weight = (
        f"the total mass is {mass.value:.2f} ± {mass.std:.2f} kg"
        if posterior.total_mass_identifiable
        else "poses do not determine the total mass (measure forces, or weigh the object)"
    )
    n = len(train.pushes)
    learned = f"From {n} push{'es' if n != 1 else ''}: {centre_text}; {weight}."
    if not test.pushes:
        return learned
    pushes = "one push" if len(test.pushes) == 1 else f"{len(test.pushes)} pushes"
    better = f"The maps predict {pushes} not used in the fit to {1e3 * np.nanmean(test.identified):.1f} mm"
    return f"{learned} {better}, equal cells with nominal values to {1e3 * np.nanmean(test.uniform):.1f} mm."


def _record_line(record: Sequence[PushScore], test: PushErrors) -> str:
    """The score of predictions made before each push, for the headline; none where pushes were held out, or none was predicted."""
    summary = summarise_scores(record)
    if test.pushes or not summary.n:
        return ""
    pushes = "One push was" if summary.n == 1 else f"{summary.n} pushes were"
    errors = [f"{1e3 * error:.1f} mm" for error in (summary.mean_cell_error, summary.mean_uniform_cell_error)]
    return f" {pushes} predicted from those before to {errors[0]}, by equal cells with nominal values to {errors[1]}."


def _error_row(name: str, errors: PushErrors) -> dict[str, Any]:
    columns = {"uniform": errors.uniform, "scalar": errors.scalar, "identified": errors.identified}
    means = {column: float(np.nanmean(values)) if len(values) else float("nan") for column, values in columns.items()}
    return {"name": name, "n": len(errors.pushes), **means}


def _candidates(candidates: Sequence[Candidate]) -> list[dict[str, str]]:
    """The best one first."""
    in_order = sorted(candidates, key=lambda c: -c.log_evidence)
    return [_candidate(candidate, in_order[0].log_evidence) for candidate in in_order]


def _candidate(candidate: Candidate, best: float) -> dict[str, str]:
    fields = {"mass": "mass_std", "load": "pressure_std", "friction": "friction_std", "length": "length"}
    return {
        "name": candidate.name,
        "probability": f"{candidate.probability:.0%}",
        "log_bayes_factor": f"{candidate.log_evidence - best:.1f}",
        **{name: "–" if candidate.maps is None else f"{getattr(candidate.maps, field):.2f}" for name, field in fields.items()},
        "feet": "; ".join(_support(support) for support in supports(candidate.on_feet)) if candidate.on_feet else "",
    }


def _support(support: Support) -> str:
    (x, y), (x_std, y_std) = 1e3 * support.position, 1e3 * support.position_std
    return f"({x:.0f} ± {x_std:.0f}, {y:.0f} ± {y_std:.0f}) mm bears {100 * support.share:.0f} ± {100 * support.share_std:.0f} %"


def _record(scores: Sequence[PushScore]) -> dict[str, Any] | None:
    """Predictions before each push; None where there are too few."""
    if len(scores) < 2:
        return None
    summary = summarise_scores(scores)
    return {
        "figure": draw_record(scores),
        "from_prior": scores[0].number == 1,
        "n": summary.n,
        "mean": summary.mean_cell_error,
        "expected": summary.mean_expected_cell_error,
        "uniform": summary.mean_uniform_cell_error,
        "share": f"{summary.share_within_90:.0%}",
    }


def _next_push(posterior: ModelPosterior, pusher_radius: float) -> dict[str, Any] | None:
    proposal = propose_push(posterior, pusher_radius)
    if proposal is None:
        return None
    plan = proposal.plan
    return {
        "figure": draw_push(posterior, plan, pusher_radius),
        "x": float(plan.contact_point[0]),
        "y": float(plan.contact_point[1]),
        "heading": float(np.degrees(plan.direction)),
        "distance": plan.distance,
        "speed": plan.speed,
        "n": N_CANDIDATES,
        "before": proposal.error_before,
        "after": proposal.error_after,
    }


def _provenance(result: Identification, provenance: Provenance) -> list[tuple[str, str]]:
    prior = ", ".join(f"{name.replace('_', ' ')} {value:g}" for name, value in asdict(result.posterior.prior).items())
    rows: list[tuple[str, str]] = [("push", source) for source in provenance.sources]
    rows += [("note", note) for note in provenance.notes]
    return [
        *rows,
        ("solver", f"{result.method}: {result.status.name.lower()}, {result.n_simulations} simulations, {result.time_s:.2f} s"),
        ("squared residual per degree of freedom", f"{result.reduced_chi2:.2f} (1: residuals as large as the stated noise)"),
        ("prior", prior),
        ("version", f"push_ident {__version__}, Python {platform.python_version()}"),
    ]


# --- figures


_MAX_ROWS = 40
"""Pushes of a figure; of more, those with the largest errors."""
_IDENTIFIED, _FITTED, _NOMINAL = "var(--accent, #1f5fa8)", "var(--warm, #c0561d)", "var(--soft, #5b6675)"


def draw_maps(posterior: ModelPosterior) -> list[tuple[str, str]]:
    """Mass, friction, their product and its relative standard deviation: title and SVG of each."""
    model = posterior.model
    product, areas = model.mass * model.friction, model.shape.cells.areas
    panels = (
        ("Mass per area", 0.1 * model.mass / areas, "g/cm²"),
        ("Support friction of each cell", model.friction, ""),
        ("Mass × friction per area: what pushes determine", 0.1 * product / areas, "g/cm²"),
        ("Relative standard deviation of mass × friction", 100 * posterior.mass_friction_std / product, "%"),
    )
    region, cells, centres, outline = _centre_ellipse(posterior), cell_polygons(model.shape), model.shape.cells.centres, model.shape.outline
    drawn = [(title, cell_panel(CellPanel(title, centres, cells, outline, values, unit, region=region))) for title, values, unit in panels]
    traced = posterior.unknowns.shape.outline
    if len(posterior.unknowns.outline_modes):
        moved = float(np.sqrt(np.mean(np.sum((outline - traced) ** 2, axis=1))))
        title = f"Outline as pushes show it (red), and as the camera traced it: vertices {1e3 * moved:.1f} mm apart"
        drawn.append((title, cell_panel(CellPanel(title, centres[:0], [], traced, np.zeros(0), "", region=outline))))
    return drawn


def _centre_ellipse(posterior: ModelPosterior) -> Float64Array:
    """Edge of the 90 % region of the centre of friction [m], shape (n, 2), object frame."""
    mechanics = posterior.mechanics
    centre = posterior.model.centre_of_friction
    rows = (mechanics.shape.cells.centres - centre).T @ mechanics.limit_derivative / float(mechanics.body.limit.sum())
    value, vector = np.linalg.eigh(rows @ posterior.covariance @ rows.T)
    angle = np.linspace(0, 2 * np.pi, 61)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    # Chi squared with 2 degrees of freedom is below 4.605 with probability 0.9.
    return np.asarray(centre + circle * np.sqrt(4.605 * np.maximum(value, 0.0)) @ vector.T)


def shown_pushes(train: PushErrors, test: PushErrors) -> list[tuple[int, bool, Float64Array]]:
    """The pushes of the figure of errors in their order: number from 0, whether it is held out, and its errors [m] under the identified
    model, equal cells with fitted scalars and equal cells with nominal values, shape (3,)."""
    every = [
        (number, errors is test, np.array([errors.identified[i], errors.scalar[i], errors.uniform[i]]))
        for errors in (train, test)
        for i, number in enumerate(errors.pushes)
    ]
    worst = sorted(every, key=lambda push: -np.nan_to_num(push[2][0], nan=np.inf))[:_MAX_ROWS]
    return sorted(worst, key=lambda push: push[0])


def draw_errors(train: PushErrors, test: PushErrors) -> str:
    """Cell error of every push under the identified model and under equal cells."""
    series = (
        Series("identified", "dot", _IDENTIFIED),
        Series("equal cells, fitted", "ring", _FITTED),
        Series("equal cells, nominal", "tick", _NOMINAL),
    )
    rows = []
    for number, is_held_out, errors in shown_pushes(train, test):
        marks = [Mark(k, 1e3 * float(e), f"push {number + 1}, {series[k].name}: {1e3 * e:.1f} mm") for k, e in enumerate(errors)]
        rows.append(Row(f"{'test' if is_held_out else 'fit'}: push {number + 1}", tuple(reversed(marks))))
    return row_chart("Cell error of each push", rows, series, "mm", axis="cell error at the end")


def draw_record(scores: Sequence[PushScore]) -> str:
    """Error of the prediction made before each push, its expected error, and the error of equal cells."""
    series = (
        Series("predicted before the push", "dot", _IDENTIFIED),
        Series("error that was expected", "ring", _IDENTIFIED),
        Series("equal cells, nominal", "tick", _NOMINAL),
    )
    rows = []
    for score in scores[-_MAX_ROWS:]:
        values = (score.cell_error, score.expected_cell_error, score.uniform_cell_error)
        marks = [Mark(k, 1e3 * v, f"push {score.number}, {series[k].name}: {1e3 * v:.1f} mm") for k, v in enumerate(values)]
        rows.append(Row(f"push {score.number}", tuple(reversed(marks))))
    return row_chart("Predictions made before each push", rows, series, "mm", axis="cell error at the end")


def draw_push(posterior: ModelPosterior, plan: PushPlan2D, pusher_radius: float) -> str:
    """The push on the object, with the uncertainty of each cell."""
    model = posterior.model
    relative = 100 * posterior.mass_friction_std / (model.mass * model.friction)
    start = plan.tool_start(0.0)
    arrow = Arrow(start, start + plan.distance * plan.heading, pusher_radius)
    shape = model.shape
    return cell_panel(CellPanel("Next push", shape.cells.centres, cell_polygons(shape), shape.outline, relative, "%", BLUES, arrow=arrow))
