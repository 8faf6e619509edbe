"""Limits that a moving arm is watched by."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["WatchLimits"]


@dataclass(frozen=True, slots=True)
class WatchLimits:
    """Limits that a moving arm is watched by. Those up to `wrench_timeout` are parameters of the executor."""

    arm_timeout: float = 0.1
    """The arm is held this long after the last joint state, by wall time, at the latest [s]."""
    start_tolerance: float = 0.02
    """Largest distance of a joint from its commanded position, at the start of a motion and during it [rad]."""
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
    period: float = 0.01
    """Time between two looks at arm, sensors and objects [s]."""
    late_look: float = 0.03
    """A look that comes so long after the previous one was delayed itself [s]."""
    max_absence: float = 0.5
    """Longest time without a look [s]: after it the motion does not go on, the cell may have changed and the path of the tool has a gap."""
    arrival_timeout: float = 1.0
    """Longest time to arrive after the end of the plan [s]."""
    pieces_per_horizon: int = 4
    """Pieces that are sent within `motion_horizon`: three may be lost or late before the arm brakes."""
    acceleration_shares: tuple[float, ...] = (1.0, 0.8, 0.6)
    """Shares of the joints' acceleration limits that are tried for a piece [1]: one cubic takes up to 1.5 times the acceleration of the two
    that it stands for."""
    standstill_lag: float = 0.001
    """Travel of the tool [m] by which an arm at rest is behind its pieces: it has missed some, and would jump to the next one."""
    standstill_travel: float = 3e-4
    """A tool that has moved less [m] within `standstill_time` is at rest, or so slow that it is behind for no other reason."""
    standstill_time: float = 0.03
    """[s]"""
    delay_margin: float = 0.03
    """Delay of the arm beyond its usual one [s]: one more state."""
    takeover_share: float = 0.125
    """Share of the time to a posture for which an arm without an earlier command is watched [1]. A cubic has made 4.3 % of its way then: an
    arm more than 23 start tolerances away has moved by more than one."""

    def patience(self, timeout: float) -> float:
        """Longest silence of another source [s]: `timeout`, or twice that of the arm where it may pause for longer, as a simulated one."""
        return float(max(timeout, 2.0 * self.arm_timeout))
