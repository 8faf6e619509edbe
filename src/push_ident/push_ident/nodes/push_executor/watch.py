"""The watch over a moving arm: whatever goes wrong ends the motion, and the arm is held."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from push_ident.errors import PlanningError
from push_ident.nodes.convert import stamp_from_msg
from push_ident.nodes.push_executor.arm_port import ArmPort, ArmState
from push_ident.nodes.push_executor.force_port import ForcePort
from push_ident.nodes.push_executor.hand_port import HandPort
from push_ident.nodes.recording_port import RecordingPort
from push_ident.pushing.motion import ArmMotion
from push_ident.pushing.push import PushCode

__all__ = ["ArmWatch", "patience"]

_PERIOD: Final = 0.01
"""[s] between two looks at the moving arm."""
_LATE: Final = 0.03
"""A look that comes so much [s] after the last one was held up itself."""
_SAME_CLOCK: Final = 1.0
"""The arm's stamps are on the node's clock when they differ by less [s]."""
_ARRIVAL: Final = 1.0
"""[s] the arm may still need after the end of the plan."""


def patience(values: dict[str, Any], name: str) -> float:
    """Longest silence [s] that the parameter `name` allows: where the arm may pause for longer, as a simulated one, all may."""
    return float(max(values[name], 2.0 * values["arm_timeout"]))


class _MotionClock:
    """Time since a motion began, by the stamps of the arm: the node's clock may lag behind them, as that of a simulation does.

    An arm whose stamps have nothing to do with the node's clock is timed by the receipt of its states.
    """

    def __init__(self, last: ArmState, now: float) -> None:
        """`last`: the arm's state when the motion was sent, at `now` [s] of the node's clock."""
        stamp = stamp_from_msg(last.stamp)
        self._by_stamp = abs(stamp - now) < _SAME_CLOCK
        self._received = time.monotonic()
        self.started = stamp if self._by_stamp else now
        """[s] on the node's clock."""

    def at(self, state: ArmState) -> float:
        """When a state was [s]."""
        return stamp_from_msg(state.stamp) - self.started if self._by_stamp else state.received - self._received


class ArmWatch:
    """Starts motions and stays with them until they have ended, or something is wrong."""

    def __init__(self, arm: ArmPort, hand: HandPort, force: ForcePort, recording: RecordingPort, now: Callable[[], float]) -> None:
        """`now`: time of the node's clock [s]."""
        self._arm, self._hand, self._force, self._recording, self._now = arm, hand, force, recording, now
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
        values: dict[str, Any],
        *,
        replan: Callable[[np.ndarray], ArmMotion],
        check_wanted: Callable[[], None],
        on_start: Callable[[ArmMotion, float], None],
        on_look: Callable[[float, ArmState], None],
    ) -> None:
        """Make one motion.

        Args:
            motion: What was planned.
            values: Parameters of the node.
            replan: Plans it once more from the posture [rad], if the arm was moved since.
            check_wanted: Raises PlanningError when the motion should end.
            on_start: Told the motion that was sent and when [s].
            on_look: Told at each look the time since the start [s] and the arm's state; may raise PlanningError, which ends the motion.

        Raises:
            PlanningError: Nothing moved, or the arm is held: TRACKING, ARM_SILENT, FORCE, HAND, RECORDING, and those of the arguments.
        """
        for attempt in range(2):
            command = self._arm.prepare(motion)
            q = self._arm.next_state(values["arm_timeout"]).q
            off = float(np.max(np.abs(q - motion.trajectory.position[0])))
            check_wanted()
            if off <= values["start_tolerance"]:
                clock = _MotionClock(self._arm.send(command), self._now())
                on_start(motion, clock.started)
                return self._follow(motion, clock, values, check_wanted, on_look)
            if attempt == 0:
                motion = replan(q)
        raise PlanningError(
            PushCode.TRACKING,
            f"the arm moves by itself: {off:.3f} rad off the start of the plan, limit {values['start_tolerance']:.3f} rad.",
        )

    def _follow(
        self,
        motion: ArmMotion,
        clock: _MotionClock,
        values: dict[str, Any],
        check_wanted: Callable[[], None],
        on_look: Callable[[float, ArmState], None],
    ) -> None:
        feels = self._force.silence <= patience(values, "wrench_timeout")
        self.peak_force, _ = 0.0, self._force.take_peak()
        looked = time.monotonic()
        try:
            while True:
                time.sleep(_PERIOD)
                now, before = time.monotonic(), looked
                looked = now
                check_wanted()
                state = self._arm.fresh_state(values["arm_timeout"], is_late=now - before > _LATE)
                elapsed = clock.at(state)
                self._check_tracking(motion, state, elapsed, values)
                self._check_force(feels, values)
                self._check_equipment()
                on_look(elapsed, state)
                arrived = np.max(np.abs(state.q - motion.trajectory.position[-1])) <= values["start_tolerance"]
                if elapsed >= motion.duration and arrived:
                    return
        except BaseException as fault:
            # A silent arm is best held where it was sent; one that speaks, where it is.
            silent = isinstance(fault, PlanningError) and fault.code == PushCode.ARM_SILENT
            planned = motion.trajectory.at(self._now() - clock.started)
            self._arm.hold(planned if silent or self._arm.state is None else self._arm.state.q)
            raise

    def _check_tracking(self, motion: ArmMotion, state: ArmState, elapsed: float, values: dict[str, Any]) -> None:
        if elapsed < -values["arm_timeout"]:
            raise PlanningError(PushCode.TRACKING, f"time jumped back by {-elapsed:.2f} s during the motion.")
        off, limit = motion.deviation(state.pose_tip_in_table[:3, 3], elapsed, values["tracking_lag"]), values["tracking_tolerance"]
        if off > limit:
            raise PlanningError(
                PushCode.TRACKING, f"the tool is {1e3 * off:.1f} mm off its way after {elapsed:.2f} s, limit {1e3 * limit:.1f} mm."
            )
        if elapsed > motion.duration + _ARRIVAL:
            raise PlanningError(PushCode.TRACKING, f"the arm did not arrive within {_ARRIVAL:.1f} s after the end of the plan.")

    def _check_force(self, feels: bool, values: dict[str, Any]) -> None:
        peak = self._force.take_peak()
        self.peak_force = max(self.peak_force, peak)
        if peak > values["force_limit"]:
            raise PlanningError(
                PushCode.FORCE, f"pusher/wrench says {peak:.1f} N, limit {values['force_limit']:.1f} N; is something in the way?"
            )
        if feels and self._force.silence > patience(values, "wrench_timeout"):
            raise PlanningError(
                PushCode.FORCE,
                f"pusher/wrench fell silent for {self._force.silence:.2f} s, limit {patience(values, 'wrench_timeout'):.2f} s.",
            )

    def _check_equipment(self) -> None:
        if reason := self._recording.fault:
            raise PlanningError(PushCode.RECORDING, f"the recording has failed: {reason}")
        if reason := self._hand.why_no_fist():
            raise PlanningError(PushCode.HAND, reason)
