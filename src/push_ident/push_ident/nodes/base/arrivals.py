"""What arrives: messages that a full queue dropped without a word, and stamps that cannot be."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from push_ident.errors import InputError
from push_ident.nodes.base.settings import NODE


class Arrivals:
    """Messages of one subscription that its topic carried and this node did not process.

    Each message comes with its number of publication. A gap in these numbers is what was lost, in the queue or on the way; the time of
    publication shows how long a message has waited.

    Args:
        publishers: number of publishers of the topic now. Of several, the numbers mix, and no loss can be known.
    """

    def __init__(self, publishers: Callable[[], int]) -> None:
        self._publishers = publishers
        self._lock = threading.Lock()
        self._number = 0
        self._delays: deque[float] = deque(maxlen=NODE.n_delays)
        self._reported = (0, 0)
        self.n_lost = 0
        """Messages lost so far."""
        self.n_taken = 0
        """Messages that reached the callback so far."""

    def note(self, info: Mapping[str, Any]) -> None:
        """Take in what rclpy knows of a message: `publication_sequence_number`, and `source_timestamp` [ns]."""
        number, sent = info.get("publication_sequence_number"), info.get("source_timestamp")
        with self._lock:
            self.n_taken += 1
            if sent:
                self._delays.append(max(0.0, 1e-9 * (time.time_ns() - int(sent))))
            if number is None:
                return
            missing = int(number) - self._number - 1
            # A smaller number, or a first one, is another publisher, or the same one after it was started again.
            if self._number and missing > 0 and self._publishers() == 1:
                self.n_lost += missing
            self._number = int(number)

    def since_last(self) -> tuple[int, int, float]:
        """Messages lost and taken since the last call, and the longest delay from publication to callback in that time [s]."""
        with self._lock:
            lost, taken = self.n_lost - self._reported[0], self.n_taken - self._reported[1]
            self._reported = (self.n_lost, self.n_taken)
            worst = float(np.max(self._delays)) if self._delays else 0.0
            self._delays.clear()
            return lost, taken, worst


@dataclass(slots=True)
class _Stream:
    latest: float | None = None
    received: float = 0.0
    suspect: float = 0.0
    n_suspects: int = 0


class StampCheck:
    """Knows the stamps of the topics of one node, and refuses one that is far from all of them.

    One message with a wrong stamp must not make a node believe that time has jumped.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._streams: dict[str, _Stream] = {}

    def check(self, topic: str, stamp: float) -> None:
        """Raise InputError for a stamp [s] that is over 60 s away from the latest ones, unless others on its topic confirm it.

        Stamps may be ahead by the time that has passed since, as after a pause of the cell.
        """
        now = time.monotonic()
        with self._lock:
            stream = self._streams.setdefault(topic, _Stream())
            known = [(s.latest, now - s.received) for s in self._streams.values() if s.latest is not None]
            if known and not any(-NODE.max_stamp_gap <= stamp - latest <= passed + NODE.max_stamp_gap for latest, passed in known):
                follows = stream.n_suspects and abs(stamp - stream.suspect) <= NODE.max_stamp_gap
                stream.n_suspects = stream.n_suspects + 1 if follows else 1
                stream.suspect = stamp
                if stream.n_suspects < NODE.n_confirming:
                    latest = min((latest for latest, _ in known), key=lambda latest: abs(stamp - latest))
                    raise InputError(
                        f"its stamp {stamp:.3f} s is {stamp - latest:+.3g} s from those of other messages, expected up to "
                        f"{NODE.max_stamp_gap:.0f} s; check the clock of its source."
                    )
            stream.latest, stream.received, stream.n_suspects = stamp, now, 0
