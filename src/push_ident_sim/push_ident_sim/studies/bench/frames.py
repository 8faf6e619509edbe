"""How long perception takes for a frame while objects are pushed and rest, better outlines included, and for taking an object in."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import PerceptionError
from push_ident.geometry.se2 import compose, inverse
from push_ident.perception.observation import Observation
from push_ident.perception.pipeline import Perception
from push_ident.types import DepthFrame, Float64Array
from push_ident_sim.cell.camera import Placed
from push_ident_sim.cell.sensor_unit import Sensor
from push_ident_sim.cell.sensors import SENSORS, suitable_pose
from push_ident_sim.objects import make_object
from push_ident_sim.studies.common.measuring import late_quantiles
from push_ident_sim.studies.common.study import Benchmark, Json, Piece, Settings, Target
from push_ident_sim.studies.common.tables import markdown_table, millimetres

_CAMERAS: Final = {"1280 x 720": "realsense_d435_1280x720", "640 x 480": "realsense_d435_640x480"}
_OBJECTS: Final = {"toolbox": (0.0, 0.27, 0.3), "crimp": (0.0, 0.0, 1.2), "book": (0.0, -0.27, 2.0)}
"""Objects and their first poses [m, m, rad]: far enough apart that no one is taken for a part of another."""
_PUSH: Final = (0.03, 0.0, 0.35)
"""What a push moves and turns an object by, to and fro [m, m, rad]: each rest shows it from another side."""
_RATE: Final = 30.0
"""Frames a second."""
_FIRST, _MOVING, _REST = 20, 8, 50
"""Frames before the first push, of a push, and of the rest after it."""


@dataclass(frozen=True, slots=True)
class _Shown:
    """A frame, and where the objects are."""

    frame: DepthFrame
    poses: dict[str, Float64Array]


def _pieces(settings: Settings) -> list[Piece]:
    n_pushes, n_runs = (1, 1) if settings.quick else (2, 3)
    numbers = (1,) if settings.quick else (1, len(_OBJECTS))
    cameras = list(_CAMERAS)[1:] if settings.quick else list(_CAMERAS)
    return [Piece(f"{camera}, {n} objects", _measure, (camera, n, n_pushes, n_runs, settings.seed)) for camera in cameras for n in numbers]


def _measure(camera: str, n_objects: int, n_pushes: int, n_runs: int, seed: int) -> Json:
    """Times of all frames of some runs over the same images; the run before them loads the kernels."""
    shown = list(_show(_CAMERAS[camera], n_objects, n_pushes, seed))
    reported = suitable_pose(_CAMERAS[camera])
    runs = [_run(shown, reported) for _ in range(n_runs + 1)][1:]
    first = next(i for i, row in enumerate(runs[0]) if row["new"])
    known = [row for run in runs for row in run[first + 1 :]]
    return {
        "camera": camera,
        "n_objects": n_objects,
        "n_taken_in": runs[0][first]["new"],
        "frame": late_quantiles([row["cpu"] for row in known]),
        "to_poses": late_quantiles([delay for run in runs for delay in _delays(run[first + 1 :])]),
        "taking_in_s": float(np.median([run[first]["cpu"] for run in runs])),
        "pose_error_m": float(np.median([error for row in known for error in row["errors"]])),
    }


def _show(sensor: str, n_objects: int, n_pushes: int, seed: int) -> Iterator[_Shown]:
    """The objects at rest, then each pushed in turn; a better outline may follow from each rest but the first."""
    unit, reported, rng = Sensor(sensor, seed), suitable_pose(sensor), np.random.default_rng(seed)
    objects = {name: make_object(name, seed) for name in list(_OBJECTS)[:n_objects]}
    poses = {name: np.array(_OBJECTS[name]) for name in objects}
    camera = unit.camera(next(iter(objects.values())), reported)
    number = 0

    def look(n: int) -> Iterator[_Shown]:
        nonlocal number
        view = camera.view([Placed(sim_object, poses[name]) for name, sim_object in objects.items()], {}, SENSORS[sensor].second)
        images = [unit.read(view, rng) for _ in range(min(n, 5))]
        at = {name: pose.copy() for name, pose in poses.items()}
        for i in range(n):
            number += 1
            yield _Shown(DepthFrame(number / _RATE, images[i % len(images)], unit.intrinsics), at)

    yield from look(_FIRST)
    for push in range(n_pushes):
        change = np.array(_PUSH) * (1.0 if push % 2 == 0 else -1.0, 1.0, 1.0)
        for name in objects:
            start = poses[name]
            for step in range(1, _MOVING + 1):
                poses[name] = start + change * step / _MOVING
                yield from look(1)
            yield from look(_REST)


def _run(shown: list[_Shown], reported: ArrayLike) -> list[Json]:
    perception, offsets, rows = Perception(reported), {}, []
    for view in shown:
        posed_at: list[float] = []
        cpu = time.process_time()
        observed = perception.observe(view.frame, (), partial(_note_time, posed_at))
        done = time.process_time()
        for object_id in observed.new_shapes:
            # The object that is nearest to it.
            at = perception.first_pose(object_id)
            name = min(view.poses, key=lambda name: float(np.hypot(*(view.poses[name] - at)[:2])))
            offsets[object_id] = name, compose(inverse(view.poses[name]), at)
        rows.append(
            {
                "cpu": done - cpu,
                "posed": (posed_at[0] if posed_at else done) - cpu,
                "new": len(observed.new_shapes),
                "errors": _errors(observed, view.poses, offsets),
            }
        )
    if not offsets:
        raise PerceptionError(f"No object was taken in: {observed.why_no_pose()}.")
    return rows


def _note_time(times: list[float], _: object) -> None:
    times.append(time.process_time())


def _errors(observed: Observation, poses: dict[str, Float64Array], offsets: dict[str, tuple[str, Float64Array]]) -> list[float]:
    """Distances of the tracked objects from where they are [m]."""
    tracked = [(known.pose, *offsets[known.object_id]) for known in observed.objects if known.pose is not None]
    return [float(np.hypot(*(pose - compose(poses[name], offset))[:2])) for pose, name, offset in tracked]


def _delays(run: list[Json]) -> list[float]:
    """From images to their poses [s]: of the images that come while a frame is worked on, the newest waits."""
    delays: list[float] = []
    i, free = 0, 0.0
    while i < len(run):
        i = max(min(int(free * _RATE), len(run) - 1), i)
        start = max(i / _RATE, free)
        delays.append(start + run[i]["posed"] - i / _RATE)
        free, i = start + run[i]["cpu"], i + 1
    return delays


def _targets(summary: Json) -> list[Target]:
    targets = []
    for row in summary["rows"]:
        if (row["camera"], row["n_objects"]) == ("1280 x 720", len(_OBJECTS)):
            what = f"{row['n_objects']} objects at {row['camera']}"
            for key, part in (("to_poses", "image to poses"), ("frame", "whole frame")):
                late = row[key]["p99_s"]
                targets.append(Target(f"{what}: {part}, 99 %", "≤ 40 ms", f"{1e3 * late:.1f} ms", late <= 0.040))
        if (row["camera"], row["n_objects"]) == ("640 x 480", 1):
            taken = row["taking_in_s"]
            targets.append(Target("taking an object in at 640 x 480", "≤ 0.5 s", f"{taken:.2f} s", taken <= 0.5))
    return targets


def _tables(summary: Json) -> str:
    head = ["camera", "objects", "whole frame [ms]", "image to poses at 30 Hz [ms]", "taking in [s]", "error of a position [mm]"]
    rows = [
        [
            row["camera"],
            f"{row['n_taken_in']}",
            _ms(row["frame"]),
            _ms(row["to_poses"]),
            f"{row['taking_in_s']:.2f}",
            millimetres(row["pose_error_m"], 2),
        ]
        for row in summary["rows"]
    ]
    return markdown_table(head, rows) + "\n\nTimes: median/99 %/worst."


def _ms(times: Json) -> str:
    return "/".join(f"{1e3 * times[key]:.1f}" for key in ("median_s", "p99_s", "worst_s"))


STUDY = Benchmark(
    name="frames",
    title="Perception of a frame",
    question=(
        f"Models of a RealSense D435 before one and three objects, each pushed twice and at rest in between for {_REST} frames. Image "
        "to poses: with a camera of 30 Hz, where the newest image waits while a frame is worked on. Taking in: the frame in which all "
        "objects become known."
    ),
    pieces=_pieces,
    summarise=lambda results: {"rows": list(results)},
    targets=_targets,
    tables=_tables,
)
