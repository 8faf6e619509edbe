"""A node process stops cleanly in every state."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from helpers.executor_cell import Stalls

SCRIPT = """
import time
from push_ident.errors import InputError
from push_ident.nodes.base.cell_node import CellNode, Component, Health
from push_ident.nodes.base.lifetime import LIFETIME
from push_ident.nodes.base.run import run_node

class Tested(CellNode):
    def __init__(self):
        super().__init__("tested", ())
    def make_component(self):
        return Ticking(self)

class Ticking(Component):
    def __init__(self, node):
        self.context = node.context
        node.create_timer(0.05, self.tick)
        self.started = False
    def health(self):
        return Health(b"\\0", "")
    def tick(self):
        if not self.started:
            self.started = True
            print("ticking", flush=True)
        if MODE == "busy":
            while True:
                time.sleep(0.01)
    def close(self):
        end = time.process_time() + 0.5 * (MODE == "slow")
        while time.process_time() < end:
            pass
        print("held while the context is", self.context.ok(), flush=True)

def factory():
    if MODE == "refusing":
        raise InputError("speed is 9, expected 0 to 1.")
    return Tested()

LIFETIME.leave(run_node(factory, n_threads=N))
"""


def ended(process: subprocess.Popen[str], number: signal.Signals, within: float) -> str:
    """Output of a process that a signal ends within a time [s], beside what this machine lets it wait."""
    with Stalls() as stalls:
        asked = time.monotonic()
        process.send_signal(number)
        output, _ = process.communicate(timeout=30.0)
        took = time.monotonic() - asked
    assert took < within + 4.0 * stalls.worst
    return output


def start(mode: str, n_threads: int = 1) -> subprocess.Popen[str]:
    script = f"MODE, N = {mode!r}, {n_threads}\n" + SCRIPT
    return subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


@pytest.mark.alone
@pytest.mark.parametrize(("number", "n_threads"), [(signal.SIGTERM, 1), (signal.SIGINT, 3)])
def test_a_signal_closes_the_node_while_it_can_still_publish(number, n_threads):
    process = start("idle", n_threads)
    assert process.stdout is not None and "ticking" in process.stdout.readline()
    output = ended(process, number, within=2.0)
    assert process.returncode == 0, output
    assert output.strip() == "held while the context is True"


@pytest.mark.alone
def test_a_callback_that_never_returns_does_not_keep_the_process():
    process = start("busy")
    assert process.stdout is not None and "ticking" in process.stdout.readline()
    output = ended(process, signal.SIGINT, within=2.2)
    assert process.returncode == 1 and "Traceback" not in output
    assert "ended by force" in output and " tick" in output


@pytest.mark.alone
def test_a_node_that_waits_for_a_busy_processor_is_not_ended_by_force():
    """It needs half a second of the processor that it has a tenth of."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        process = start("slow")
        assert process.stdout is not None and "ticking" in process.stdout.readline()
        others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(3)]
    finally:
        os.sched_setaffinity(0, before)
    try:
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=60.0)
    finally:
        for other in others:
            other.kill()
            other.wait()
    assert process.returncode == 0 and output.strip() == "held while the context is True"


def test_a_node_that_cannot_start_gives_the_reason_in_one_line():
    output, _ = (process := start("refusing")).communicate(timeout=60.0)
    assert process.returncode == 1
    assert "speed is 9, expected 0 to 1." in output and "Traceback" not in output


IMPORT_ALL = """
import importlib, os, pkgutil, signal, sys, threading
import cv2, rclpy  # their loaders set the environment; our modules must not
environment, path = dict(os.environ), list(sys.path)
handlers = {number: signal.getsignal(number) for number in signal.valid_signals()}
interval = sys.getswitchinterval()
import push_ident.nodes
importlib.import_module("push_ident.nodes.push_executor.push_executor_node")
assert "numba" not in sys.modules, "the executor loads compiled kernels, which it does not need"
names = [module.name for module in pkgutil.walk_packages(push_ident.nodes.__path__, "push_ident.nodes.")]
assert len(names) > 20, names
for name in names:
    importlib.import_module(name)
    assert not rclpy.ok(), f"{name} initialises ROS"
    assert dict(os.environ) == environment, f"{name} changes the environment"
    assert sys.path == path, f"{name} changes the path of imports"
    assert {number: signal.getsignal(number) for number in signal.valid_signals()} == handlers, f"{name} sets signal handlers"
    assert sys.getswitchinterval() == interval, f"{name} changes the switch interval"
    assert threading.active_count() == 1, f"{name} starts a thread"
assert "scipy.stats" not in sys.modules, "half a second of each start; scipy.special has the distributions"
"""


def test_nothing_happens_when_a_module_of_the_nodes_is_imported():
    done = subprocess.run([sys.executable, "-c", IMPORT_ALL, "some_node"], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


def test_an_unknown_executable_is_refused_in_one_line():
    call = [sys.executable, "-m", "push_ident.nodes", "camera_node"]
    done = subprocess.run(call, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "camera_node" in done.stderr and "perception_node" in done.stderr and "Traceback" not in done.stderr
