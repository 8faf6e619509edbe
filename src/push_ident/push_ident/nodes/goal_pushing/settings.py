"""What the node of goals decides on that is no parameter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

__all__ = ["GOAL_PUSHING", "GoalPushingSettings"]


@dataclass(frozen=True, slots=True)
class GoalPushingSettings:
    """Times are wall time."""

    executor_discovery: float = 5.0
    """For the executor to be there and to discover this node [s]; one that runs answers within milliseconds."""
    executor_answer: float = 10.0
    """For the executor to accept a push that was sent [s]."""
    n_records: int = 16
    """Latest push records that are remembered."""
    look_period: float = 0.01
    """Between two looks whether the previous goal has ended [s]; see `planning.goal_session`."""
    hold_wait: float = 0.9
    """For the arm to hold when the node is deactivated [s]; a component may take a second."""
    pose_poll: float = 0.002
    """Between two looks for a pose during a steered push [s]: a tenth of what a correction takes."""
    correction_budget: float = 0.02
    """After so long nothing begins any more that makes a correction better [s]: with what is under way then, and where others use the cores
    as well, it still comes before the next of 30 frames a second. On free cores all of it takes less."""
    n_correction_times: int = 2000
    """Latest times of corrections that are kept: over a minute."""
    n_planners: int = 4
    """Objects whose planner of goals is kept: each holds a library of some 3 MB."""
    n_path_planners: int = 2
    """The same of paths."""


GOAL_PUSHING: Final = GoalPushingSettings()
