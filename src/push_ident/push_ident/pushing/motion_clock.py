"""Time during a motion of an arm, of which stamps tell, and stamps may be wrong."""

from __future__ import annotations

from typing import Final

from push_ident.errors import PlanningError
from push_ident.pushing.ports import Arm, ArmState, Clock
from push_ident.pushing.push import PushCode

__all__ = ["MotionClock"]

_SAME_CLOCK: Final = 1.0
"""The arm's stamps are on the clock of the cell when they differ by less [s]."""
_CLOCK_JUMP: Final = 0.25
"""A change of the arm's clock, beyond the time that has passed, that counts as setting it [s]."""
_RECEIPT: Final = 0.5
"""A state may be taken in so much later than it was [s]: a process that stands still for longer ends its motion anyway."""


class MotionClock:
    """Time during a motion: that of the stamps of a simulated arm, which the clock of its cell may lag behind; of a real one wall time.

    An arm whose stamps are on no known clock is timed by the receipt of its states.
    """

    def __init__(self, arm: Arm, last: ArmState, clock: Clock) -> None:
        """`last`: a state of the arm from before the motion."""
        now = clock.now()
        self._arm, self._clock = arm, clock
        self.by_stamp = abs(last.stamp - now) < _SAME_CLOCK
        """Whether times are those of the arm's own clock."""
        self._received = clock.monotonic()
        self.started = arm.stamp_now()[0] if self.by_stamp else now
        """[s] on the clock of the cell."""
        self.latest = self.started
        """Latest result of `now` [s]."""
        self.ahead = 0.0
        """What it then had gained on wall time, beyond all before [s]."""
        self.is_known = True
        """Whether that is the present: a simulated arm whose states are overdue may have stopped, or may go on."""
        self._gained = self.started - self._received
        self._of_state = self.started

    def of(self, state: ArmState) -> float:
        """When a state was [s]."""
        return state.stamp if self.by_stamp else self.started + state.received - self._received

    def now(self) -> float:
        """The present; never decreases [s]."""
        wall = self._clock.monotonic()
        # No stamp makes a real arm go faster: they may be wrong.
        time, self.is_known = self.started + wall - self._received, True
        if self.by_stamp and self._clock.is_simulated:
            time, self.is_known = self._arm.stamp_now()
        self.ahead = max(time - wall - self._gained, 0.0)
        self.latest, self._gained = max(time, self.latest), self._gained + self.ahead
        return self.latest

    def check(self, state: ArmState) -> None:
        """Raise PlanningError TRACKING where the clock of the stamps was set, or that of a real arm runs at another pace than this one."""
        time, wall = self.of(state), self.started + state.received - self._received
        self._of_state, before = time, self._of_state
        back, ahead = before - time, self.ahead
        if not self._clock.is_simulated:
            back, ahead = max(back, wall - time - _RECEIPT), time - wall
        if max(back, ahead) > _CLOCK_JUMP:
            way, jump = ("back", back) if back > ahead else ("ahead", ahead)
            raise PlanningError(PushCode.TRACKING, f"time jumped {way} by {jump:.2f} s during the motion, by the stamps of joint_states.")
