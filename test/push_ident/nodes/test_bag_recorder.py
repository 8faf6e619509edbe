"""A disk that fills up, and a recorder that is killed, cost no more than the last second; a bag is played without waiting for decades."""

from __future__ import annotations

import resource
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from helpers.executor_cell import Stalls, wait_for
from helpers.node_process import NodeProcess, Talker
from helpers.spinning import running
from push_ident.bags.opening import open_bag
from push_ident.bags.salvage import salvage
from push_ident.bags.writer import BagWriter
from push_ident.geometry.frames import CAMERA_FRAME
from push_ident.nodes.base.cell_node import LATCHED
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import position_to_msg
from push_ident.nodes.recording.bag_player_node import BagPlayerNode
from push_ident.nodes.recording.bag_recorder_node import BagRecorderNode

FULL = 10_000_000
"""[MiB] that no disk has free."""
DECADES = 1e9
"""[s]"""


class User(Talker):
    """Publishes the pusher and hears what the recorder says of itself."""

    def __init__(self, domain: int, folder: Path) -> None:
        super().__init__(domain)
        self.domain, self._folder = domain, folder
        self.said: list[DiagnosticStatus] = []
        self.n_sent = 0
        self._pusher = self.node.create_publisher(PoseStamped, "pusher/pose", 1000)
        self.node.create_subscription(DiagnosticStatus, "recording", self.said.append, LATCHED)

    def record(self, *, most_bytes: int | None = None, numbered: bool = False) -> NodeProcess:
        """A recorder that has begun; none of its files becomes larger than `most_bytes`."""

        def limit() -> None:
            if most_bytes is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

        chosen = {"bag": str(self._folder / "bag"), "min_free_mib": 1, "numbered": numbered}
        process = NodeProcess("bag_recorder_node", "push_ident.nodes", chosen, self.domain, self._folder, before=limit)
        self.until(lambda: self.said)
        return process

    @property
    def recorded(self) -> int:
        """Messages of the pusher in the bag, as the recorder reports once a second."""
        return int(self.values().get("/pusher/pose", 0))

    def send(self, n: int) -> None:
        self.until(lambda: self._pusher.get_subscription_count() > 0)
        for _ in range(n):
            self._pusher.publish(position_to_msg(self.node.get_clock().now().to_msg(), [0.0, 0.0, 0.01]))
            self.n_sent += 1
            self.spin(0.001)


@pytest.fixture
def user(tmp_path: Path) -> Iterator[User]:
    with User(own_domain(), tmp_path) as user:
        yield user


@pytest.mark.live
def test_disk_that_runs_low_closes_the_bag_readable_and_is_reported(user: User, tmp_path: Path) -> None:
    with running(BagRecorderNode, user.domain, f"bag:={tmp_path / 'bag'}", "min_free_mib:=1") as recorder:
        user.until(lambda: user.said)
        assert user.said[0].level != DiagnosticStatus.ERROR
        user.send(200)
        user.until(lambda: user.recorded == 200)
        assert recorder.set_parameters([Parameter("min_free_mib", value=FULL)])[0].successful
        user.until(lambda: user.said[-1].level == DiagnosticStatus.ERROR)
        assert "MiB free" in user.said[-1].message
        # Closed at once, not when the process ends.
        user.until((tmp_path / "bag" / "metadata.yaml").exists, timeout=10.0)
        report = salvage(tmp_path / "bag", tmp_path / "copy")
        assert report.total == 200 and report.end == ""


@pytest.mark.live
def test_disk_that_refuses_a_write_is_reported_and_the_rest_stays_readable(user: User, tmp_path: Path) -> None:
    recorder = user.record(most_bytes=30_000)
    try:
        while user.said[-1].level != DiagnosticStatus.ERROR:
            assert user.n_sent < 20_000
            user.send(50)
            time.sleep(0.1)
        assert "cannot be written" in user.said[-1].message
        assert salvage(tmp_path / "bag", tmp_path / "copy").total > 0
    finally:
        recorder.stop()
    assert "Traceback" not in recorder.output


@pytest.mark.alone
def test_kill_loses_no_more_than_a_second_and_the_next_recorder_begins_another_bag(user: User, tmp_path: Path) -> None:
    killed = user.record(numbered=True)
    try:
        for _ in range(5):
            user.send(60)
            time.sleep(0.1)
        sent_before = user.n_sent
        with Stalls() as stalls:
            began = time.monotonic()
            while time.monotonic() - began < 2.0 + 4.0 * stalls.worst:
                user.send(5)
                time.sleep(0.1)
    finally:
        killed.kill()
    assert salvage(tmp_path / "bag", tmp_path / "copy").total >= sent_before
    first = sorted((path, path.read_bytes()) for path in (tmp_path / "bag").rglob("*") if path.is_file())
    with running(BagRecorderNode, own_domain(), f"bag:={tmp_path / 'bag'}", "numbered:=true", "min_free_mib:=1"):
        wait_for((tmp_path / "bag_2").is_dir)
    assert sorted((path, path.read_bytes()) for path in (tmp_path / "bag").rglob("*") if path.is_file()) == first


@pytest.mark.live
@pytest.mark.parametrize("image_first", [True, False])
def test_the_camera_stands_in_the_bag_once_whoever_places_it(user: User, tmp_path: Path, image_first: bool) -> None:
    """The parameters of the recorder give it, and perception broadcasts it."""
    quaternion = "[0.67815377, 0.67815377, -0.20026847, -0.20026847]"
    links = [TransformStamped(header=Header(frame_id="table"), child_frame_id=name) for name in (CAMERA_FRAME, "stand")]
    for link in links:
        link.transform.rotation.w = 1.0
    send = [(Image, "depth/image_rect", Image()), (TFMessage, "/tf_static", TFMessage(transforms=links))]
    with running(BagRecorderNode, user.domain, f"bag:={tmp_path / 'bag'}", "min_free_mib:=1", f"camera_quaternion:={quaternion}"):
        for kind, topic, message in send if image_first else send[::-1]:
            user.publish(kind, topic, message)
            user.until(lambda topic=topic: int(user.values().get(f"/{topic}".replace("//", "/"), 0)) == 1)
    with open_bag(tmp_path / "bag") as bag:
        static = [topic for topic in bag.topics if topic.topic.endswith("tf_static")]
        bag.register(static)
        found = {
            stamped.child_frame_id: stamped.transform.rotation.x for _, _, message in bag.messages(static) for stamped in message.transforms
        }
        n_links = sum(len(message.transforms) for _, _, message in bag.messages(static))
    assert found == {CAMERA_FRAME: pytest.approx(0.678 if image_first else 0.0, abs=1e-3), "stand": 0.0} and n_links == 2


@pytest.mark.live
def test_time_without_messages_that_no_recording_has_is_not_waited_for(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for stamp in (1.0, 1.1, 1.2, DECADES, DECADES + 0.1):
            writer.write_pusher(stamp, [0.0, 0.0])
    ended = threading.Event()
    before = signal.signal(signal.SIGTERM, lambda *_: ended.set())  # so a player ends its process
    try:
        with running(BagPlayerNode, own_domain(), f"bag:={tmp_path / 'bag'}", "wait:=0.0", "listeners:=0"):
            wait_for(ended.is_set, 60.0)
    finally:
        signal.signal(signal.SIGTERM, before)
    said = capfd.readouterr().err
    assert "played 5 messages" in said and "hours; that is skipped" in said
