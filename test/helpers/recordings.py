"""Files as others publish or export them, made for tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from push_ident.types import Float64Array, PushRecord

PERIOD = 6.0
"""Time from the start of a push to that of the next in tables [s]."""


def icra16_push(start_time: float, *, n_force: int = 40, gap: float = 0.0) -> str:
    """A push of 6 mm along x in the published form: the tool meets the edge x = 0 of the object, `gap` [mm] before it stands there."""
    time = start_time + np.linspace(0.0, 4.0, 41)
    tool = np.linspace(490.0, 506.0, 41) - gap
    axes = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0)
    force_time = start_time + np.linspace(0.0, 4.0, n_force)
    touching = np.interp(force_time, time, tool) + gap >= 500.0
    raw = -(touching[:, None] * [4.0, 0.0]) @ axes + [0.7, -0.3]
    lines = [f"{x} 20 12 1 0 0 0" for x in (500.0, 506.0)]
    lines += [str(n_force), *(f"{t:.3f} {fx:.4f} {fy:.4f}" for t, (fx, fy) in zip(force_time, raw, strict=True))]
    lines += [str(len(time)), *(f"{t:.3f} {x:.3f} 60 20 1 0 0 0" for t, x in zip(time, tool, strict=True))]
    return "\n".join(lines)


def icra16_file(path: Path, *, announced: int = 2, n: int = 2, n_force: int = 40, gap: float = 0.0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pushes = [icra16_push(1.4e9 + 30.0 * k, n_force=n_force, gap=gap) for k in range(n)]
    path.write_text("\n".join([str(announced), *pushes]) + "\n")
    return path


def mit_content(record: PushRecord, start: float = 1460088637.2) -> dict[str, Any]:
    """The three fields of a file. The force on the probe points against its motion."""
    push, path = record.poses, record.pusher
    return {
        "tip_pose": [[start + t, *p, 0.0] for t, p in zip(path.time, path.position.tolist(), strict=True)],
        "ft_wrench": [[start + t + 0.001, -2.0, 0.5, 0.01] for t in path.time],
        "object_pose": [[start + t, *p] for t, p in zip(push.time, push.pose.tolist(), strict=True)],
    }


def mit_file(folder: Path, content: Any, *, number: int = 0, shape: str = "rect1", surface: str = "abs") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"motion_surface={surface}_shape={shape}_a=0_v=100_i=0.000_s=0.{number:03d}_t=-0.349.json"
    file.write_text(json.dumps(content, indent=4))
    return file


def table_file(file: Path, names: str, rows: Float64Array, *, separator: str = ",", digits: int = 9) -> Path:
    lines = [separator.join(f"{value:.{digits}g}" for value in row) for row in rows]
    file.write_text("\n".join([names.replace(",", separator), *lines]) + "\n")
    return file


def tracked_rows(records: list[PushRecord]) -> tuple[Float64Array, Float64Array]:
    """Rows (time, x, y, yaw) of the object and (time, x, y, push) of the pusher; at rest for 1 s around each push."""
    poses, pusher = [], []
    for number, record in enumerate(records):
        start = number * PERIOD + 2.0
        time, pose = record.poses.time + start, record.poses.pose
        wait = np.arange(0.1, 1.0, 1 / 30)
        rng = np.random.default_rng(number)
        for stamps, place in ((time[0] - wait[::-1], pose[0]), (time, None), (time[-1] + wait, pose[-1])):
            noise = rng.normal(size=(len(stamps), 3)) * [2e-4, 2e-4, 2e-3]
            poses.append(np.column_stack([stamps, pose if place is None else place + noise]))
        pusher.append(np.column_stack([record.pusher.time + start, record.pusher.position, np.full(len(record.pusher.time), number)]))
    return np.vstack(poses), np.vstack(pusher)
