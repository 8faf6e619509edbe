"""A picture of a simulation that is corrected: the scene, its gap, the causes, and the corrected scene.

push-ident simulate --out out/hammer --pushes 10 --seed 3 --effect table_tilt=0.05,0.02
MUJOCO_GL=egl .venv/bin/python tools/draw_fix.py docs/examples/hammer_scene.xml out/hammer docs/images/own_simulator.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from push_ident.diagnosis.diagnose import diagnose
from push_ident.geometry.se2 import transform_points
from push_ident.offline.loading import load_pushes
from push_ident.simulators.gap import SimulatorGap, simulator_gap
from push_ident.simulators.mujoco_scene import MujocoScene
from push_ident.types import Float64Array

RECORDED, WRONG, RIGHT, BEFORE = "#1c2430", "#b54a12", "#1f5fa8", "#dfe4ea"


def photograph(scene: Path) -> Float64Array:
    """The scene as MuJoCo shows it, shape (height, width, 3)."""
    spec = mujoco.MjSpec.from_file(str(scene))
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.4] * 3, [0.5] * 3
    for geom in spec.geoms:
        geom.rgba = {"hammer": (0.30, 0.50, 0.75, 1.0), "finger": (0.80, 0.40, 0.15, 1.0)}.get(geom.parent.name, (0.85, 0.87, 0.90, 1.0))
    finger = spec.body("finger")
    finger.pos = [spec.body("hammer").pos[0] - 0.03, spec.body("hammer").pos[1] + 0.05, finger.pos[2]]
    model = spec.compile()
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    mujoco.mj_forward(model, data)
    camera.lookat, camera.distance, camera.elevation, camera.azimuth = data.body("hammer").xpos, 0.5, -45.0, 60.0
    with mujoco.Renderer(model, 420, 420) as renderer:
        renderer.update_scene(data, camera)
        return np.asarray(renderer.render())


def draw_push(ax: Axes, gap: SimulatorGap, outline: Float64Array, push: int, row: int, colour: str) -> None:
    """The recorded end of a push, and that in the simulator, as it is or corrected."""
    ways = ((gap.observed[0], BEFORE, "-", True), (gap.observed[1], RECORDED, "-", False), (gap.ends[row], colour, "--", False))
    for poses, edge, style, filled in ways:
        corners = 1e3 * transform_points(poses[push], outline)
        ax.add_patch(Polygon(corners, fill=filled, facecolor=BEFORE, edgecolor=edge, linestyle=style, linewidth=1.6))
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.set_xticks([])
    ax.set_yticks([])


def draw(scene: Path, gap: SimulatorGap, outline: Float64Array) -> Figure:
    """The four panels."""
    figure = Figure(figsize=(12.0, 3.4), layout="constrained")
    first, second, third, fourth = figure.subplots(1, 4, width_ratios=(1.0, 1.0, 1.5, 1.0))
    push, before, after = int(np.argmax(gap.errors[0])), 1e3 * gap.errors[0].mean(), 1e3 * gap.corrected.mean()
    first.imshow(photograph(scene))
    first.set_axis_off()
    first.set_title(f"1  {gap.name}", fontsize=10)
    draw_push(second, gap, outline, push, 0, WRONG)
    second.set_title(f"2  its gap: {before:.1f} mm", fontsize=10)
    names = [name.replace("what the engine", "what MuJoCo") for name in gap.parts]
    third.barh(names, 1e3 * gap.sizes, xerr=1e3 * gap.stds, color=RIGHT, ecolor=RECORDED)
    third.invert_yaxis()
    third.tick_params(labelsize=8)
    third.set_xlabel("mm of the error on held-out pushes", fontsize=8)
    third.set_title("3  the causes", fontsize=10)
    draw_push(fourth, gap, outline, push, 1, RIGHT)
    fourth.set_title(f"4  corrected, in MuJoCo: {after:.1f} mm", fontsize=10)
    return figure


def main() -> None:
    """Read, compare and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("bag", type=Path)
    parser.add_argument("picture", type=Path)
    given = parser.parse_args()
    records = load_pushes([given.bag]).records
    effects = [effect.name for effect in diagnose(records).effects]
    gap = simulator_gap(records, MujocoScene(given.scene, "hammer", "finger"), effects=effects, on_progress=print)
    draw(given.scene, gap, records[0].shape.outline).savefig(given.picture, dpi=110)


if __name__ == "__main__":
    main()
