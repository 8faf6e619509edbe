"""One process of a supervisor: in a group of its own, its lines forwarded, its life bound to that of the supervisor, and when it is started
again: after a pause that doubles from one early death to the next, and not for ever.
"""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import threading
import time
from collections import deque
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from rich.console import Console
from rich.text import Text

from push_ident.files import open_log
from push_ident.limits import printable
from push_ident.nodes.base.lifetime import LIFELINE, stop_signals_blocked

LAST_LINES: Final = 0.5
"""Longest wait for the last lines of a process that has ended [s]."""


@dataclass(frozen=True, slots=True)
class NodeCommand:
    """One process to run."""

    name: str
    argv: tuple[str, ...]
    may_end: bool = False
    """Whether it may end with exit code 0 without stopping the others, as the player of a bag does."""
    is_node: bool = False
    """Whether it is a node of this project: those start with the stop signals blocked until they can handle them."""


@dataclass(frozen=True, slots=True)
class NodeExit:
    """A process that ended unexpectedly."""

    name: str
    code: int
    """Exit code; -N if signal N ended it."""
    tail: tuple[str, ...]
    """Its last lines of standard output and error, in order."""

    @property
    def how(self) -> str:
        """Name and end in one line."""
        return self.name + (f" was ended by {signal.Signals(-self.code).name}" if self.code < 0 else f" ended with exit code {self.code}")

    def __str__(self) -> str:
        return "\n".join([self.how + ("; its last lines:" if self.tail else ""), *(f"  {line}" for line in self.tail)])


@dataclass(frozen=True, slots=True)
class RestartPolicy:
    """How often and how soon a process is started again."""

    first: float = 1.0
    """Pause before the first restart [s]: long enough for the other nodes to see it gone."""
    longest: float = 30.0
    """The pause doubles with each early death up to this [s]."""
    settled: float = 60.0
    """A death after so long a life is no early one: the count begins anew [s]."""
    attempts: int = 8
    """Early deaths in a row after which it is not started again: two minutes of trying."""


class Backoff:
    """Counts the deaths of one process."""

    def __init__(self, policy: RestartPolicy) -> None:
        self._policy = policy
        self.early = 0
        """Early deaths in a row."""

    def pause(self, lived: float) -> float | None:
        """Pause before the restart after a death [s], None where there is none any more.

        Args:
            lived: From the start of the process to its death [s].
        """
        self.early = 1 if lived >= self._policy.settled else self.early + 1
        if self.early > self._policy.attempts:
            return None
        return min(self._policy.first * 2.0 ** (self.early - 1), self._policy.longest)


class NodeProcess:
    """One process in a group of its own, with a thread that forwards its lines."""

    def __init__(self, command: NodeCommand, lifeline: int, log: Path | None, console: Console | None, prefix: Text) -> None:
        self.command = command
        self._tail: deque[str] = deque(maxlen=12)
        self._gone = False
        self._log, self._console, self._prefix = log, console, prefix
        self._started = time.monotonic()
        self._ended: float | None = None
        with stop_signals_blocked() if command.is_node else nullcontext():
            self._popen = subprocess.Popen(
                command.argv,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONUNBUFFERED": "1", LIFELINE: str(lifeline)},
                text=True,
                errors="replace",
                start_new_session=True,
                pass_fds=(lifeline,),
            )
        assert self._popen.stdout is not None
        # Room for output while this process or its terminal is stopped, beyond which the other one would wait, too.
        with suppress(OSError):  # refused where the user has many such pipes: the usual size then
            fcntl.fcntl(self._popen.stdout, fcntl.F_SETPIPE_SZ, 1 << 20)
        self._reader = threading.Thread(target=self._read, args=(self._popen.stdout,), name=f"output of {command.name}", daemon=True)
        self._reader.start()

    def _read(self, output: IO[str]) -> None:
        with output, open_log(self._log or Path(os.devnull)) as file:
            for line in output:
                self._tail.append(line.rstrip("\n"))
                file.write(line)
                file.flush()
                self._show(line.rstrip("\n"))

    def _show(self, text: str) -> None:
        if self._console is not None:
            self._console.print(Text.assemble(self._prefix, printable(text)), soft_wrap=True)

    def say(self, text: str) -> None:
        """Add a line of the supervisor to what the process has written, after its end."""
        if self._log is not None:
            with open_log(self._log) as file:
                file.write(text + "\n")
        self._show(text)

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._popen.pid

    @property
    def lived(self) -> float:
        """From its start until it was seen dead, or now [s]."""
        return (time.monotonic() if self._ended is None else self._ended) - self._started

    def poll(self) -> int | None:
        """Exit code, None while it runs."""
        code = self._popen.poll()
        if code is not None and self._ended is None:
            self._ended = time.monotonic()
        return code

    def exit(self) -> NodeExit:
        """How the process ended, after it did."""
        self._reader.join(timeout=LAST_LINES)
        return NodeExit(self.command.name, self._popen.returncode, tuple(self._tail))

    def runs(self) -> bool:
        """Whether the process or one of its children runs."""
        if not self._gone:  # afterwards the number may belong to another group
            self._gone = self._popen.poll() is not None and not _group_runs(self._popen.pid)
        return not self._gone

    def signal(self, number: signal.Signals) -> bool:
        """Send a signal to the whole group; whether it had a running process."""
        if not self.runs():
            return False
        try:
            os.killpg(self._popen.pid, number)
        except ProcessLookupError:
            return False
        return True

    def close(self) -> None:
        """Wait for the end of the process and for its last lines."""
        self._popen.wait()
        self._reader.join(timeout=LAST_LINES)


def _group_runs(group: int) -> bool:
    """Whether a process of a group runs.

    One that has ended stays in its group until its parent has asked for its exit code. That of an orphan is asked for by init: seconds
    later on some machines, never in some containers. So that the group still takes signals says nothing.
    """
    for file in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # ended meanwhile
            state, _, its_group = file.read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()[:3]
            if int(its_group) == group and state not in "ZX":
                return True
    return False
