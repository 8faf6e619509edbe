"""The only way to move the arm: each command continues the one before within the limits of the joints, or is not sent.

Before a motion, the takeover commands the arm to stand, so slowly that it keeps to the limits from wherever it may be: a test, within its
joint limits, of whether it stands where its states say.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from push_ident.errors import PlanningError
from push_ident.pushing.arm_motion import ArmMotion, JointLimits
from push_ident.pushing.pacing import SPLICE
from push_ident.pushing.ports import Arm, ArmState, Clock, ControllerGoal
from push_ident.pushing.push import PushCode
from push_ident.pushing.push_request import WatchLimits
from push_ident.pushing.trajectory import SAMPLE_PERIOD, JointTrajectory
from push_ident.types import Float64Array

Send = Callable[[tuple[str, ...], JointTrajectory, float | None], object]
"""Gets the names of the joints, a trajectory, and when it starts [s], as `Arm.send`."""


class Commanded:
    """The motion of an arm by its last command, whatever its states say. At rest between two motions."""

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._motion: JointTrajectory | None = None

    def posture(self, names: tuple[str, ...]) -> Float64Array | None:
        """Posture of the joints with these names at the end of the last command [rad]; None without one."""
        return None if self._motion is None or names != self._names else self._motion.position[-1].copy()

    def after(self, piece: JointTrajectory, start: float) -> JointTrajectory:
        """The motion when a controller gets `piece` at `start` [s]: a cubic to its first point from where it is then, and on from there."""
        position, velocity = (row for row in self._now(start))
        time = np.append(start, start + piece.time)
        return JointTrajectory(time, np.vstack([position, piece.position]), np.vstack([velocity, piece.velocity]))

    def take(self, names: tuple[str, ...], motion: JointTrajectory) -> None:
        """The arm was commanded this; times on the clock of the commands [s]."""
        self._names, self._motion = names, motion

    def forget(self) -> None:
        """The posture is unknown: the arm may not have reached its last command."""
        self._motion = None

    def rest(self, names: tuple[str, ...], posture: Float64Array) -> None:
        """The arm stands at `posture` [rad], by its last command or by observation."""
        self.take(names, JointTrajectory(np.zeros(1), posture[None, :], np.zeros((1, len(posture)))))

    def _now(self, time: float) -> tuple[Float64Array, Float64Array]:
        assert self._motion is not None, "the takeover comes first"
        return self._motion.follow(np.array([time]))


class CommandLink:
    """Sends the pieces of one motion; nothing moves the arm any more once it was held.

    Each piece passes one last check: a controller that follows it from the command before keeps to the limits of every joint. Otherwise it
    is not sent; the arm then stands at the end of the one before, which is at rest.
    """

    def __init__(self, arm: Arm, commanded: Commanded, limits: JointLimits) -> None:
        self._arm, self._commanded, self._limits = arm, commanded, limits
        self._lock = threading.Lock()
        self._is_held = False

    def move(self, piece: JointTrajectory, now: float, *, is_stamped: bool = False) -> bool:
        """Start a piece `now` [s] in place of the one under way; false where it would exceed a limit. Raises PlanningError after `hold`."""
        with self._lock:
            self._check_not_held()
            return self._send(piece, now, now if is_stamped else None, self._arm.send)

    def hand_over(self, piece: JointTrajectory, now: float, *, is_stamped: bool = False) -> ControllerGoal | None:
        """As `move`, as a goal of the controller; None where it would exceed a limit. The hold of the arm ends it, as any motion."""
        goals: list[ControllerGoal] = []
        with self._lock:
            self._check_not_held()
            self._send(piece, now, now if is_stamped else None, lambda *command: goals.append(self._arm.send_goal(*command)))
        return goals[0] if goals else None

    def hold(self, piece: JointTrajectory, now: float) -> bool:
        """End the motion with a piece; false where it would exceed a limit: the arm then stops at the end of the one before."""
        with self._lock:
            self._is_held = True
            return self._send(piece, now, None, self._arm.send)

    def leave(self) -> None:
        """Send nothing any more: the controller holds the arm, and where is not known."""
        with self._lock:
            self._is_held = True
            self._commanded.forget()

    def _check_not_held(self) -> None:
        if self._is_held:
            raise PlanningError(PushCode.CANCELED, "the arm is held; it is not moved any more.")

    def _send(self, piece: JointTrajectory, now: float, start: float | None, send: Send) -> bool:
        motion = self._commanded.after(piece, now)
        if not self._limits.are_kept_by(motion):
            return False
        send(self._limits.names, piece, start)
        self._commanded.take(self._limits.names, motion)
        return True


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

        Raises PlanningError: TRACKING where its states contradict the command, and those of `check_wanted`.
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
                    f"joint_states are not believed: the arm was commanded to hold the position that they report, and {why} "
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
