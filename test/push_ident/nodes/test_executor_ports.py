"""The inputs of push_executor_node, in the process of the test: force, recorder, hand, and the lease of the arm."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import WrenchStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from helpers.executor_cell import wait_for
from push_ident.errors import InputError
from push_ident.nodes.base.cell_node import LATCHED, CellNode, Component, Health
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import force_to_msg
from push_ident.nodes.push_executor.arm_lease import ArmLease
from push_ident.nodes.push_executor.force_port import ForcePort
from push_ident.nodes.push_executor.hand_port import RobotiqHand
from push_ident.nodes.push_executor.push_executor_node import PushExecutorNode
from push_ident.nodes.recording import recording_port
from push_ident.nodes.recording.recording_port import REPEATED, RecordingPort
from push_ident.nodes.recording.settings import RECORDING
from push_ident_sim.cell.sim_hand_node import SimHandNode

pytestmark = pytest.mark.live


class Listener(CellNode):
    """A node that has the ports."""

    def __init__(self, context: Context) -> None:
        super().__init__("listener", (), context=context)

    def make_component(self) -> Component:
        return _Nothing()


class _Nothing(Component):
    def health(self) -> Health:
        return Health(DiagnosticStatus.OK, "")


@pytest.fixture
def executor() -> Iterator[SingleThreadedExecutor]:
    """That spins whatever is added to it."""
    context = Context()
    rclpy.init(context=context, domain_id=own_domain())
    executor = SingleThreadedExecutor(context=context)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    yield executor
    nodes = executor.get_nodes()
    executor.shutdown()
    thread.join(2.0)
    for node in nodes:
        node.destroy_node()
    context.try_shutdown()


@pytest.fixture
def listener(executor: SingleThreadedExecutor) -> Listener:
    node = Listener(executor.context)
    executor.add_node(node)
    return node


def test_force_that_cannot_be_trusted_is_infinite_and_a_stamp_that_repeats_is_silence(
    executor: SingleThreadedExecutor, listener: Listener
) -> None:
    port = ForcePort(listener, listener.default_callback_group)
    driver = Node("driver", context=executor.context)
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
    executor: SingleThreadedExecutor, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(recording_port, "time", SimpleNamespace(monotonic=lambda: now[0]))
    port = RecordingPort(listener, listener.default_callback_group)
    recorder = Node("recorder", context=executor.context)
    publisher = recorder.create_publisher(DiagnosticStatus, "recording", LATCHED)
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
    recorder.destroy_publisher(publisher)
    now[0] += 100.0
    wait_for(lambda: port.fault == "")  # a recorder that has left is not asked for any more


def test_simulated_hand_is_activated_and_closed_to_a_fist(executor: SingleThreadedExecutor, listener: Listener) -> None:
    times = [f"{name}:=0.3" for name in ("activation_time", "closing_time")]
    arguments = ["--ros-args", "-p", "closed:=false", *(item for time in times for item in ("-p", time))]
    executor.add_node(SimHandNode(context=executor.context, cli_args=arguments))
    port = RobotiqHand(listener, "simulated", timeout=2.0, callback_group=listener.default_callback_group)
    wait_for(lambda: "not activated" in port.why_no_fist())
    assert port.close_fist(5.0, lambda: False) == ""
    with pytest.raises(InputError, match="robotiq_3f_gripper_ros2_interfaces"):
        RobotiqHand(listener, "robotiq_3f", timeout=2.0, callback_group=listener.default_callback_group)


HOLD = """
from push_ident.nodes.push_executor.arm_lease import ArmLease
lease = ArmLease(7, "/arm")
print("held", flush=True)
input()
"""


def test_one_executor_has_the_arm_and_a_killed_one_leaves_it_free(executor: SingleThreadedExecutor) -> None:
    node = PushExecutorNode(context=executor.context)
    with pytest.raises(InputError, match=f"process {os.getpid()}"):
        PushExecutorNode(context=executor.context)
    node.close()
    again = PushExecutorNode(context=executor.context)
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
