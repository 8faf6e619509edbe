"""What recorder and player of bags decide on that is no parameter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

__all__ = ["RECORDING", "RecordingSettings"]


@dataclass(frozen=True, slots=True)
class RecordingSettings:
    """Times are wall time unless stated otherwise."""

    status_period: float = 0.5
    """Between two statuses of a recorder that writes [s]."""
    n_missed: int = 4
    """Statuses that do not come until a recorder counts as stopped."""
    n_messages: int = 1000
    """Messages of a topic that may wait for the disk: 1 s at 1 kHz."""
    n_images: int = 60
    """Depth images that may wait for the disk: 2 s at 30 Hz, 37 MB at 640 x 480."""
    clock_period_ns: int = 10_000_000
    """Between two messages on /clock of a bag that is played [ns], recorded time."""
    longest_pause_ns: int = 3600 * 10**9
    """A longer recorded time without any message is not waited for [ns]: a clock was set in the middle of it, or a stamp is wrong."""
    n_ahead: int = 2
    """Depth images under way to the node that processes them."""
    image_timeout: float = 120.0
    """Longest time for one image [s]; the first one compiles, on a loaded machine for half a minute."""
    delivery_timeout: float = 120.0
    """Longest wait for listeners to take the last messages [s]."""


RECORDING: Final = RecordingSettings()
