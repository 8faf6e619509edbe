"""A process of the suite: started, signalled, killed and started again, with what it wrote."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Final

from push_ident.cli.supervisor import NodeCommand
from push_ident.files import open_log
from push_ident.nodes.base.lifetime import LIFELINE, stop_signals_blocked
from push_ident_sim.faults.harness.priority import as_urgent_as_this_one

__all__ = ["TRACEBACK", "Process"]

TRACEBACK: Final = "Traceback (most recent call last)"


@cache
def _lifeline() -> tuple[int, int]:
    """Both ends of a pipe that ends with this process, and its children with it, however it ends."""
    return os.pipe()


class Process:
    """One process in a group of its own.

    Args:
        command: what to run.
        log: file that it appends to.
        environment: variables beside those of this process.
    """

    def __init__(self, command: NodeCommand, log: Path, environment: Mapping[str, str]) -> None:
        self.command, self.log, self._environment = command, log, dict(environment)
        self._popen: subprocess.Popen[bytes] | None = None
        self.start()

    @property
    def name(self) -> str:
        """Of the command."""
        return self.command.name

    @property
    def pid(self) -> int:
        """Of the process that runs now, or ran last."""
        assert self._popen is not None
        return self._popen.pid

    @property
    def runs(self) -> bool:
        """Whether it runs."""
        return self._popen is not None and self._popen.poll() is None

    @property
    def output(self) -> str:
        """All that it wrote, also before it was started again."""
        return self.log.read_text(encoding="utf-8", errors="replace") if self.log.exists() else ""

    def start(self) -> None:
        """Start it, where it does not run."""
        if self.runs:
            return
        environment = os.environ | {"PYTHONUNBUFFERED": "1", LIFELINE: str(_lifeline()[0])} | self._environment
        # As the supervisor starts it.
        quiet = stop_signals_blocked() if self.command.is_node else contextlib.nullcontext()
        with open_log(self.log) as file, quiet:
            self._popen = subprocess.Popen(
                self.command.argv,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
                pass_fds=(_lifeline()[0],),
            )
        as_urgent_as_this_one(self._popen.pid)

    def signal(self, number: signal.Signals) -> float:
        """Send a signal to the process alone; the time [s]."""
        if self.runs:
            os.kill(self.pid, number)
        return time.monotonic()

    def kill(self) -> float:
        """SIGKILL to it and its children; the time [s]."""
        now = time.monotonic()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        assert self._popen is not None
        self._popen.wait()
        return now

    def wait(self, patience: float) -> int | None:
        """Exit code; None where it still runs after `patience` [s]."""
        assert self._popen is not None
        try:
            return int(self._popen.wait(patience))
        except subprocess.TimeoutExpired:
            return None

    def interrupt(self, patience: float = 5.0) -> tuple[int | None, float]:
        """Ctrl-C: exit code (None: killed after `patience` [s]) and time to the end [s]."""
        asked = self.signal(signal.SIGINT)
        code = self.wait(patience)
        took = time.monotonic() - asked
        if code is None:
            self.kill()
        return code, took
