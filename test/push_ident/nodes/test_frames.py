"""Frames on /tf and /tf_static: those of the nodes, beside those of others. Those of perception: `test_perception_node.py`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import Pose, PoseStamped, TransformStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String
from tf2_msgs.msg import TFMessage

from helpers.bags import write_push
from helpers.node_process import wait_for
from helpers.spinning import BareNode, running, spinning
from push_ident.bags.decode import homogeneous_of
from push_ident.bags.writer import BagWriter
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.geometry.se3 import pose_of_quaternion
from push_ident.nodes.base.cell_node import LATCHED
from push_ident.nodes.base.frames import StaticFrames
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import stamp_from_msg, stamp_to_msg, transform_to_msg
from push_ident.nodes.push_executor.push_executor_node import PushExecutorNode
from push_ident.nodes.recording.bag_player_node import BagPlayerNode
from push_ident_sim.cell.robot import HOME, JOINT_NAMES, robot_description

pytestmark = pytest.mark.live

CAMERA_IN_TABLE = pose_of_quaternion([0.5, -0.1, 0.8], [1.0, 0.0, 0.0, 0.0])
OPTICAL_IN_LINK = pose_of_quaternion([0.0, 0.015, 0.0], [-0.5, 0.5, -0.5, 0.5])
STAMP = stamp_to_msg(12.5)


def link(parent: str, child: str, pose: np.ndarray) -> TransformStamped:
    msg, at = TransformStamped(header=Header(frame_id=parent), child_frame_id=child), transform_to_msg(STAMP, pose).pose
    shift, msg.transform.rotation = msg.transform.translation, at.orientation
    shift.x, shift.y, shift.z = at.position.x, at.position.y, at.position.z
    return msg


class Others(Node):
    """Hears all frames, and publishes those of other nodes."""

    def __init__(self, **kwargs: object) -> None:
        super().__init__("others", **kwargs)
        self.static: list[TFMessage] = []
        self.moving: list[TFMessage] = []
        self.tool: list[PoseStamped] = []
        self._static = self.create_publisher(TFMessage, "/tf_static", LATCHED)
        self.create_subscription(TFMessage, "/tf_static", self.static.append, LATCHED)
        self.create_subscription(TFMessage, "/tf", self.moving.append, QoSProfile(depth=100))
        self.create_subscription(PoseStamped, "tool/pose", self.tool.append, 10)

    def state(self, *links: TransformStamped) -> None:
        self._static.publish(TFMessage(transforms=links))


@pytest.fixture
def domain() -> int:
    return own_domain()


@pytest.fixture
def others(domain: int) -> Iterator[Others]:
    with spinning(lambda context: Others(context=context), domain) as node:
        yield node


@pytest.fixture
def frames(domain: int) -> Iterator[StaticFrames]:
    made: list[StaticFrames] = []
    with spinning(lambda context: BareNode(lambda node: made.append(StaticFrames(node)), context=context), domain):
        yield made[0]


def test_camera_without_a_tree_of_its_own_is_placed_in_the_table(others: Others, frames: StaticFrames) -> None:
    for pose in (CAMERA_IN_TABLE, OPTICAL_IN_LINK, CAMERA_IN_TABLE):  # and follows what is found out later
        others.static.clear()
        frames.place(STAMP, "optical", pose)
        wait_for(lambda: others.static)
        (stamped,) = others.static[-1].transforms
        assert (stamped.header.frame_id, stamped.child_frame_id, stamped.header.stamp) == ("table", "optical", STAMP)
        np.testing.assert_allclose(homogeneous_of(stamped.transform), pose, atol=1e-12)
    assert "optical" not in frames, "its own frames are not those of others"


def test_of_a_camera_with_a_driver_the_root_of_its_tree_is_placed(others: Others, frames: StaticFrames) -> None:
    others.state(link("camera_link", "/optical", OPTICAL_IN_LINK))
    wait_for(lambda: "optical" in frames)
    others.static.clear()
    frames.place(STAMP, "optical", CAMERA_IN_TABLE)
    wait_for(lambda: others.static)
    (stamped,) = others.static[-1].transforms
    assert (stamped.header.frame_id, stamped.child_frame_id) == ("table", "camera_link")
    np.testing.assert_allclose(homogeneous_of(stamped.transform) @ OPTICAL_IN_LINK, CAMERA_IN_TABLE, atol=1e-12)


def test_camera_that_others_place_is_left_to_them_also_later(others: Others, frames: StaticFrames) -> None:
    frames.place(STAMP, "optical", CAMERA_IN_TABLE)
    wait_for(lambda: others.static)
    others.static.clear()
    # A robot on a stand, with the camera on it: the table is another branch of that tree.
    others.state(link("world", "table", CAMERA_IN_TABLE), link("world", "optical", OPTICAL_IN_LINK))
    wait_for(lambda: any(not msg.transforms for msg in others.static))
    # Frames in a loop have no root: the node goes on.
    others.state(link("table", "world", CAMERA_IN_TABLE), link("other", "one", CAMERA_IN_TABLE), link("one", "other", CAMERA_IN_TABLE))
    wait_for(lambda: "one" in frames)
    frames.place(STAMP, "one", CAMERA_IN_TABLE)


def test_tool_is_where_the_arm_says_unless_another_node_has_its_link(domain: int, others: Others) -> None:
    others.create_publisher(String, "robot_description", LATCHED).publish(String(data=robot_description()))
    states = others.create_publisher(JointState, "joint_states", 10)

    def say() -> None:
        state = JointState(name=list(JOINT_NAMES), position=list(HOME))
        state.header.stamp = others.get_clock().now().to_msg()
        states.publish(state)
        others.create_rate(50.0).sleep()

    with running(PushExecutorNode, domain, n_threads=5):
        wait_for(lambda: len(others.moving) >= 10 and len(others.tool) >= 10, meanwhile=say)
        told = {(msg.header.stamp.sec, msg.header.stamp.nanosec): msg.pose for msg in others.tool}
        (stamped,) = others.moving[5].transforms
        pose: Pose = told[stamped.header.stamp.sec, stamped.header.stamp.nanosec]
        assert (stamped.header.frame_id, stamped.child_frame_id) == ("table", "tool_tip")
        assert stamped.transform.rotation == pose.orientation
        np.testing.assert_allclose(homogeneous_of(stamped.transform), ArmKinematics(robot_description()).forward(np.array(HOME)), atol=1e-9)
        others.state(link("tool_pusher", "tool_tip", CAMERA_IN_TABLE))
        others.moving.clear()
        others.tool.clear()

        def is_silent() -> bool:
            if others.moving:
                others.moving.clear()
                others.tool.clear()
            return len(others.tool) >= 20

        wait_for(is_silent, meanwhile=say)


def test_replay_moves_the_frame_of_each_recorded_object(domain: int, others: Others, tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 10.0)
    with running(BagPlayerNode, domain, f"bag:={tmp_path / 'bag'}", "wait:=0.0", "listeners:=0", "loop:=true", "rate:=20.0"):
        wait_for(lambda: len(others.moving) >= 60)
    for msg in others.moving:
        (stamped,) = msg.transforms
        assert (stamped.header.frame_id, stamped.child_frame_id) == ("table", "object_o7")
        yaw = stamp_from_msg(stamped.header.stamp)  # as `write_push` turns it
        expected = pose_of_quaternion([0.1, 0.2, 0.0], [0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)])
        np.testing.assert_allclose(homogeneous_of(stamped.transform), expected, atol=1e-6)
