"""Figures of results for notebooks and files."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, PathPatch, Polygon
from matplotlib.path import Path

from push_ident.diagnosis.report.figures import ranking_bars
from push_ident.diagnosis.result import Diagnosis
from push_ident.errors import InputError
from push_ident.geometry.cut_cells import cell_polygons
from push_ident.geometry.se2 import transform_points
from push_ident.identification.predicting.next_push import Proposal
from push_ident.identification.predicting.planned import PlannedPush
from push_ident.identification.predicting.scoring import Comparison
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.results.result import Identification
from push_ident.limits import plain_text
from push_ident.offline.loading import LoadedPushes
from push_ident.types import Float64Array, ObjectShape, PushRecord

_ACCENT, _LIGHT, _WARM, _GREY = "#1f5fa8", "#9fb8d6", "#c0561d", "#8a95a1"


class Picture(Figure):
    """A figure of matplotlib that shows itself in a notebook, whatever the backend."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=80)
        return buffer.getvalue()


def draw(result: Any, title: str = "") -> Picture:
    """See `push_ident.plot`."""
    for kinds, make in _FIGURES:
        if isinstance(result, kinds):
            return make(result, title)
    raise InputError(
        f"There is no figure of a {type(result).__name__}; plot() draws pushes and the results of identify, predict, diagnose, next_push."
    )


def _maps(result: Identification | ModelPosterior, title: str) -> Picture:
    posterior = result.posterior if isinstance(result, Identification) else result
    model = posterior.model
    product, areas = model.mass * model.friction, model.shape.cells.areas
    panels = (
        ("mass per area [g/cm²]", 0.1 * model.mass / areas),
        ("friction", model.friction),
        ("mass × friction per area [g/cm²]", 0.1 * product / areas),
        ("its standard deviation [%]", 100 * posterior.mass_friction_std / product),
    )
    figure = Picture(figsize=(12.5, 3.4), layout="constrained")
    for ax, (name, values) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        patches = draw_cells(ax, model.shape, values, "viridis", (min(0.0, float(values.min())), float(values.max())))
        ax.plot(*model.centre_of_friction, marker="+", color="red", markersize=9)
        ax.set_title(name, fontsize=10)
        figure.colorbar(patches, ax=ax, shrink=0.8)
    return _titled(figure, title or "Mass and friction of every cell; red: centre of friction")


def _pushes(pushes: LoadedPushes, title: str) -> Picture:
    figure, axes = _grid(len(pushes))
    for ax, record in zip(axes, pushes.records, strict=False):
        outline = record.shape.outline
        _outline(ax, transform_points(record.poses.pose[0], outline), _GREY, "before")
        _outline(ax, transform_points(record.poses.pose[-1], outline), _ACCENT, "after")
        ax.plot(*(1e3 * record.pusher.position.T), color=_WARM, linewidth=1.2, label="pusher")
        ax.add_patch(Circle(tuple(1e3 * record.pusher.position[0]), 1e3 * record.pusher.radius, fill=False, edgecolor=_WARM))
        _finish(ax, f"push {record.order + 1}", is_first=ax is axes[0])
    return _titled(figure, title or f"{len(pushes)} pushes of object {pushes.object_id}, table frame [mm]")


def _record(record: PushRecord, title: str) -> Picture:
    return _pushes(LoadedPushes(record.object_id, [record], []), title)


def _comparison(compared: Comparison, title: str) -> Picture:
    figure, axes = _grid(len(compared))
    for ax, push in zip(axes, compared, strict=False):
        outline = push.record.shape.outline
        _outline(ax, transform_points(push.record.poses.pose[0], outline), _GREY, "before")
        _outline(ax, transform_points(push.observed, outline), "black", "observed")
        if np.isfinite(push.cell_error):
            _outline(ax, transform_points(push.prediction.pose[-1], outline), _ACCENT, "predicted")
            ax.add_patch(_region(push.prediction.pose[-1], push.prediction.covariance[-1]))
        _finish(ax, f"push {push.record.order + 1}: error {1e3 * push.cell_error:.1f} mm", is_first=ax is axes[0])
    return _titled(figure, title or "Predicted and observed ends, table frame [mm]; ellipse: 90 % region of the origin")


def _planned(push: PlannedPush, title: str) -> Picture:
    figure, (ax,) = _grid(1)
    _outline(ax, transform_points(push.pose, push.shape.outline), _GREY, "before")
    ax.plot(*(1e3 * push.path.position.T), color=_WARM, linewidth=1.2, label="pusher")
    for outcome in push.outcomes if len(push.outcomes) > 1 else ():
        _outline(ax, transform_points(outcome.end, push.shape.outline), _LIGHT, f"with a chance of {outcome.chance:.0%}")
    if push.outcomes:
        _outline(ax, transform_points(push.prediction.pose[-1], push.shape.outline), _ACCENT, "predicted")
        ax.add_patch(_region(push.prediction.pose[-1], push.prediction.covariance[-1]))
    _finish(ax, f"touched with a chance of {push.prediction.touched:.0%}", is_first=True)
    return _titled(figure, title or "Predicted push, table frame [mm]; ellipse: 90 % region of the origin")


def _region(pose: Float64Array, covariance: Float64Array) -> Ellipse:
    """90 % region of the predicted origin of the object."""
    value, vector = np.linalg.eigh(covariance[:2, :2])
    across, along = 2e3 * np.sqrt(-2 * np.log(0.1) * np.maximum(value, 0.0))
    angle = float(np.degrees(np.arctan2(vector[1, 1], vector[0, 1])))
    return Ellipse(tuple(1e3 * pose[:2]), along, across, angle=angle, fill=False, edgecolor=_ACCENT, linestyle="--")


def _proposal(proposal: Proposal, title: str) -> Picture:
    posterior, plan = proposal.posterior, proposal.plan
    model = posterior.model
    relative = 100 * posterior.mass_friction_std / (model.mass * model.friction)
    figure = Picture(figsize=(6.0, 4.0), layout="constrained")
    ax = figure.subplots()
    patches = draw_cells(ax, model.shape, relative, "Greys", (0.0, float(relative.max())))
    figure.colorbar(patches, ax=ax, shrink=0.8, label="standard deviation of mass × friction [%]")
    start = plan.tool_start(0.0)
    ax.add_patch(Circle(tuple(start), proposal.pusher_radius, fill=False, edgecolor=_WARM, linewidth=1.5))
    end = start + plan.distance * plan.heading
    ax.annotate("", xy=tuple(end), xytext=tuple(start), arrowprops={"arrowstyle": "-|>", "color": _WARM, "lw": 2.0})
    ax.autoscale_view()
    return _titled(figure, title or "Next push, object frame; dark: cells that are known least")


def _diagnosis(diagnosis: Diagnosis, title: str) -> Picture:
    if diagnosis.selection is None:
        raise InputError(f"There is no figure of a diagnosis that abstains: {diagnosis.sentence}")
    figure = Picture(figsize=(9.0, 4.8), layout="constrained")
    ax = figure.subplots()
    bars, limit = ranking_bars(diagnosis.selection, diagnosis.policy.selection.min_log_bayes_factor)
    names = [_text(bar.name) for bar in bars]
    ax.barh(names, [bar.width for bar in bars], color=[_ACCENT if bar.highlighted else _LIGHT for bar in bars])
    for row, bar in enumerate(bars):
        ax.text(max(bar.width, limit) + 1.0, row, _text(bar.text), va="center", fontsize=9)
    ax.axvline(limit, color="black", linewidth=0.8, linestyle="--")
    ax.invert_yaxis()
    ax.set_xlim(0.0, 130.0)
    ax.set_xticks([0.0, limit], ["0", f"{diagnosis.policy.selection.min_log_bayes_factor:.0f}"])
    ax.set_xlabel("log Bayes factor [nat]; dashed: from here on detected")
    return _titled(figure, title or f"Which effect explains the gap: {diagnosis.verdict.value}")


def draw_cells(ax: Axes, shape: ObjectShape, values: Float64Array, colours: str, limits: tuple[float, float]) -> PatchCollection:
    """Colour the cells of an object by `values`, shape (n_cells,), inside its outline."""
    paths = ([Path(np.vstack([line, line[:1]]), closed=True) for line in lines] for lines in cell_polygons(shape))
    cells = [PathPatch(Path.make_compound_path(*lines)) for lines in paths]
    patches = PatchCollection(cells, cmap=colours, edgecolor="white", linewidth=0.3)
    patches.set_array(values)
    patches.set_clim(*limits)
    ax.add_collection(patches)
    ax.add_patch(Polygon(shape.outline, fill=False, edgecolor="black", linewidth=1.0))
    ax.set_aspect("equal")
    ax.autoscale_view()
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(lambda metres, _: f"{1e3 * metres:.0f}")
    ax.set_xlabel("x [mm]", fontsize=8)
    ax.tick_params(labelsize=7)
    return patches


def _grid(n: int) -> tuple[Picture, list[Any]]:
    n = min(n, 8)  # of more pushes, the first
    columns = min(n, 4)
    rows = -(-n // columns)
    figure = Picture(figsize=(max(4.8, 3.2 * columns), 3.0 * rows + 0.4), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for unused in axes[n:]:
        unused.set_visible(False)
    return figure, list(axes[:n])


def _outline(ax: Any, points: Float64Array, colour: str, label: str) -> None:
    closed = 1e3 * np.vstack([points, points[:1]])
    style = (0, (4, 2)) if label == "predicted" else "-"
    ax.plot(*closed.T, color=colour, linewidth=1.3, linestyle=style, label=label)


def _finish(ax: Any, title: str, *, is_first: bool) -> None:
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title(title, fontsize=10)
    if is_first:
        ax.legend(fontsize=8, frameon=False)


def _text(text: str) -> str:
    """Foreign text for a figure: one line, and no formula; matplotlib would parse what stands between two `$`, and fail."""
    return plain_text(text).replace("$", r"\$")


def _titled(figure: Picture, title: str) -> Picture:
    width = int(12 * figure.get_figwidth())  # characters
    figure.suptitle("\n".join(textwrap.wrap(_text(title), width)), fontsize=12)
    return figure


_FIGURES: tuple[tuple[Any, Callable[[Any, str], Picture]], ...] = (
    ((Identification, ModelPosterior), _maps),
    (LoadedPushes, _pushes),
    (PushRecord, _record),
    (Comparison, _comparison),
    (PlannedPush, _planned),
    (Proposal, _proposal),
    (Diagnosis, _diagnosis),
)
