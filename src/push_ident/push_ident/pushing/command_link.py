"""The only way to move the arm: each command continues the one before within the limits of the joints, or is not sent.

Before a motion, `take_over.py` commands the arm to stand, so slowly that it keeps to the limits from wherever it may be.
"""

from __future__ import annotations

import threading

import numpy as np

from push_ident.errors import PlanningError
from push_ident.pushing.joint_limits import JointLimits
from push_ident.pushing.ports import Arm
from push_ident.pushing.push import PushCode
from push_ident.pushing.trajectory import JointTrajectory
from push_ident.types import Float64Array

__all__ = ["CommandLink", "Commanded"]


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

    Args:
        arm: that is moved.
        commanded: its last command.
        limits: of its joints.
    """

    def __init__(self, arm: Arm, commanded: Commanded, limits: JointLimits) -> None:
        self._arm, self._commanded, self._limits = arm, commanded, limits
        self._lock = threading.Lock()
        self._is_held = False

    def move(self, piece: JointTrajectory, now: float, *, is_stamped: bool = False) -> bool:
        """Start a piece `now` [s] in place of the one under way; false where it would exceed a limit. Raises PlanningError after `hold`."""
        with self._lock:
            if self._is_held:
                raise PlanningError(PushCode.CANCELED, "the arm is held; it is not moved any more.")
            return self._send(piece, now, now if is_stamped else None)

    def hold(self, piece: JointTrajectory, now: float) -> bool:
        """End the motion with a piece; false where it would exceed a limit: the arm then stops at the end of the one before."""
        with self._lock:
            self._is_held = True
            return self._send(piece, now, None)

    def _send(self, piece: JointTrajectory, now: float, start: float | None) -> bool:
        motion = self._commanded.after(piece, now)
        if not self._limits.are_kept_by(motion):
            return False
        self._arm.send(self._limits.names, piece, start)
        self._commanded.take(self._limits.names, motion)
        return True
