"""One message with a wrong stamp must not make a node believe that time has jumped."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

from push_ident.errors import InputError
from push_ident.nodes.base.settings import NODE

__all__ = ["StampCheck"]


@dataclass(slots=True)
class _Stream:
    latest: float | None = None
    received: float = 0.0
    suspect: float = 0.0
    n_suspects: int = 0


class StampCheck:
    """Knows the stamps of the topics of one node, and refuses one that is far from all of them."""

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
