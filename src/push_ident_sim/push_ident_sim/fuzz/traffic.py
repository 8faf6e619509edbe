"""Valid messages of a cell: pushes of a hammer, depth images of it, and an arm that follows its commands."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PolygonStamped, PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import CameraInfo, Image, JointState
from shape_msgs.msg import SolidPrimitive
from trajectory_msgs.msg import JointTrajectory

from push_ident.geometry.kinematics import ArmKinematics
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.geometry.table import Table
from push_ident.nodes.convert.messages import (
    TABLE_FRAME,
    cylinder_to_msg,
    depth_frame_to_msgs,
    force_to_msg,
    planar_pose_to_msg,
    position_to_msg,
    shape_to_msgs,
    stamp_to_msg,
)
from push_ident.nodes.convert.table import EDGE_TOPIC, TABLE_TOPIC, edge_to_msg, table_to_msg
from push_ident.physics.effects import CAUSES, EFFECTS
from push_ident.physics.overhang import TableEdge
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.pushing.sampling import sample_push
from push_ident.types import CameraIntrinsics, DepthFrame, Float64Array, PusherPath
from push_ident_msgs.msg import PushRecord
from push_ident_sim.cell.robot import HOME, robot_description
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import TruthSettings, path_of_plan, true_model

__all__ = ["OBJECT", "RADIUS", "Arm", "Sent", "depth_messages", "diagnosis_text", "push_messages", "shape_messages", "table_messages"]

OBJECT: Final = "o1"
RADIUS: Final = 0.008
"""Of the pusher [m]."""
_PAUSE: Final = 2.5
"""Between two pushes, with the object at rest [s]."""
_POSE_RATE, _PUSHER_RATE = 30.0, 60.0
_STD: Final = np.array([1e-3, 1e-3, math.radians(0.5)])

Sent = tuple[str, Any]
"""A topic and a message."""


def shape_messages(stamp: float = 1.0) -> list[Sent]:
    """Latched topics: cells and outline of the hammer, shape of the pusher."""
    cells, outline = shape_to_msgs(true_model(make_object("hammer", 0)).shape, OBJECT, stamp_to_msg(stamp))
    return [
        (f"/objects/{OBJECT}/cells", cells),
        (f"/objects/{OBJECT}/outline", outline),
        ("/pusher/shape", cylinder_to_msg(RADIUS, 0.08)),
    ]


def table_messages(stamp: float = 1.0) -> list[Sent]:
    """Latched topics: a table of two metres around all that is pushed, and one of its edges."""
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    edge = TableEdge.between(corners[1], corners[2])
    return [
        (f"/{TABLE_TOPIC}", table_to_msg(Table(corners), stamp_to_msg(stamp))),
        (f"/{EDGE_TOPIC}", edge_to_msg(edge, stamp_to_msg(stamp))),
    ]


def diagnosis_text() -> str:
    """JSON of a diagnosis that names an effect of a size which no push contradicts."""
    cause = CAUSES[0]
    sizes = {parameter.name: parameter.nominal + 0.1 * parameter.typical for parameter in EFFECTS[cause].parameters}
    named = {"name": cause, "parameters": sizes, "std": {name: abs(size) for name, size in sizes.items()}}
    probabilities = {name: 0.95 if name == cause else 0.0 for name in EFFECTS}
    return json.dumps(
        {"verdict": "named", "effects": [named], "probabilities": probabilities, "gap": {"before_per_push_m": [0.005, 0.006]}}
    )


def push_messages(seed: int, start: float) -> list[Sent]:
    """One push in order of stamps, from `start` [s]: poses at rest, the push with its wrench, its record, and poses at rest again."""
    rng, model, settings = np.random.default_rng(seed), true_model(make_object("hammer", 0)), TruthSettings()
    pose = np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(-np.pi, np.pi)])
    path = path_of_plan(sample_push(model.shape, pose, rng, settings.pushes), settings)
    end = float(path.time[-1])
    sampled = np.arange(0.0, end, 1.0 / _PUSHER_RATE)
    pusher = PusherPath(sampled, np.column_stack([np.interp(sampled, path.time, axis) for axis in path.position.T]), RADIUS)
    frames = np.arange(-0.5, end + 1.0, 1.0 / _POSE_RATE)
    reported = frames[(frames >= 0) & (frames <= sampled[-1])]
    motion = simulate(model, PushScenario(pusher, pose, reported)).pose
    begin = start + 0.6
    messages: list[tuple[float, str, Any]] = []
    for frame in frames:
        true = np.array([np.interp(frame, reported, axis) for axis in motion.T])
        msg = planar_pose_to_msg(_stamp(begin + frame), true + _STD * rng.normal(size=3), np.diag(_STD**2))
        messages.append((frame, f"/objects/{OBJECT}/pose", msg))
    for moment, (x, y) in zip(sampled, pusher.position, strict=True):
        messages.append((moment, "/pusher/pose", position_to_msg(_stamp(begin + moment), [x, y, 0.01])))
        messages.append((moment, "/pusher/wrench", force_to_msg(_stamp(begin + moment), rng.normal(size=2))))
    record = PushRecord(push_id=seed % 2**31 + 1, object_id=OBJECT, start=_stamp(begin), end=_stamp(begin + sampled[-1]))
    record.header.frame_id, record.header.stamp, record.stop = TABLE_FRAME, record.end, record.end
    record.distance, record.speed = 0.08, 0.15
    messages.append((sampled[-1] + 0.05, "/push_record", record))
    return [(topic, msg) for _, topic, msg in sorted(messages, key=lambda item: item[0])]


def length_of(messages: list[Sent]) -> float:
    """From the first stamp of a push to where the next may start [s]."""
    stamps = [msg.header.stamp.sec + 1e-9 * msg.header.stamp.nanosec for _, msg in messages]
    return max(stamps) - min(stamps) + _PAUSE


def _stamp(seconds: float) -> Time:
    return stamp_to_msg(float(seconds))


def depth_messages(*, shrink: int = 1, seed: int = 0) -> Iterator[tuple[Image, CameraInfo]]:
    """Depth images of the hammer at rest, with the noise of a camera, at the pose of the simulated camera; the same four again and again.

    `shrink` divides the number of pixels along each edge.
    """
    from push_ident_sim.cell.camera import INTRINSICS, DepthCamera, DepthNoise
    from push_ident_sim.cell.sensors import PLAIN, suitable_pose

    full = INTRINSICS
    camera = CameraIntrinsics(
        full.width // shrink, full.height // shrink, full.fx / shrink, full.fy / shrink, full.cx / shrink, full.cy / shrink
    )
    view, rng, noise = DepthCamera(make_object("hammer", 0), suitable_pose(PLAIN), camera), np.random.default_rng(seed), DepthNoise()
    perfect = view.render((0.02, -0.03, 0.4), {})
    images = [noise.apply(perfect.copy(), rng) for _ in range(4)]
    while True:
        for depth in images:
            yield depth_frame_to_msgs(DepthFrame(0.0, depth, camera), Time())


class Arm:
    """An arm that follows every trajectory exactly from where it stands, and a box that the tool carries along while they overlap."""

    BOX: Final = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
    """Outline of the box [m]."""
    RADIUS: Final = 0.018
    """Of the tool [m]."""

    def __init__(self, parked: tuple[float, ...] = (0.5, *HOME[1:])) -> None:
        self.kinematics = ArmKinematics(robot_description(), neutral=HOME)
        self.parked = np.array(parked)
        self.names: tuple[str, ...] = tuple(self.kinematics.joint_names)
        self.commands: list[tuple[float, Float64Array, JointTrajectory]] = []
        """Time of receipt [s], where the arm was, and the command."""
        self.reset()

    def reset(self) -> None:
        """Arm and box to where they were at first."""
        self.q = self.parked.copy()
        self.box = np.array([0.0, 0.02, 0.3])
        self._moved_from = self.kinematics.forward(self.q)[:3, 3]
        self._motion: tuple[float, Float64Array, Float64Array] | None = None

    def on_command(self, msg: JointTrajectory) -> None:
        """Follow it from now on. What cannot be followed is only recorded."""
        self.step()
        received = time.monotonic()
        self.commands.append((received, self.q.copy(), msg))
        if sorted(msg.joint_names) != sorted(self.names) or not msg.points:
            return
        order = [list(msg.joint_names).index(name) for name in self.names]
        if any(len(point.positions) != len(order) for point in msg.points):
            return
        times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in msg.points])
        positions = np.array([p.positions for p in msg.points])[:, order]
        if times[0] > 0.0:
            times, positions = np.append(0.0, times), np.vstack([self.q, positions])
        self._motion = (received, times, positions)

    def step(self) -> None:
        """Move to where the arm should be now, and the box with it."""
        if self._motion is not None:
            since, times, positions = self._motion
            self.q = np.array([np.interp(time.monotonic() - since, times, axis) for axis in positions.T])
        tip, before = self.kinematics.forward(self.q)[:3, 3], self._moved_from
        self._moved_from = tip
        if tip[2] < 0.05 and signed_distance(tip[None, :2], transform_points(self.box, self.BOX))[0] < self.RADIUS:
            self.box[:2] += tip[:2] - before[:2]

    def states(self, stamp: Time) -> JointState:
        """Joint states."""
        msg = JointState(name=list(self.names), position=self.q.tolist(), velocity=[0.0] * len(self.q))
        msg.header.stamp = stamp
        return msg


KINDS: Final = {
    "/pusher/pose": PoseStamped,
    "/pusher/wrench": WrenchStamped,
    "/pusher/shape": SolidPrimitive,
    "/push_record": PushRecord,
    f"/objects/{OBJECT}/pose": PoseWithCovarianceStamped,
    f"/objects/{OBJECT}/cells": OccupancyGrid,
    f"/objects/{OBJECT}/outline": PolygonStamped,
}
"""Type of each topic of a push."""
