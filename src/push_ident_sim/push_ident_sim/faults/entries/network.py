"""Faults of the network and of how nodes find each other."""

from __future__ import annotations

import socket
from typing import Final

import psutil
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import String

from push_ident.cli.supervisor import node_commands
from push_ident_sim.faults.fault import Fault, Trial
from push_ident_sim.faults.harness.cell import ARM_CELL, CAMERA_CELL, Cell
from push_ident_sim.faults.harness.monitor import until
from push_ident_sim.faults.harness.process import Process

__all__ = ["FAULTS"]

_LOOPBACK: Final = ("127.", "::1")


def _open_sockets(process: Process) -> list[str]:
    """Addresses on which a process accepts connections or datagrams from another machine."""
    found = []
    for connection in psutil.Process(process.pid).net_connections(kind="inet"):
        if not connection.laddr or connection.raddr:
            continue
        listens = connection.type == socket.SOCK_DGRAM or connection.status == psutil.CONN_LISTEN
        if listens and not connection.laddr.ip.startswith(_LOOPBACK):
            found.append(f"{connection.laddr.ip}:{connection.laddr.port}")
    return found


def _listening(trial: Trial) -> None:
    cell = trial.cell
    viewer = next((c for c in node_commands("sim", view=True) if c.name == "viewer_node"), None)
    if viewer is not None:
        cell.add(viewer)
        trial.wait(6.0)
    try:
        for name, process in cell.processes.items():
            if process.runs:
                addresses = _open_sockets(process)
                trial.expect(not addresses, f"{name} listens on {', '.join(sorted(addresses))}")
        trial.note = f"{len(cell.processes)} processes"
    finally:
        if viewer is not None:
            cell.remove("viewer_node")


def _named_in_log(trial: Trial, cell: Cell, node: str, topic: str, since: int) -> None:
    def named() -> bool:
        text = cell.processes[node].output[since:].lower()
        return topic in text and ("durability" in text or "reliability" in text)

    report = cell.monitor.report_of(node)
    told = report is not None and "durability" in f"{report.message} {report.values}".lower()
    if not told:
        trial.expect_soon(named, 4.0, f"{node} does not name the policy of {topic}")


def _incompatible(trial: Trial) -> None:
    """Publishers of latched topics that do not latch."""
    cell = trial.cell
    qos = QoSProfile(depth=1, durability=DurabilityPolicy.VOLATILE, reliability=ReliabilityPolicy.BEST_EFFORT)
    before = {name: len(process.output) for name, process in cell.processes.items()}
    publishers = [cell.monitor.node.create_publisher(kind, topic, qos) for kind, topic in _LATCHED]
    trial.wait(2.0)
    _named_in_log(trial, cell, "perception_node", "pusher/shape", before["perception_node"])
    _named_in_log(trial, cell, "push_executor_node", "robot_description", before["push_executor_node"])
    for publisher in publishers:
        cell.monitor.node.destroy_publisher(publisher)
    trial.note = "named by perception and executor"


_LATCHED: Final = ((SolidPrimitive, "pusher/shape"), (String, "robot_description"))


def _parameters(trial: Trial) -> None:
    """Impossible values for running nodes; a misspelt key at the start of one."""
    cell = trial.cell
    refused = 0
    wrong: dict[str, dict[str, float | str | bool]] = {
        "push_executor_node": {"push_speed": -1.0, "force_limit": float("nan"), "arm_timeout": 1e9, "no_such": 1.0, "settle": "soon"},
        "identification_node": {"update_period": float("inf"), "prediction_period": -1.0, "method": "magic", "autostart": False},
        "sim_cell_node": {"real_time_factor": -1.0, "object": "[/x]", "time_step": 0.001},
    }
    for node, values in wrong.items():
        for name, value in values.items():
            answer = cell.set_parameter(node, name, value)
            trial.expect(not answer.successful and answer.reason, f"{node} accepts {name} = {value}")
            refused += 1
    command = next(c for c in node_commands("sim") if c.name == "identification_node")
    name = "misspelt"
    process = cell.add(type(command)(name, (*command.argv, "-r", "__node:=misspelt", "-p", "psuh_gap:=0.7", "-p", "state_directory:=''")))
    try:
        until(lambda: "psuh_gap" in process.output and "push_gap" in process.output, 15.0, "a misspelt key is not warned of")
    finally:
        cell.remove(name)
    cell.whole_push()
    trial.note = f"{refused} values refused"


FAULTS: Final = (
    Fault(
        number=13,
        name="incompatible-qos",
        what="publishers of latched topics that do not latch",
        holds="events of the middleware",
        expected="the policy is named",
        run=_incompatible,
        cell=CAMERA_CELL,
    ),
    Fault(
        number=14,
        name="parameters",
        what="parameters out of range, NaN, of another type, read-only, unknown; a misspelt key at the start",
        holds="the tables of parameters",
        expected="refused, the old value stays; unknown keys warned of",
        run=_parameters,
        cell=ARM_CELL,
    ),
    Fault(
        number=33,
        name="listening",
        what="every socket of every process, the viewer included",
        holds="the profile of the middleware; the viewer's address",
        expected="loopback only",
        run=_listening,
        cell=ARM_CELL,
    ),
)
