"""Hypothesis strategies for what comes from outside: messages, bags, depth frames. `make fuzz` tries many times as many examples."""

from __future__ import annotations

import os
from collections.abc import Callable

from hypothesis import HealthCheck, Phase, settings

USUAL = 6.0
"""All tests with the marker `fuzz` take so long with their usual numbers of examples, on two cores [min]."""
MINUTES = float(os.environ.get("FUZZ_MINUTES", "0"))
"""With it they take about so long, and have other examples each time."""


def fuzzed(examples: int, *, shrink: bool = True) -> Callable[[Callable[..., object]], settings]:
    """Settings of a test with so many examples; `shrink`: whether a failure can be repeated, and is made smaller."""
    return settings(
        max_examples=int(examples * max(MINUTES / USUAL, 1.0)),
        derandomize=not MINUTES,
        database=None,
        print_blob=True,
        deadline=None,
        phases=[phase for phase in Phase if shrink or phase is not Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
