"""Node `bag_recorder`: writes the topics of the bag contract to an MCAP file that stays readable after a kill."""

from __future__ import annotations

import shutil
from collections import Counter
from itertools import count
from pathlib import Path
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from tf2_msgs.msg import TFMessage

from push_ident.bags.contract import Role, role_of
from push_ident.bags.writer import BagWriter
from push_ident.errors import BagError
from push_ident.geometry.frames import CAMERA_FRAME
from push_ident.geometry.se3 import pose_of_quaternion
from push_ident.nodes.base.arrivals import Arrivals
from push_ident.nodes.base.cell_node import LATCHED, CellNode, Component, Health
from push_ident.nodes.base.parameters import Parameter
from push_ident.nodes.convert.messages import message_class
from push_ident.nodes.recording.recording_port import RECORDING, RECORDING_TOPIC, REPEATED

PARAMETERS: Final = (
    Parameter("bag", "", "Bag to write: a new folder", read_only=True),
    Parameter("numbered", False, "Where `bag` exists, record to the first of bag_2, bag_3, ... that does not", read_only=True),
    Parameter("min_free_mib", 200, "free disk below which nothing is recorded, and a bag under way is closed [MiB]", 1, 10_000_000),
    Parameter("depth", True, "Record depth images too (some 18 MB/s before compression)", read_only=True),
    Parameter("camera_position", [0.0] * 3, "Optical frame in the table frame, written to the bag, x y z [m]", -10.0, 10.0, read_only=True),
    Parameter("camera_quaternion", [0.0] * 4, "Its orientation, x y z w; zeros: not known, not written", -1.0, 1.0, read_only=True),
)


class BagRecorderNode(CellNode):
    """Subscribes to every topic of the contract that appears and writes its messages unchanged.

    It publishes its status on the latched topic `recording`, twice a second: an executor that received it stops pushing when it falls
    silent. When it cannot write any more, it closes the bag at once, which stays readable, and reports it. A node that is deactivated keeps
    its bag open; cleaned up, it closes the bag, and configured again it begins the next one: `bag`, `bag_2`, `bag_3`. So does a node that
    is started again after its death, if it is `numbered`.
    """

    def __init__(self, **kwargs: Any) -> None:
        self._n_bags = 0
        super().__init__("bag_recorder_node", PARAMETERS, **kwargs)

    def make_component(self) -> Component:
        """A bag that is new."""
        if not self.settings["bag"]:
            raise BagError("The parameter `bag` is empty; give the bag to write, as -p bag:=PATH.")
        recorder = _BagRecorder(self, self._next_bag(Path(self.settings["bag"])))
        self._n_bags += 1
        return recorder

    def _next_bag(self, path: Path) -> Path:
        """The bag itself at first, whether it exists or not, unless it is numbered; else the first number that is free."""
        if not self._n_bags and not (self.settings["numbered"] and path.exists()):
            return path
        return next(bag for k in count(2) if not (bag := path.with_name(f"{path.name}_{k}")).exists())


class _BagRecorder(Component):
    def __init__(self, node: CellNode, path: Path) -> None:
        self._node, self._settings = node, node.settings
        quaternion = self._settings["camera_quaternion"]
        self._extrinsics = pose_of_quaternion(self._settings["camera_position"], quaternion) if np.any(quaternion) else None
        self._has_camera = False
        """Whether the bag has the camera from the parameters."""
        existing = next(p for p in [path.absolute(), *path.absolute().parents] if p.exists())
        self._disk = existing if existing.is_dir() else existing.parent
        self._check_disk()
        self._writer = BagWriter(path)
        self._writer.__enter__()
        self._counts: Counter[str] = Counter()
        self._arrivals: dict[str, Arrivals] = {}
        self._failed = ""
        self._recording = node.create_publisher(DiagnosticStatus, RECORDING_TOPIC, LATCHED)
        node.create_timer(RECORDING.status_period, self._check_and_report, clock=Clock(clock_type=ClockType.STEADY_TIME))
        node.get_logger().info(f"recording to {path}")

    def resume(self) -> None:
        self._discover()
        self._recording.publish(self._status())

    def pause(self) -> None:
        if not self._failed:
            self._recording.publish(DiagnosticStatus(level=DiagnosticStatus.STALE, message="not active"))

    def close(self) -> None:
        if not self._failed:
            self._writer.__exit__(None, None, None)
        self._node.get_logger().info(f"{self._counts.total()} messages in {self._writer.path}")

    def _check_and_report(self) -> None:
        if self._failed:
            return
        try:
            self._check_disk()
        except Exception as error:
            self._fail(self._node.guard.explain(error))
        else:
            self._discover()
            self._recording.publish(self._status())

    def _check_disk(self) -> None:
        free, least = shutil.disk_usage(self._disk).free >> 20, self._settings["min_free_mib"]
        if free < least:
            raise BagError(f"{self._disk} has {free} MiB free, expected at least {least}; free some space first.")

    def _fail(self, why: str) -> None:
        """Publish the failure and close the bag, which stays readable."""
        self._failed = why
        self._recording.publish(self._status())
        self._node.get_logger().error(self._failed)
        try:
            self._writer.__exit__(None, None, None)
        except Exception as failure:
            self._node.get_logger().error(f"the bag has no index, but its chunks can be read: {failure}")
        self._node.report()

    def _discover(self) -> None:
        for topic, types in self._node.get_topic_names_and_types():
            entry = role_of(topic)
            if entry is None or topic in self._counts or entry.role.msgtype not in types or self._node.count_publishers(topic) == 0:
                continue
            if entry.role is Role.DEPTH and not self._settings["depth"]:
                continue
            if (message := message_class(entry.role.msgtype)) is None:
                continue
            latched = any(
                info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for info in self._node.get_publishers_info_by_topic(topic)
            )
            qos = QoSProfile(
                depth=RECORDING.n_images if entry.role is Role.DEPTH else RECORDING.n_messages,
                reliability=ReliabilityPolicy.BEST_AVAILABLE,
                durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
            )
            self._counts[topic] = 0
            if entry.role is Role.PUSH_RECORD:  # without a record of it, a push that was broken off must not count as one
                self._writer.declare(topic, entry.role.msgtype)
            self._arrivals[topic] = self._node.arrivals_of(topic)
            self._node.create_subscription(
                message,
                topic,
                lambda data, t=topic, m=entry.role.msgtype: self._write(t, m, data),
                qos,
                raw=True,
                arrivals=self._arrivals[topic],
            )

    def _write(self, topic: str, msgtype: str, data: bytes) -> None:
        if self._failed:
            return
        try:
            now = self._node.get_clock().now().nanoseconds
            if self._extrinsics is not None and topic.endswith(Role.DEPTH.value.name):
                self._writer.write_extrinsics(1e-9 * now, self._extrinsics)
                self._extrinsics, self._has_camera = None, True
            if topic.endswith(Role.TF_STATIC.value.name):
                data = self._without_second_camera(data)
            if data:
                self._writer.write_raw(topic, msgtype, now, data)
            self._counts[topic] += 1
        except Exception as error:
            self._fail(self._node.guard.explain(error))

    def _without_second_camera(self, data: bytes) -> bytes:
        """A message of /tf_static without the frame of the camera, if the bag has that from the parameters; empty if no other is left.

        Where it comes before the first image, the parameters are not needed.
        """
        msg = deserialize_message(data, TFMessage)
        others = [stamped for stamped in msg.transforms if stamped.child_frame_id.strip("/") != CAMERA_FRAME]
        if len(others) == len(msg.transforms):
            return data
        if not self._has_camera:
            self._extrinsics = None
            return data
        msg.transforms = others
        return serialize_message(msg) if others else b""

    def health(self) -> Health:
        level = DiagnosticStatus.ERROR if self._failed else DiagnosticStatus.OK if self._counts else DiagnosticStatus.WARN
        text = self._failed or (f"{self._counts.total()} messages" if self._counts else "no topic of the bag contract is published")
        values: dict[str, object] = dict(sorted(self._counts.items()))
        lost = {topic: arrivals.n_lost for topic, arrivals in self._arrivals.items() if arrivals.n_lost}
        if lost:
            # The bag has gaps from now on, so this stays.
            level = max(level, DiagnosticStatus.WARN)
            text += f"; {sum(lost.values())} were lost: the disk is slower than the topics"
        return Health(level, text, values | {f"{topic} lost": number for topic, number in sorted(lost.items())})

    def _status(self) -> DiagnosticStatus:
        health, name = self.health(), self._node.get_fully_qualified_name()
        values = [KeyValue(key=key, value=str(value)) for key, value in health.values.items()]
        if not self._failed:
            values.append(KeyValue(key=REPEATED, value=str(RECORDING.status_period)))
        return DiagnosticStatus(level=health.level, name=name, message=health.message, hardware_id="push_ident", values=values)
