"""Processes are started, watched and stopped together."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from rich.console import Console

from helpers.executor_cell import Stalls
from helpers.node_process import is_alive, wait_for
from push_ident.cli.processes import Backoff, RestartPolicy
from push_ident.cli.supervisor import NodeCommand, Supervisor, SupervisorError, config_file, node_commands
from push_ident.errors import InputError
from push_ident.nodes.base.lifetime import stop_signals_blocked

pytestmark = pytest.mark.live

SLEEP = "import time; print('ready'); time.sleep(60)"
DIES = "import sys; print('no camera', file=sys.stderr); sys.exit(7)"
ONCE_READY = """
import pathlib, time
log = pathlib.Path({log!r})
while not log.exists() or "ready" not in log.read_text():
    time.sleep(0.02)
"""
IGNORES_CTRL_C = "import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN); print('ready'); time.sleep(60)"
# Its child is ready first: a Ctrl-C while Python starts can be lost, as an exception in a callback of the import machinery.
HAS_CHILD = f"""
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", {SLEEP!r}], stdout=subprocess.PIPE)
child.stdout.readline()
print("child", child.pid)
{SLEEP}
"""
RUN = """
import ctypes, json, sys, time
from pathlib import Path
ctypes.CDLL(None).prctl(36, 1)  # PR_SET_CHILD_SUBREAPER: orphans are left to this process, which asks none for its exit code, as some inits
from push_ident.cli.supervisor import NodeCommand, Supervisor
commands = [
    NodeCommand(name, (sys.executable, "-c", *code), is_node=len(code) > 1) for name, code in json.loads(sys.argv[1]).items()
]
"""
RUNS = RUN + "sys.exit(Supervisor(commands, log_dir=Path(sys.argv[2])).run())"
WORKS = RUN + "with Supervisor(commands, log_dir=Path(sys.argv[2])):\n    time.sleep(60)"
"""As `push-ident demo` does."""


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
QUICK = RestartPolicy(first=0.1, longest=0.4, settled=60.0, attempts=3)


def command(name: str, code: str, may_end: bool = False) -> NodeCommand:
    return NodeCommand(name, (sys.executable, "-c", code), may_end)


def wait_for_line(path: Path, word: str) -> str:
    wait_for(lambda: path.exists() and word in path.read_text())
    return path.read_text()


def child_in(log: Path) -> int:
    """The child of a process that has one, once both are ready."""
    return int(wait_for_line(log, "ready").split()[1])


def start_in_own_process(tmp_path: Path, program: str = RUNS, **codes: str | tuple[str, ...]) -> subprocess.Popen[str]:
    """A process with a supervisor; `codes`: programs, with arguments where they are nodes."""
    given = {name: [code] if isinstance(code, str) else code for name, code in codes.items()}
    call = [sys.executable, "-c", program, json.dumps(given), str(tmp_path)]
    return subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_death_of_one_names_it_and_stops_the_rest(tmp_path: Path) -> None:
    log = tmp_path / "listener.log"
    process = start_in_own_process(tmp_path, camera=ONCE_READY.format(log=str(log)) + DIES, listener=HAS_CHILD)
    output, error = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "camera ended with exit code 7" in error and "no camera" in error
    assert "listener" not in error and "Traceback" not in output + error
    assert not is_alive(child_in(log))


@pytest.mark.alone
@pytest.mark.parametrize(
    ("program", "number"),
    [(RUNS, signal.SIGINT), pytest.param(RUNS, signal.SIGTERM, marks=pytest.mark.long), (RUNS, signal.SIGHUP), (WORKS, signal.SIGHUP)],
    ids=["INT", "TERM", "HUP", "HUP at work"],
)
def test_request_to_stop_stops_all_within_two_seconds(tmp_path: Path, program: str, number: signal.Signals) -> None:
    process = start_in_own_process(tmp_path, program, one=HAS_CHILD, two=SLEEP)
    child = child_in(tmp_path / "one.log")
    wait_for_line(tmp_path / "two.log", "ready")
    with Stalls() as stalls:
        start = time.monotonic()
        process.send_signal(number)
        _, error = process.communicate(timeout=30)
        took = time.monotonic() - start
    assert took < 2.0 + 4.0 * stalls.worst
    assert (process.returncode == 0) == (program == RUNS), error
    assert not is_alive(child)


@pytest.mark.alone
def test_process_deaf_to_ctrl_c_is_ended_and_named(tmp_path: Path) -> None:
    supervisor = Supervisor([command("deaf", IGNORES_CTRL_C), command("good", SLEEP)], log_dir=tmp_path)
    supervisor.start()
    for name in ("deaf", "good"):
        wait_for_line(tmp_path / f"{name}.log", "ready")
    with Stalls() as stalls:
        start = time.monotonic()
        stubborn, took = supervisor.stop(), time.monotonic() - start
    assert stubborn == ["deaf"] and took < 7.0 + 4.0 * stalls.worst
    assert supervisor.exit_code("deaf") == -signal.SIGTERM


def test_process_that_stops_slowly_is_waited_for(tmp_path: Path) -> None:
    """As a node of a loaded machine does."""
    slow = (
        "import signal, sys, time; signal.signal(signal.SIGINT, lambda *_: (time.sleep(2.5), sys.exit(0))); print('ready'); time.sleep(60)"
    )
    supervisor = Supervisor([command("slow", slow)], log_dir=tmp_path)
    supervisor.start()
    wait_for_line(tmp_path / "slow.log", "ready")
    assert supervisor.stop() == [] and supervisor.exit_code("slow") == 0


def test_process_that_may_end_stops_nothing_but_may_not_fail_and_an_error_of_the_caller_stops_all(tmp_path: Path) -> None:
    processes = [command("player", "pass", may_end=True), command("one", SLEEP)]
    with pytest.raises(ZeroDivisionError), Supervisor(processes, log_dir=tmp_path) as supervisor:
        wait_for(lambda: supervisor.exit_code("player") is not None)
        assert supervisor.exit_code("player") == 0
        assert supervisor.poll() is None and supervisor.exit_code("one") is None
        _ = 1 / 0
    assert supervisor.exit_code("one") is not None
    with Supervisor([command("player", DIES, may_end=True)], log_dir=tmp_path) as supervisor:
        wait_for(lambda: supervisor.exit_code("player") is not None)
        with pytest.raises(SupervisorError, match="player ended with exit code 7"):
            supervisor.check()


def test_program_that_does_not_exist_is_named_and_what_ran_is_stopped(tmp_path: Path) -> None:
    supervisor = Supervisor([command("one", SLEEP), NodeCommand("ghost", (str(tmp_path / "ghost"),))], log_dir=tmp_path)
    with pytest.raises(SupervisorError, match="ghost cannot be started"):
        supervisor.start()
    assert supervisor.exit_code("one") is not None


def test_nodes_of_a_kind_and_what_contradicts_it(tmp_path: Path) -> None:
    names = [node.name for node in node_commands("replay", bag=tmp_path, perception=False)]
    assert names == ["identification_node", "bag_player_node"]
    with pytest.raises(InputError, match="path of a bag"):
        node_commands("replay")
    with pytest.raises(InputError, match="expected none"):
        node_commands("arm", bag=tmp_path)
    with pytest.raises(InputError, match="sim_cell_node"):
        node_commands("arm", parameters={"sim_cell_node": {"seed": 1}})
    with pytest.raises(InputError, match="all different"):
        Supervisor([command("one", SLEEP), command("one", SLEEP)])
    assert yaml.safe_load(config_file("push_ident", "push_ident.yaml").read_text())
    with pytest.raises(SupervisorError, match="is missing"):
        config_file("push_ident", "nothing.yaml")


# ---- nodes live no longer than their supervisor, hold what moves before they end, and are started again when they die


def node(folder: Path, name: str, loading: float = 0.0) -> tuple[str, ...]:
    return (NODE, str(folder), name, str(loading))


def written(file: Path) -> int:
    wait_for(lambda: file.exists() and file.read_text())
    return int(file.read_text())


def children_of(process: int) -> list[int]:
    return [int(pid) for pid in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


@pytest.mark.alone
@pytest.mark.parametrize("loads", [False, True], ids=["running", "loading"])
def test_killed_supervisor_leaves_no_process_and_every_node_that_runs_holds_first(tmp_path: Path, loads: bool) -> None:
    supervisor = start_in_own_process(tmp_path, **{name: node(tmp_path, name, loading=30.0 * loads) for name in ("one", "two")})
    if loads:
        wait_for(lambda: len(children_of(supervisor.pid)) == 2)
        family = children_of(supervisor.pid)
    else:
        family = [written(tmp_path / f"{name}.{what}") for name in ("one", "two") for what in ("pid", "child")]
    check_end_with(supervisor, family)
    assert sorted(file.name for file in tmp_path.glob("*.held")) == ([] if loads else ["one.held", "two.held"])
    assert all(file.read_text() == "True" for file in tmp_path.glob("*.held"))


def check_end_with(parent: subprocess.Popen[Any], family: list[int]) -> None:
    """No process of the family outlives a parent that is killed."""
    with Stalls() as stalls:
        parent.kill()
        parent.wait()
        wait_for(lambda: not any(is_alive(pid) for pid in family), lambda: 2.0 + 4.0 * stalls.worst)


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
    check_end_with(command, [next(int(line) for line in command.stdout if line.strip().isdigit())])


def test_killed_node_is_started_again_without_what_it_had_started(tmp_path: Path) -> None:
    console = Console(record=True, width=200, file=(tmp_path / "console").open("w"))
    command = NodeCommand("one", (sys.executable, "-c", *node(tmp_path, "one")), is_node=True)
    with Supervisor([command], log_dir=tmp_path, console=console, restart=QUICK) as supervisor:
        first, child = written(tmp_path / "one.pid"), written(tmp_path / "one.child")
        (tmp_path / "one.pid").unlink()
        os.kill(first, signal.SIGKILL)
        wait_for(lambda: supervisor.poll() is not None or (tmp_path / "one.pid").exists())
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


QUICK_ONES = [("up sim", 1.6), ("doctor", 0.0)]
MORE = [(command, delay) for command in ("up sim", "doctor") for delay in (0.05, 0.3, 0.8)]


@pytest.mark.alone
@pytest.mark.parametrize(("command", "delay"), [*QUICK_ONES, *(pytest.param(*one, marks=pytest.mark.long) for one in MORE)])
def test_ctrl_c_at_any_moment_of_a_command_is_quiet(tmp_path: Path, command: str, delay: float) -> None:
    """Signals are blocked until it can handle them, as those of nodes and, by the environment that `make setup` writes, of commands."""
    with (tmp_path / "output").open("w") as file, stop_signals_blocked():
        process = subprocess.Popen((sys.executable, "-m", "push_ident.cli", *command.split()), stdout=file, stderr=file)
    try:
        time.sleep(delay)
        with Stalls() as stalls:
            process.send_signal(signal.SIGINT)
            asked = time.monotonic()
            code, took = process.wait(timeout=30.0), time.monotonic() - asked
    finally:
        process.kill()
    assert "Traceback" not in (tmp_path / "output").read_text()
    assert code == (0 if command.startswith("up") else 130)
    assert took < 3.0 + 6.0 * stalls.worst


def test_pause_doubles_with_each_early_death_up_to_its_limits_and_a_long_life_begins_the_count_anew() -> None:
    backoff = Backoff(RestartPolicy(first=1.0, longest=30.0, settled=60.0, attempts=7))
    assert [backoff.pause(0.5) for _ in range(8)] == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0, None]
    assert [backoff.pause(lived) for lived in (60.0, 59.0, 60.0, 0.5)] == [1.0, 2.0, 1.0, 2.0]
