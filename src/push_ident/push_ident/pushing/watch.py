"""The watch over a moving arm: any fault ends the motion, and the arm is held; without the watch itself the arm stops, too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.errors import PlanningError
from push_ident.pushing.motion import ArmMotion
from push_ident.pushing.pacing import SPLICE, PathPacing
from push_ident.pushing.ports import Arm, ArmState, Clock, ExecutionPorts
from push_ident.pushing.push import PushCode
from push_ident.pushing.standstill import Standstill
from push_ident.pushing.trajectory import JointTrajectory

__all__ = ["ArmWatch", "WatchLimits"]

_PERIOD: Final = 0.01
"""[s] between two checks of the moving arm."""
_LATE: Final = 0.03
"""A check so much [s] after the previous one was delayed itself."""
_SAME_CLOCK: Final = 1.0
"""The arm's stamps are on the clock of the cell when they differ by less [s]."""
_ARRIVAL: Final = 1.0
"""[s] the arm may still need after the end of the plan."""
_ABSENT: Final = 0.5
"""A motion that was not watched for longer [s] does not go on: the cell may have changed meanwhile, and the path of the tool has a gap."""
_CLOCK_JUMP: Final = 0.25
"""A change of the arm's clock, beyond the time that has passed, that counts as setting it [s]."""
_PIECES: Final = 4
"""Pieces that are sent within the horizon: three may be lost or late before the arm brakes."""
_HOLD_WITHIN: Final = 0.1
"""Time that an arm off its path is given to come to a halt [s]."""


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
    motion_horizon: float = 0.08
    """Motion at the planned speed that the arm is given ahead [s]: without news it brakes after that."""
    stamp_commands: bool = False
    """Whether pieces say when they start by the clock of the arm's stamps; else they start on receipt, and transport adds its jitter."""
    wrench_timeout: float = 0.5
    """Longest time without a force measurement, where there was one at the start of the motion [s]."""

    def patience(self, timeout: float) -> float:
        """Longest silence [s] that `timeout` allows of another source: an arm that may pause for longer, as a simulated one, sets it."""
        return float(max(timeout, 2.0 * self.arm_timeout))


class _MotionClock:
    """Time during a motion, by the stamps of the arm: the clock of the cell may lag behind them, as that of a simulation does.

    An arm whose stamps are on no known clock is timed by the receipt of its states.
    """

    def __init__(self, arm: Arm, last: ArmState, clock: Clock) -> None:
        """`last`: a state of the arm from before the motion."""
        now = clock.now()
        self._arm, self._clock = arm, clock
        self.by_stamp = abs(last.stamp - now) < _SAME_CLOCK
        """Whether times are those of the arm's own clock."""
        self._received = clock.monotonic()
        self.started = arm.stamp_now() if self.by_stamp else now
        """[s] on the clock of the cell."""
        self.latest = self.started
        """Latest result of `now` [s]."""
        self.ahead = 0.0
        """What it then had gained on wall time, beyond all before [s]."""
        self._gained = self.started - self._received

    def of(self, state: ArmState) -> float:
        """When a state was [s]."""
        return state.stamp if self.by_stamp else self.started + state.received - self._received

    def set_back(self, state: ArmState) -> float:
        """By how much the stamp of a state says that the clock was set back [s]; 0 or less: it was not."""
        return self.latest - state.stamp - _CLOCK_JUMP if self.by_stamp else 0.0

    def now(self) -> float:
        """The present; never decreases [s]."""
        wall = self._clock.monotonic()
        time = self._arm.stamp_now() if self.by_stamp else self.started + wall - self._received
        self.ahead = max(time - wall - self._gained, 0.0)
        self.latest, self._gained = max(time, self.latest), self._gained + self.ahead
        return self.latest


def _unwatched(duration: float) -> PlanningError:
    return PlanningError(PushCode.TRACKING, f"the motion was not watched for {duration:.1f} s, and the arm has stopped by itself.")


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
        on_start: Callable[[ArmMotion, PathPacing], None],
        on_look: Callable[[float, float, ArmState], ArmMotion | None],
    ) -> None:
        """Make one motion.

        Args:
            motion: what was planned.
            limits: that it must keep to.
            replan: plans it once more from the posture [rad], if the arm was moved since.
            check_wanted: raises PlanningError when the motion should end.
            on_start: called with the motion that begins, and with what tells when the arm reaches which part of it.
            on_look: called at each check with the time of the plan [s] that the arm has reached, the time of the cell then [s],
                and the arm's state. May give another motion, which is the same up to where the next piece begins to act; may raise
                PlanningError, which ends the motion.

        Raises:
            PlanningError: nothing moved, or the arm is held: TRACKING, ARM_SILENT, FORCE, HAND, RECORDING, and those of the arguments.
        """
        for attempt in range(2):
            state = self._arm.next_state(limits.arm_timeout)
            distance = float(np.max(np.abs(state.q - motion.trajectory.position[0])))
            check_wanted()
            if distance <= limits.start_tolerance:
                clock = _MotionClock(self._arm, state, self._clock)
                pacing = PathPacing(motion.trajectory, motion.acceleration_limit, limits.motion_horizon, clock.started)
                on_start(motion, pacing)
                return self._follow(motion, pacing, clock, limits, check_wanted, on_look)
            if attempt == 0:
                motion = replan(state.q)
        raise PlanningError(
            PushCode.TRACKING,
            f"the arm moves by itself: it is {distance:.3f} rad from the start of the plan, limit {limits.start_tolerance:.3f} rad.",
        )

    def _follow(
        self,
        motion: ArmMotion,
        pacing: PathPacing,
        clock: _MotionClock,
        limits: WatchLimits,
        check_wanted: Callable[[], None],
        on_look: Callable[[float, float, ArmState], ArmMotion | None],
    ) -> None:
        """The only place from which the arm is moved: one thread, and nothing follows the hold."""
        is_measured = self._force.silence <= limits.patience(limits.wrench_timeout)
        self.peak_force, _ = 0.0, self._force.take_peak()
        looked = sent = self._clock.monotonic()
        link = self._arm.open(motion)
        try:
            is_stamped = limits.stamp_commands and clock.by_stamp
            standstill = Standstill(limits.tracking_lag, _ABSENT)
            link.move(pacing.piece(clock.started), clock.started if is_stamped else None)
            while True:
                self._clock.sleep(_PERIOD)
                now, before = self._clock.monotonic(), looked
                looked = now
                check_wanted()
                state = self._arm.fresh_state(limits.arm_timeout, is_late=now - before > _LATE)
                self._check_time(clock, state, now - before)
                self._check_tracking(motion, pacing, state, clock.of(state), limits)
                self._check_force(is_measured, limits)
                self._check_equipment()
                if (stands_at := standstill.where(motion, pacing, state, clock.of(state))) is not None:
                    pacing.stand_at(clock.now(), stands_at)
                elapsed = pacing.path_time(clock.of(state))
                if (changed := on_look(elapsed, clock.of(state), state)) is not None:
                    motion = changed
                    pacing.change(motion.trajectory)
                arrived = np.max(np.abs(state.q - motion.trajectory.position[-1])) <= limits.start_tolerance
                if elapsed >= motion.duration and arrived:
                    return
                if self._clock.monotonic() - now > _ABSENT:
                    continue  # this process stood still since the check above: the next look says so, and nothing more is sent
                if now - sent > limits.motion_horizon / _PIECES - 0.5 * _PERIOD and not pacing.is_complete:
                    sent = now
                    # Where the clock has gained on wall time the arm may be further behind than it seems: it gets that much longer.
                    time = clock.now()
                    link.move(pacing.piece(time, splice=SPLICE + clock.ahead), time if is_stamped else None)
        except BaseException as error:
            fault = self._cause(error, looked, limits)
            link.hold(self._last_piece(fault, pacing, clock))
            if fault is error:
                raise
            raise fault from error

    def _cause(self, fault: BaseException, looked: float, limits: WatchLimits) -> BaseException:
        """What ended a motion: to a process that stood still since it `looked` [s], all others seem to have been silent."""
        unwatched = self._clock.monotonic() - looked
        seems_silent = isinstance(fault, PlanningError) and fault.code in (PushCode.FORCE, PushCode.HAND, PushCode.OBJECT_LOST)
        is_force = self.peak_force > limits.force_limit
        return _unwatched(unwatched) if seems_silent and not is_force and unwatched > _ABSENT else fault

    def _last_piece(self, fault: BaseException, pacing: PathPacing, clock: _MotionClock) -> JointTrajectory:
        """An arm on its path brakes on it; one that has left it stands where it is."""
        state = self._arm.state
        if isinstance(fault, PlanningError) and fault.code == PushCode.TRACKING and state is not None:
            return JointTrajectory(np.array([_HOLD_WITHIN]), state.q[None, :], np.zeros((1, len(state.q))))
        return pacing.halt(clock.now())

    def _check_time(self, clock: _MotionClock, state: ArmState, unwatched: float) -> None:
        """Raise PlanningError TRACKING when it is not known how far the arm has come."""
        if unwatched > _ABSENT:
            raise _unwatched(unwatched)
        if (back := clock.set_back(state)) > 0.0:
            raise PlanningError(PushCode.TRACKING, f"time jumped back by {back + _CLOCK_JUMP:.2f} s during the motion.")
        if clock.ahead > _CLOCK_JUMP:
            raise PlanningError(PushCode.TRACKING, f"time jumped ahead by {clock.ahead:.2f} s during the motion.")

    def _check_tracking(self, motion: ArmMotion, pacing: PathPacing, state: ArmState, time: float, limits: WatchLimits) -> None:
        earliest, latest = pacing.path_time(time - limits.tracking_lag), pacing.path_time(time)
        deviation, limit = motion.deviation(state.pose_tip_in_table[:3, 3], earliest, latest), limits.tracking_tolerance
        if deviation > limit:
            raise PlanningError(
                PushCode.TRACKING,
                f"the tool is {1e3 * deviation:.1f} mm from its path after {time - pacing.started:.2f} s, limit {1e3 * limit:.1f} mm.",
            )
        if pacing.is_complete and time > pacing.time_of(motion.duration) + _ARRIVAL:
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
