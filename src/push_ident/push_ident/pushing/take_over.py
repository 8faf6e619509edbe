"""The moment before a motion: whether the arm stands where its states say, found out within its limits wherever it really stands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from push_ident.errors import PlanningError
from push_ident.pushing.arm_motion import ArmMotion
from push_ident.pushing.command_link import Commanded
from push_ident.pushing.joint_limits import JointLimits
from push_ident.pushing.pacing import SPLICE
from push_ident.pushing.ports import Arm, ArmState, Clock
from push_ident.pushing.push import PushCode
from push_ident.pushing.trajectory import JointTrajectory
from push_ident.pushing.watch_limits import WatchLimits
from push_ident.types import Float64Array

__all__ = ["TakeOver", "joint_distance", "stand_at"]

_PERIOD: Final = 0.01
"""[s] between two looks at the states."""
_WATCHED: Final = 0.125
"""Share of the time to a posture for which an arm is watched that was told nothing before. A cubic has made 4.3 % of its way then: an arm
more than 23 start tolerances away has moved by more than one."""


class TakeOver:
    """Brings the arm to where a motion begins.

    An arm that is told to stand where its states say that it stands does not move. Where its states move all the same, they are not true,
    and nobody knows what would hold the arm: nothing more is sent, and no motion begins until they say what the arm was told, or until
    somebody says that it may.
    """

    def __init__(self, arm: Arm, clock: Clock, commanded: Commanded) -> None:
        self._arm, self._clock, self._commanded = arm, clock, commanded
        self._lie, self._lied_to = "", np.zeros(0)

    def check(self, limits: WatchLimits) -> None:
        """Raise PlanningError TRACKING where the states were not true, and nothing shows that they are now."""
        if not self._lie:
            return
        q = self._arm.next_state(limits.arm_timeout).q
        if q.shape != self._lied_to.shape or joint_distance(q, self._lied_to) > limits.start_tolerance:
            raise PlanningError(PushCode.TRACKING, self._lie)
        self._lie = ""

    def trust(self) -> None:
        """Believe the states again."""
        self._lie = ""

    def at(self, motion: ArmMotion, limits: WatchLimits, check_wanted: Callable[[], None]) -> ArmState:
        """Let the arm stand where `motion` begins; its state then. Nothing is sent where it stands there, as it was told before.

        Raises:
            PlanningError: TRACKING where its states are not true, and those of `check_wanted`.
        """
        joints, start = motion.limits, motion.trajectory.position[0]
        told, state = self._commanded.posture(joints.names), self._arm.next_state(limits.arm_timeout)
        if told is None:
            arrives = joints.time_to_move(joints.upper - joints.lower)
            self._stand(joints, start, arrives, _WATCHED * arrives, limits, check_wanted)
            unseen = limits.start_tolerance / (_WATCHED**2 * (3.0 - 2.0 * _WATCHED))
            arrives = joints.time_to_move(np.full(len(start), unseen))
        else:
            # It has done what it was told, whatever clock that was timed by.
            self._commanded.rest(joints.names, told)
            arrives = joints.time_to_move(np.maximum(np.abs(start - told), np.abs(start - state.q)))
        return self._stand(joints, start, arrives, arrives, limits, check_wanted) if arrives > SPLICE else state

    def _stand(
        self, joints: JointLimits, q: Float64Array, arrives: float, watched: float, limits: WatchLimits, check_wanted: Callable[[], None]
    ) -> ArmState:
        """Tell the arm to be at `q` [rad] after `arrives` [s], where it is by its states, which are `watched` [s]; the last of them."""
        before = joint_distance(self._arm.next_state(limits.arm_timeout).q, q)
        self._arm.take_states()
        self._arm.send(joints.names, stand_at(q, arrives), None)
        self._commanded.forget()
        sent = self._clock.monotonic()
        while True:
            self._clock.sleep(_PERIOD)
            check_wanted()
            state = self._arm.fresh_state(limits.arm_timeout)
            farthest = max((joint_distance(s.q, q) for s in self._arm.take_states()), default=0.0)
            why = self._arm.impossible_state(sent)
            if farthest > before + limits.start_tolerance:
                why = why or f"by them it moved {farthest:.3f} rad away."
            if why:
                self._lie = (
                    f"joint_states are not believed: the arm was told to stand where they said that it stands, and {why} "
                    "Check its driver, then deactivate and activate the executor."
                )
                self._lied_to = q
                raise PlanningError(PushCode.TRACKING, self._lie)
            if self._clock.monotonic() - sent >= watched:
                self._commanded.rest(joints.names, q)
                return state


def joint_distance(q: Float64Array, other: Float64Array) -> float:
    """Of the joint that is farthest apart [rad]."""
    return float(np.max(np.abs(q - other)))


def stand_at(q: Float64Array, arrives: float) -> JointTrajectory:
    """Be at `q` [rad] after `arrives` [s], and stay. Two points: one alone is how an arm is held."""
    return JointTrajectory(np.array([arrives, arrives + _PERIOD]), np.tile(q, (2, 1)), np.zeros((2, len(q))))
