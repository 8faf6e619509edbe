"""An image older than the latest one: of a source that starts again, or of a second camera driver."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from push_ident.errors import PerceptionError
from push_ident.nodes.perception.parameters import IMAGE_TIMES

__all__ = ["OlderImages"]


class OlderImages:
    """Whether time went back, as when a bag starts again.

    Args:
        publishers: number of nodes that publish the images now.
        clock: receive time [s].
    """

    def __init__(self, publishers: Callable[[], int], clock: Callable[[], float] = time.monotonic) -> None:
        self._publishers, self._clock = publishers, clock
        self._several_at = -math.inf

    def check(self, age: float) -> None:
        """Raise PerceptionError for an image `age` [s] older than the latest, where several nodes publish images or have just done so."""
        n = self._publishers()
        if n > 1:
            self._several_at = self._clock()
            raise PerceptionError(f"{n} nodes publish images, and this one is {age:.3f} s older than the latest; stop all but one")
        if self._clock() - self._several_at < IMAGE_TIMES.queued:
            raise PerceptionError(f"this image is {age:.3f} s older than the latest: of a node that has just stopped")
