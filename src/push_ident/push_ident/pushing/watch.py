"""The watch over a moving arm: any fault ends the motion, and the arm is held; if the watch itself ends, the arm stops, too."""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Callable
from functools import partial

import numpy as np

from push_ident.errors import PlanningError
from push_ident.pushing.arm_clock import MotionClock
from push_ident.pushing.arm_motion import ArmMotion
from push_ident.pushing.command_link import Commanded, CommandLink, TakeOver, joint_distance, stand_at
from push_ident.pushing.free_motions import FreeMotions
from push_ident.pushing.pacing import SPLICE, PathPacing
from push_ident.pushing.ports import Arm, ArmState, ControllerGoal, ExecutionPorts
from push_ident.pushing.push import PushCode
from push_ident.pushing.push_request import FOLLOW, WatchLimits
from push_ident.pushing.trajectory import JointTrajectory
from push_ident.types import Float64Array

Change = Callable[[ArmMotion], bool]
"""To go on with another motion; false where it comes too late, or a limit forbids it: nothing has changed then."""
OnLook = Callable[[float, float, ArmState, Change], object]
"""Gets the time of the plan [s] that the arm has reached, the time of the cell then [s], the state of the arm, and how to change the
motion."""


class Tracking:
    """Compares the states of an arm with the pieces of a motion that it got."""

    def __init__(self, pacing: PathPacing, limits: WatchLimits) -> None:
        self._pacing, self._limits = pacing, limits
        self._delays: list[float] = []
        """Delays behind the pieces while the tool moved [s], sorted: controllers differ."""
        self._tip: Float64Array | None = None
        self._since = np.inf
        self._follows_goal = False
        self.stood_at: float | None = None
        """Path time [s] at which an arm stands that is behind its pieces; None where it follows."""

    def take(self, motion: ArmMotion, state: ArmState, time: float) -> None:
        """Judge a state; `time` [s] on the clock of the pieces.

        Raises PlanningError: TRACKING for a state that contradicts the commands.
        """
        earliest, latest = self._pacing.path_time(time - self._limits.tracking_lag), self._pacing.path_time(time)
        if self.stood_at is not None:
            earliest = min(earliest, self.stood_at)
        tip, after = state.pose_tip_in_table[:3, 3], f"{time - self._pacing.started:.2f} s"
        if (distance := motion.deviation(tip, earliest, latest)) > self._limits.tracking_tolerance:
            limit = f"{1e3 * self._limits.tracking_tolerance:.1f} mm"
            raise PlanningError(PushCode.TRACKING, f"the tool is {1e3 * distance:.1f} mm from its path after {after}, limit {limit}.")
        joint, angle = motion.joint_deviation(state.q, earliest, latest)
        if angle > self._limits.start_tolerance:
            limit = f"{self._limits.start_tolerance:.3f} rad"
            raise PlanningError(PushCode.TRACKING, f"{joint} is {angle:.3f} rad from its path after {after}, limit {limit}.")
        if self.stood_at is None:
            self.stood_at = self._standstill(motion, tip, time, latest)

    def is_at_end(self, motion: ArmMotion, state: ArmState) -> bool:
        """Whether an arm that stood has come to where its last piece ends."""
        assert self.stood_at is not None, "it stood"
        reached = motion.time_at(state.pose_tip_in_table[:3, 3], self.stood_at, self._pacing.reaches)
        return _tool_travel(motion, reached, self._pacing.reaches) <= self._limits.standstill_lag

    def go_on(self) -> None:
        """The arm is where its pieces led; it is to follow the next ones."""
        self.stood_at = self._tip = None

    def follow_goal(self, follows: bool) -> None:
        """Whether the controller makes a goal now: no piece comes that the arm would jump to, so the largest delay counts."""
        self._follows_goal = follows
        self.go_on()

    def _standstill(self, motion: ArmMotion, tip: Float64Array, time: float, led_to: float) -> float | None:
        """Path time at which the arm stands although its pieces lead on [s]; None if it moves, or should stand."""
        reached = min(motion.time_at(tip, self._pacing.path_time(time - self._limits.tracking_lag), led_to), led_to)
        if self._tip is None:
            self._tip, self._since = tip, time
        elif np.linalg.norm(tip - self._tip) > self._limits.standstill_travel:
            self._tip, self._since = tip, time
            if not self._follows_goal:
                insort(self._delays, time - self._pacing.time_of(reached))
        if time - self._since < self._limits.standstill_time:
            return None
        # Its delay is unknown before it has moved: a controller that is slow to begin has missed nothing.
        is_known = self._delays and not self._follows_goal
        delay = self._delays[len(self._delays) // 2] + self._limits.delay_margin if is_known else self._limits.tracking_lag
        return reached if _tool_travel(motion, reached, self._pacing.path_time(time - delay)) > self._limits.standstill_lag else None


def _tool_travel(motion: ArmMotion, begin: float, end: float) -> float:
    """Travel of the tool between two times of the plan [m]."""
    first, last = np.searchsorted(motion.trajectory.time, [begin, end])
    return float(np.sum(np.linalg.norm(np.diff(motion.tip[int(first) : int(last) + 1], axis=0), axis=1)))


class _UnderWay:
    """One motion that the arm makes: its pieces, and where the arm is on it."""

    def __init__(self, motion: ArmMotion, limits: WatchLimits, clock: MotionClock, arm: Arm, commanded: Commanded) -> None:
        self.limits, self.clock, self._motion = limits, clock, motion
        self.pacing = PathPacing(motion.trajectory, motion.limits.planned.acceleration, limits.motion_horizon, clock.started)
        self._tracking = Tracking(self.pacing, limits)
        self._link, self._free = CommandLink(arm, commanded, motion.limits), FreeMotions(motion, limits)
        self._is_stamped = limits.stamp_commands and clock.by_stamp
        self._tried = 0.0
        self._piece_period = limits.motion_horizon / limits.pieces_per_horizon - 0.5 * limits.period
        self._deadline: float | None = None
        """For an arm that has missed pieces to be where they led [s]; None if it was not sent there."""

    def change(self, motion: ArmMotion, now: float) -> bool:
        """Go on with another motion, if its next piece continues the last command within the limits; otherwise nothing changes.

        Planning took time: where the arm has come further than to where the two part, it would have to jump. `now` as in `send`.
        """
        time, before = self.clock.now(), self._motion
        if not self.clock.is_known or self._tracking.stood_at is not None or self.is_with_controller:
            return False
        self.pacing.change(motion.trajectory)
        if self.send(time, now):
            self._motion, self._free = motion, FreeMotions(motion, self.limits)
            return True
        self.pacing.change(before.trajectory)
        return False

    @property
    def is_with_controller(self) -> bool:
        """Whether the controller makes a free part of the motion by itself."""
        return self._free.goal is not None

    def check_controller(self) -> None:
        """Raise PlanningError where the controller does not make the part of the motion that it has, if it has one."""
        if self.is_with_controller:
            self._free.check(self.clock.now(), self.pacing, stands=self._tracking.stood_at is not None)
            if not self.is_with_controller:
                self._tracking.follow_goal(False)

    def judge(self, state: ArmState) -> None:
        """Raise PlanningError TRACKING for a state that an arm on its way cannot have."""
        self.clock.check(state)
        self._tracking.take(self._motion, state, self.clock.of(state))

    def has_arrived(self, state: ArmState) -> bool:
        """Whether the motion has ended. Raises PlanningError TRACKING where it should have ended long ago."""
        time = self.clock.of(state)
        if self.pacing.path_time(time) >= self._motion.duration and not self.is_with_controller:
            if joint_distance(state.q, self._motion.trajectory.position[-1]) <= self.limits.start_tolerance:
                return True
            if time > self.pacing.time_of(self._motion.duration) + (timeout := self.limits.arrival_timeout):
                raise PlanningError(PushCode.TRACKING, f"the arm did not arrive within {timeout:.1f} s after the end of the plan.")
        return False

    def go_on(self, state: ArmState, now: float) -> None:
        """Send what is due `now` [s], `Clock.monotonic`."""
        if self.is_with_controller:
            return
        time = self.clock.now()
        if not self.clock.is_known:
            return  # the arm makes the pieces that it has, and brakes
        if self._tracking.stood_at is not None:
            self._catch_up(state, self._tracking.stood_at, time)
        elif now - self._tried > self._piece_period and not self.pacing.is_complete:
            is_sent, timeout = self.send(time, now), self.limits.arrival_timeout
            if not is_sent and time > self.pacing.ends + timeout:
                why = "each next piece of the motion would exceed a limit of the joints"
                raise PlanningError(PushCode.TRACKING, f"the arm has stood on its way for {timeout:.1f} s: {why}.")

    def send(self, time: float, now: float) -> bool:
        """Send the next piece; false where none was sent. `time` [s] on the clock of the motion, `now` on that of this process.

        One that would exceed a limit, as one made late may, is left out: the arm brakes, and the next one goes on more gently.
        """
        self._tried = now
        free_until = self._free.end_of(self.pacing.path_time(time))
        for share in self.limits.acceleration_shares:
            # Where the clock has gained on wall time the arm may be further behind than it seems: it gets that much longer.
            piece = self.pacing.piece(time, SPLICE + self.clock.ahead, share, free_until)
            by_goal = free_until is not None
            if self._hand_over(piece, time) if by_goal else self._link.move(piece, time, is_stamped=self._is_stamped):
                self._deadline = None
                return True
            self.pacing.take_back()
        return False

    def _hand_over(self, piece: JointTrajectory, time: float) -> bool:
        self._free.goal = self._link.hand_over(piece, time, is_stamped=self._is_stamped)
        if self._free.goal is not None:
            self._tracking.follow_goal(True)
        return self._free.goal is not None

    def hold(self) -> None:
        """End the motion on the path of the pieces that were sent, whatever the states say: the arm follows these.

        Where it stands behind, or its progress is unknown, that would be a jump: then it completes its last command, which ends at rest.
        A goal of the controller is no such command: it is canceled, after the hold where one was sent. What the controller has ended
        by itself it holds by itself: nothing is sent.
        """
        goal = self._free.goal
        if goal is not None and goal.fault is not None:
            self._link.leave()
            return
        is_sent = False
        try:
            is_sent = self._brake()
        finally:
            if goal is not None:
                self._end(goal, is_braking=is_sent)

    def _brake(self) -> bool:
        time = self.clock.now()
        if self._tracking.stood_at is not None or not self.clock.is_known:
            return False
        for share in self.limits.acceleration_shares:
            if self._link.hold(self.pacing.halt(time, share), time):
                return True
            self.pacing.take_back()
        return False

    def _end(self, goal: ControllerGoal, *, is_braking: bool) -> None:
        """End a goal whose arm brakes by the hold: a cancel in between would stop it at once, with all that its drives can.

        The hold has replaced the trajectory of the goal, so that the controller usually ends it by itself once the arm stands.
        """
        until = self.pacing.ends + self.limits.tracking_lag
        while is_braking and goal.is_accepted and not goal.is_over and self.clock.now() < until:
            self.clock.sleep(self.limits.period)
        is_ended = goal.is_over
        if not is_ended:
            goal.cancel()
        if not is_ended or goal.fault is not None:
            self._link.leave()

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
            # A cubic from rest to rest is 1.5 times as fast as its mean: no faster than planned.
            arrives = max(arrives, 1.5 * (pacing.reaches - stood_at))
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


def _unwatched(duration: float, *, by_controller: bool) -> PlanningError:
    meanwhile = "the controller of the arm went on with its goal" if by_controller else "the arm has stopped by itself"
    return PlanningError(PushCode.TRACKING, f"the motion was not watched for {duration:.1f} s, and {meanwhile}.")


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
        if limits.free_motions == FOLLOW:
            self._arm.check_goals()
        self._take_over.check(limits)

    def trust(self) -> None:
        """Accept joint states again that contradicted the commands."""
        self._take_over.trust()

    def posture(self, limits: WatchLimits) -> Float64Array:
        """Start of the next motion [rad]: the commanded posture if the arm stands there, else the measured one."""
        state = self._arm.next_state(limits.arm_timeout)
        commanded = self._commanded.posture(self._arm.planner.joint_names)
        return state.q if commanded is None or joint_distance(state.q, commanded) > limits.start_tolerance else commanded

    def run(
        self,
        motion: ArmMotion,
        limits: WatchLimits,
        *,
        replan: Callable[[np.ndarray], ArmMotion],
        check_wanted: Callable[[], None],
        on_start: Callable[[ArmMotion, PathPacing], None],
        on_look: OnLook,
    ) -> None:
        """Make one motion.

        Args:
            replan: plans it once more from the posture [rad], if the arm was moved since.
            check_wanted: raises PlanningError when the motion should end.
            on_start: called with the motion that begins, and with what tells when the arm reaches which part of it.
            on_look: called at each check; may raise PlanningError, which ends the motion.

        Raises PlanningError: nothing moved, or the arm is held: TRACKING, ARM_SILENT, FORCE, HAND, RECORDING, LIMIT, and those of the
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

    def _follow(self, under_way: _UnderWay, check_wanted: Callable[[], None], on_look: OnLook) -> None:
        """Make a motion from where the arm stands: one thread, and nothing follows the hold."""
        clock, limits = under_way.clock, under_way.limits
        self.peak_force, _ = 0.0, self._force.take_peak()
        began = looked = self._clock.monotonic()
        self._arm.take_states()
        try:
            under_way.send(clock.started, began)
            while True:
                self._clock.sleep(limits.period)
                now, before = self._clock.monotonic(), looked
                looked = now
                check_wanted()
                state = self._arm.fresh_state(limits.arm_timeout, is_late=now - before > limits.late_look)
                if now - before > limits.max_absence:
                    raise _unwatched(now - before, by_controller=under_way.is_with_controller)
                under_way.check_controller()
                for each in self._arm.take_states():
                    under_way.judge(each)
                if reason := self._arm.impossible_state(began):
                    raise PlanningError(PushCode.TRACKING, f"joint_states cannot be true: {reason}")
                self._check_force(limits)
                self._check_equipment()
                time = clock.of(state)
                on_look(under_way.pacing.path_time(time), time, state, partial(self._change, under_way, now, limits))
                if under_way.has_arrived(state):
                    return
                if self._is_present(now, limits):
                    under_way.go_on(state, now)
        except BaseException as error:
            fault = self._cause(error, looked, under_way)
            under_way.hold()
            if fault is error:
                raise
            raise fault from error

    def _change(self, under_way: _UnderWay, looked: float, limits: WatchLimits, motion: ArmMotion) -> bool:
        return self._is_present(looked, limits) and under_way.change(motion, self._clock.monotonic())

    def _is_present(self, looked: float, limits: WatchLimits) -> bool:
        """Whether something may be sent: not where this process was suspended since it `looked` [s], which the next look reports."""
        return self._clock.monotonic() - looked <= limits.max_absence

    def _cause(self, fault: BaseException, looked: float, under_way: _UnderWay) -> BaseException:
        """Why a motion ended: to a process that was suspended since it `looked` [s], all sources seem silent."""
        unwatched, limits = self._clock.monotonic() - looked, under_way.limits
        seems_silent = isinstance(fault, PlanningError) and fault.code in (PushCode.FORCE, PushCode.HAND, PushCode.OBJECT_LOST)
        is_force = self.peak_force > limits.force_limit
        if not seems_silent or is_force or unwatched <= limits.max_absence:
            return fault
        return _unwatched(unwatched, by_controller=under_way.is_with_controller)

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
        """Raise PlanningError FORCE where the force is unknown now, so that its limit cannot be enforced."""
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
