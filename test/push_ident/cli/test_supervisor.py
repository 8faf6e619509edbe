"""Processes are started, watched and stopped together."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from helpers.executor_cell import Stalls
from helpers.node_process import is_alive, wait_until
from push_ident.cli.supervisor import NodeCommand, Supervisor, SupervisorError, config_file, node_commands
from push_ident.errors import InputError

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
import ctypes, json, sys
from pathlib import Path
ctypes.CDLL(None).prctl(36, 1)  # PR_SET_CHILD_SUBREAPER: orphans are left to this process, which asks none for its exit code, as some inits
from push_ident.cli.supervisor import NodeCommand, Supervisor
commands = [NodeCommand(name, (sys.executable, "-c", code)) for name, code in json.loads(sys.argv[1]).items()]
sys.exit(Supervisor(commands, log_dir=Path(sys.argv[2])).run())
"""


def command(name: str, code: str, may_end: bool = False) -> NodeCommand:
    return NodeCommand(name, (sys.executable, "-c", code), may_end)


def wait_for_line(path: Path, word: str) -> str:
    wait_until(lambda: path.exists() and word in path.read_text())
    return path.read_text()


def child_in(log: Path) -> int:
    """The child of a process that has one, once both are ready."""
    return int(wait_for_line(log, "ready").split()[1])


def start_in_own_process(tmp_path: Path, **codes: str) -> subprocess.Popen[str]:
    call = [sys.executable, "-c", RUN, json.dumps(codes), str(tmp_path)]
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
@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long), signal.SIGHUP])
def test_request_to_stop_stops_all_within_two_seconds(tmp_path: Path, number: signal.Signals) -> None:
    process = start_in_own_process(tmp_path, one=HAS_CHILD, two=SLEEP)
    child = child_in(tmp_path / "one.log")
    wait_for_line(tmp_path / "two.log", "ready")
    with Stalls() as stalls:
        start = time.monotonic()
        process.send_signal(number)
        _, error = process.communicate(timeout=30)
        took = time.monotonic() - start
    assert took < 2.0 + 4.0 * stalls.worst
    assert process.returncode == 0, error
    assert not is_alive(child)


@pytest.mark.alone
def test_process_deaf_to_ctrl_c_is_ended_and_named(tmp_path: Path) -> None:
    supervisor = Supervisor([command("deaf", IGNORES_CTRL_C), command("good", SLEEP)], log_dir=tmp_path)
    supervisor.start()
    wait_for_line(tmp_path / "deaf.log", "ready")
    wait_for_line(tmp_path / "good.log", "ready")
    with Stalls() as stalls:
        start = time.monotonic()
        stubborn, took = supervisor.stop(), time.monotonic() - start
    assert stubborn == ["deaf"] and took < 4.0 + 4.0 * stalls.worst
    assert supervisor.exit_code("deaf") == -signal.SIGTERM


def test_no_process_remains_after_an_error_in_the_caller(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), Supervisor([command("one", SLEEP)], log_dir=tmp_path) as supervisor:
        wait_for_line(tmp_path / "one.log", "ready")
        assert supervisor.poll() is None
        _ = 1 / 0
    assert supervisor.exit_code("one") is not None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_no_process_remains_when_the_caller_is_terminated(tmp_path: Path, number: signal.Signals) -> None:
    """`push-ident demo` under `timeout`, say."""
    script = (
        "import sys, time; from pathlib import Path; from push_ident.cli.supervisor import NodeCommand, Supervisor\n"
        "commands = [NodeCommand('one', (sys.executable, '-c', sys.argv[2]))]\n"
        "with Supervisor(commands, log_dir=Path(sys.argv[1])):\n    time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", script, str(tmp_path), HAS_CHILD], stderr=subprocess.DEVNULL)
    child = child_in(tmp_path / "one.log")
    process.send_signal(number)
    assert process.wait(timeout=60) != 0
    assert not is_alive(child)


def test_process_that_may_end_stops_nothing_but_may_not_fail(tmp_path: Path) -> None:
    with Supervisor([command("player", "pass", may_end=True), command("one", SLEEP)], log_dir=tmp_path) as supervisor:
        wait_until(lambda: supervisor.exit_code("player") is not None)
        assert supervisor.exit_code("player") == 0
        assert supervisor.poll() is None and supervisor.exit_code("one") is None
    with Supervisor([command("player", DIES, may_end=True)], log_dir=tmp_path) as supervisor:
        wait_until(lambda: supervisor.exit_code("player") is not None)
        with pytest.raises(SupervisorError, match="player ended with exit code 7"):
            supervisor.check()


def test_program_that_does_not_exist_is_named_and_what_ran_is_stopped(tmp_path: Path) -> None:
    missing = NodeCommand("ghost", (str(tmp_path / "ghost"),))
    supervisor = Supervisor([command("one", SLEEP), missing], log_dir=tmp_path)
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


def test_installed_parameter_files_are_those_of_the_sources() -> None:
    for package, name in (("push_ident", "push_ident.yaml"), ("push_ident_sim", "sim.yaml")):
        assert yaml.safe_load(config_file(package, name).read_text())
    with pytest.raises(SupervisorError, match="is missing"):
        config_file("push_ident", "nothing.yaml")
