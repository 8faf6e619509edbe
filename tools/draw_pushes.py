"""An animated picture of a bag: each push is predicted from those before it, made, and learned from.

push-ident simulate --object hammer --pushes 7 --seed 3 --out out/pushes --truth out/pushes.json
.venv/bin/python tools/draw_pushes.py out/pushes out/pushes.json docs/images/pushes.gif --json docs/results/pushes.json
"""

from __future__ import annotations

import argparse
import io
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Polygon
from PIL import Image

from push_ident.api.plots import draw_cells
from push_ident.geometry.cells import cell_error
from push_ident.geometry.se2 import transform_points
from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import predict
from push_ident.identification.unknowns.mechanics import uniform_model
from push_ident.offline.loading import load_pushes
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.types import Float64Array, ObjectShape, PushRecord

FRAMES = 15
"""Pictures of one push."""
SECONDS = 0.09
"""Each of them."""
REST = 1.2
"""After a push, while its result stands [s]."""
PREDICTED, OBSERVED, EQUAL = "#d1495b", "#22313f", "#9aa5b1"


@dataclass
class Shot:
    """One push: what was predicted before it, and what happened."""

    record: PushRecord
    share: Float64Array | None
    """Friction force of each cell over the mean, as identified before the push; None before the first."""
    time: Float64Array
    predicted: Float64Array
    """Poses, shape (n_frames, 3)."""
    equal: Float64Array
    """The same by equal cells with nominal values."""
    error: float
    equal_error: float


def shots_of(records: list[PushRecord]) -> list[Shot]:
    """Predict each push from those before it; the first from equal cells."""
    found = []
    for number, record in enumerate(records):
        known = identify(records[:number]) if number else None
        time = np.linspace(record.poses.time[0], record.poses.time[-1], FRAMES)
        first = record.poses.pose[0]
        equal = identify_equal(record, time)
        poses = equal if known is None else predict(known.posterior, PushScenario(record.pusher, first, time)).pose
        last = record.poses.pose[-5:].mean(axis=0)
        errors = [cell_error(record.shape.cells, pose[-1], last) for pose in (poses, equal)]
        model = None if known is None else known.posterior.model
        load = None if model is None else model.mass * model.friction
        found.append(Shot(record, None if load is None else load / load.mean(), time, poses, equal, *errors))
    return found


def identify_equal(record: PushRecord, time: Float64Array) -> Float64Array:
    """Motion of equal cells with nominal values, shape (n_frames, 3)."""
    return simulate(uniform_model(record.shape), PushScenario(record.pusher, record.poses.pose[0], time)).pose


def outline_at(pose: Float64Array, shape: ObjectShape) -> Float64Array:
    return transform_points(pose, shape.outline)


def picture(shots: list[Shot], number: int, frame: int, truth: Float64Array, top: float) -> Image.Image:
    """One picture: the table on the left, the maps and the errors on the right."""
    shot, shape = shots[number], shots[number].record.shape
    figure = Figure(figsize=(7.6, 4.0), dpi=100, layout="constrained", facecolor="white")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.35, 1.0))
    table, known, true, bars = (figure.add_subplot(cell) for cell in (grid[:, 0], grid[0, 1], grid[1, 1], grid[2, 1]))
    poses, time = shot.record.poses, shot.time[frame]
    pose = np.array([np.interp(time, poses.time, poses.pose[:, axis]) for axis in range(3)])
    pusher = [float(np.interp(time, shot.record.pusher.time, shot.record.pusher.position[:, axis])) for axis in range(2)]
    table.add_patch(Polygon(outline_at(pose, shape), facecolor="#dfe6ec", edgecolor=OBSERVED, linewidth=1.6))
    table.add_patch(Polygon(outline_at(shot.equal[frame], shape), fill=False, edgecolor=EQUAL, linewidth=1.4, linestyle=":"))
    table.add_patch(Polygon(outline_at(shot.predicted[frame], shape), fill=False, edgecolor=PREDICTED, linewidth=1.6, linestyle="--"))
    table.add_patch(Circle((pusher[0], pusher[1]), shot.record.pusher.radius, facecolor="#f2a541", edgecolor="black", linewidth=0.8))
    points = np.vstack([outline_at(p, shape) for p in (poses.pose[0], poses.pose[-1], shot.predicted[-1], shot.equal[-1])])
    middle, half = 0.5 * (points.min(axis=0) + points.max(axis=0)), 0.16
    table.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half), xticks=[], yticks=[], aspect="equal")
    table.set_title(f"push {number + 1}, predicted from {number or 'no'} push{'' if number == 1 else 'es'}", fontsize=10)
    table.plot([], [], color=OBSERVED, label="observed")
    table.plot([], [], color=EQUAL, linestyle=":", label="predicted with equal cells")
    table.plot([], [], color=PREDICTED, linestyle="--", label="predicted with the identified maps")
    table.legend(loc="lower left", fontsize=7, frameon=False)
    values = np.ones(len(shape.cells)) if shot.share is None else shot.share
    for axes, what, title in (
        (known, values, "friction force of each cell, identified"),
        (true, truth, "the truth (never shown to the fit)"),
    ):
        draw_cells(axes, shape, what, "viridis", (0.0, top))
        axes.set(xticks=[], yticks=[], xlabel="")
        axes.set_title(title, fontsize=8)
        axes.set_axis_off()
    done = shots[: number + (frame == FRAMES - 1)]
    places = np.arange(len(shots))
    bars.bar(places[: len(done)] - 0.2, [1e3 * s.equal_error for s in done], 0.38, color=EQUAL)
    bars.bar(places[: len(done)] + 0.2, [1e3 * s.error for s in done], 0.38, color=PREDICTED)
    highest = 1e3 * max(s.equal_error for s in shots)
    bars.set(xlim=(-0.6, len(shots) - 0.4), ylim=(0, 1.15 * highest), xticks=places)
    bars.set_xticklabels([str(place + 1) for place in places])
    bars.tick_params(labelsize=7)
    bars.set_title("error of the prediction at the end of each push [mm]", fontsize=8)
    bars.legend(
        handles=[Patch(color=EQUAL, label="equal cells"), Patch(color=PREDICTED, label="identified")],
        fontsize=6.5,
        frameon=False,
        ncols=2,
        loc="upper right",
    )
    for side in ("top", "right"):
        bars.spines[side].set_visible(False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return Image.open(buffer).convert("RGB")


def palette_of(pictures: list[Image.Image]) -> Image.Image:
    """Colours of the ends of all pushes, in which everything is drawn."""
    width, height = pictures[0].size
    ends = pictures[FRAMES - 1 :: FRAMES]
    sheet = Image.new("RGB", (width, height * len(ends)))
    for place, one in enumerate(ends):
        sheet.paste(one, (0, place * height))
    return sheet.quantize(128, method=Image.Quantize.FASTOCTREE)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("bag", "truth", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--json", type=Path, help="file for the errors, from which the list of results is made")
    options = parser.parse_args()
    shots = shots_of(list(load_pushes([options.bag]).records))
    true = json.loads(options.truth.read_text(encoding="utf-8"))
    load = np.array(true["mass_kg"]) * np.array(true["friction"])
    truth = load / load.mean()
    pictures = [picture(shots, number, frame, truth, float(truth.max())) for number in range(len(shots)) for frame in range(FRAMES)]
    palette = palette_of(pictures)
    frames = [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures]
    durations = [int(1e3 * (REST if frame == FRAMES - 1 else SECONDS)) for _ in shots for frame in range(FRAMES)]
    frames[0].save(options.out, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=True)
    errors = {"errors_m": [shot.error for shot in shots], "equal_errors_m": [shot.equal_error for shot in shots]}
    if options.json is not None:
        options.json.write_text(json.dumps({key: [round(value, 6) for value in row] for key, row in errors.items()}) + "\n")
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
