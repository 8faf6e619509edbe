"""Nodes live no longer than their supervisor, hold what moves before they end, and are started again when they die."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from helpers.executor_cell import Stalls
from helpers.node_process import is_alive, wait_until
from push_ident.cli.processes import Backoff, RestartPolicy
from push_ident.cli.supervisor import NodeCommand, Supervisor, node_commands
from push_ident.nodes.base.lifetime import stop_signals_blocked

pytestmark = pytest.mark.live

NODE = """
import os, subprocess, sys, time
from pathlib import Path
from push_ident.nodes.base.lifetime import LIFETIME
LIFETIME.begin()
time.sleep(float(sys.argv[3]))
from push_ident.nodes.base.cell_node import CellNode, Component, Health
from push_ident.nodes.base.run import run_node
folder, name = Path(sys.argv[1]), sys.argv[2]

class Tested(CellNode):
    def __init__(self):
        super().__init__(name, ())
        (folder / f"{name}.pid").write_text(str(os.getpid()))
    def make_component(self):
        return Arm(self)

class Arm(Component):
    def __init__(self, node):
        self.context = node.context
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        (folder / f"{name}.child").write_text(str(child.pid))
    def health(self):
        return Health(b"\\0", "")
    def close(self):
        (folder / f"{name}.held").write_text(str(self.context.ok()))

LIFETIME.leave(run_node(Tested))
"""
"""A node with a child process; `close` holds its arm."""
RUN = """
import json, sys
from push_ident.cli.supervisor import NodeCommand, Supervisor
supervisor = Supervisor([NodeCommand(name, tuple(argv), is_node=True) for name, argv in json.loads(sys.argv[1]).items()])
sys.exit(supervisor.run())
"""
QUICK = RestartPolicy(first=0.1, longest=0.4, settled=60.0, attempts=3)


def node(folder: Path, name: str, loading: float = 0.0) -> tuple[str, ...]:
    return (sys.executable, "-c", NODE, str(folder), name, str(loading))


def start_supervisor(nodes: dict[str, tuple[str, ...]]) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", RUN, json.dumps(nodes)], stderr=subprocess.DEVNULL)


def written(file: Path) -> int:
    wait_until(lambda: file.exists() and file.read_text())
    return int(file.read_text())


def children_of(process: int) -> list[int]:
    return [int(pid) for pid in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


@pytest.mark.alone
def test_killed_supervisor_leaves_no_process_and_every_node_holds_first(tmp_path: Path) -> None:
    supervisor = start_supervisor({name: node(tmp_path, name) for name in ("one", "two")})
    family = [written(tmp_path / f"{name}.{what}") for name in ("one", "two") for what in ("pid", "child")]
    with Stalls() as stalls:
        supervisor.kill()
        supervisor.wait()
        wait_until(lambda: not any(is_alive(pid) for pid in family), lambda: 2.0 + 4.0 * stalls.worst)
    assert [(tmp_path / f"{name}.held").read_text() for name in ("one", "two")] == ["True", "True"]


@pytest.mark.alone
@pytest.mark.parametrize("delay", [0.0, pytest.param(0.05, marks=pytest.mark.long), pytest.param(0.2, marks=pytest.mark.long)])
def test_supervisor_killed_while_its_nodes_start_leaves_no_process(tmp_path: Path, delay: float) -> None:
    supervisor = start_supervisor({name: node(tmp_path, name, loading=30.0) for name in ("one", "two")})
    wait_until(lambda: len(children_of(supervisor.pid)) == 2)
    family = children_of(supervisor.pid)
    time.sleep(delay)
    with Stalls() as stalls:
        supervisor.kill()
        supervisor.wait()
        wait_until(lambda: not any(is_alive(pid) for pid in family), lambda: 2.0 + 4.0 * stalls.worst)


@pytest.mark.alone
def test_killed_command_leaves_no_worker_of_a_study() -> None:
    program = (
        "import os, time\n"
        "from push_ident_sim.workers import single_threads\n"
        "if __name__ == '__main__':\n"
        "    with single_threads() as pool:\n"
        "        print(pool.submit(os.getpid).result(), flush=True)\n"
        "        pool.submit(time.sleep, 60).result()\n"
    )
    command = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert command.stdout is not None
    worker = next(int(line) for line in command.stdout if line.strip().isdigit())
    with Stalls() as stalls:
        command.kill()
        command.wait()
        wait_until(lambda: not is_alive(worker), lambda: 2.0 + 4.0 * stalls.worst)


def test_stopped_supervisor_changes_nothing(tmp_path: Path) -> None:
    supervisor = start_supervisor({"one": node(tmp_path, "one")})
    process = written(tmp_path / "one.pid")
    supervisor.send_signal(signal.SIGSTOP)
    time.sleep(1.0)
    assert is_alive(process)
    supervisor.send_signal(signal.SIGCONT)
    supervisor.send_signal(signal.SIGINT)
    assert supervisor.wait(timeout=60.0) == 0
    assert not is_alive(process)


def test_killed_node_is_started_again_without_what_it_had_started(tmp_path: Path) -> None:
    console = Console(record=True, width=200, file=(tmp_path / "console").open("w"))
    command = NodeCommand("one", node(tmp_path, "one"), is_node=True)
    with Supervisor([command], log_dir=tmp_path, console=console, restart=QUICK) as supervisor:
        first, child = written(tmp_path / "one.pid"), written(tmp_path / "one.child")
        (tmp_path / "one.pid").unlink()
        os.kill(first, signal.SIGKILL)
        wait_until(lambda: supervisor.poll() is not None or (tmp_path / "one.pid").exists())
        assert written(tmp_path / "one.pid") == supervisor.pid("one") != first
        assert not is_alive(child)
    said = "one was ended by SIGKILL; it is started again in 0.1 s"
    assert said in console.export_text() and said in (tmp_path / "one.log").read_text()
    assert [str(death.how) for death in supervisor.deaths] == ["one was ended by SIGKILL"]


def test_node_that_dies_early_again_and_again_ends_the_cell_and_one_that_could_not_start_is_not_started_again(tmp_path: Path) -> None:
    for code, deaths in ((3, QUICK.attempts), (1, 0)):
        dying = NodeCommand("camera", (sys.executable, "-c", f"import sys; print('no camera'); sys.exit({code})"))
        supervisor = Supervisor([dying], log_dir=tmp_path / str(code), restart=QUICK)
        assert supervisor.run() == 1
        assert len(supervisor.deaths) == deaths
        assert (tmp_path / str(code) / "camera.log").read_text().count("no camera") == deaths + 1


def interrupted(argv: tuple[str, ...], delay: float, output: Path) -> tuple[int, float, str]:
    """Exit code, time to the end [s] and output of a program that gets Ctrl-C after a delay.

    Its signals are blocked until it can handle them, as those of nodes and, by the environment that `make setup` writes, of commands.
    """
    with output.open("w") as file, stop_signals_blocked():
        process = subprocess.Popen(argv, stdout=file, stderr=file)
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    asked = time.monotonic()
    try:
        code = process.wait(timeout=30.0)
    finally:
        process.kill()
    return code, time.monotonic() - asked, output.read_text()


def supervised(node_name: str) -> NodeCommand:
    return next(command for command in node_commands("sim") if command.name == node_name)


@pytest.mark.alone
@pytest.mark.parametrize(
    "node_name",
    [
        "push_executor_node",
        pytest.param("identification_node", marks=pytest.mark.long),
        pytest.param("gap_diagnosis_node", marks=pytest.mark.long),
    ],
)
def test_stop_at_any_moment_of_a_supervised_node_is_quiet_and_quick(tmp_path: Path, node_name: str) -> None:
    rng = random.Random(node_name)
    for number in range(3):
        delay = rng.uniform(0.0, 3.0) if number else 0.0
        # After 1.8 s a node ends itself by force: where the machine stalls for long meanwhile, the trial shows nothing of it.
        for _ in range(5):
            stubborn, code, stalled = stopped(node_name, delay, tmp_path)
            if stalled < 0.3:
                break
        assert stubborn == [] and code == 0


def stopped(node_name: str, delay: float, folder: Path) -> tuple[list[str], int | None, float]:
    """Start a node and stop it after a delay [s]: what did not stop on SIGINT, its exit code, and the longest stall meanwhile [s]."""
    supervisor = Supervisor([supervised(node_name)], log_dir=folder)
    supervisor.start()
    time.sleep(delay)
    with Stalls() as stalls:
        asked = time.monotonic()
        stubborn, took = supervisor.stop(), time.monotonic() - asked
    assert took < 2.0 + 4.0 * stalls.worst
    assert "Traceback" not in (folder / f"{node_name}.log").read_text()
    return stubborn, supervisor.exit_code(node_name), stalls.worst


DELAYS = (0.0, 0.05, 0.3, 0.8, 1.6)
FEW = (("up sim", 1.6), ("doctor", 0.0))
MORE = [(command, delay) for command in ("up sim", "doctor") for delay in DELAYS if (command, delay) not in FEW]


@pytest.mark.alone
@pytest.mark.parametrize(("command", "delay"), [*FEW, *(pytest.param(*one, marks=pytest.mark.long) for one in MORE)])
def test_ctrl_c_at_any_moment_of_a_command_is_quiet(tmp_path: Path, command: str, delay: float) -> None:
    with Stalls() as stalls:
        code, took, output = interrupted((sys.executable, "-m", "push_ident.cli", *command.split()), delay, tmp_path / "output")
    assert "Traceback" not in output
    assert code == (0 if command.startswith("up") else 130)
    assert took < 3.0 + 6.0 * stalls.worst


def test_pause_doubles_with_each_early_death_up_to_its_limits_and_a_long_life_begins_the_count_anew() -> None:
    backoff = Backoff(RestartPolicy(first=1.0, longest=30.0, settled=60.0, attempts=7))
    assert [backoff.pause(0.5) for _ in range(8)] == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0, None]
    assert [backoff.pause(lived) for lived in (60.0, 59.0, 60.0, 0.5)] == [1.0, 2.0, 1.0, 2.0]
