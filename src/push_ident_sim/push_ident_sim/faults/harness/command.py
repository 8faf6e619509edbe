"""A command of `push-ident` run to its end, with the time and the memory that it took."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from push_ident_sim.faults.harness.process import TRACEBACK

__all__ = ["Ended", "run_command"]

_LIMIT: Final = 120.0
"""A command that runs longer is killed [s]."""


@dataclass(frozen=True, slots=True)
class Ended:
    """How a command ended."""

    code: int
    """Exit status; negative where a signal ended it."""
    output: str
    """Standard output, then standard error."""
    error: str
    seconds: float
    """Of the processor [s]: what a busy machine does not change."""
    megabytes: float
    """Largest resident memory [MB]."""

    @property
    def is_refusal(self) -> bool:
        """Whether it ended with an exit status and one line of error."""
        return self.code > 0 and len(self.error.strip().splitlines()) == 1 and TRACEBACK not in self.output


def run_command(folder: Path, *arguments: object) -> Ended:
    """Run `push-ident` with arguments; what it writes goes into files in `folder`."""
    began = time.monotonic()
    files = [folder / f"command.{name}" for name in ("out", "err")]
    with files[0].open("wb") as out, files[1].open("wb") as err:
        process = subprocess.Popen(
            [sys.executable, "-m", "push_ident.cli", *map(str, arguments)], stdout=out, stderr=err, stdin=subprocess.DEVNULL
        )
        deadline = began + _LIMIT
        while (ended := os.wait4(process.pid, os.WNOHANG))[0] == 0:
            if time.monotonic() > deadline:
                process.kill()
            time.sleep(0.02)
    process.returncode = os.waitstatus_to_exitcode(ended[1])
    output, error = (path.read_text(encoding="utf-8", errors="replace") for path in files)
    return Ended(process.returncode, output + error, error, ended[2].ru_utime + ended[2].ru_stime, ended[2].ru_maxrss / 1e3)
