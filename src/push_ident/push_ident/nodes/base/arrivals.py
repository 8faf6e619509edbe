"""Messages that a topic carried and this node did not process: a full queue drops the oldest ones without a word.

Each message comes with its number of publication. A gap in these numbers is what was lost, in the queue or on the way; the time of
publication shows how long a message has waited.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from push_ident.nodes.base.settings import NODE

__all__ = ["Arrivals"]


class Arrivals:
    """Of one subscription.

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
