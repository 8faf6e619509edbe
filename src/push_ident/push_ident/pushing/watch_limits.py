"""What a moving arm must keep to."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["WatchLimits"]


@dataclass(frozen=True, slots=True)
class WatchLimits:
    """What a moving arm must keep to. Fields are parameters of the executor."""

    arm_timeout: float = 0.1
    """The arm is held this long after the last joint state, by wall time, at the latest [s]."""
    start_tolerance: float = 0.02
    """Largest distance of a joint from where it was told to be, at the start of a motion and during it [rad]."""
    tracking_tolerance: float = 0.010
    """Largest distance of the tool from its planned path [m]."""
    tracking_lag: float = 0.2
    """Largest delay of the arm behind the plan [s]."""
    force_limit: float = 60.0
    """Largest horizontal force [N]."""
    motion_horizon: float = 0.08
    """Motion at the planned speed that the arm is given ahead [s]: without news it brakes after that."""
    stamp_commands: bool = False
    """Whether pieces say when they start by the clock of the arm's stamps; else they start on receipt, and transport adds its jitter."""
    wrench_timeout: float = 0.5
    """Longest time without a force measurement, where there ever was one [s]."""

    def patience(self, timeout: float) -> float:
        """Longest silence [s] that `timeout` allows of another source: an arm that may pause for longer, as a simulated one, sets it."""
        return float(max(timeout, 2.0 * self.arm_timeout))
