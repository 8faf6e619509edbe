"""Takeover of an arm before a motion: a test, within its joint limits, of whether it stands where its states say."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from push_ident.errors import PlanningError
from push_ident.pushing.arm_motion import ArmMotion
from push_ident.pushing.command_link import Commanded
from push_ident.pushing.joint_limits import JointLimits
from push_ident.pushing.pacing import SPLICE
from push_ident.pushing.ports import Arm, ArmState, Clock
from push_ident.pushing.push import PushCode
from push_ident.pushing.trajectory import SAMPLE_PERIOD, JointTrajectory
from push_ident.pushing.watch_limits import WatchLimits
from push_ident.types import Float64Array

__all__ = ["TakeOver", "joint_distance", "stand_at"]


class TakeOver:
    """Brings the arm to where a motion begins.

    An arm that is commanded to its measured posture does not move. If its states change all the same, they are wrong, and no command is
    known to hold the arm: nothing more is sent, and no motion begins until the states agree with the command, or an operator confirms.
    """

    def __init__(self, arm: Arm, clock: Clock, commanded: Commanded) -> None:
        self._arm, self._clock, self._commanded = arm, clock, commanded
        self._contradiction, self._commanded_then = "", np.zeros(0)

    def check(self, limits: WatchLimits) -> None:
        """Raise PlanningError TRACKING while states contradict the last command."""
        if not self._contradiction:
            return
        q = self._arm.next_state(limits.arm_timeout).q
        if q.shape != self._commanded_then.shape or joint_distance(q, self._commanded_then) > limits.start_tolerance:
            raise PlanningError(PushCode.TRACKING, self._contradiction)
        self._contradiction = ""

    def trust(self) -> None:
        """Accept the states again."""
        self._contradiction = ""

    def at(self, motion: ArmMotion, limits: WatchLimits, check_wanted: Callable[[], None]) -> ArmState:
        """Command the arm to the start of `motion`; its state then. Nothing is sent if it stands there by its last command.

        Raises:
            PlanningError: TRACKING where its states contradict the command, and those of `check_wanted`.
        """
        joints, start = motion.limits, motion.trajectory.position[0]
        commanded, state = self._commanded.posture(joints.names), self._arm.next_state(limits.arm_timeout)
        if commanded is None:
            arrives = joints.time_to_move(joints.upper - joints.lower)
            self._stand(joints, start, arrives, limits.takeover_share * arrives, limits, check_wanted)
            unnoticed = limits.start_tolerance / (limits.takeover_share**2 * (3.0 - 2.0 * limits.takeover_share))
            arrives = joints.time_to_move(np.full(len(start), unnoticed))
        else:
            # The last command has ended, whatever clock it was timed by.
            self._commanded.rest(joints.names, commanded)
            arrives = joints.time_to_move(np.maximum(np.abs(start - commanded), np.abs(start - state.q)))
        return self._stand(joints, start, arrives, arrives, limits, check_wanted) if arrives > SPLICE else state

    def _stand(
        self, joints: JointLimits, q: Float64Array, arrives: float, watched: float, limits: WatchLimits, check_wanted: Callable[[], None]
    ) -> ArmState:
        """Command the arm to `q` [rad], its measured posture, to arrive after `arrives` [s]; its state after `watched` [s]."""
        before = joint_distance(self._arm.next_state(limits.arm_timeout).q, q)
        self._arm.take_states()
        self._arm.send(joints.names, stand_at(q, arrives), None)
        self._commanded.forget()
        sent = self._clock.monotonic()
        while True:
            self._clock.sleep(limits.period)
            check_wanted()
            state = self._arm.fresh_state(limits.arm_timeout)
            farthest = max((joint_distance(s.q, q) for s in self._arm.take_states()), default=0.0)
            why = self._arm.impossible_state(sent)
            if farthest > before + limits.start_tolerance:
                why = why or f"by them it moved {farthest:.3f} rad away."
            if why:
                self._contradiction = (
                    f"joint_states are not believed: the arm was told to stand where they said that it stands, and {why} "
                    "Check its driver, then deactivate and activate the executor."
                )
                self._commanded_then = q
                raise PlanningError(PushCode.TRACKING, self._contradiction)
            if self._clock.monotonic() - sent >= watched:
                self._commanded.rest(joints.names, q)
                return state


def joint_distance(q: Float64Array, other: Float64Array) -> float:
    """Largest distance of a joint between two postures [rad]."""
    return float(np.max(np.abs(q - other)))


def stand_at(q: Float64Array, arrives: float) -> JointTrajectory:
    """Be at `q` [rad] after `arrives` [s], and stay. Two points: a single one means hold."""
    return JointTrajectory(np.array([arrives, arrives + SAMPLE_PERIOD]), np.tile(q, (2, 1)), np.zeros((2, len(q))))
