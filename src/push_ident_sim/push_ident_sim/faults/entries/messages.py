"""Messages and requests of any content."""

from __future__ import annotations

import copy
import os
import pickle
import time
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import psutil
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point32, PolygonStamped, PoseStamped, Quaternion
from nav_msgs.msg import OccupancyGrid
from shape_msgs.msg import SolidPrimitive

from push_ident.pushing.push import PushCode
from push_ident_msgs.msg import PushRecord
from push_ident_msgs.srv import LoadModel, PredictPush, SaveModel
from push_ident_sim.faults.fault import Fault, Trial
from push_ident_sim.faults.harness.cell import ARM_CELL, Cell
from push_ident_sim.faults.harness.proxy import duplicated, lossy, reordered
from push_ident_sim.faults.harness.topics import OBJECT

__all__ = ["FAULTS"]

_EXECUTOR, _IDENTIFICATION = "push_executor_node", "identification_node"
_POSE: Final = f"objects/{OBJECT}/pose"
_NAN: Final = float("nan")
_MARKUP: Final = "[/x] <b>&nbsp;\x1b[31m \u202e{0}%s\n../../x"
_MEMORY: Final = 300.0
"""By how much the memory of a node may grow [MB]: what is claimed is a thousand times as much."""


def _pose_faults(good: Any) -> Iterator[tuple[str, Any]]:
    """Poses that are refused, by what is wrong with them."""

    def but(what: str, change: Callable[[Any], Any]) -> tuple[str, Any]:
        msg = copy.deepcopy(good)
        change(msg)
        return what, msg

    def covariance(value: float) -> Callable[[Any], Any]:
        return lambda m: setattr(m.pose, "covariance", np.full(36, value))

    yield but("covariance of NaN", covariance(_NAN))
    yield but("covariance of zero", covariance(0.0))
    yield but("negative covariance", lambda m: setattr(m.pose, "covariance", (-np.eye(6)).ravel()))
    yield but("infinite covariance", covariance(float("inf")))
    yield but("covariance of 1e308", lambda m: setattr(m.pose, "covariance", (np.eye(6) * 1e308).ravel()))
    yield but("no quaternion", lambda m: setattr(m.pose.pose, "orientation", Quaternion(x=0.0, y=0.0, z=0.0, w=0.0)))
    yield but("quaternion of NaN", lambda m: setattr(m.pose.pose.orientation, "w", _NAN))
    yield but("position of NaN", lambda m: setattr(m.pose.pose.position, "x", _NAN))
    yield but("infinite position", lambda m: setattr(m.pose.pose.position, "y", float("-inf")))
    yield but("another frame", lambda m: setattr(m.header, "frame_id", "map"))
    yield but("markup as frame", lambda m: setattr(m.header, "frame_id", _MARKUP))
    yield but("a tilted pose", lambda m: setattr(m.pose.pose, "orientation", Quaternion(x=1.0, y=0.0, z=0.0, w=0.0)))


def _alive_and_counted(trial: Trial, node: str, before: int, sent: int, since: float) -> None:
    """The node lives and counted at least `sent` refusals."""
    cell = trial.cell

    def counted() -> bool:
        reports = cell.monitor.reports_of(node, since)
        return bool(reports) and reports[-1].refused - before >= sent

    trial.expect_soon(counted, 4.0, f"{node} has not counted {sent} refusals")


def _refused(cell: Cell, node: str) -> int:
    report = cell.monitor.report_of(node)
    return 0 if report is None else report.refused


def _poses(trial: Trial) -> None:
    """Impossible poses, in the middle of a push."""
    cell = trial.cell
    before = {node: _refused(cell, node) for node in (_EXECUTOR, _IDENTIFICATION)}
    sent = cell.begin()
    since, number = time.monotonic(), 0
    for _, msg in _pose_faults(cell.proxy.latest(_POSE)):
        cell.monitor.publish(_POSE, msg)
        number += 1
        trial.wait(0.1)  # the executor keeps the latest few only
    result = cell.end(sent)
    trial.expect(result.error_code == PushCode.NONE, f"the push ended with {result.error_code} {result.error_text}")
    for node, count in before.items():
        _alive_and_counted(trial, node, count, number, since)
    trial.expect_refusal(_IDENTIFICATION, _POSE, since=since)
    trial.note = f"{number} poses refused by each node; the push was made"


def _others(trial: Trial) -> None:
    """Impossible content on every other topic."""
    cell = trial.cell
    joints, wrench = cell.proxy.latest("joint_states"), cell.proxy.latest("pusher/wrench")
    before = {node: _refused(cell, node) for node in (_EXECUTOR, _IDENTIFICATION)}
    since = time.monotonic()
    bad_joints, bad_wrench = copy.deepcopy(joints), copy.deepcopy(wrench)
    bad_joints.position = array("d", [_NAN] * 7)
    bad_joints.header.stamp = Time(sec=2**31 - 1, nanosec=2**32 - 1)
    bad_wrench.wrench.force.x = _NAN
    record = PushRecord(push_id=2**32 - 1, object_id=_MARKUP, error_text=_MARKUP, speed=_NAN, direction=float("inf"))
    record.start, record.end = Time(sec=-(2**31), nanosec=0), Time(sec=2**31 - 1, nanosec=2**32 - 1)
    status = DiagnosticStatus(level=b"\xff", name=_MARKUP, message=_MARKUP)
    for topic, msg in (
        ("joint_states", bad_joints),
        ("pusher/wrench", bad_wrench),
        ("pusher/pose", PoseStamped()),
        ("pusher/shape", SolidPrimitive(type=77)),
        ("pusher/shape", SolidPrimitive(type=SolidPrimitive.CYLINDER, dimensions=[_NAN, _NAN])),
        ("push_record", record),
        ("recording", status),
        (f"objects/{OBJECT}/cells", OccupancyGrid()),
    ):
        cell.monitor.publish(topic, msg)
    outline = _outline(cell)
    cell.monitor.publish(f"objects/{OBJECT}/outline", outline)
    trial.wait(1.5)
    _alive_and_counted(trial, _IDENTIFICATION, before[_IDENTIFICATION], 4, since)
    _alive_and_counted(trial, _EXECUTOR, before[_EXECUTOR], 2, since)
    trial.note = "9 messages on 8 topics"


def _outline(cell: Cell) -> Any:
    msg = PolygonStamped()
    msg.header.frame_id = f"object_{OBJECT}"
    msg.polygon.points = [Point32(x=_NAN, y=float("inf"), z=0.0)] * 2
    return msg


def _requests(trial: Trial) -> None:
    """Services with impossible requests: each is answered with a reason."""
    cell = trial.cell
    code, poison = trial.folder / "ran", trial.folder / "pickle.json"
    poison.write_bytes(pickle.dumps(_Bomb(code)))
    noise = trial.folder / "noise.json"
    noise.write_bytes(np.random.default_rng(0).bytes(4096))
    deep = trial.folder / "deep.json"
    deep.write_text("[" * 200_000)
    asked = 0
    for kind, name, request in (
        *((SaveModel, "save_model", SaveModel.Request(path=path)) for path in ("", "/", "/proc/nothing/x", "\x00", _MARKUP, "x" * 5000)),
        (SaveModel, "save_model", SaveModel.Request(object_id=_MARKUP, path=str(trial.folder / "m.json"))),
        *((LoadModel, "load_model", LoadModel.Request(path=str(path))) for path in ("", "/", "/dev/zero", noise, poison, deep, "\x00")),
        # Without "\x00": it arrives as an empty path, which takes effects out of the model.
        *((LoadModel, "load_diagnosis", LoadModel.Request(path=str(path))) for path in ("/", "/dev/zero", noise, poison, deep)),
        (PredictPush, "predict_push", PredictPush.Request(object_id=_MARKUP)),
        (PredictPush, "predict_push", PredictPush.Request()),
        (PredictPush, "predict_push", _path_of_nan()),
    ):
        answer = cell.monitor.call(kind, name, request)
        trial.expect(not answer.success and answer.message, f"{name} with {str(request)[:80]!r} was not refused with a reason")
        asked += 1
    trial.expect(not code.exists(), "the content of a file was executed")
    trial.note = f"{asked} requests refused with a reason"


class _Bomb:
    """Unpickled, it makes a file."""

    def __init__(self, path: Path) -> None:
        self._path = str(path)

    def __reduce__(self) -> tuple[Any, tuple[str, int]]:
        return os.mknod, (self._path, 0o600)


def _path_of_nan() -> PredictPush.Request:
    request = PredictPush.Request(object_id=OBJECT)
    request.pusher_path.header.frame_id = "table"
    poses = [PoseStamped() for _ in range(5)]
    for i, pose in enumerate(poses):
        pose.header.stamp = Time(sec=2**31 - 1 - i, nanosec=2**32 - 1)
        pose.pose.position.x = _NAN
    request.pusher_path.poses = poses
    return request


def _garbage(trial: Trial) -> None:
    """Bytes that are no message, on every topic."""
    cell = trial.cell
    rng = np.random.default_rng(1)
    topics = (_POSE, "joint_states", "pusher/wrench", "pusher/pose", "push_record", "pusher/shape", f"objects/{OBJECT}/cells")
    for topic in topics:
        for size in (0, 3, 4, 5, 40, 4000):
            cell.monitor.publish(topic, b"\x00\x01\x00\x00"[: min(4, size)] + rng.bytes(max(0, size - 4)))
    trial.wait(2.0)
    trial.note = f"{6 * len(topics)} pieces of garbage"


def _memory(cell: Cell) -> dict[str, float]:
    return {name: psutil.Process(process.pid).memory_info().rss / 1e6 for name, process in cell.processes.items() if process.runs}


def _giants(trial: Trial) -> None:
    """Messages that claim gigabytes."""
    cell = trial.cell
    before = _memory(cell)
    grid = OccupancyGrid()
    grid.header.frame_id = f"object_{OBJECT}"
    grid.info.width = grid.info.height = 2**32 - 1
    grid.info.resolution = 0.01
    grid.info.origin.orientation.w = 1.0
    whole = copy.deepcopy(grid)
    whole.info.width = whole.info.height = 3000
    whole.data = array("b", [100]) * 9_000_000
    since = time.monotonic()
    for msg in (grid, whole):
        cell.monitor.publish(f"objects/{OBJECT}/cells", msg)
    for node in (_IDENTIFICATION, _EXECUTOR):
        trial.expect_refusal(node, "cells", since=since, patience=10.0)
        grown = _memory(cell).get(node, 0.0) - before[node]
        trial.expect(grown < _MEMORY, f"the memory of {node} grew by {grown:.0f} MB")
    trial.note = "grids of 1.8e19 and of 9e6 cells refused"


def _disordered(trial: Trial, rule: Callable[[str], Any]) -> None:
    """Every message of the sensors under a rule, for a whole push."""
    cell = trial.cell
    topics = ("joint_states", "pusher/wrench", _POSE, "pusher/pose", "push_record")
    for topic in topics:
        cell.proxy.set(topic, rule(topic))
    sent = cell.monitor.send(cell.goal())
    result = cell.end(sent)
    trial.wait(0.5)
    trial.expect(not cell.is_moving(), "the arm still moves")
    allowed = (PushCode.NONE, PushCode.ARM_SILENT, PushCode.TRACKING, PushCode.FORCE, PushCode.OBJECT_LOST)
    trial.expect(result.error_code in allowed, f"the push ended with {result.error_code} {result.error_text}")
    trial.note = result.error_text or "the push was made"
    trial.lost = "the push under way" if result.error_code else "nothing"


FAULTS: Final = (
    Fault(
        number=27,
        name="impossible-poses",
        what="12 poses with NaN, zero, negative or infinite values, wrong frames and markup, in the middle of a push",
        holds="the conversion of messages; the guard around every callback",
        expected="refused, counted and named; the push goes on",
        run=_poses,
        cell=ARM_CELL,
        fast=True,
    ),
    Fault(
        number=42,
        name="impossible-messages",
        what="NaN, huge times, empty arrays and markup on every other topic",
        holds="the conversion of messages; the guard around every callback",
        expected="refused, counted and named; no node ends",
        run=_others,
        cell=ARM_CELL,
    ),
    Fault(
        number=43,
        name="impossible-requests",
        what="services with empty, endless and impossible paths, noise, a pickle, JSON 200,000 deep, paths of NaN",
        holds="the guard around every service; no pickle anywhere",
        expected="each answered with a reason; nothing is executed",
        run=_requests,
        cell=ARM_CELL,
        fast=True,
    ),
    Fault(
        number=25,
        name="garbage",
        what="random bytes in place of messages on seven topics",
        holds="the middleware; the guard around every callback",
        expected="no node ends",
        run=_garbage,
        cell=ARM_CELL,
    ),
    Fault(
        number=31,
        name="giant-messages",
        what="cells that claim 1.8e19 entries; 9 million cells",
        holds="limits of what is taken from outside",
        expected="refused by their claim; memory bounded",
        run=_giants,
        cell=ARM_CELL,
    ),
    Fault(
        number=44,
        name="duplicates",
        what="every message of the sensors comes twice, for a whole push",
        holds="stamps are compared",
        expected="the push is made, or aborted and held",
        run=lambda trial: _disordered(trial, lambda topic: duplicated),
        cell=ARM_CELL,
    ),
    Fault(
        number=45,
        name="reordered",
        what="every message of the sensors comes up to 50 ms late, out of order, for a whole push",
        holds="stamps are compared",
        expected="the push is made, or aborted and held",
        run=lambda trial: _disordered(trial, lambda topic: reordered(0.05)),
        cell=ARM_CELL,
    ),
    Fault(
        number=46,
        name="losses",
        what="30 % of the messages of the sensors are lost at random, for a whole push",
        holds="timeouts are longer than a few messages",
        expected="the push is made, or aborted and held",
        run=lambda trial: _disordered(trial, lambda topic: lossy(0.3) if topic != "push_record" else (lambda data, now: [(0.0, data)])),
        cell=ARM_CELL,
    ),
)
