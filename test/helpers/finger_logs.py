"""Logs of pushes with two fingers, as CMU's, of simulated pushes: poses are late, and displaced by a camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from push_ident.bags.importers.cmu_fingers import published_shape
from push_ident.geometry.se2 import transform_points
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.types import Float64Array, ObjectModel, PusherPath

FINGERS = np.array([[0.0, 0.009], [0.0, -0.009]])
DELAY, CAMERA = 0.15, np.array([0.0015, -0.001, 0.01])
BEGAN = 1495591575.0


def arc(first: Float64Array, spin: float) -> PusherPath:
    """The hand stands for 0.5 s, goes along an arc for 4 s, and stands again for 0.7 s; before the left face of the rectangle."""
    time = np.linspace(0.0, 5.2, 157)
    going = np.clip(time - 0.5, 0.0, 4.0)
    yaw = first[2] + spin * going
    step = 0.02 * np.diff(going)[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])[:-1]
    position = transform_points(first, np.array([[-0.0295, 0.0]])) + np.vstack([np.zeros(2), np.cumsum(step, axis=0)])
    return PusherPath(time, position, 0.0025, yaw=yaw, fingers=FINGERS)


def write_run(file: Path, seed: int) -> list[Float64Array]:
    """A log of two pushes in a row, with frames that the camera missed; gives the true end of each."""
    rng = np.random.default_rng(seed)
    shape = published_shape([file])
    n = len(shape.cells)
    model = ObjectModel(shape, np.full(n, 0.2 / n), np.full(n, 0.3), 0.5)
    pose = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(-3.0, 3.0)])
    lines, ends, began = [], [], BEGAN
    for number in (3, 1):
        path = arc(pose, rng.uniform(-0.2, 0.2))
        motion = simulate(model, PushScenario(path, pose, path.time))
        seen_at = np.clip(path.time - DELAY, 0.0, None)
        seen = np.column_stack([np.interp(seen_at, path.time, motion.pose[:, axis]) for axis in range(3)]) - CAMERA
        for k, time in enumerate(path.time):
            missed = 0.0 if 60 <= k < 70 else 1.0
            x, y, yaw = missed * seen[k]
            hand = path.position[k]
            assert path.yaw is not None
            turn = np.arctan2(np.sin(path.yaw[k]), np.cos(path.yaw[k]))
            lines.append(f"{began + time:.2f},{1e3 * x},{1e3 * y},{yaw},{1e3 * hand[0]},{1e3 * hand[1]},{turn},{number}")
        pose, began = motion.pose[-1], began + 8.0
        ends.append(pose)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines) + "\n")
    return ends
