"""Waiting for somebody to listen, where the first messages count."""

from __future__ import annotations

import time
from typing import Final

from rclpy.publisher import Publisher

__all__ = ["await_listener"]

_LONGEST: Final = 10.0
"""Longest wait for a listener [s]; nodes look for new objects once a second."""
_POLL: Final = 0.02


def await_listener(publisher: Publisher) -> None:
    """Wait until a publisher has a subscription, at most 10 s of wall time."""
    deadline = time.monotonic() + _LONGEST
    while publisher.get_subscription_count() == 0 and time.monotonic() < deadline:
        time.sleep(_POLL)
