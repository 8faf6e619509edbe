"""Figures of the identification report, as SVG."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from push_ident.identification.predicting.prediction import PushErrors
from push_ident.identification.predicting.scoring import PushScore
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.pages.chart import BLUES, Arrow, CellPanel, Mark, Row, Series, cell_panel, row_chart
from push_ident.pushing.push import PushPlan2D
from push_ident.types import Float64Array

_MAX_ROWS = 40
"""Pushes of a figure; of more, those with the largest errors."""
_IDENTIFIED, _FITTED, _NOMINAL = "var(--accent, #1f5fa8)", "var(--warm, #c0561d)", "var(--soft, #5b6675)"


def draw_maps(posterior: ModelPosterior) -> list[tuple[str, str]]:
    """Mass, friction, their product and its relative standard deviation: title and SVG of each."""
    model = posterior.model
    product = model.mass * model.friction
    panels = (
        ("Mass of each cell", 1e3 * model.mass, "g"),
        ("Support friction of each cell", model.friction, ""),
        ("Mass × friction: what pushes determine", 1e3 * product, "g"),
        ("Relative standard deviation of mass × friction", 100 * posterior.mass_friction_std / product, "%"),
    )
    region = _centre_ellipse(posterior)
    return [(title, _panel(posterior, title, values, unit, region)) for title, values, unit in panels]


def _panel(posterior: ModelPosterior, title: str, values: Float64Array, unit: str, region: Float64Array) -> str:
    shape = posterior.model.shape
    return cell_panel(CellPanel(title, shape.cells.centres, shape.cells.size, shape.outline, values, unit, region=region))


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
    cells = model.shape.cells
    return cell_panel(CellPanel("Next push", cells.centres, cells.size, model.shape.outline, relative, "%", BLUES, arrow=arrow))
