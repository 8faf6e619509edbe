"""Exports of motion capture programs, written from known poses."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from push_ident.bags.importers.axes import parse_axes
from push_ident.types import Float64Array


@dataclass(frozen=True)
class Body:
    name: str
    position: Float64Array
    """In the axes of the file [m], shape (n, 3)."""
    attitude: Rotation
    """n of them."""
    is_lost: Sequence[bool]


Writer = Callable[[Path, Float64Array, list[Body]], Path]
"""Writes the bodies at these times [s]."""


def motive(rotation: str = "Quaternion", length: str = "Meters", *, timecode: bool = False) -> Writer:
    """With markers, errors and a skeleton beside the rigid bodies."""
    scale = {"Meters": 1.0, "Centimeters": 1e2, "Millimeters": 1e3}[length]
    axes = [*("XYZW" if rotation == "Quaternion" else rotation)]

    def write(file: Path, time: Float64Array, bodies: list[Body]) -> Path:
        index = ["Frame", "Time (Seconds)", *(["TimeCode"] if timecode else [])]
        # Type, name, ID, parent, what, axis.
        columns = [["", label, *[""] * timecode] for label in ("Type", "Name", "ID", "Parent", "")] + [index]
        values: list[list[Any]] = [[k, f"{t:.6f}", *["15:26:46:12.02"] * timecode] for k, t in enumerate(time)]
        for body in bodies:
            turn = body.attitude.as_quat() if rotation == "Quaternion" else body.attitude.as_euler(rotation, degrees=True)
            for what, names, numbers in (("Rotation", axes, turn), ("Position", [*"XYZ"], scale * body.position)):
                _add(columns, values, ["Rigid Body", body.name, "A1", "", what], names, numbers, body.is_lost)
            error = np.full((len(time), 1), 2e-4)
            _add(columns, values, ["Rigid Body", body.name, "A1", "", "Mean Marker Error"], [""], error, body.is_lost)
            marker = ["Rigid Body Marker", f"{body.name}:Marker 1", "B1", body.name, "Position"]
            _add(columns, values, marker, [*"XYZ"], 7.0 + body.position, body.is_lost)
        head = ["Format Version", "1.23", "Take Name", "a, b", "Capture Frame Rate", "100.000000", "Rotation Type", rotation]
        return _write(file, ",", [[*head, "Length Units", length, "Coordinate Space", "Global"], [], *columns, *values])

    return write


def vicon(rotation: str = "rad", length: str = "mm", *, title: str = "Objects", prefix: str = "", empty: bool = True) -> Writer:
    """`rotation`: unit of a rotation vector, `quaternion`, or `euler` for angles Rx Ry Rz in degrees; lost bodies are empty, or zero."""
    scale = {"m": 1.0, "cm": 1e2, "mm": 1e3}[length]

    def write(file: Path, time: Float64Array, bodies: list[Body]) -> Path:
        rate = 1.0 / (time[1] - time[0])
        columns: list[list[str]] = [["", ""], ["Frame", "Sub Frame"], ["", ""]]
        values: list[list[Any]] = [[f"{t * rate:.0f}", 0] for t in time]
        for body in bodies:
            numbers = {
                "rad": lambda turn: turn.as_rotvec(),
                "deg": lambda turn: turn.as_rotvec(degrees=True),
                "quaternion": lambda turn: turn.as_quat(),
                "euler": lambda turn: turn.as_euler("XYZ", degrees=True),
            }[rotation](body.attitude)
            names = ["RX", "RY", "RZ", "RW"][: numbers.shape[1]]
            unit = {"rad": "rad", "quaternion": ""}.get(rotation, "deg")
            columns[0] += [prefix + body.name, *[""] * (len(names) + 2)]
            columns[1] += [*names, "TX", "TY", "TZ"]
            columns[2] += [*[unit] * len(names), *[length] * 3]
            for row, pose, lost in zip(values, np.column_stack([numbers, scale * body.position]), body.is_lost, strict=True):
                row += ["" if empty else "0"] * len(pose) if lost else [f"{v:.8f}" for v in pose]
        return _write(file, ",", [[title], [f"{rate:.0f}"], *columns, *values, [], ["Trajectories"], [f"{rate:.0f}"], ["", "", "a:m1"]])

    return write


def qualisys(*, empty: bool = False) -> Writer:
    """Lost bodies are zero, or empty."""

    def write(file: Path, time: Float64Array, bodies: list[Body]) -> Path:
        head = [["NO_OF_FRAMES", len(time)], ["NO_OF_BODIES", len(bodies)], ["FREQUENCY", "100"], ["DATA_INCLUDED", "6D"]]
        names = ["Frame", "Time"]
        values: list[list[Any]] = [[k + 1, f"{t:.5f}"] for k, t in enumerate(time)]
        for body in bodies:
            names += [f"{body.name} X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *(f"Rot[{k}]" for k in range(9))]
            columns = body.attitude.as_matrix().transpose(0, 2, 1).reshape(-1, 9)
            numbers = np.column_stack([1e3 * body.position, body.attitude.as_euler("XYZ", degrees=True), np.ones(len(time)), columns])
            for row, pose, lost in zip(values, numbers, body.is_lost, strict=True):
                row += ["" if empty else "0.00000"] * 16 if lost else [f"{v:.5f}" for v in pose]
        rows = [*head, ["BODY_NAMES", *(body.name for body in bodies)], names, *values]
        return _write(file, "\t", [[*row, ""] if len(row) > 8 else row for row in rows])

    return write


def tracked_bodies(rows: tuple[Float64Array, Float64Array], up: str) -> tuple[Float64Array, list[Body]]:
    """The recording as a program has it whose axes `up` are those of the table: frames of 60 Hz, each body lost where it has no sample."""
    poses, pusher = rows
    to_table = parse_axes(up, "")
    frames = np.arange(round(60 * poses[0, 0]), round(60 * poses[-1, 0]) + 1)
    is_lost = [~np.isin(frames, np.round(60 * samples[:, 0])) for samples in rows]
    time = frames / 60
    x, y, yaw = (np.interp(time, poses[:, 0], poses[:, column]) for column in (1, 2, 3))
    tool = [np.interp(time, pusher[:, 0], pusher[:, column]) for column in (1, 2)]
    height = np.full(len(time), 0.03)
    turn = Rotation.from_rotvec(np.outer(yaw, to_table[2]))
    return time, [
        Body("My box", np.column_stack([x, y, height]) @ to_table, turn, is_lost[0].tolist()),
        Body("Tool", np.column_stack([*tool, height]) @ to_table, Rotation.identity(len(time)), is_lost[1].tolist()),
    ]


def _add(
    columns: list[list[str]], values: list[list[Any]], of: list[str], axes: list[str], numbers: Float64Array, is_lost: Sequence[bool]
) -> None:
    for axis in axes:
        for row, cell in zip(columns, [*of, axis], strict=True):
            row.append(cell)
    for row, cells, lost in zip(values, numbers, is_lost, strict=True):
        row += [""] * len(axes) if lost else [f"{cell:.6f}" for cell in cells]


def _write(file: Path, separator: str, rows: Sequence[Sequence[object]]) -> Path:
    text = io.StringIO()
    csv.writer(text, delimiter=separator, lineterminator="\r\n").writerows(rows)
    file.write_text(text.getvalue(), encoding="utf-8", newline="")
    return file
