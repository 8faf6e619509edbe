"""The arm's clock between two of its states, and the time of a motion by it."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from typing import Final

from push_ident.errors import PlanningError
from push_ident.pushing.ports import Arm, ArmState, Clock
from push_ident.pushing.push import PushCode


@dataclass(frozen=True, slots=True)
class ClockSettings:
    """How stamps of an arm are taken for time."""

    window: int = 32
    """States of the fit: a third of a second at 100 Hz, in which jitter of 1 ms in their receipt averages to 0.4 ms at the end."""
    max_extrapolation: float = 0.05
    """Longest time after the latest stamp that the clock shows [s]: a simulation may pause."""
    jump: float = 0.25
    """Change of a stamp, beyond the time between two of them, that counts as setting the clock [s]."""
    same_clock: float = 1.0
    """The arm's stamps are on the clock of the cell when they differ by less [s]."""
    receipt_delay: float = 0.5
    """Longest time from the stamp of a state to its receipt [s]: a process that stands still for longer ends its motion anyway."""


_CLOCK: Final = ClockSettings()


class ArmClock:
    """Estimates what the arm's clock shows, by a straight line through stamps over times of receipt.

    A simulated arm's clock may be slower or faster than wall time. May be used by several threads.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._samples: deque[tuple[float, float]] = deque(maxlen=_CLOCK.window)

    def observe(self, received: float, stamp: float) -> None:
        """Process the stamp [s] of a state and its receipt [s], wall time."""
        with self._lock:
            if self._samples and self._is_jump(received, stamp):
                self._samples.clear()
            self._samples.append((received, stamp))

    def at(self, wall: float) -> tuple[float, bool]:
        """Time of the arm's clock [s] at a wall time [s] after the latest state, and whether that is known: a state is overdue where not.

        There must have been a state.
        """
        with self._lock:
            latest = self._samples[-1][1]
            mean_wall, mean_stamp, rate = self._fit()
        time = max(mean_stamp + rate * (wall - mean_wall), latest)
        return min(time, latest + _CLOCK.max_extrapolation), time <= latest + _CLOCK.max_extrapolation

    @property
    def rate(self) -> float:
        """Seconds of the arm's clock per second of wall time; 1 before it is known."""
        with self._lock:
            return self._fit()[2]

    def _is_jump(self, received: float, stamp: float) -> bool:
        wall_before, stamp_before = self._samples[-1]
        passed = stamp - stamp_before
        return passed < -_CLOCK.jump or passed > _CLOCK.jump + max(self._fit()[2], 1.0) * (received - wall_before)

    def _fit(self) -> tuple[float, float, float]:
        """Mean wall time, mean stamp and slope."""
        samples, n = self._samples, len(self._samples)
        if n == 0:
            return 0.0, 0.0, 1.0
        wall = sum(w for w, _ in samples) / n
        stamp = sum(s for _, s in samples) / n
        spread = sum((w - wall) ** 2 for w, _ in samples)
        if n < 4 or spread <= 0.0:
            return samples[-1][0], samples[-1][1], 1.0
        return wall, stamp, max(sum((w - wall) * (s - stamp) for w, s in samples) / spread, 0.0)


class MotionClock:
    """Time during a motion: the stamps of a simulated arm, which the clock of its cell may lag behind; wall time for a real arm.

    An arm whose stamps are on no known clock is timed by the receipt of its states.
    """

    def __init__(self, arm: Arm, last: ArmState, clock: Clock) -> None:
        """`last`: a state of the arm from before the motion."""
        now = clock.now()
        self._arm, self._clock = arm, clock
        self.by_stamp = abs(last.stamp - now) < _CLOCK.same_clock
        """Whether times are those of the arm's own clock."""
        self._received = clock.monotonic()
        self.started = arm.stamp_now()[0] if self.by_stamp else now
        """[s] on the clock of the cell."""
        self.latest = self.started
        """Latest result of `now` [s]."""
        self.ahead = 0.0
        """By how much it then was ahead of wall time, beyond all earlier gains [s]."""
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

    def sleep(self, seconds: float) -> None:
        """Wait so long, wall time."""
        self._clock.sleep(seconds)

    def check(self, state: ArmState) -> None:
        """Raise PlanningError TRACKING where the clock of the stamps was set, or that of a real arm runs at another pace than this one."""
        time, wall = self.of(state), self.started + state.received - self._received
        self._of_state, before = time, self._of_state
        back, ahead = before - time, self.ahead
        if not self._clock.is_simulated:
            back, ahead = max(back, wall - time - _CLOCK.receipt_delay), time - wall
        if max(back, ahead) > _CLOCK.jump:
            way, jump = ("back", back) if back > ahead else ("ahead", ahead)
            raise PlanningError(PushCode.TRACKING, f"time jumped {way} by {jump:.2f} s during the motion, by the stamps of joint_states.")
