"""A process of a cell: started as the supervisor starts it, signalled, killed and started again, with what it wrote."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from functools import cache
from pathlib import Path

from push_ident.cli.supervisor import NodeCommand
from push_ident.files import open_log
from push_ident.nodes.base.lifetime import LIFELINE, stop_signals_blocked

TRACEBACK = "Traceback (most recent call last)"


@cache
def lifeline() -> tuple[int, int]:
    """Both ends of a pipe that ends with this process, and its children with it, however it ends."""
    return os.pipe()


def set_priority(pid: int, niceness: int) -> None:
    """Of all threads of a process, as far as this one has the right to: a cell goes before other work, as on the computer of a robot."""
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            os.setpriority(os.PRIO_PROCESS, int(task.name), niceness)
        # Linux schedules sessions against each other first: niceness alone counts only within one.
        Path(f"/proc/{pid}/autogroup").write_text(str(niceness), encoding="ascii")


class Process:
    """One process in a session of its own; its output goes to the end of a file."""

    def __init__(self, command: NodeCommand, log: Path, domain: int) -> None:
        self.command, self._log, self._domain = command, log, domain
        self._popen: subprocess.Popen[bytes] | None = None
        self.start()

    @property
    def pid(self) -> int:
        assert self._popen is not None
        return self._popen.pid

    @property
    def runs(self) -> bool:
        return self._popen is not None and self._popen.poll() is None

    @property
    def output(self) -> str:
        """All that it wrote, also before it was started again."""
        return self._log.read_text(encoding="utf-8", errors="replace") if self._log.exists() else ""

    def start(self) -> None:
        if self.runs:
            return
        environment = os.environ | {"PYTHONUNBUFFERED": "1", LIFELINE: str(lifeline()[0]), "ROS_DOMAIN_ID": str(self._domain)}
        with open_log(self._log) as file, stop_signals_blocked() if self.command.is_node else contextlib.nullcontext():
            self._popen = subprocess.Popen(
                self.command.argv,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
                pass_fds=(lifeline()[0],),
            )
        set_priority(self.pid, os.getpriority(os.PRIO_PROCESS, 0))

    def signal(self, number: signal.Signals) -> float:
        if self.runs:
            os.kill(self.pid, number)
        return time.monotonic()

    def kill(self) -> float:
        now = time.monotonic()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        self.wait(10.0)
        return now

    def wait(self, patience: float) -> int | None:
        assert self._popen is not None
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self._popen.wait(patience)
        return None

    def interrupt(self, patience: float = 5.0) -> int | None:
        """Ctrl-C; the exit code, None where it had to be killed after `patience` [s]."""
        self.signal(signal.SIGINT)
        code = self.wait(patience)
        if code is None:
            self.kill()
        return code
