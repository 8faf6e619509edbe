"""Parts of a motion that the controller of the arm makes by itself, one goal for each: those in which the tip is above every object.

The watch looks at the arm as during all others. What differs is what the arm does without news: it goes on to the end of the part.
"""

from __future__ import annotations

from push_ident.errors import PlanningError
from push_ident.pushing.arm_motion import ArmMotion
from push_ident.pushing.pacing import PathPacing
from push_ident.pushing.ports import ControllerGoal
from push_ident.pushing.push import PushCode
from push_ident.pushing.push_request import FOLLOW, WatchLimits


class FreeMotions:
    """The free parts of one motion, and the goal that the controller has of them."""

    def __init__(self, motion: ArmMotion, limits: WatchLimits) -> None:
        self._limits = limits
        self._parts = motion.parts_above(limits.free_height) if limits.free_motions == FOLLOW else []
        self.goal: ControllerGoal | None = None
        """That it makes now; None where the arm gets pieces."""

    def end_of(self, path_time: float) -> float | None:
        """Path time [s] at which a free part ends that a motion is in, unless the rest of it is no longer than a piece; else None."""
        return next((end for begin, end in self._parts if begin <= path_time < end - self._limits.motion_horizon), None)

    def check(self, time: float, pacing: PathPacing, *, stands: bool) -> None:
        """Note when the controller has ended its goal; `time` [s] on the clock of the motion, `stands`: the arm stands on its way.

        Raises PlanningError where it ended the goal before its time, or does not make it.
        """
        goal, timeout = self.goal, self._limits.arrival_timeout
        if goal is None:
            return
        if (fault := goal.fault) is not None:
            raise fault
        if stands:
            raise PlanningError(PushCode.TRACKING, "the arm does not follow: by joint_states it stands, and its controller has a goal.")
        if goal.is_over and time >= pacing.ends:
            self.goal = None
        elif time > pacing.ends + timeout:
            what = "ended" if goal.is_accepted else "accepted"
            raise PlanningError(PushCode.TRACKING, f"the controller has not {what} its goal {timeout:.1f} s after the end of the motion.")
