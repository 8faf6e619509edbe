"""Times and limits that all nodes have in common. No ROS: a process reads them before anything else is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """Not parameters: no cell needs other values. Times are wall time."""

    report_period: float = 1.0
    """Between two messages in /diagnostics [s]."""
    log_period: float = 5.0
    """Shortest time between two log lines of the same kind about one source [s]."""
    n_sources: int = 100
    """Sources with a count of refusals, so that memory stays bounded; further ones share a count."""
    n_delays: int = 500
    """Delays of the latest messages of a topic, of which the worst is reported."""
    event_period: float = 1.0
    """Between two looks for events of publishers and subscriptions, which wait until then [s]: a QoS or a type that does not fit."""
    drain: float = 1.0
    """Longest wait for callbacks of a component to end before it is closed [s]; `pause` has asked them to."""
    answer_delay: float = 0.1
    """For answers under way, before what sends them is withdrawn [s]."""
    max_stamp_gap: float = 60.0
    """Stamps of one cell lie closer together than this [s]: topics of a bag that is played fast may be seconds apart."""
    n_confirming: int = 3
    """Messages of one topic in a row that agree on another time: time was set, or another bag is played."""
    niceness: int = 5
    """Of nodes that do not move the arm: a third of the processor time of one at 0, where both want it (each step counts 1.25 in Linux)."""
    spin_wait: float = 0.05
    """Between two checks of the request to stop [s]; limits the delay of a stop while no message arrives."""
    worker_start: float = 3e-4
    """For a worker thread to begin its callback [s]."""
    stop_within: float = 1.8
    """Longest time from a request to stop to the end of the process [s]; 2 s are promised."""
    listener_wait: float = 10.0
    """Longest wait for a subscription where the first messages count [s]; nodes look for new objects once a second."""


NODE: Final = NodeSettings()
