"""Whether the live cell pushes objects where they belong: to a pose, along a line, and out over an edge, through camera and all nodes."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from geometry_msgs.msg import PoseStamped

from push_ident.cli.supervisor import Supervisor, node_commands
from push_ident.errors import PushIdentError
from push_ident.files import write_whole
from push_ident.geometry.se2 import compose, inverse, wrap_angle
from push_ident.nodes.client.cell_client import CellClient, CellTimeout
from push_ident.types import Float64Array
from push_ident_sim.objects import make_object
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped
from push_ident_sim.studies.common.reaching import causes_in_words, failures, share, share_in_words

__all__ = ["STUDY"]

_KINDS = _POSE, _LINE, _EDGE = ("pose", "line", "edge")
_EXPLORING: Final = 2
"""Random pushes before the first one to the goal."""
_REACH: Final = 0.10
"""Half the side of the square that goals are drawn from [m]."""
_LENGTH: Final = 0.08
"""Of the line [m]: the hammer in any heading stays in the workspace."""
_BEFORE_LINE: Final = ("--tolerance-mm", 5)
"""How exactly the object is put before the line."""
_TABLE_END: Final = 0.10
"""Where the table ends for goals at its edge [m]."""
_FROM_EDGE: Final = 0.02
"""Least distance of the object from it at the start [m]."""
_TIME_LIMIT: Final = 240.0
"""Of a goal [s]."""
_TIMEOUT: Final = 60.0
"""Beyond that, for a command to end [s]."""
_PATIENCE: Final = 30.0
"""Longest time for the true pose [s]: it comes many times a second of simulated time."""
_NO_TRUTH: Final = "the simulated cell tells no true pose"
_CORRECTIONS: Final = "corrections of the last push"
"""How the diagnostics of the goal node begin that say how long they took."""


def _run(case: Case, settings: CaseSettings) -> Json:
    del settings
    rng, kind = np.random.default_rng([case.model, _KINDS.index(case.variant)]), case.variant
    os.environ["ROS_DOMAIN_ID"] = str(random.Random(zlib.crc32(case.key.encode())).randint(1, 100))
    cell: dict[str, object] = {"object": case.object_name, "seed": case.model, "noise_seed": case.model}
    if kind == _EDGE:
        start = _TABLE_END - _FROM_EDGE - np.max(np.linalg.norm(make_object(case.object_name, case.model).outline, axis=1))
        cell |= {"table": [-0.8, _TABLE_END, -0.7, 0.7], "start_pose": [float(start), 0.0, float(rng.uniform(-np.pi, np.pi))]}
    commands = [c for c in node_commands("sim", parameters={"sim_cell_node": cell}) if c.name != "gap_diagnosis_node"]
    with (
        tempfile.TemporaryDirectory() as folder,
        Supervisor(commands, log_dir=Path(folder)) as nodes,
        CellClient(check=nodes.check) as client,
    ):
        truth: list[Float64Array] = []
        client.node.create_subscription(PoseStamped, "/sim_cell_node/ground_truth/pose", lambda msg: truth.append(_planar(msg)), 10)
        object_id = client.wait_for_object()
        seen = client.pose_at_rest(object_id, after=-np.inf)
        client.wait(lambda: truth or None, _PATIENCE, _NO_TRUTH)
        # Both frames are of the object: where the true one lies in that of perception.
        true_frame = compose(inverse(seen), truth[-1])
        if kind == _LINE:
            options: tuple[object, ...] = ("--path", _line(client, object_id, case.model, Path(folder) / "line.csv"))
        elif kind == _POSE:
            x, y, yaw = *rng.uniform(-_REACH, _REACH, 2), rng.uniform(-np.pi, np.pi)
            options = ("--x", x, "--y", y, "--yaw", yaw, "--explore", _EXPLORING)
        else:
            options = ("--edge", "--explore", _EXPLORING, "--overhang-mm", 30)
        result = Path(folder) / "result.json"
        said = _command("push-to", *options, "--time-limit", _TIME_LIMIT, "--json", result)
        if not result.exists():
            raise PushIdentError(f"push-to wrote no result: {said[-300:]}")
        truth.clear()
        client.wait(lambda: truth or None, _PATIENCE, _NO_TRUTH)
        content: Json = json.loads(result.read_text(encoding="utf-8"))
        health = client.reasons()
        took = next((text for key, text in client.values_of("goal_pushing").items() if key.startswith(_CORRECTIONS)), "none")
    return {
        "reached": content["reached"],
        "code": content["code"],
        "text": content["text"],
        "pushes": content["n_pushes"],
        "time_s": content["time_s"],
        "goal": content["goal"],
        "tolerance": [content["tolerance_m"], content["tolerance_rad"]],
        "true_error": None if content["goal"] is None else _error(truth[-1], compose(np.array(content["goal"]), true_frame)),
        "fell": "has fallen" in health,
        "rms": [content.get("rms_position_m"), content.get("rms_yaw_rad")],
        "corrections": content.get("n_corrections", 0),
        "corrections_ms": [float(part) for part in took.split(",")] if took != "none" else None,
        "load": os.getloadavg()[0],
    }


def _command(*arguments: object) -> str:
    command = [sys.executable, "-m", "push_ident.cli", *map(str, arguments)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIME_LIMIT + _TIMEOUT)
    except subprocess.TimeoutExpired:
        raise PushIdentError(f"push-ident {arguments[0]} was not over after {_TIME_LIMIT + _TIMEOUT:.0f} s") from None
    return done.stdout + done.stderr


def _planar(msg: PoseStamped) -> Float64Array:
    place, turn = msg.pose.position, msg.pose.orientation
    return np.array([place.x, place.y, 2.0 * np.arctan2(turn.z, turn.w)])


def _line(client: CellClient, object_id: str, seed: int, file: Path) -> Path:
    """The object, explored and put before the middle; in the file, the line from there in its heading."""
    said = _command("push", "--random", _EXPLORING, "--seed", seed)
    try:
        client.wait_for_map(object_id, 1)
    except CellTimeout as error:
        raise PushIdentError(f"{error}; push --random said: {said[-300:]}") from None
    yaw = client.pose_at_rest(object_id, after=-np.inf)[2]
    ahead = _LENGTH * np.array([np.cos(yaw), np.sin(yaw)])
    _command("push-to", "--x", -0.5 * ahead[0], "--y", -0.5 * ahead[1], "--yaw", yaw, *_BEFORE_LINE, "--time-limit", _TIME_LIMIT)
    x, y, yaw = client.pose_at_rest(object_id, after=-np.inf)
    write_whole(file, f"{x}, {y}, {yaw}\n{x + _LENGTH * np.cos(yaw)}, {y + _LENGTH * np.sin(yaw)}, {yaw}\n", "the line")
    return file


def _error(pose: Float64Array, goal: Float64Array) -> list[float]:
    """Distance [m] and angle [rad] between two poses of the true frame."""
    return [float(np.hypot(*(pose - goal)[:2])), float(abs(wrap_angle(pose[2] - goal[2])))]


def _is_success(values: Json) -> bool:
    """Whether the node says so, the true pose is within the tolerances, and the object lies on the table."""
    error = values["true_error"]
    return bool(values["reached"] and not values["fell"] and error is not None and np.all(np.array(error) <= values["tolerance"]))


def _cause(values: Json) -> str:
    if values["fell"]:
        return "FELL"
    return "SUCCESS" if _is_success(values) else values["code"] if not values["reached"] else "true pose beyond tolerance"


def _summarise(results: Sequence[CaseResult]) -> Json:
    return {kind: _row([result.values for result in own]) for kind, own in grouped(results, "variant").items()}


def _row(runs: Sequence[Json]) -> Json:
    errors = np.array([run["true_error"] for run in runs if _is_success(run)]).reshape(-1, 2)
    timed = [run["corrections_ms"] for run in runs if run["corrections_ms"] is not None]
    rms = np.array([run["rms"] for run in runs if run["reached"] and run["rms"][0] is not None], dtype=np.float64).reshape(-1, 2)
    return {
        "success": share(_is_success(run) for run in runs),
        "fell": sum(run["fell"] for run in runs),
        "pushes": round(float(np.mean([run["pushes"] for run in runs])), 2),
        "time_s": round(float(np.median([run["time_s"] for run in runs])), 1),
        "true_error": errors.mean(axis=0).round(5).tolist() if len(errors) else None,
        "rms": rms.mean(axis=0).round(5).tolist() if len(rms) else None,
        "corrections": sum(run["corrections"] for run in runs),
        "corrections_ms": [float(np.median([t[0] for t in timed])), max(t[1] for t in timed)] if timed else None,
        "causes": failures((_cause(run) for run in runs), "SUCCESS"),
        "load": round(float(np.median([run["load"] for run in runs])), 1),
        "errors": [run["true_error"] for run in runs],
        "tolerance": runs[0]["tolerance"],
    }


def _tables(summary: Json) -> str:
    head = ["", "success (95 % interval)", "falls", "pushes", "time"]
    head += ["true error in the end", "from the path (RMS)", "a correction", "failures"]
    rows = [
        [
            kind,
            share_in_words(row["success"]),
            str(row["fell"]),
            f"{row['pushes']:.1f}",
            f"{row['time_s']:.0f} s",
            _in_words(row["true_error"]),
            _in_words(row["rms"]),
            "" if row["corrections_ms"] is None else "{:.0f} / {:.0f} ms".format(*row["corrections_ms"]),
            causes_in_words(row["causes"]),
        ]
        for kind, row in summary.items()
    ]
    return markdown_table(head, rows)


def _in_words(error: Sequence[float] | None) -> str:
    return "" if error is None else f"{1e3 * error[0]:.1f} mm, {np.degrees(error[1]):.1f}°"


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (axes,) = new_figure(1, width=6.0, height=3.6)
    for (kind, row), colour in zip(summary.items(), ("gauss_newton", "uniform", "truth"), strict=False):
        errors = np.array([error for error in row["errors"] if error is not None]).reshape(-1, 2) / row["tolerance"]
        axes.plot(errors[:, 0], errors[:, 1], "o", color=COLOURS[colour], label=kind)
    axes.plot([0, 1, 1], [1, 1, 0], color="0.7", linewidth=1)
    axes.set_xlabel("distance from the goal in the end [tolerances]")
    axes.set_ylabel("angle to it [tolerances]")
    label_below(axes, 3)
    save(figure, folder / "goals-live.png")
    return {"goals-live.png": "True poses in the end, each run a dot: inside the grey corner is success."}


STUDY = Experiment(
    name="goals-live",
    place=70,
    title="Goals in the live cell",
    question=(
        "Are objects pushed where they belong by the cell as a user starts it? The simulated cell with depth camera, perception, executor, "
        f"identification and goal node runs live, and `push-ident push-to` is given a goal after {_EXPLORING} random pushes of an object "
        "that nobody knows: `pose`, anywhere in a square of 20 cm and in any heading, within 20 mm and 0.1 rad; `line`, 8 cm in its "
        "heading through the middle, from where it was put before, followed as closely as within 3 mm and 2°; `edge`, from any heading "
        "out over an edge of the table by 30 mm, the pre-grasp pose within 20 mm and 15°. Success: the node says so, the true pose is "
        "within the tolerances of the goal, and it did not fall; true and seen poses are compared from where the object was seen at "
        "first. Times are those of the wall clock, with the exploring pushes except for `line`, of the line alone; a correction: median "
        "of the runs and the worst 99th percentile of one, of the last steered push."
    ),
    variants=_KINDS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "perception", "pushing", "physics", "identification", "planning", "nodes"),
    one_at_a_time=True,
)
