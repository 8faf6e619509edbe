"""The watch over a moving arm: any fault ends the motion, and the arm is held; without the watch itself the arm stops, too."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from push_ident.errors import PlanningError
from push_ident.pushing.arm_motion import ArmMotion
from push_ident.pushing.command_link import Commanded, CommandLink
from push_ident.pushing.motion_clock import MotionClock
from push_ident.pushing.pacing import SPLICE, PathPacing
from push_ident.pushing.ports import Arm, ArmState, ExecutionPorts
from push_ident.pushing.push import PushCode
from push_ident.pushing.take_over import TakeOver, joint_distance, stand_at
from push_ident.pushing.tracking import Tracking
from push_ident.pushing.watch_limits import WatchLimits
from push_ident.types import Float64Array

__all__ = ["ArmWatch"]

_PERIOD: Final = 0.01
"""[s] between two checks of the moving arm."""
_LATE: Final = 0.03
"""A check so much [s] after the previous one was delayed itself."""
_ARRIVAL: Final = 1.0
"""[s] the arm may still need after the end of the plan."""
_ABSENT: Final = 0.5
"""A motion that was not watched for longer [s] does not go on: the cell may have changed meanwhile, and the path of the tool has a gap."""
_PIECES: Final = 4
"""Pieces that are sent within the horizon: three may be lost or late before the arm brakes."""
_PEAK: Final = 1.5
"""Of the speed of a cubic from rest to rest, over its mean."""
_SHARES: Final = (1.0, 0.8, 0.6)
"""Of what the joints allow, that are tried: one cubic takes up to 1.5 times the acceleration of the two that it stands for."""


class _UnderWay:
    """One motion that the arm makes: its pieces, and where the arm is on it.

    Args:
        motion: that is made.
        limits: that it must keep to.
        clock: of the motion, which begins now.
        arm: that is moved.
        commanded: what it was told before.
    """

    def __init__(self, motion: ArmMotion, limits: WatchLimits, clock: MotionClock, arm: Arm, commanded: Commanded) -> None:
        self.limits, self.clock, self._motion = limits, clock, motion
        self.pacing = PathPacing(motion.trajectory, motion.limits.planned.acceleration, limits.motion_horizon, clock.started)
        self._tracking = Tracking(self.pacing, limits.tracking_tolerance, limits.start_tolerance, limits.tracking_lag)
        self._link = CommandLink(arm, commanded, motion.limits)
        self._is_stamped = limits.stamp_commands and clock.by_stamp
        self._tried = 0.0
        self._deadline: float | None = None
        """For an arm that has missed pieces to be where they led [s]; None where it was not told to be there."""

    def change(self, motion: ArmMotion) -> None:
        """Another motion, the same up to where the next piece begins to act."""
        self._motion = motion
        self.pacing.change(motion.trajectory)

    def judge(self, state: ArmState) -> None:
        """Raise PlanningError TRACKING for a state that an arm on its way cannot have."""
        self.clock.check(state)
        self._tracking.take(self._motion, state, self.clock.of(state))

    def has_arrived(self, state: ArmState) -> bool:
        """Whether the motion has ended. Raises PlanningError TRACKING where it should have ended long ago."""
        time = self.clock.of(state)
        if self.pacing.path_time(time) >= self._motion.duration:
            if joint_distance(state.q, self._motion.trajectory.position[-1]) <= self.limits.start_tolerance:
                return True
            if time > self.pacing.time_of(self._motion.duration) + _ARRIVAL:
                raise PlanningError(PushCode.TRACKING, f"the arm did not arrive within {_ARRIVAL:.1f} s after the end of the plan.")
        return False

    def go_on(self, state: ArmState, now: float) -> None:
        """Send what is due `now` [s], `Clock.monotonic`."""
        time = self.clock.now()
        if not self.clock.is_known:
            return  # it has braked when its states come again, or goes on with what it has
        if self._tracking.stood_at is not None:
            self._catch_up(state, self._tracking.stood_at, time)
        elif now - self._tried > self.limits.motion_horizon / _PIECES - 0.5 * _PERIOD and not self.pacing.is_complete:
            self.send(time, now)

    def send(self, time: float, now: float) -> None:
        """Send the next piece; `time` [s] on the clock of the motion, `now` on that of this process.

        One that would break a limit, as one made late may, is left out: the arm brakes, and the next one goes on more gently.
        """
        self._tried = now
        for share in _SHARES:
            # Where the clock has gained on wall time the arm may be further behind than it seems: it gets that much longer.
            piece = self.pacing.piece(time, SPLICE + self.clock.ahead, share)
            if self._link.move(piece, time, is_stamped=self._is_stamped):
                self._deadline = None
                return
            self.pacing.take_back()

    def hold(self) -> None:
        """End the motion: on the path of what was sent, whatever the states say, for the arm is there or on its way to there.

        Where it stands behind, or nobody knows how far it is, that would be a jump: then it ends what it was told last, which ends at rest.
        """
        time = self.clock.now()
        if self._tracking.stood_at is not None or not self.clock.is_known:
            return
        for share in _SHARES:
            if self._link.hold(self.pacing.halt(time, share), time):
                return
            self.pacing.take_back()

    def _catch_up(self, state: ArmState, stood_at: float, time: float) -> None:
        """Bring an arm that has missed pieces to where they led, within its limits from wherever it is, and get no other before.

        An arm that has missed none, and whose states stand still, does not move by it. Raises PlanningError TRACKING where it stays behind.
        """
        pacing, motion = self.pacing, self._motion
        if time < pacing.ends:
            return
        if self._deadline is None:
            (stood, end), _ = motion.trajectory.follow(np.array([stood_at, pacing.reaches]))
            arrives = motion.limits.time_to_move(np.maximum(np.abs(end - stood), np.abs(end - state.q)))
            arrives = max(arrives, _PEAK * (pacing.reaches - stood_at))  # no faster than planned
            if arrives > SPLICE:
                self._link.move(stand_at(end, arrives), time)
            self._deadline = time + arrives + self.limits.tracking_lag
        elif self._tracking.is_at_end(motion, state):
            self._tracking.go_on()
        elif time > self._deadline:
            raise PlanningError(
                PushCode.TRACKING,
                f"the arm does not follow: by joint_states it stands where it was to be {pacing.time_of(stood_at) - pacing.started:.2f} s "
                "after its start. Is it blocked, or are they frozen?",
            )


def _unwatched(duration: float) -> PlanningError:
    return PlanningError(PushCode.TRACKING, f"the motion was not watched for {duration:.1f} s, and the arm has stopped by itself.")


class ArmWatch:
    """Starts motions and supervises them until they have ended, or something is wrong."""

    def __init__(self, ports: ExecutionPorts) -> None:
        self._arm, self._hand, self._force, self._recorder = ports.arm, ports.hand, ports.force, ports.recorder
        self._clock = ports.clock
        self._commanded = Commanded()
        self._take_over = TakeOver(ports.arm, ports.clock, self._commanded)
        self.peak_force = 0.0
        """Largest horizontal force of the last motion [N]."""

    def check_ready(self, limits: WatchLimits) -> None:
        """Raise PlanningError when no motion may begin: RECORDING, HAND, BUSY, FORCE, TRACKING."""
        self._check_equipment()
        self._check_measured(limits)
        if rivals := self._arm.rivals():
            raise PlanningError(PushCode.BUSY, f"{', '.join(rivals)} commands the arm as well; only one node may publish joint_trajectory.")
        self._take_over.check(limits)

    def trust(self) -> None:
        """Believe the joint states again, where they were caught in a lie."""
        self._take_over.trust()

    def posture(self, limits: WatchLimits) -> Float64Array:
        """Where the next motion begins [rad]: where the arm was told to stand, if it stands there, else where it says that it is."""
        state = self._arm.next_state(limits.arm_timeout)
        told = self._commanded.posture(self._arm.planner.joint_names)
        return state.q if told is None or joint_distance(state.q, told) > limits.start_tolerance else told

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
            motion: what was planned from `posture`.
            limits: that it must keep to.
            replan: plans it once more from the posture [rad], if the arm was moved since.
            check_wanted: raises PlanningError when the motion should end.
            on_start: called with the motion that begins, and with what tells when the arm reaches which part of it.
            on_look: called at each check with the time of the plan [s] that the arm has reached, the time of the cell then [s],
                and the arm's state. May give another motion, which is the same up to where the next piece begins to act; may raise
                PlanningError, which ends the motion.

        Raises:
            PlanningError: nothing moved, or the arm is held: TRACKING, ARM_SILENT, FORCE, HAND, RECORDING, LIMIT, and those of the
                arguments.
        """
        for attempt in range(2):
            distance = joint_distance(self._arm.next_state(limits.arm_timeout).q, motion.trajectory.position[0])
            check_wanted()
            if distance <= limits.start_tolerance:
                self._check_measured(limits)
                state = self._take_over.at(motion, limits, check_wanted)
                under_way = _UnderWay(motion, limits, MotionClock(self._arm, state, self._clock), self._arm, self._commanded)
                on_start(motion, under_way.pacing)
                return self._follow(under_way, check_wanted, on_look)
            if attempt == 0:
                motion = replan(self.posture(limits))
        raise PlanningError(
            PushCode.TRACKING,
            f"the arm moves by itself: it is {distance:.3f} rad from the start of the plan, limit {limits.start_tolerance:.3f} rad.",
        )

    def _follow(
        self,
        under_way: _UnderWay,
        check_wanted: Callable[[], None],
        on_look: Callable[[float, float, ArmState], ArmMotion | None],
    ) -> None:
        """Make a motion from where the arm stands: one thread, and nothing follows the hold."""
        clock, limits = under_way.clock, under_way.limits
        self.peak_force, _ = 0.0, self._force.take_peak()
        began = looked = self._clock.monotonic()
        self._arm.take_states()
        try:
            under_way.send(clock.started, began)
            while True:
                self._clock.sleep(_PERIOD)
                now, before = self._clock.monotonic(), looked
                looked = now
                check_wanted()
                state = self._arm.fresh_state(limits.arm_timeout, is_late=now - before > _LATE)
                if now - before > _ABSENT:
                    raise _unwatched(now - before)
                for each in self._arm.take_states():
                    under_way.judge(each)
                if reason := self._arm.impossible_state(began):
                    raise PlanningError(PushCode.TRACKING, f"joint_states cannot be true: {reason}")
                self._check_force(limits)
                self._check_equipment()
                time = clock.of(state)
                if (changed := on_look(under_way.pacing.path_time(time), time, state)) is not None:
                    under_way.change(changed)
                if under_way.has_arrived(state):
                    return
                if self._clock.monotonic() - now > _ABSENT:
                    continue  # this process stood still since the check above: the next look says so, and nothing more is sent
                under_way.go_on(state, now)
        except BaseException as error:
            fault = self._cause(error, looked, limits)
            under_way.hold()
            if fault is error:
                raise
            raise fault from error

    def _cause(self, fault: BaseException, looked: float, limits: WatchLimits) -> BaseException:
        """What ended a motion: to a process that stood still since it `looked` [s], all others seem to have been silent."""
        unwatched = self._clock.monotonic() - looked
        seems_silent = isinstance(fault, PlanningError) and fault.code in (PushCode.FORCE, PushCode.HAND, PushCode.OBJECT_LOST)
        is_force = self.peak_force > limits.force_limit
        return _unwatched(unwatched) if seems_silent and not is_force and unwatched > _ABSENT else fault

    def _check_force(self, limits: WatchLimits) -> None:
        """Raise PlanningError FORCE where it was too large since the last look, or is not known."""
        peak = self._force.take_peak()
        self.peak_force = max(self.peak_force, peak)
        if not math.isfinite(peak):
            raise PlanningError(PushCode.FORCE, f"pusher/wrench cannot be trusted. {self._force.fault or 'Is the sensor overloaded?'}")
        if peak > limits.force_limit:
            raise PlanningError(
                PushCode.FORCE, f"pusher/wrench reports {peak:.1f} N, limit {limits.force_limit:.1f} N; is something in the way?"
            )
        self._check_measured(limits)

    def _check_measured(self, limits: WatchLimits) -> None:
        """Raise PlanningError FORCE where the force is not known now, so that its limit cannot be kept."""
        silence, limit = self._force.silence, limits.patience(limits.wrench_timeout)
        if self._force.is_there and (silence > limit or self._force.fault):
            since = f"for {silence:.2f} s, limit {limit:.2f} s" if math.isfinite(silence) else "yet"
            why = self._force.fault or "Without one there is no force limit; restart the sensor, or this node to push without one."
            raise PlanningError(PushCode.FORCE, f"no force that can be trusted on pusher/wrench {since}. {why}")

    def _check_equipment(self) -> None:
        if reason := self._recorder.fault:
            raise PlanningError(PushCode.RECORDING, f"the recording has failed: {reason}")
        if reason := self._hand.why_no_fist():
            raise PlanningError(PushCode.HAND, reason)
