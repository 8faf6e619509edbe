"""Collects finished pushes from the topics of a cell."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from geometry_msgs.msg import PolygonStamped, PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.clock import Clock, ClockType
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import Bool, Float32MultiArray

from push_ident.bags.contract import Role
from push_ident.errors import PushIdentError
from push_ident.geometry.se2 import transform_points
from push_ident.nodes.base.arrivals import Arrivals, StampCheck
from push_ident.nodes.base.cell_node import LATCHED, CellNode
from push_ident.nodes.convert.messages import (
    camera_accuracy_from_msg,
    force_from_msg,
    planar_pose_from_msg,
    planar_pose_of,
    position_from_msg,
    push_interval_from_msg,
    pusher_shape_from_msg,
)
from push_ident.nodes.input.objects import ObjectTopics, ShapeInput
from push_ident.pushing.cutter import UNRECORDED, PushCutter
from push_ident.types import Float64Array, ObjectShape, PusherShape, PushRecord
from push_ident_msgs.msg import PushRecord as PushRecordMsg

# Waiting messages are kept: a publisher that keeps all, such as the bag player, is held back and overwrites nothing.
# The middleware bounds what waits: 5000 messages of a topic in Fast DDS; from then on messages are lost, which is counted.
_ALL: Final = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.BEST_AVAILABLE)
_FROM_FIRST: Final = QoSProfile(
    history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.BEST_AVAILABLE, durability=DurabilityPolicy.BEST_AVAILABLE
)
"""Of poses of a recording, which may be far ahead when its objects are discovered: also those before, where the publisher keeps them."""
_FAILED: Final = "pushes that failed, left out"
_UNRECORDED: Final = "pushes without an end record, left out"


@dataclass(frozen=True, slots=True)
class CollectorTimes:
    """Wall times; within a push the stamps count."""

    silence: float = 2.0
    """Without a message after which a push counts as finished [s]: the source has stopped."""
    hidden: float = 10.0
    """The same while no object has a pose since the push, or its record has not come [s]: the arm may hide it, or be on its way home."""
    clock: float = 3.0
    """Without /clock after which simulated time counts as missing [s]."""
    period: float = 0.1
    """Between two checks for complete pushes [s]."""


COLLECTOR: Final = CollectorTimes()


class PushCollector:
    """Subscribes to objects, pusher, wrench and push records of a cell, and cuts them into pushes.

    Args:
        gap: pause of the pusher that ends a push [s].
        on_object: called with the id of each object as soon as its pose is published.
        on_shape: called with id and shape of an object whenever its shape is published; a `PushIdentError` refuses the shape.
        on_pushes: called with complete pushes, each a list of one record per object; empty without enough observations.
        on_left_out: called when a push is left out, so that nothing is kept of what was learned during it.
        on_frame: called with the id of an object after each new pose while a push is under way.
        source: node that plays all messages and says on its topic `done` when no more come: until then silence ends no push; empty: a cell.

    Attributes:
        counts: numbers of messages, by kind and outcome.
        last_error: reason of the latest refusal of a message.
        radius: radius of the pusher [m]; 0 until it is published.
    """

    def __init__(
        self,
        node: CellNode,
        gap: float,
        *,
        on_object: Callable[[str], None],
        on_shape: Callable[[str, ObjectShape], None],
        on_pushes: Callable[[list[list[PushRecord]]], None],
        on_left_out: Callable[[], None] = lambda: None,
        on_frame: Callable[[str], None] = lambda object_id: None,
        source: str = "",
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.last_error = ""
        self.tool = PusherShape(0.0)
        """Outline of the pusher; of no radius before it is known."""
        self._node = node
        self._on_object, self._on_shape, self._on_pushes, self._on_frame = on_object, on_shape, on_pushes, on_frame
        self._on_left_out = on_left_out
        self._lock = threading.RLock()
        self._cutter = PushCutter(gap)
        self._stamps = StampCheck()
        self._latest: dict[str, tuple[float, Float64Array, Float64Array]] = {}
        self._shapes: dict[str, ObjectShape] = {}
        self._shape_input = ShapeInput()
        self._run = 1
        self._began = self._received = time.monotonic()
        self._flushed = True
        self._arrivals: dict[str, Arrivals] = {}
        self._subscribe(PoseStamped, "pusher/pose", self._on_pusher)
        node.create_subscription(SolidPrimitive, "pusher/shape", self._on_pusher_shape, LATCHED)
        node.create_subscription(PoseWithCovarianceStamped, Role.CAMERA_ACCURACY.value.name, self._on_camera_accuracy, LATCHED)
        self._subscribe(WrenchStamped, "pusher/wrench", self._on_wrench)
        self._subscribe(PushRecordMsg, "push_record", self._on_push_record)
        self._source_is_done = not source
        if source:
            node.create_subscription(Bool, f"{source}/done", self._on_source, LATCHED)
        # On the wall clock: it must run when simulated time stands still.
        node.create_timer(COLLECTOR.period, self._collect, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._topics = ObjectTopics(node, self._on_new_object)

    # ---- state

    @property
    def now(self) -> float:
        """Latest stamp of all streams [s]."""
        return self._cutter.now

    def latest(self, object_id: str) -> tuple[float, Float64Array, Float64Array | None] | None:
        """Stamp [s], latest pose and covariance of an object, which may not be known yet; None before the first."""
        if (latest := self._latest.get(object_id)) is None:
            return None
        with self._lock:
            return (*latest[:2], self._cutter.covariance_of(object_id, latest[2]))

    def lacking_covariance(self, object_id: str) -> str:
        """What is taken for the covariance that poses of the object lack, or what is missing for it; empty where they have one."""
        with self._lock:
            return self._cutter.noise_texts().get(object_id, "")

    def outlines_of_others(self, object_id: str) -> list[Float64Array]:
        """Outlines of all other objects, table frame [m], each of shape (n_vertices, 2)."""
        with self._lock:
            return [
                transform_points(pose, self._shapes[other].outline)
                for other, (_, pose, _) in self._latest.items()
                if other != object_id and other in self._shapes
            ]

    def partial(self, object_id: str) -> PushRecord | None:
        """The part so far of the push under way; None while there is none."""
        with self._lock:
            return self._cutter.partial(object_id)

    def what_is_missing(self) -> str:
        """Why no pushes arrive; empty if they can."""
        if self._clock_is_missing():
            return "use_sim_time is true but nothing comes on /clock; is the simulator or bag player running?"
        if not self._topics.ids:
            return "no objects/<id>/pose is published; is perception (or a bag player) running?"
        if not self._shapes:
            return "poses arrive but no objects/<id>/cells; the publisher must keep them (transient local)"
        for object_id in list(self._latest):
            if (now := self.latest(object_id)) is not None and now[2] is None:
                return f"object {object_id}: {self.lacking_covariance(object_id)}"
        return ""

    def report(self) -> dict[str, Any]:
        """Counts for diagnostics."""
        with self._lock:
            return {
                **self.counts,
                **{f"covariance of {object_id}": text for object_id, text in self._cutter.noise_texts().items()},
                _FAILED: self.counts[_FAILED],
                _UNRECORDED: self.counts[_UNRECORDED],
                "run": self._run,
                "last error": self.last_error or "none",
            }

    def overload(self) -> tuple[str, dict[str, Any]]:
        """What was lost since the last call because messages come faster than they are processed (empty: nothing), and values."""
        lost: list[str] = []
        total, worst = 0, 0.0
        for topic, arrivals in list(self._arrivals.items()):
            missing, taken, delay = arrivals.since_last()
            worst, total = max(worst, delay), total + arrivals.n_lost
            if missing:
                lost.append(f"{missing} of {missing + taken} messages of {topic}")
        text = f"{', '.join(lost)} were lost: they come faster than they are processed" if lost else ""
        return text, {"messages lost": total, "message delay, worst [s]": f"{worst:.3f}"}

    def refuse(self, what: str, source: str, why: str) -> None:
        """Count and log something from a topic or thread `source` that cannot be used; `what` it would have been, in the plural."""
        self.counts[f"{what} refused"] += 1
        self.last_error = f"{source}: {why}"
        self._node.guard.refuse(source, why)

    def pause(self) -> None:
        """Drop a push under way: the next messages come after a gap."""
        with self._lock:
            self._cutter.reset()
        self._on_left_out()

    # ---- messages

    def _subscribe(self, kind: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile = _ALL) -> None:
        self._arrivals[topic] = self._node.arrivals_of(topic)
        self._node.create_subscription(kind, topic, callback, qos, arrivals=self._arrivals[topic])

    @contextmanager
    def _taking(self, what: str, topic: str) -> Iterator[None]:
        try:
            with self._lock:
                yield
        except PushIdentError as error:
            self.refuse(what, topic, str(error))

    def _on_new_object(self, object_id: str) -> None:
        node, prefix = self._node, f"objects/{object_id}"
        self._on_object(object_id)
        for kind, name in ((OccupancyGrid, "cells"), (PolygonStamped, "outline"), (Float32MultiArray, "outline_std")):
            node.create_subscription(kind, f"{prefix}/{name}", partial(self._on_shape_msg, object_id, name), LATCHED)
        self._subscribe(
            PoseWithCovarianceStamped,
            f"{prefix}/pose",
            lambda m: self._on_pose(object_id, m),
            _ALL if self._source_is_done else _FROM_FIRST,
        )
        node.get_logger().info(f"object {object_id} found")

    def _on_shape_msg(self, object_id: str, part: str, msg: Any) -> None:
        with self._taking("shapes", f"objects/{object_id}/{part}"):
            shape = self._shape_input.add(object_id, **{part: msg})
            if shape is None:
                return
            self._on_shape(object_id, shape)
            self._shapes[object_id] = shape
            self._cutter.set_shape(object_id, shape)
            self.counts["shapes"] += 1

    def _on_pose(self, object_id: str, msg: PoseWithCovarianceStamped) -> None:
        topic = f"objects/{object_id}/pose"
        with self._taking("poses", topic):
            stamp, pose, covariance = planar_pose_from_msg(msg)
            self._stamps.check(topic, stamp)
            if not self._arrived("poses", self._cutter.add_pose(object_id, stamp, pose, covariance)):
                return
            self._latest[object_id] = (stamp, pose, covariance)
            if not (self._cutter.is_under_way and object_id in self._shapes):
                return
        self._on_frame(object_id)

    def _on_pusher(self, msg: PoseStamped) -> None:
        with self._taking("pusher samples", "pusher/pose"):
            stamp, position = position_from_msg(msg)
            self._stamps.check("pusher/pose", stamp)
            if not self._cutter.expects_records:
                self._cutter.expects_records = self._node.count_publishers("push_record") > 0
            # A cylinder may be held at any tilt of its flange; what else turns needs a heading.
            pose = position[:2] if self.tool.is_cylinder else planar_pose_of(msg.pose)
            self._arrived("pusher samples", self._cutter.add_pusher(stamp, pose))

    def _on_pusher_shape(self, msg: SolidPrimitive) -> None:
        with self._taking("pusher shapes", "pusher/shape"):
            self.tool = pusher_shape_from_msg(msg)
            self._cutter.set_pusher_shape(self.tool)

    def _on_camera_accuracy(self, msg: PoseWithCovarianceStamped) -> None:
        with self._taking("camera accuracies", Role.CAMERA_ACCURACY.value.name):
            self._cutter.set_camera(camera_accuracy_from_msg(msg))

    def _on_wrench(self, msg: WrenchStamped) -> None:
        with self._taking("wrenches", "pusher/wrench"):
            stamp, force = force_from_msg(msg)
            self._stamps.check("pusher/wrench", stamp)
            self._arrived("wrenches", self._cutter.add_wrench(stamp, force))

    def _on_push_record(self, msg: PushRecordMsg) -> None:
        with self._taking("push records", "push_record"):
            interval = push_interval_from_msg(msg)
            self._stamps.check("push_record", interval.end)
            self._cutter.add_record(interval)
            self._cutter.expects_records = True
            self.counts["push records"] += 1

    def _on_source(self, msg: Bool) -> None:
        with self._lock:
            self._source_is_done = bool(msg.data)
            self._received = time.monotonic()

    def _arrived(self, what: str, taken: bool) -> bool:
        """Count a message; return whether it was used."""
        self.counts[what if taken else f"{what} with old stamps"] += 1
        if self._cutter.run > self._run:
            self._run = self._cutter.run
            self._node.get_logger().warning(
                f"time went back to {self._cutter.now:.2f} s ({what}): run {self._run}; buffered data dropped, models kept"
            )
            self.counts["time jumps"] += 1
        self._received = time.monotonic()
        self._flushed = False
        return taken

    @property
    def n_ended(self) -> int:
        """Pushes that have ended and are not handed on yet."""
        with self._lock:
            return self._cutter.n_ended

    @property
    def is_at_rest(self) -> bool:
        """Whether nothing has come for so long that all buffered pushes were handed on."""
        return self._flushed

    def _collect(self) -> None:
        with self._lock:
            if not (self._source_is_done or self._latest):
                return  # a recording may be far ahead of the first object that is discovered
            patience = COLLECTOR.hidden if self._cutter.is_awaiting else COLLECTOR.silence
            silent = self._source_is_done and not self._flushed and time.monotonic() - self._received > patience
            pushes = self._cutter.finished(flush=silent)
            self._flushed = self._flushed or silent
        for push in pushes:
            if push.unrecorded:
                self.counts[_UNRECORDED] += 1
                self.refuse("pushes", "push_record", UNRECORDED)
            self.counts[_FAILED] += push.interval.error_code != 0
        good = [push.records for push in pushes if push.interval.error_code == 0 and not push.unrecorded]
        if len(good) < len(pushes):
            self._on_left_out()
        if good:
            self._on_pushes(good)

    def _clock_is_missing(self) -> bool:
        simulated = self._node.get_parameter("use_sim_time").value
        patient = time.monotonic() - self._began < COLLECTOR.clock
        return bool(simulated and not patient and self._node.get_clock().now().nanoseconds == 0)
