"""The watch over a moving arm: any fault ends the motion, and the arm is held."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.errors import PlanningError
from push_ident.pushing.motion import ArmMotion
from push_ident.pushing.ports import ArmState, Clock, ExecutionPorts
from push_ident.pushing.push import PushCode

__all__ = ["ArmWatch", "WatchLimits"]

_PERIOD: Final = 0.01
"""[s] between two checks of the moving arm."""
_LATE: Final = 0.03
"""A check so much [s] after the previous one was delayed itself."""
_SAME_CLOCK: Final = 1.0
"""The arm's stamps are on the clock of the cell when they differ by less [s]."""
_ARRIVAL: Final = 1.0
"""[s] the arm may still need after the end of the plan."""


@dataclass(frozen=True, slots=True)
class WatchLimits:
    """What a moving arm must keep to. Fields are parameters of the executor."""

    arm_timeout: float = 0.1
    """The arm is held this long after the last joint state, by wall time, at the latest [s]."""
    start_tolerance: float = 0.02
    """Largest joint distance between arm and start of the plan [rad]."""
    tracking_tolerance: float = 0.010
    """Largest distance of the tool from its planned path [m]."""
    tracking_lag: float = 0.2
    """Largest delay of the arm behind the plan [s]."""
    force_limit: float = 60.0
    """Largest horizontal force [N]."""
    wrench_timeout: float = 0.5
    """Longest time without a force measurement, where there was one at the start of the motion [s]."""

    def patience(self, timeout: float) -> float:
        """Longest silence [s] that `timeout` allows of another source: an arm that may pause for longer, as a simulated one, sets it."""
        return float(max(timeout, 2.0 * self.arm_timeout))


class _MotionClock:
    """Time since a motion began, by the stamps of the arm: the clock of the cell may lag behind them, as that of a simulation does.

    An arm whose stamps are on no known clock is timed by the receipt of its states.
    """

    def __init__(self, last: ArmState, clock: Clock) -> None:
        """`last`: the arm's state when the motion was sent."""
        now = clock.now()
        self._by_stamp = abs(last.stamp - now) < _SAME_CLOCK
        self._received = clock.monotonic()
        self.started = last.stamp if self._by_stamp else now
        """[s] on the clock of the cell."""

    def at(self, state: ArmState) -> float:
        """When a state was [s]."""
        return state.stamp - self.started if self._by_stamp else state.received - self._received


class ArmWatch:
    """Starts motions and supervises them until they have ended, or something is wrong."""

    def __init__(self, ports: ExecutionPorts) -> None:
        self._arm, self._hand, self._force, self._recorder = ports.arm, ports.hand, ports.force, ports.recorder
        self._clock = ports.clock
        self.peak_force = 0.0
        """Largest horizontal force of the last motion [N]."""

    def check_ready(self) -> None:
        """Raise PlanningError when no motion may begin: RECORDING, HAND, BUSY."""
        self._check_equipment()
        if rivals := self._arm.rivals():
            raise PlanningError(PushCode.BUSY, f"{', '.join(rivals)} commands the arm as well; only one node may publish joint_trajectory.")

    def run(
        self,
        motion: ArmMotion,
        limits: WatchLimits,
        *,
        replan: Callable[[np.ndarray], ArmMotion],
        check_wanted: Callable[[], None],
        on_start: Callable[[ArmMotion, float], None],
        on_look: Callable[[float, ArmState], None],
    ) -> None:
        """Make one motion.

        Args:
            motion: what was planned.
            limits: that it must keep to.
            replan: plans it once more from the posture [rad], if the arm was moved since.
            check_wanted: raises PlanningError when the motion should end.
            on_start: called with the motion that was sent, and when [s].
            on_look: called at each check with the time since the start [s] and the arm's state; may raise PlanningError, which ends the
                motion.

        Raises:
            PlanningError: nothing moved, or the arm is held: TRACKING, ARM_SILENT, FORCE, HAND, RECORDING, and those of the arguments.
        """
        for attempt in range(2):
            command = self._arm.prepare(motion)
            q = self._arm.next_state(limits.arm_timeout).q
            distance = float(np.max(np.abs(q - motion.trajectory.position[0])))
            check_wanted()
            if distance <= limits.start_tolerance:
                clock = _MotionClock(self._arm.send(command), self._clock)
                on_start(motion, clock.started)
                return self._follow(motion, clock, limits, check_wanted, on_look)
            if attempt == 0:
                motion = replan(q)
        raise PlanningError(
            PushCode.TRACKING,
            f"the arm moves by itself: it is {distance:.3f} rad from the start of the plan, limit {limits.start_tolerance:.3f} rad.",
        )

    def _follow(
        self,
        motion: ArmMotion,
        clock: _MotionClock,
        limits: WatchLimits,
        check_wanted: Callable[[], None],
        on_look: Callable[[float, ArmState], None],
    ) -> None:
        is_measured = self._force.silence <= limits.patience(limits.wrench_timeout)
        self.peak_force, _ = 0.0, self._force.take_peak()
        looked = self._clock.monotonic()
        try:
            while True:
                self._clock.sleep(_PERIOD)
                now, before = self._clock.monotonic(), looked
                looked = now
                check_wanted()
                state = self._arm.fresh_state(limits.arm_timeout, is_late=now - before > _LATE)
                elapsed = clock.at(state)
                self._check_tracking(motion, state, elapsed, limits)
                self._check_force(is_measured, limits)
                self._check_equipment()
                on_look(elapsed, state)
                arrived = np.max(np.abs(state.q - motion.trajectory.position[-1])) <= limits.start_tolerance
                if elapsed >= motion.duration and arrived:
                    return
        except BaseException as fault:
            # A silent arm is best held where it was sent; one that still reports, where it is.
            silent = isinstance(fault, PlanningError) and fault.code == PushCode.ARM_SILENT
            planned = motion.trajectory.at(self._clock.now() - clock.started)
            latest = self._arm.state
            self._arm.hold(planned if silent or latest is None else latest.q)
            raise

    def _check_tracking(self, motion: ArmMotion, state: ArmState, elapsed: float, limits: WatchLimits) -> None:
        if elapsed < -limits.arm_timeout:
            raise PlanningError(PushCode.TRACKING, f"time jumped back by {-elapsed:.2f} s during the motion.")
        deviation, limit = motion.deviation(state.pose_tip_in_table[:3, 3], elapsed, limits.tracking_lag), limits.tracking_tolerance
        if deviation > limit:
            raise PlanningError(
                PushCode.TRACKING,
                f"the tool is {1e3 * deviation:.1f} mm from its path after {elapsed:.2f} s, limit {1e3 * limit:.1f} mm.",
            )
        if elapsed > motion.duration + _ARRIVAL:
            raise PlanningError(PushCode.TRACKING, f"the arm did not arrive within {_ARRIVAL:.1f} s after the end of the plan.")

    def _check_force(self, is_measured: bool, limits: WatchLimits) -> None:
        peak = self._force.take_peak()
        self.peak_force = max(self.peak_force, peak)
        if peak > limits.force_limit:
            raise PlanningError(
                PushCode.FORCE, f"pusher/wrench reports {peak:.1f} N, limit {limits.force_limit:.1f} N; is something in the way?"
            )
        silence, limit = self._force.silence, limits.patience(limits.wrench_timeout)
        if is_measured and silence > limit:
            raise PlanningError(PushCode.FORCE, f"no message on pusher/wrench for {silence:.2f} s, limit {limit:.2f} s.")

    def _check_equipment(self) -> None:
        if reason := self._recorder.fault:
            raise PlanningError(PushCode.RECORDING, f"the recording has failed: {reason}")
        if reason := self._hand.why_no_fist():
            raise PlanningError(PushCode.HAND, reason)
