"""Figures of the identification report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from push_ident.identification.picture import draw_cells
from push_ident.identification.result import ModelPosterior
from push_ident.identification.scoring import PushScore
from push_ident.pushing.push import PushPlan2D
from push_ident.types import Float64Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from push_ident.identification.push_errors import PushErrors

__all__ = ["draw_errors", "draw_maps", "draw_push", "draw_record"]

_CHI2_90_2D = 4.605
"""Chi squared with 2 degrees of freedom is below it with probability 0.9."""


def draw_maps(posterior: ModelPosterior) -> Figure:
    """Mass, friction, their product and its relative standard deviation, with the centre of friction."""
    from matplotlib.figure import Figure

    model = posterior.model
    product = model.mass * model.friction
    panels = (
        ("mass [g]", 1e3 * model.mass),
        ("friction", model.friction),
        ("mass × friction [g]", 1e3 * product),
        ("standard deviation of the product [%]", 100 * posterior.mass_friction_std / product),
    )
    figure = Figure(figsize=(12.5, 3.3), layout="constrained")
    ellipse = _centre_ellipse(posterior)
    for ax, (name, values) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        patches = draw_cells(ax, model.shape, values, "viridis", (min(0.0, float(values.min())), float(values.max())))
        ax.plot(*model.centre_of_friction, marker="+", color="red", markersize=9)
        ax.plot(*ellipse.T, color="red", linewidth=1.0)
        ax.set_title(name, fontsize=10)
        figure.colorbar(patches, ax=ax, shrink=0.8).ax.tick_params(labelsize=7)
    return figure


def _centre_ellipse(posterior: ModelPosterior) -> Float64Array:
    """Edge of the 90 % region of the centre of friction [m], shape (n, 2), object frame."""
    parameters = posterior.unknowns
    mechanics = parameters.mechanics(posterior.z)
    centre = posterior.model.centre_of_friction
    rows = (parameters.shape.cells.centres - centre).T @ mechanics.limit_derivative / float(mechanics.body.limit.sum())
    value, vector = np.linalg.eigh(rows @ posterior.covariance @ rows.T)
    angle = np.linspace(0, 2 * np.pi, 61)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(centre + circle * np.sqrt(_CHI2_90_2D * np.maximum(value, 0.0)) @ vector.T)


def draw_errors(train: PushErrors, test: PushErrors) -> Figure:
    """Cell error of every push: a bar for the identified maps, marks for equal cells."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 2.8), layout="constrained")
    ax = figure.subplots()
    for errors, name, colour in ((train, "in the fit", "#9fb8d6"), (test, "held out", "#1f5fa8")):
        if errors.pushes:
            ax.bar(errors.pushes, 1e3 * errors.identified, color=colour, label=f"identified, {name}")
    pushes = [*train.pushes, *test.pushes]
    for marker, colour, name, values in (
        ("_", "#444444", "equal cells, nominal", [*train.uniform, *test.uniform]),
        ("x", "#b5651d", "equal cells, fitted", [*train.scalar, *test.scalar]),
    ):
        ax.plot(pushes, 1e3 * np.array(values), linestyle="none", marker=marker, color=colour, label=name, markersize=9)
    ax.set_xticks(sorted(pushes))
    ax.set_xlabel("push")
    ax.set_ylabel("cell error at the end [mm]")
    ax.set_ylim(bottom=0.0)
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def draw_record(scores: Sequence[PushScore]) -> Figure:
    """Error of the prediction made before each push, its expected error, and the error of equal cells."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 2.8), layout="constrained")
    ax = figure.subplots()
    numbers = [score.number for score in scores]
    for name, colour, style, values in (
        ("predicted before the push", "#1f5fa8", "o-", [s.cell_error for s in scores]),
        ("expected by the prediction", "#9fb8d6", "--", [s.expected_cell_error for s in scores]),
        ("equal cells, nominal", "#444444", "_", [s.uniform_cell_error for s in scores]),
    ):
        ax.plot(numbers, 1e3 * np.array(values), style, color=colour, label=name)
    ax.set_xticks(numbers)
    ax.set_xlabel("push")
    ax.set_ylabel("cell error at the end [mm]")
    ax.set_ylim(bottom=0.0)
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def draw_push(posterior: ModelPosterior, plan: PushPlan2D, pusher_radius: float) -> Figure:
    """The push on the object, with the uncertainty of each cell."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    model = posterior.model
    relative = 100 * posterior.mass_friction_std / (model.mass * model.friction)
    figure = Figure(figsize=(4.6, 3.4), layout="constrained")
    ax = figure.subplots()
    patches = draw_cells(ax, model.shape, relative, "Greys", (0.0, float(relative.max())))
    figure.colorbar(patches, ax=ax, shrink=0.8, label="standard deviation of mass × friction [%]")
    start = plan.tool_start(0.0)
    ax.add_patch(Circle(tuple(start), pusher_radius, fill=False, edgecolor="#1f5fa8", linewidth=1.5))
    ax.annotate(
        "",
        xy=tuple(start + plan.distance * plan.heading),
        xytext=tuple(start),
        arrowprops={"arrowstyle": "-|>", "color": "#1f5fa8", "lw": 2.0},
    )
    ax.plot(*plan.contact_point, marker="o", color="#1f5fa8", markersize=4)
    ax.autoscale_view()
    return figure
