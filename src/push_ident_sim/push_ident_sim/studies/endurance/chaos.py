"""Faults at random moments: nodes killed, or stopped for a while."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from push_ident.cli.supervisor import Supervisor
from push_ident_sim.studies.common.base import Json

__all__ = ["PERIOD", "Chaos"]

PERIOD: Final = 120.0
"""One fault in each period, at a random moment of it [s]."""
_STOPS: Final = 0.25
"""Share of faults that stop a node instead of killing it."""
_STOPPED: Final = (0.5, 5.0)
"""For how long a node is stopped [s]."""


class Chaos:
    """Kills and stops the processes of a supervisor, drawn from a seed.

    Args:
        supervisor: of the nodes; it starts them again.
        names: nodes to choose from.
        seed: of moments, nodes and faults.
        until: time after the start without further faults [s], so that all can settle.
    """

    def __init__(self, supervisor: Supervisor, names: Sequence[str], seed: int, until: float) -> None:
        self._supervisor, self._names, self._until = supervisor, tuple(names), until
        self._rng = random.Random(seed)
        self._began = time.monotonic()
        self._number = 0
        self._next = self._moment()
        self._stopped: tuple[int, float] | None = None
        self.faults: list[Json] = []
        """`time_s`, `node`, `fault` (killed or stopped), `stopped_s`."""

    def _moment(self) -> float:
        return (self._number + self._rng.random()) * PERIOD

    def tend(self) -> Json | None:
        """To be called often; the fault that it has just made, if any."""
        now = time.monotonic()
        if self._stopped is not None and now >= self._stopped[1]:
            self.release()
        elapsed = now - self._began
        if elapsed < self._next or elapsed > self._until or self._stopped is not None:
            return None
        self._number += 1
        self._next = self._moment()
        name = self._rng.choice(self._names)
        stops, seconds = self._rng.random() < _STOPS, self._rng.uniform(*_STOPPED)
        pid = self._supervisor.pid(name)
        fault: Json = {"time_s": elapsed, "node": name, "fault": "stopped" if stops else "killed", "stopped_s": seconds if stops else 0.0}
        try:
            os.kill(pid, signal.SIGSTOP if stops else signal.SIGKILL)
        except ProcessLookupError:
            return None  # it is between two lives
        if stops:
            self._stopped = pid, now + seconds
        self.faults.append(fault)
        return fault

    def release(self) -> None:
        """Let a stopped node go on."""
        if self._stopped is not None:
            with suppress(ProcessLookupError):
                os.kill(self._stopped[0], signal.SIGCONT)
            self._stopped = None
