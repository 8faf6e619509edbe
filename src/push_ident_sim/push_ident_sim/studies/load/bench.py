"""Nodes under load: the processes, their processor time, their memory, and what they report."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from rclpy.qos import QoSProfile

from push_ident.cli.supervisor import NodeCommand, node_commands
from push_ident.errors import PushIdentError
from push_ident_sim.faults.harness.monitor import Monitor, Reported, until
from push_ident_sim.faults.harness.process import Process
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.live_nodes import processor_time, resident_memory

__all__ = ["Bench", "bench", "delays", "source_of"]

_READY: Final = 30.0
"""Longest wait for a process [s]."""
SLOW_WRITE: Final = 0.4
"""Time that the slow disk adds to each write [s]; the bag is written in chunks of about 1 MB."""


def source_of(kind: str, rates: Sequence[float], n: int) -> NodeCommand:
    """The process that publishes load, at the first rate [Hz]; SIGUSR1 goes on to the next."""
    text = ",".join(map(str, rates))
    return NodeCommand(f"{kind}_source", (sys.executable, "-m", "push_ident_sim.studies.load.sources", kind, text, str(n)))


def slow_disk(command: NodeCommand, bag: Path) -> NodeCommand:
    """The same process with a kernel that delays its writes to the bag: strace injects the delay into the system call itself."""
    strace = ("strace", "-f", "--seccomp-bpf", "-qq", "-o", "/dev/null", "-e", "trace=write", "-P", str(bag / f"{bag.name}.mcap"))
    delayed = ("-e", f"inject=write:delay_exit={round(1e6 * SLOW_WRITE)}")
    return NodeCommand(command.name, (*strace, *delayed, *command.argv))


class Bench:
    """Processes on a ROS domain of their own, and a monitor.

    Attributes:
        monitor: what the nodes report.
        processes: by name.
    """

    def __init__(self, folder: Path, domain: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.domain = folder, domain
        self.monitor = Monitor(domain)
        self.processes: dict[str, Process] = {}

    def add(self, command: NodeCommand) -> Process:
        """Start a process."""
        log = self.folder / f"{command.name}-{len(list(self.folder.glob('*.log')))}.log"
        process = Process(command, log, {"ROS_DOMAIN_ID": str(self.domain)})
        self.processes[command.name] = process
        return process

    def add_source(self, kind: str, rates: Sequence[float], n: int) -> Process:
        """Start a process that publishes load, and wait until it does."""
        process = self.add(source_of(kind, rates, n))
        until(lambda: "ready" in process.output or not process.runs, _READY, f"{process.name} did not start")
        return process

    def end_source(self, kind: str) -> Json:
        """Stop it; what it has published."""
        process = self.processes.pop(f"{kind}_source")
        process.interrupt(patience=5.0)
        lines = [line for line in process.output.splitlines() if line.startswith("{")]
        if not lines:
            raise PushIdentError(f"{process.name} ended: {process.output[-300:]}")
        counts: Json = json.loads(lines[-1])
        return counts

    def add_node(self, name: str, parameters: dict[str, object] | None = None, *, record: Path | None = None) -> Process:
        """Start a node of the suite, as beside a real arm."""
        chosen = {c.name: c for c in node_commands("arm", record=record, parameters={name: parameters or {}}, log_level="warn")}
        return self.add(chosen[name])

    def listen(self, kind: type, topics: Sequence[str]) -> list[tuple[float, float]]:
        """Receipt and stamp of each message on some topics from now on [s, wall clock]; the list grows."""
        heard: list[tuple[float, float]] = []
        for topic in topics:
            self.monitor.node.create_subscription(
                kind, topic, lambda msg: heard.append((time.time(), _stamp_of(msg))), QoSProfile(depth=200)
            )
        return heard

    def wait_for_report(self, name: str, patience: float = _READY) -> Reported:
        """Its next status."""
        asked = time.monotonic()
        until(lambda: self.monitor.reports_of(name, asked), patience, f"{name} did not report")
        return self.monitor.reports_of(name, asked)[-1]

    def usage(self, names: Sequence[str], seconds: float) -> Json:
        """Let everything run; processor share (1: one core) and largest memory [MB] of some processes, and the longest stall here [s]."""
        self.monitor.stall = 0.0
        before, began = {name: processor_time(self.processes[name].pid) for name in names}, time.monotonic()
        memory = dict.fromkeys(names, 0.0)
        while time.monotonic() - began < seconds:
            time.sleep(0.25)
            memory = {name: max(most, resident_memory(self.processes[name].pid)) for name, most in memory.items()}
        took = time.monotonic() - began
        share = {name: (processor_time(self.processes[name].pid) - before[name]) / took for name in names}
        return {"seconds": took, "cpu": share, "memory_mb": memory, "stall_s": self.monitor.stall, "load": os.getloadavg()[0]}

    def close(self) -> None:
        """Stop all."""
        for process in self.processes.values():
            process.interrupt(patience=3.0)
        self.monitor.close()


@contextmanager
def bench(folder: Path, domain: int) -> Iterator[Bench]:
    """A bench that ends its processes."""
    made = Bench(folder, domain)
    try:
        yield made
    finally:
        made.close()


def delays(values: Sequence[float]) -> Json:
    """Median, 99 % and worst of some delays [s]; None without any."""
    if not len(values):
        return {"n": 0, "median_s": None, "p99_s": None, "worst_s": None}
    median, late, worst = (float(v) for v in np.quantile(np.asarray(values), [0.5, 0.99, 1.0]))
    return {"n": len(values), "median_s": median, "p99_s": late, "worst_s": worst}


def _stamp_of(msg: Any) -> float:
    return float(msg.header.stamp.sec + 1e-9 * msg.header.stamp.nanosec)
