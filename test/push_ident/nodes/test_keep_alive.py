"""The arm stands soon after its client is gone, however it went, and a client hears soon that its executor is: real processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped

from helpers.executor_cell import QUICK, Cell, Stalls, ask, start_node, wait_for, wait_until_ready
from push_ident.cli.supervisor import node_command

pytestmark = pytest.mark.alone

TIMEOUT = 1.0
"""client_timeout [s]: twice the arm timeout of these executors would be as much."""
MISSED = TIMEOUT + 0.3
"""From the last sign of a client until it is missed [s]: the executor looks every 0.1 s, late on a busy machine."""
REACTION = 0.15
"""From the end of a push until the arm stands [s]: 50 ms in the executor, and braking."""
LONG: dict[str, object] = {"distance": 0.12, "speed": 0.03}
"""A push that takes 5 s: longer than any time that is bounded here."""
COMMAND = ("push", "--at", "0.05,0", "--direction", str(np.pi), "--object", "box", "--in-object", "--distance", "0.12", "--speed", "0.03")
STUCK = """
import sys, time
from pathlib import Path
from push_ident.nodes.client.cell_client import CellClient
from push_ident.cli.push import contact_goal
import numpy as np
flag = Path(sys.argv[1])
with CellClient() as client:
    client.node.create_timer(0.02, lambda: time.sleep(60.0) if flag.exists() else None)
    client.execute_push(contact_goal(np.array([0.05, 0.0]), np.pi, object_id="box", in_object=True, distance=0.12, speed=0.03))
"""
"""A client whose thread is stuck as soon as there is a file."""
SUPERVISOR = """
import json, sys
from push_ident.cli.supervisor import NodeCommand, Supervisor
sys.exit(Supervisor([NodeCommand("executor", tuple(json.loads(sys.argv[1])), is_node=True)]).run())
"""


@pytest.fixture(scope="module")
def executors(domain: int) -> Iterator[list[subprocess.Popen[str]]]:
    """The executor, and those before it that have ended."""
    started: list[subprocess.Popen[str]] = []
    yield started
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def cell(domain: int, the_cell: Cell, executors: list[subprocess.Popen[str]]) -> Cell:
    """At home with an executor, and room for the longest push."""
    the_cell.reset()
    the_cell.box[0] = 0.06
    if not executors or executors[-1].poll() is not None:
        the_cell.diagnostics.clear()
        executors.append(start_node(domain))
        wait_until_ready(the_cell)
    wait_for(lambda: any("pushing" not in msg.status[0].message for msg in list(the_cell.diagnostics)[-1:]))
    return the_cell


@contextmanager
def client(domain: int, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A process of a client, and the end of it."""
    with subprocess.Popen(
        [sys.executable, *arguments],
        env=os.environ | {"ROS_DOMAIN_ID": str(domain)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def command(domain: int) -> AbstractContextManager[subprocess.Popen[str]]:
    return client(domain, "-m", "push_ident.cli", *COMMAND)


def wait_until_it_pushes(cell: Cell, process: subprocess.Popen[str]) -> None:
    wait_for(lambda: process.poll() is not None or len(cell.pusher) > 20, 60.0)
    assert process.poll() is None, process.communicate()[0]


def stands_after(cell: Cell, event: float) -> float:
    """Wait until the arm has stood for 0.2 s; how long after an event it moved last [s]."""

    def moved() -> np.ndarray:
        states = list(cell.states)
        q = np.array([q for _, q in states])
        return np.array([t for t, _ in states])[1:][np.max(np.abs(np.diff(q, axis=0)), axis=1) > 1e-9]

    wait_for(lambda: time.monotonic() - moved()[-1] > 0.2, 20.0)
    return float(moved()[-1] - event)


def executor_says(cell: Cell, text: str) -> None:
    wait_for(lambda: any(text in value.value for msg in list(cell.diagnostics) for value in msg.status[0].values))


def test_arm_stands_soon_after_the_client_was_killed(cell: Cell, domain: int) -> None:
    with command(domain) as process:
        wait_until_it_pushes(cell, process)
        with Stalls() as stalls:
            process.kill()
            stands = stands_after(cell, time.monotonic())
    print(f"the arm stands {stands:.2f} s after SIGKILL of its client")
    assert stands < MISSED + REACTION + 4 * stalls.worst
    executor_says(cell, "CANCELED: its client has been silent for 1.")


@pytest.mark.long
def test_terminated_client_holds_the_arm_at_once(cell: Cell, domain: int) -> None:
    with command(domain) as process:
        wait_until_it_pushes(cell, process)
        with Stalls() as stalls:
            process.terminate()
            stands = stands_after(cell, time.monotonic())
        assert process.wait(10.0) == 128 + signal.SIGTERM
    assert stands < 2 * REACTION + 4 * stalls.worst
    executor_says(cell, "CANCELED: canceled on request")


def test_message_that_cannot_be_used_does_not_stop_ctrl_c_of_a_client(cell: Cell, domain: int) -> None:
    poses = cell.create_publisher(PoseWithCovarianceStamped, "objects/box/pose", 10)
    wrong = PoseWithCovarianceStamped()
    wrong.header.frame_id = "map"
    with command(domain) as process:
        wait_until_it_pushes(cell, process)
        for _ in range(3):
            poses.publish(wrong)
            time.sleep(0.1)
        with Stalls() as stalls:
            process.send_signal(signal.SIGINT)
            stands = stands_after(cell, time.monotonic())
        output = process.communicate()[0]
    ask(cell, lambda: cell.destroy_publisher(poses))
    assert stands < 2 * REACTION + 4 * stalls.worst
    assert output.count("\n") == 1 and "refused: objects/box/pose" in output, output


@pytest.mark.parametrize("is_interrupted", [False, pytest.param(True, marks=pytest.mark.long)], ids=["alone", "Ctrl-C"])
def test_client_whose_thread_is_stuck_leaves_no_moving_arm(cell: Cell, domain: int, tmp_path: Path, is_interrupted: bool) -> None:
    flag = tmp_path / "stuck"
    with client(domain, "-c", STUCK, str(flag)) as process:
        wait_until_it_pushes(cell, process)
        with Stalls() as stalls:
            flag.touch()
            time.sleep(0.1)
            if is_interrupted:
                process.send_signal(signal.SIGINT)
            stands = stands_after(cell, time.monotonic())
    print(f"the arm stands {stands:.2f} s later")
    assert stands < (2 * REACTION if is_interrupted else MISSED + REACTION) + 4 * stalls.worst


@pytest.mark.parametrize(
    ("number", "within", "text"),
    [
        pytest.param(signal.SIGINT, 1.0, "CANCELED: the node was stopped", marks=pytest.mark.long),
        (signal.SIGKILL, 4.0, "push_executor_node has not answered for 3 s"),
    ],
    ids=["stopped", "killed"],
)
def test_client_hears_soon_that_the_executor_is_gone(
    cell: Cell, domain: int, executors: list[subprocess.Popen[str]], number: signal.Signals, within: float, text: str
) -> None:
    with command(domain) as process:
        wait_until_it_pushes(cell, process)
        with Stalls() as stalls:
            executors[-1].send_signal(number)
            gone = time.monotonic()
            output = process.communicate(timeout=30.0)[0]
            heard = time.monotonic() - gone
    print(f"{heard:.2f} s after {number.name}: {output}")
    assert process.returncode == 1 and text in output and "Traceback" not in output
    assert heard < within + 0.5 + 4 * stalls.worst  # and the end of its process


@pytest.mark.long
def test_client_hears_soon_of_a_supervisor_terminated_twice(cell: Cell, domain: int, executors: list[subprocess.Popen[str]]) -> None:
    executors[-1].kill()
    executors[-1].wait()
    cell.diagnostics.clear()
    argv = json.dumps(node_command("push_executor_node", QUICK).argv)
    with client(domain, "-c", SUPERVISOR, argv) as supervisor:
        wait_until_ready(cell)
        with command(domain) as process:
            wait_until_it_pushes(cell, process)
            with Stalls() as stalls:
                for _ in range(2):
                    supervisor.terminate()
                    time.sleep(0.1)
                gone = time.monotonic()
                output = process.communicate(timeout=30.0)[0]
                heard = time.monotonic() - gone
        supervisor.wait(10.0)
    print(f"heard {heard:.2f} s after two SIGTERM: {output}")
    assert process.returncode == 1 and ("the node was stopped" in output or "has left the ROS graph" in output), output
    assert heard < 1.5 + 4 * stalls.worst
