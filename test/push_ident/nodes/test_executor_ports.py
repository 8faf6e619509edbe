"""The inputs of push_executor_node, in the process of the test: arm, force, recorder, hand, and the lease of the arm."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from helpers.executor_cell import wait_for
from helpers.memory_cell import SHAPE
from helpers.spinning import BareNode, spinning
from push_ident.errors import InputError, PlanningError
from push_ident.geometry.se2 import transform_points
from push_ident.nodes.base.cell_node import LATCHED
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import force_to_msg, planar_pose_to_msg, shape_to_msgs, stamp_to_msg
from push_ident.nodes.input.objects import TrackedObjects
from push_ident.nodes.push_executor.arm_port import ArmLease, ArmPort, ForcePort
from push_ident.nodes.push_executor.hand_port import RobotiqHand
from push_ident.nodes.push_executor.push_executor_node import PushExecutorNode
from push_ident.nodes.recording import recording_port
from push_ident.nodes.recording.recording_port import RECORDING, REPEATED, RecordingPort
from push_ident_sim.cell.robot import HOME, JOINT_NAMES, robot_description
from push_ident_sim.cell.sim_hand_node import SimHandNode

pytestmark = pytest.mark.live


@pytest.fixture
def listener() -> Iterator[BareNode]:
    """A node that has the ports."""
    with spinning(lambda context: BareNode(context=context), own_domain()) as node:
        yield node


@pytest.fixture
def driver(listener: BareNode) -> Node:
    """What is on the other side of the topics."""
    return Node("driver", context=listener.context)


class Arm:
    """Joint states and descriptions of an arm at home, and the port that hears them."""

    def __init__(self, port: ArmPort, driver: Node) -> None:
        self.port, self._driver = port, driver
        self._states = driver.create_publisher(JointState, "joint_states", qos_profile_sensor_data)
        self._descriptions = driver.create_publisher(String, "robot_description", LATCHED)

    def describe(self, change: tuple[str, str] = ("", "")) -> None:
        self._descriptions.publish(String(data=robot_description().replace(*change)))

    def until(self, condition: Callable[[], object]) -> None:
        """Say where it is until something is so."""

        def say() -> object:
            state = JointState(name=list(JOINT_NAMES), position=list(HOME))
            state.header.stamp = self._driver.get_clock().now().to_msg()
            self._states.publish(state)
            return condition()

        wait_for(say)


@pytest.fixture
def arm(listener: BareNode, driver: Node) -> Arm:
    group = listener.default_callback_group
    port = ArmPort(listener, description_file="", tip_frame="tool_tip", neutral=list(HOME), callback_group=group, on_state=lambda *_: None)
    return Arm(port, driver)


def test_arm_without_any_state_yet_is_waited_for_and_so_is_its_description(arm: Arm) -> None:
    """The topics of a cell that has just started come in any order."""
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(arm.port.next_state, 0.5)
        time.sleep(1.6)  # longer than an arm that was heard before may be silent
        later = time.monotonic() + 0.3
        arm.until(lambda: time.monotonic() > later)
        assert not asked.done()
        arm.describe()
        arm.until(asked.done)
        assert asked.result().q == pytest.approx(HOME)


def test_description_is_used_once_the_arm_stands_unless_its_joints_are_others(arm: Arm) -> None:
    arm.describe()
    arm.until(lambda: arm.port.state)
    first, at_80_mm = arm.port.planner, '<child link="tool_tip" /><origin xyz="0 0 0.08" />'
    with arm.port.in_use():
        arm.describe((at_80_mm, at_80_mm.replace("0.08", "0.09")))
        n_received = arm.port.n_received
        arm.until(lambda: arm.port.n_received > n_received + 20)
        assert arm.port.planner is first
    arm.until(lambda: arm.port.planner is not first)
    second = arm.port.planner
    heights = [planner.forward(np.array(HOME))[2, 3] for planner in (first, second)]
    assert heights[0] - heights[1] == pytest.approx(0.01, abs=1e-4)
    arm.describe((f'"{JOINT_NAMES[2]}"', '"renamed"'))
    arm.until(lambda: "its joints renamed" in arm.port.description_fault)
    assert arm.port.planner is second


def test_force_that_cannot_be_trusted_is_infinite_and_a_stamp_that_repeats_is_silence(listener: BareNode, driver: Node) -> None:
    port = ForcePort(listener, listener.default_callback_group)
    publisher = driver.create_publisher(WrenchStamped, "pusher/wrench", qos_profile_sensor_data)
    wait_for(publisher.get_subscription_count)
    stamps = iter(range(1, 100))

    def publish(force: float, stamp: int | None = None) -> None:
        publisher.publish(force_to_msg(Time(sec=stamp or next(stamps)), [force, 0.0]))

    assert port.silence == math.inf and port.is_there
    publish(12.0)
    wait_for(lambda: port.silence < math.inf)
    assert port.take_peak() == 12.0 and port.take_peak() == 0.0 and port.fault == ""
    for wrong in (1e6, math.nan):
        publish(wrong)
        wait_for(lambda: port.fault)
        assert port.take_peak() == math.inf
        publish(1.0)
        wait_for(lambda: not port.fault)
        port.take_peak()
    publish(1.0, stamp=50)
    wait_for(port.take_peak)
    n_refused = listener.guard.refused
    silence = port.silence
    publish(40.0, stamp=50)
    wait_for(lambda: listener.guard.refused > n_refused)
    assert port.take_peak() == 0.0 and port.silence > silence, "a driver that repeats itself has lost its sensor"


def test_recorder_that_promised_its_next_status_and_falls_silent_is_a_fault_until_it_writes_again(
    listener: BareNode, driver: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(recording_port, "time", SimpleNamespace(monotonic=lambda: now[0]))
    port = RecordingPort(listener, listener.default_callback_group)
    publisher = driver.create_publisher(DiagnosticStatus, "recording", LATCHED)
    promise = [KeyValue(key=REPEATED, value=str(RECORDING.status_period))]
    assert port.fault == "", "nobody asked for a recording"
    publisher.publish(DiagnosticStatus(level=DiagnosticStatus.ERROR, message="disk full", values=promise))
    wait_for(lambda: port.fault == "disk full")
    publisher.publish(DiagnosticStatus(level=DiagnosticStatus.OK, values=promise))
    wait_for(lambda: port.fault == "")
    now[0] += 3.9 * RECORDING.status_period
    assert port.fault == ""
    now[0] += 0.2 * RECORDING.status_period
    assert "fell silent" in port.fault
    publisher.publish(DiagnosticStatus(level=DiagnosticStatus.OK))
    wait_for(lambda: port.fault == "")
    now[0] += 100.0
    assert port.fault == "", "a recorder of another kind promises nothing"
    publisher.publish(DiagnosticStatus(level=DiagnosticStatus.ERROR, message="disk full"))
    wait_for(lambda: port.fault == "disk full")
    driver.destroy_publisher(publisher)
    now[0] += 100.0
    wait_for(lambda: port.fault == "")  # a recorder that has left is not asked for any more


def test_simulated_hand_is_activated_and_closed_to_a_fist(listener: BareNode) -> None:
    times = [f"{name}:=0.3" for name in ("activation_time", "closing_time")]
    arguments = ["--ros-args", "-p", "closed:=false", *(item for time in times for item in ("-p", time))]
    hand = SimHandNode(context=listener.context, cli_args=arguments)
    listener.executor.add_node(hand)
    port = RobotiqHand(listener, "simulated", timeout=2.0, callback_group=listener.default_callback_group)
    wait_for(lambda: "not activated" in port.why_no_fist())
    assert port.close_fist(5.0, lambda: False) == ""
    with pytest.raises(InputError, match="robotiq_3f_gripper_ros2_interfaces"):
        RobotiqHand(listener, "robotiq_3f", timeout=2.0, callback_group=listener.default_callback_group)


HOLD = """
from push_ident.nodes.push_executor.arm_port import ArmLease
lease = ArmLease(7, "/arm")
print("held", flush=True)
input()
"""


def test_one_executor_has_the_arm_and_a_killed_one_leaves_it_free(context: Context) -> None:
    node = PushExecutorNode(context=context)
    with pytest.raises(InputError, match=f"process {os.getpid()}"):
        PushExecutorNode(context=context)
    node.close()
    again = PushExecutorNode(context=context)
    again.close()
    holder = subprocess.Popen([sys.executable, "-c", HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        with pytest.raises(InputError, match=f"process {holder.pid}"):
            ArmLease(7, "/arm")
        ArmLease(7, "/left/arm").release()  # another arm
    finally:
        holder.kill()
        holder.communicate()
    ArmLease(7, "/arm").release()


def test_states_without_numbers_say_that_the_driver_has_no_arm_yet(arm: Arm, driver: Node, listener: BareNode) -> None:
    arm.describe()
    states = driver.create_publisher(JointState, "joint_states", qos_profile_sensor_data)

    def is_named() -> bool:
        states.publish(JointState(name=list(JOINT_NAMES), position=[math.nan] * len(JOINT_NAMES)))
        return "are not numbers (NaN)" in arm.port.why_silent

    wait_for(is_named)
    assert arm.port.n_dropped and listener.guard.refused
    with pytest.raises(PlanningError, match="the driver has no data of the arm yet"):
        arm.port.fresh_state(0.5)
    arm.until(lambda: arm.port.state is not None and not arm.port.why_silent)


def test_object_without_a_covariance_is_known_once_it_has_rested_for_ten_frames(listener: BareNode, driver: Node) -> None:
    """While it is pushed, what it does is no noise."""
    pushing = True
    objects = TrackedObjects(listener, listener.default_callback_group, lambda: pushing)
    for name, msg in zip(("cells", "outline"), shape_to_msgs(SHAPE, "box", Time(sec=1)), strict=True):
        driver.create_publisher(type(msg), f"objects/box/{name}", LATCHED).publish(msg)
    poses = driver.create_publisher(PoseWithCovarianceStamped, "objects/box/pose", 10)
    rng, std, n = np.random.default_rng(0), np.array([2e-3, 2e-3, 0.02]), 0

    def why() -> str:
        try:
            objects.get("box", 60.0)
        except PlanningError as error:
            return str(error)
        return ""

    def move(step: float) -> None:
        """One frame, until it is there."""
        nonlocal n
        n += 1
        pose = std * rng.normal(size=3) + [step * n, 0.0, 0.0]
        poses.publish(planar_pose_to_msg(stamp_to_msg(1.0 + n / 30), pose, np.zeros((3, 3))))
        there = transform_points(pose, SHAPE.outline)
        wait_for(lambda: not objects.ids or np.allclose(objects.outlines_of_others("")[0], there, atol=1e-6))

    wait_for(lambda: objects.ids == ("box",), meanwhile=lambda: (move(0.01), time.sleep(0.05)))
    for _ in range(20):
        move(0.01)
    assert "lack a covariance, and 0 of its frames at rest" in why() and "wait, or publish covariances" in why()
    pushing = False
    for _ in range(9):
        move(0.0)
    assert "lack a covariance, and 8 of its frames" in why()
    for _ in range(40):
        move(0.0)
    found = np.sqrt(np.diag(objects.get("box", 60.0).covariance))
    assert found == pytest.approx(std, rel=0.3) and "frames at rest" in objects.notes["covariance of box"]
