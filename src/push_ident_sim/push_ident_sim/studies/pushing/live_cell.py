"""A simulated cell with the real executor, as processes of their own, and an observer of every topic between them."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from numpy.typing import NDArray
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from push_ident.cli.supervisor import NodeCommand, Supervisor, node_commands
from push_ident.errors import PushIdentError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.geometry.se2 import yaw_of_quaternion
from push_ident.nodes.base.network import process_domain
from push_ident.nodes.convert.messages import force_from_msg, stamp_from_msg
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import PushRecord
from push_ident_sim.cell.robot import HOME, robot_description

__all__ = ["Heard", "LiveCell", "Processes", "SentGoal", "live_cell", "observed"]

FloatArray = NDArray[np.float64]

_STARTUP: Final = 60.0
"""Longest wait for the cell to plan a push [s]."""
_POLL: Final = 0.002
_LOOK: Final = 0.05
"""Period at which the observer checks whether it should end [s]."""
_RELAYED: Final = "relayed_joint_states"
"""The executor receives this topic instead of `joint_states`, so that joint states can be stopped."""


@dataclass(slots=True)
class Heard:
    """Messages since it was created. Received: `time.monotonic` [s]; stamps in simulated time [s]."""

    states: list[tuple[float, float, Any, Any]] = field(default_factory=list)
    """Joint states: received, stamp, positions, velocities."""
    commands: list[tuple[float, JointTrajectory]] = field(default_factory=list)
    """Motions that were commanded: received, message."""
    forces: list[tuple[float, float]] = field(default_factory=list)
    """Stamp, horizontal force [N]."""
    truth: list[tuple[float, float, float, float]] = field(default_factory=list)
    """Stamp and true pose of the object: x, y [m], yaw [rad]."""
    records: list[PushRecord] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class SentGoal:
    """A goal that the executor has accepted."""

    handle: Any
    future: Any
    """Of its result."""

    @property
    def has_ended(self) -> bool:
        """Whether its result is there."""
        return bool(self.future.done())


class Processes(Protocol):
    """The processes of a cell."""

    def check(self) -> None:
        """Raise PushIdentError when one of them has ended."""
        ...


class LiveCell:
    """Sends goals to the executor and records all messages. Made by `observed`."""

    def __init__(self, supervisor: Processes, context: Context, executor: SingleThreadedExecutor) -> None:
        self._supervisor = supervisor
        self._executor = executor
        self.node = Node("observer", context=context)
        executor.add_node(self.node)
        self.kinematics = ArmKinematics(robot_description(), neutral=HOME)
        self.heard = Heard()
        self.relaying = True
        self.last_relayed = time.monotonic()
        """When the executor last received joint states."""
        self._client = ActionClient(self.node, ExecutePush, "execute_push")
        self._reset = self.node.create_client(Trigger, "sim_cell_node/reset")
        self._relay = self.node.create_publisher(JointState, _RELAYED, 10)
        for kind, topic, take, qos in (
            (JointState, "joint_states", self._on_state, 50),
            (JointTrajectory, "joint_trajectory", lambda msg: self.heard.commands.append((time.monotonic(), msg)), 10),
            (WrenchStamped, "pusher/wrench", self._on_wrench, qos_profile_sensor_data),
            (PoseStamped, "sim_cell_node/ground_truth/pose", self._on_truth, 50),
            (PushRecord, "push_record", lambda msg: self.heard.records.append(msg), 10),
        ):
            self.node.create_subscription(kind, topic, take, qos)

    def pause(self, seconds: float) -> None:
        """Let wall time pass [s]; raises as `wait` when one of the processes ends."""
        until = time.monotonic() + seconds
        self.wait(lambda: time.monotonic() >= until, seconds + 10.0, "the pause did not end")

    def wait(self, condition: Callable[[], object], timeout: float, missing: str) -> None:
        """Raises PushIdentError, saying what is `missing`, after `timeout` [s], or when one of the processes ends."""
        deadline = time.monotonic() + timeout
        while not condition():
            self._supervisor.check()
            if time.monotonic() > deadline:
                raise PushIdentError(f"{missing} within {timeout:.0f} s")
            time.sleep(_POLL)

    def send(self, goal: ExecutePush.Goal, on_phase: Callable[[int], None] = lambda phase: None) -> SentGoal:
        """Send a goal that will be accepted; `on_phase` gets the phase of each feedback."""
        self.wait(self._client.server_is_ready, _STARTUP, "execute_push was not served")
        sent = self._ask(lambda: self._client.send_goal_async(goal, feedback_callback=lambda msg: on_phase(int(msg.feedback.phase))))
        self.wait(sent.done, 20.0, "execute_push did not answer")
        handle = sent.result()
        return SentGoal(handle, self._ask(handle.get_result_async))

    def result(self, sent: SentGoal, timeout: float = 120.0) -> ExecutePush.Result:
        """Of a goal, once it has ended."""
        self.wait(lambda: sent.has_ended, timeout, "the push was not over")
        return sent.future.result().result

    def cancel(self, sent: SentGoal) -> float:
        """Cancel a goal; returns the time of the request [s]."""
        requested = time.monotonic()
        self._ask(sent.handle.cancel_goal_async)
        return requested

    def reset_object(self) -> None:
        """Put the object back to the middle; the arm must not be there."""
        answer = self._ask(lambda: self._reset.call_async(Trigger.Request()))
        self.wait(answer.done, 20.0, "the simulated cell did not reset the object")
        if not answer.result().success:
            raise PushIdentError(f"the object was not reset: {answer.result().message}")

    def await_executor(self) -> None:
        """Until the executor can plan a push of the object."""
        goal = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, dry_run=True)
        deadline = time.monotonic() + _STARTUP
        while (result := self.result(self.send(goal))).error_code != 0:
            if time.monotonic() > deadline:
                raise PushIdentError(f"no push can be planned {_STARTUP:.0f} s after the start: {result.error_text}")
            time.sleep(0.2)

    def _ask(self, question: Callable[[], Any]) -> Any:
        # Called in the thread that spins: from another one, the answer may arrive before the request is registered, and is dropped.
        answer = self._executor.create_task(question)
        self.wait(answer.done, 20.0, "the observer's own thread did not answer")
        return answer.result()

    def _on_state(self, msg: JointState) -> None:
        received = time.monotonic()
        if self.relaying:
            self._relay.publish(msg)
            self.last_relayed = received
        self.heard.states.append((received, stamp_from_msg(msg.header.stamp), msg.position, msg.velocity))

    def _on_wrench(self, msg: WrenchStamped) -> None:
        stamp, force = force_from_msg(msg)
        self.heard.forces.append((stamp, float(np.linalg.norm(force))))

    def _on_truth(self, msg: PoseStamped) -> None:
        position, q = msg.pose.position, msg.pose.orientation
        yaw = float(yaw_of_quaternion([q.x, q.y, q.z, q.w]))
        self.heard.truth.append((stamp_from_msg(msg.header.stamp), position.x, position.y, yaw))


@contextmanager
def live_cell(cell: dict[str, object], executor: dict[str, object], *, relay: bool) -> Iterator[LiveCell]:
    """Simulated cell, simulated hand and executor, each a process, on a ROS domain of their own; stopped at the end.

    Args:
        cell: Parameters of `sim_cell_node`. The executor gets the true poses of the object, with the noise of a good camera.
        executor: Parameters of `push_executor_node`.
        relay: Relay the joint states to the executor through the observer, who can stop them.

    Raises:
        PushIdentError: A process ends, or nothing can be planned.
    """
    domain = process_domain()
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    truth: dict[str, object] = {"camera_rate": 0.0, "truth_as_perception": True}
    commands = node_commands(
        "sim",
        parameters={"sim_cell_node": truth | cell, "push_executor_node": {"hand": "simulated", "hand_timeout": 5.0} | executor},
        log_level="warn",
    )
    chosen = [command for command in commands if command.name in ("sim_cell_node", "push_executor_node")]
    if relay:
        chosen = [
            NodeCommand(c.name, (*c.argv, "-r", f"joint_states:={_RELAYED}")) if c.name == "push_executor_node" else c for c in chosen
        ]
    chosen.append(NodeCommand("sim_hand_node", (sys.executable, "-m", "push_ident_sim", "sim_hand_node")))
    # Ctrl-C ends a worker silently; here it has to stop its processes first.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with Supervisor(chosen) as supervisor, observed(supervisor, domain) as bench:
            bench.await_executor()
            yield bench
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, before)
        signal.raise_signal(signal.SIGINT)
        raise
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def observed(processes: Processes, domain: int) -> Iterator[LiveCell]:
    """An observer of a cell of these processes, which spins in a thread of its own."""
    context = Context()
    context.init(domain_id=domain)
    spinner, stop = SingleThreadedExecutor(context=context), threading.Event()

    def spin() -> None:
        # Not `spin`: to end that from another thread, its executor would have to be destroyed while it runs.
        while not stop.is_set():
            spinner.spin_once(timeout_sec=_LOOK)

    bench = LiveCell(processes, context, spinner)
    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield bench
    finally:
        stop.set()
        thread.join(timeout=2.0)
        spinner.shutdown(timeout_sec=0.5)
        bench.node.destroy_node()
        context.try_shutdown()
