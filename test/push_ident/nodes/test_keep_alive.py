"""The arm stands soon after its client is gone, however it went, and a client hears soon that its executor is: real processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped

from helpers.executor_cell import Cell, Stalls, start_node, wait_for, wait_until_ready
from helpers.node_process import NodeProcess

pytestmark = pytest.mark.alone

TIMEOUT = 1.0
"""client_timeout [s]: twice the arm timeout of these executors would be as much."""
MISSED = TIMEOUT + 0.3
"""From the last sign of a client until it is missed [s]: the executor looks every 0.1 s, late on a busy machine."""
REACTION, BRAKING = 0.15, 0.05
"""From the end of a push until the arm stands [s]: 50 ms in the executor, and braking."""
COMMAND = (
    *["-m", "push_ident.cli", "push", "--object", "box", "--in-object", "--at", "0.05,0", "--direction"],
    str(np.pi),
    *["--distance", "0.12", "--speed", "0.03"],
)
"""A push that takes 5 s: longer than any time that is bounded here."""
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


@pytest.fixture(scope="module")
def executor(domain: int, the_cell: Cell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeProcess]:
    process = start_node(domain, tmp_path_factory.mktemp("node"))
    wait_until_ready(the_cell)
    yield process
    process.kill()


@pytest.fixture
def cell(the_cell: Cell, executor: NodeProcess) -> Cell:
    """At home with an executor, and room for the longest push."""
    the_cell.reset()
    the_cell.box[0] = 0.06
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


def test_arm_stands_soon_after_the_client_was_killed(cell: Cell, domain: int) -> None:
    with client(domain, *COMMAND) as process:
        wait_until_it_pushes(cell, process)
        with Stalls() as stalls:
            process.kill()
            stands = stands_after(cell, time.monotonic())
    assert stands < MISSED + REACTION + 4 * stalls.worst

    def said() -> list[str]:
        return [value.value for msg in list(cell.diagnostics) for value in msg.status[0].values]

    wait_for(lambda: any("CANCELED: its client has been silent for " in value for value in said()), why=lambda: f"said {said()[-20:]}")


def test_message_that_cannot_be_used_does_not_keep_a_client_from_its_end(cell: Cell, domain: int) -> None:
    wrong = PoseWithCovarianceStamped()
    wrong.header.frame_id = "map"
    with client(domain, *COMMAND) as process:
        wait_until_it_pushes(cell, process)
        for _ in range(3):
            cell.poses.publish(wrong)
            time.sleep(0.1)
        with Stalls() as stalls:
            process.send_signal(signal.SIGINT)
            stands = stands_after(cell, time.monotonic())
        output = process.communicate()[0]
    assert stands < 2 * REACTION + 4 * stalls.worst
    assert output.count("\n") == 1 and "refused: objects/box/pose" in output, output


@pytest.mark.long  # quicker: the client that was killed
def test_client_whose_thread_is_stuck_leaves_no_moving_arm(cell: Cell, domain: int, tmp_path: Path) -> None:
    flag = tmp_path / "stuck"
    with client(domain, "-c", STUCK, str(flag)) as process:
        wait_until_it_pushes(cell, process)
        with Stalls() as stalls:
            flag.touch()
            stands = stands_after(cell, time.monotonic() + 0.1)
    assert stands < MISSED + REACTION + 4 * stalls.worst


def test_arm_stands_and_the_client_hears_soon_of_a_killed_executor(cell: Cell, domain: int, executor: subprocess.Popen[str]) -> None:
    with client(domain, *COMMAND) as process:
        wait_until_it_pushes(cell, process)
        with Stalls() as stalls:
            executor.kill()
            gone = time.monotonic()
            stands = stands_after(cell, gone)
            output = process.communicate(timeout=30.0)[0]
            heard = time.monotonic() - gone
    assert stands < 0.1 + BRAKING + 4 * stalls.worst
    assert process.returncode == 1 and "push_executor_node has not answered for 3 s" in output and "Traceback" not in output
    assert heard < 4.5 + 4 * stalls.worst  # and the end of its process
