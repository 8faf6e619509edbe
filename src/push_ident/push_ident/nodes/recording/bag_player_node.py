"""Node `bag_player`: plays a bag on live topics, with `/clock`, and ends with it."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from builtin_interfaces.msg import Time as TimeMsg
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock as ClockMsg
from std_msgs.msg import Bool

from push_ident.bags.contract import Role, topic_of
from push_ident.bags.raw import RawMessage, bag_topics, options_for, raw_messages
from push_ident.bags.read_options import ReadOptions, message_types, parse_maps
from push_ident.errors import BagError
from push_ident.geometry.frames import object_frame
from push_ident.nodes.base.cell_node import LATCHED, CellNode, Component, Health
from push_ident.nodes.base.frames import PUBLISH_TF, MovingFrames
from push_ident.nodes.base.parameters import Parameter
from push_ident.nodes.convert.messages import message_class, planar_pose_from_msg
from push_ident.nodes.recording.recording_port import RECORDING

# A subscriber that also keeps all holds the player back until it has room: nothing is lost, however fast the bag is played.
_RELIABLE: Final = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
_LATCHED_ROLES: Final = frozenset({Role.CELLS, Role.OUTLINE, Role.OUTLINE_STD, Role.PUSHER_SHAPE, Role.TF_STATIC, Role.CAMERA_ACCURACY})
_OBSERVED: Final = frozenset({Role.POSE, Role.DEPTH})
_PUSHES: Final = frozenset({Role.PUSHER, Role.WRENCH, Role.PUSH_RECORD})

PARAMETERS: Final = (
    Parameter("bag", "", "Bag to play: a folder or an .mcap or .db3 file", read_only=True),
    Parameter("rate", 1.0, "Speed relative to real time; 0: as fast as possible [-]", 0.0, 1000.0, read_only=True),
    Parameter("loop", False, "Start again at the end", read_only=True),
    Parameter("wait", 5.0, "Longest wait for `listeners` before playing [s]", 0.0, 600.0, read_only=True),
    Parameter(
        "follower",
        "",
        "Node that processes depth images, as perception_node with `every_image`: at most two are ahead of it; empty: none is waited for",
        read_only=True,
    ),
    Parameter("maps", [""], "TOPIC=ROLE for topics of other names, as `push-ident replay --map` takes it", read_only=True),
    Parameter("depth_unit", 0.0, "Metres per unit of a depth image; 0: by its encoding [m]", 0.0, 999.0, read_only=True),
    Parameter("listeners", 1, "Subscriptions to the poses of an object, or to depth, to wait for", 0, 100, read_only=True),
    PUBLISH_TF,
)


class BagPlayerNode(CellNode):
    """Publishes the recorded messages of the contract byte for byte under their contract names; depth images in another form in metres.

    It plays while it is active; activated again, it starts at the beginning.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("bag_player_node", PARAMETERS, **kwargs)

    def make_component(self) -> Component:
        """A publisher for each topic of the bag."""
        return _BagPlayer(self)


class _BagPlayer(Component):
    def __init__(self, node: CellNode) -> None:
        self._node, self._settings = node, node.settings
        if not self._settings["bag"]:
            raise BagError("The parameter `bag` is empty; give the bag to play, as -p bag:=PATH.")
        self._path = Path(self._settings["bag"])
        self._publishing: dict[str, Publisher] = {}
        maps = parse_maps([text for text in self._settings["maps"] if text], "Parameter maps")
        self._options = options_for(self._path, ReadOptions(maps, self._settings["depth_unit"] or None))
        skipped = []
        for topic, msgtype in bag_topics(self._path).items():
            entry = self._options.role_of(topic)
            is_depth = entry is not None and entry.role is Role.DEPTH and msgtype in message_types(Role.DEPTH)
            message = message_class(Role.DEPTH.msgtype if is_depth else msgtype)
            if entry is None or message is None:
                skipped.append(f"{topic} ({msgtype})")
                continue
            lossy = entry.role is Role.DEPTH and not self._settings["follower"]
            qos = LATCHED if entry.role in _LATCHED_ROLES else qos_profile_sensor_data if lossy else _RELIABLE
            # ROS refuses topic names with a part that begins with a digit.
            live_id = f"o{entry.object_id}" if entry.object_id[:1].isdigit() else entry.object_id
            name = "/tf_static" if entry.role is Role.TF_STATIC else topic_of(entry.role, live_id)
            self._publishing[topic] = self._node.create_publisher(message, name, qos)
        if not self._publishing:
            raise BagError(f"{self._path}: none of its topics is of the bag contract ({', '.join(skipped)}); record or import it again.")
        if skipped:
            self._node.get_logger().info(f"not played: {', '.join(skipped)}")
        self._frames = MovingFrames(node) if self._settings["publish_tf"] and self._publishers_of(frozenset({Role.POSE})) else None
        self._clock_publisher = self._node.create_publisher(ClockMsg, "/clock", 10)
        self._pace = _Pace(node, self._settings["follower"]) if self._settings["follower"] else None
        self._done = self._node.create_publisher(Bool, "~/done", LATCHED)
        self._done.publish(Bool(data=False))
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._n_played = 0
        self._is_done = False

    def resume(self) -> None:
        self._stop = threading.Event()
        self._is_done = False
        self._thread = threading.Thread(target=self._play, args=(self._stop,), name="play", daemon=True)
        self._thread.start()

    def pause(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=1.0)

    def health(self) -> Health:
        text = "played to the end" if self._is_done else f"playing {self._path}"
        return Health(DiagnosticStatus.OK, text, {"messages played": self._n_played})

    def _play(self, stop: threading.Event) -> None:
        with self._node.guard.watch("play"):
            self._await_listeners()
            while not stop.is_set():
                count = self._play_once(stop)
                self._node.get_logger().info(f"played {count} messages of {self._path}")
                if not self._settings["loop"]:
                    break
            if self._pace is not None and not stop.is_set():
                self._pace.wait_until(stop, 0)
        if stop.is_set():
            return
        self._is_done = True
        with self._node.guard.watch("play"):
            self._done.publish(Bool(data=True))
            self._await_delivery(stop)
        if not stop.is_set():
            signal.raise_signal(signal.SIGTERM)

    def _await_delivery(self, stop: threading.Event) -> None:
        """The last messages must reach their subscribers before the publisher is destroyed."""
        deadline = time.monotonic() + RECORDING.delivery_timeout
        for publisher in (*self._publishing.values(), self._done):
            while not publisher.wait_for_all_acked(Duration(seconds=0.1)) and not stop.is_set() and time.monotonic() < deadline:
                pass

    def _await_listeners(self) -> None:
        expected, patience = self._settings["listeners"], self._settings["wait"]
        deadline = time.monotonic() + patience
        observed, pushes = self._publishers_of(_OBSERVED), self._publishers_of(_PUSHES)

        def missing_listeners() -> str:
            n = max((p.get_subscription_count() for p in observed), default=expected)
            if n < expected:
                return f"{n} of {expected} listen to poses or depth"
            # A subscriber of poses needs these from the start: a push without its beginning is another push.
            deaf = [p.topic_name for p in pushes if expected and p.get_subscription_count() == 0]
            return f"nobody listens to {', '.join(deaf)}" if deaf else ""

        while (why := missing_listeners()) and time.monotonic() < deadline:
            if self._stop.wait(0.05):
                return
        if why:
            self._node.get_logger().warning(f"{why} after {patience:.0f} s; playing all the same")

    def _publishers_of(self, roles: frozenset[Role]) -> list[Publisher]:
        return [p for topic, p in self._publishing.items() if (entry := self._options.role_of(topic)) and entry.role in roles]

    def _play_once(self, stop: threading.Event) -> int:
        rate = self._settings["rate"]
        started, first, clocked, count = time.monotonic(), None, -(10**18), 0
        latest = 0
        for message in raw_messages(self._path, self._options):
            if stop.is_set():
                break
            if first is None:
                first = latest = message.stamp_ns
            if (pause := message.stamp_ns - latest) > RECORDING.longest_pause_ns:
                self._node.get_logger().warning(f"{self._path} has no message for {pause / 3.6e12:.3g} hours; that is skipped")
                first += pause
            latest = message.stamp_ns
            if rate > 0:
                ahead = (message.stamp_ns - first) * 1e-9 / rate - (time.monotonic() - started)
                if ahead > 0 and stop.wait(ahead):
                    break
            elif count % 100 == 99:
                # Full speed still gives the listeners a chance: their queues are long, not endless.
                stop.wait(0.005)
            if message.stamp_ns - clocked >= RECORDING.clock_period_ns:
                clocked = message.stamp_ns
                self._publish_clock(clocked)
            count += self._publish(message, stop)
            self._n_played += 1
            if self._pace is not None and self._is_image(message):
                self._pace.wait(stop, self._publishing[message.topic].get_subscription_count)
        return count

    def _is_image(self, message: RawMessage) -> bool:
        entry = self._options.role_of(message.topic)
        return entry is not None and entry.role is Role.DEPTH and message.topic in self._publishing

    def _publish_clock(self, stamp_ns: int) -> None:
        msg = ClockMsg()
        msg.clock.sec, msg.clock.nanosec = divmod(stamp_ns, 10**9)
        self._clock_publisher.publish(msg)

    def _publish(self, message: RawMessage, stop: threading.Event) -> int:
        publisher = self._publishing.get(message.topic)
        if publisher is None:
            return 0
        while not stop.is_set():
            try:
                publisher.publish(message.data)
                self._broadcast(message, publisher.topic_name)
                return 1
            except rclpy_implementation.RCLError:
                # No room within the 0.1 s timeout of DDS: a subscriber is busy.
                if not self._node.context.ok():
                    break
        return 0

    def _broadcast(self, message: RawMessage, live_name: str) -> None:
        """The frame of an object, where it has a pose."""
        entry = self._options.role_of(message.topic)
        if self._frames is None or entry is None or entry.role is not Role.POSE:
            return
        with self._node.guard.watch(message.topic):
            msg = deserialize_message(message.data, PoseWithCovarianceStamped)
            planar_pose_from_msg(msg)
            self._frames.broadcast(msg.header.stamp, {object_frame(live_name.split("/")[-2]): msg.pose.pose})


class _Pace:
    """Keeps few depth images ahead of the node that processes them, so that none is lost and the other topics stay in step with them.

    Args:
        follower: name of the node that processes images and publishes `done_until` after each.
    """

    def __init__(self, node: CellNode, follower: str) -> None:
        self._node = node
        self._wake = threading.Condition()
        self._n_sent = self._n_done = 0
        self._heard = time.monotonic()
        node.create_subscription(TimeMsg, f"{follower}/done_until", self._on_done, _RELIABLE)

    def _on_done(self, msg: TimeMsg) -> None:
        with self._wake:
            self._n_done += 1
            self._heard = time.monotonic()
            self._wake.notify_all()

    def wait(self, stop: threading.Event, n_listeners: Callable[[], int]) -> None:
        """After an image: wait until at most `n_ahead` images are not done; one without a subscription is not waited for."""
        if n_listeners() == 0:
            return
        self._n_sent += 1
        self._heard = time.monotonic()
        self.wait_until(stop, RECORDING.n_ahead)

    def wait_until(self, stop: threading.Event, ahead: int) -> None:
        """Wait until at most so many images are not done."""
        with self._wake:
            while self._n_sent - self._n_done > ahead and not stop.is_set():
                self._wake.wait(0.1)
                if time.monotonic() - self._heard > RECORDING.image_timeout:
                    self._node.get_logger().warning(
                        f"{self._n_sent - self._n_done} images are not done after {RECORDING.image_timeout:.0f} s; playing on"
                    )
                    self._n_done = self._n_sent
