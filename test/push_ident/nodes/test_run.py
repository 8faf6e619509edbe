"""A node process stops cleanly, whatever it is busy with."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest

pytestmark = pytest.mark.alone

SCRIPT = """
import sys, time
from rclpy.node import Node
from push_ident.errors import InputError
from push_ident.nodes.run import run_node

class Tested(Node):
    def __init__(self):
        super().__init__("tested")
        self.create_timer(0.05, self.tick)
        self.started = False
    def tick(self):
        if not self.started:
            self.started = True
            print("ticking", flush=True)
        if MODE == "busy":
            while True:
                time.sleep(0.01)
    def close(self):
        print("held while the context is", self.context.ok(), flush=True)

def factory():
    if MODE == "refusing":
        raise InputError("speed is 9, expected 0 to 1.")
    return Tested()

sys.exit(run_node(factory, n_threads=N))
"""


def start(mode: str, n_threads: int = 1) -> subprocess.Popen[str]:
    script = f"MODE, N = {mode!r}, {n_threads}\n" + SCRIPT
    return subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


@pytest.mark.parametrize(("number", "n_threads"), [(signal.SIGINT, 1), (signal.SIGTERM, 1), (signal.SIGINT, 3)])
def test_a_signal_closes_the_node_while_it_can_still_publish(number, n_threads):
    process = start("idle", n_threads)
    assert process.stdout is not None and "ticking" in process.stdout.readline()
    asked = time.monotonic()
    process.send_signal(number)
    output, _ = process.communicate(timeout=5.0)
    assert time.monotonic() - asked < 2.0
    assert process.returncode == 0
    assert output.strip() == "held while the context is True"


def test_a_callback_that_never_returns_does_not_keep_the_process():
    process = start("busy")
    assert process.stdout is not None and "ticking" in process.stdout.readline()
    asked = time.monotonic()
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=5.0)
    assert time.monotonic() - asked < 2.2
    assert process.returncode == 1 and "Traceback" not in output


def test_a_node_that_cannot_start_says_why_in_one_line():
    output, _ = (process := start("refusing")).communicate(timeout=10.0)
    assert process.returncode == 1
    assert "speed is 9, expected 0 to 1." in output and "Traceback" not in output


@pytest.mark.parametrize("module", ["push_ident.nodes.perception_node", "push_ident_sim.cell.sim_cell_node"])
@pytest.mark.parametrize("delay", [0.0, 0.1, 0.3, 1.0, 2.0])
def test_interrupt_while_a_node_is_loaded_ends_it_quietly(module, delay, tmp_path):
    # The import times tell when Python itself is up: before that no code of a package runs.
    said = tmp_path / "stderr"

    def listen_to_interrupts():
        # A shell in the background lets what it starts ignore them.
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    with said.open("w") as stderr:
        command = [sys.executable, "-X", "importtime", "-m", module]
        process = subprocess.Popen(command, stdout=stderr, stderr=stderr, preexec_fn=listen_to_interrupts)
        try:
            while "push_ident.nodes\n" not in said.read_text():
                time.sleep(0.005)
            time.sleep(delay)
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=5.0) == 0
        finally:
            process.kill()
    assert "Traceback" not in said.read_text()


def test_a_program_that_imports_a_node_keeps_its_interrupt():
    script = "import push_ident.nodes, signal; assert signal.getsignal(signal.SIGINT) is signal.default_int_handler"
    assert subprocess.run([sys.executable, "-c", script, "some_node"], check=False).returncode == 0
