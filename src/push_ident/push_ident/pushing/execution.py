"""Execution of a push: choose it, plan it, move the arm under watch, detect the contact, retreat where it fails, and report it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.frames import TABLE_FRAME, object_frame
from push_ident.geometry.se2 import transform_points
from push_ident.pushing.arm_motion import ArmMotion
from push_ident.pushing.executed_push import ExecutedPush, Purpose, displacement
from push_ident.pushing.motion import ArmPlan, PathPlan, plan_path_push, plan_push, plan_retreat, plan_turning_push
from push_ident.pushing.pacing import PathPacing
from push_ident.pushing.ports import ArmState, Client, ExecutionPorts, Phase, TrackedObject
from push_ident.pushing.possible_motion import why_impossible
from push_ident.pushing.push import PushCode, PushPlan2D
from push_ident.pushing.push_request import ExecutionSettings, Mode, PushOutcome, PushRequest
from push_ident.pushing.sampling import (
    is_near_edge,
    push_along_path,
    push_from_goal,
    push_with_both_ends,
    recentring_pushes,
    sample_push,
)
from push_ident.pushing.steering import PathRequest, Steering, ToolCorrection
from push_ident.pushing.tool_path import ToolPath
from push_ident.pushing.watch import ArmWatch, Change
from push_ident.types import Float64Array, PusherPath

PlanFrom = Callable[[np.ndarray], ArmPlan]


class PushExecution:
    """Carries out requests, one at a time.

    Args:
        on_push: called with every push that has begun, once it has ended.
        on_warning: called with texts for the operator.
    """

    def __init__(
        self, ports: ExecutionPorts, *, on_push: Callable[[ExecutedPush], None], on_warning: Callable[[str], None] = lambda text: None
    ) -> None:
        self._ports, self.on_push, self.on_warning = ports, on_push, on_warning
        self._watch = ArmWatch(ports)
        self._one_at_a_time = threading.Lock()
        self._stopped = threading.Event()
        self.steering: Steering | None = None
        """Of the push along a path that is under way."""
        self.is_pushing = False
        """Whether the tool is lowered for a push now."""
        self.n_pushes = 0
        """Pushes that have begun."""

    @property
    def is_idle(self) -> bool:
        """Whether no request is being carried out."""
        return not self._one_at_a_time.locked()

    @property
    def peak_force(self) -> float:
        """Largest horizontal force of the last motion [N]."""
        return self._watch.peak_force

    def stop(self, timeout: float) -> None:
        """Hold the arm if it moves, and refuse requests from now on; returns when nothing is under way, after `timeout` [s] at most."""
        self._stopped.set()
        if self._one_at_a_time.acquire(timeout=timeout):
            self._one_at_a_time.release()

    def start(self) -> None:
        """Take requests again after `stop`: an operator has checked the arm."""
        self._watch.trust()
        self._stopped.clear()

    def close_hand(self, timeout: float) -> str:
        """Close the hand; why it is not a closed fist, empty when it is."""
        if not self._one_at_a_time.acquire(blocking=False):
            return "a push is under way; wait for it or cancel it."
        try:
            return self._ports.hand.close_fist(timeout, self._stopped.is_set)
        finally:
            self._one_at_a_time.release()

    def execute(self, request: PushRequest, settings: ExecutionSettings, client: Client) -> PushOutcome:
        """Carry out one request; what fails is in `PushOutcome.error`."""
        outcome = PushOutcome()
        if not self._one_at_a_time.acquire(blocking=False):
            outcome.error = PlanningError(PushCode.BUSY, "another push is under way; wait for it or cancel it.")
            return outcome
        try:
            with self._ports.arm.in_use():
                _Execution(self, self._ports, self._watch, request, settings, client, outcome).run()
        except PlanningError as error:
            outcome.error = error
        except InputError as error:
            outcome.error = PlanningError(PushCode.INVALID_GOAL, str(error))
        finally:
            self._one_at_a_time.release()
        return outcome

    def correct(self, correction: ToolCorrection) -> None:
        """Take a correction of the push under way; in another thread. Raises InputError where it is refused."""
        if (steering := self.steering) is None:
            raise InputError("There is no push along a path now; corrections are for the push that its feedback names.")
        steering.offer(correction)

    def check_open(self) -> None:
        """Raise PlanningError CANCELED once `stop` was called."""
        if self._stopped.is_set():
            raise PlanningError(PushCode.CANCELED, "the node was stopped; the arm holds.")

    def begin(self) -> int:
        """Number of a push that begins."""
        self.n_pushes += 1
        return self.n_pushes


@dataclass(slots=True)
class _Execution:
    owner: PushExecution
    ports: ExecutionPorts
    watch: ArmWatch
    request: PushRequest
    settings: ExecutionSettings
    client: Client
    outcome: PushOutcome

    def run(self) -> None:
        """Raises PlanningError when the request is refused or the push fails."""
        request, settings = self.request, self.settings
        self.client.feedback(Phase.PLAN, 0.0)
        if request.mode not in tuple(Mode):
            expected = ", ".join(f"MODE_{mode.name} ({mode.value})" for mode in Mode)
            raise PlanningError(PushCode.INVALID_GOAL, f"mode is {request.mode}, expected one of {expected}.")
        if not request.dry_run:
            self.watch.check_ready(settings.limits)
        target = self._target(request.object_id)
        if not request.dry_run and self._should_recentre(target):
            self._refuse_impossible(target)
            self._recentre(target)
            target = self._target(target.object_id)

        def plan_from(q: np.ndarray) -> ArmPlan:
            return self._plan(target, q)

        self.outcome.object_id = target.object_id
        plan = self.outcome.plan = plan_from(self._posture())
        if request.dry_run:
            return
        purpose = Purpose.RECENTRE if request.mode == Mode.RECENTRE else Purpose.REQUESTED
        push = ExecutedPush(purpose, target, plan)
        try:
            self._make(push, plan_from, lambda elapsed: phase_of(push.plan, elapsed))
        finally:
            self.outcome.plan, self.outcome.push_id = push.plan, push.push_id
            self._end_steering()

    def _target(self, object_id: str) -> TrackedObject:
        """The object; raises PlanningError UNKNOWN_OBJECT where its pose is not known well enough."""
        target = self.ports.objects.get(object_id, self.settings.pose_timeout)
        std, limit = (
            float(np.sqrt(np.linalg.eigvalsh(target.covariance[:2, :2])[-1])),
            self.settings.motion.clearance / self.settings.clearance_deviations,
        )
        if std > limit:
            raise PlanningError(
                PushCode.UNKNOWN_OBJECT,
                f"the pose of `{target.object_id}` is too uncertain: standard deviation {1e3 * std:.1f} mm, limit {1e3 * limit:.1f} mm, a "
                "third of `clearance`: the tool might come down on it. Measure it better, or give more clearance.",
            )
        return target

    # ---- recentring

    def _should_recentre(self, target: TrackedObject) -> bool:
        """Only if the requested push does not depend on the pose of the object in the table frame."""
        follows = self.request.mode == Mode.RANDOM or (
            self.request.mode == Mode.CONTACT and self.request.frame_id == object_frame(target.object_id)
        )
        return self.settings.recentre and follows and is_near_edge(target.shape, target.pose, self.settings.push)

    def _refuse_impossible(self, target: TrackedObject) -> None:
        """Raise PlanningError INVALID_GOAL for a push that is impossible at any pose: nothing may move for it."""
        if self.request.mode != Mode.CONTACT:
            return
        try:
            self._requested_push(target)
        except PlanningError as error:
            if error.code == PushCode.INVALID_GOAL:
                raise

    def _recentre(self, target: TrackedObject) -> None:
        def plan_from(q: np.ndarray) -> ArmPlan:
            return self._plan_recentring(target, q)

        try:
            push = ExecutedPush(Purpose.RECENTRE, target, plan_from(self._posture()))
        except PlanningError as error:
            if error.code != PushCode.UNREACHABLE:
                raise
            self.owner.on_warning(f"`{target.object_id}` is near the edge of the workspace and stays there: {error}")
            return
        try:
            self._make(push, plan_from, lambda elapsed: Phase.RECENTRE)
        except PlanningError as error:
            raise PlanningError(error.code, f"while the object was pushed back to the middle: {error}") from None
        finally:
            self.outcome.recentre_push_id = push.push_id

    # ---- planning

    def _posture(self) -> Float64Array:
        return self.watch.posture(self.settings.limits)

    def _plan(self, target: TrackedObject, q_now: np.ndarray) -> ArmPlan:
        if self.request.mode == Mode.RECENTRE:
            return self._plan_recentring(target, q_now)
        if self.request.mode == Mode.PATH:
            return self._plan_path(target, q_now)
        if self.request.mode == Mode.CONTACT:
            return plan_push(self.ports.arm.planner, q_now, self._requested_push(target), self.settings.motion, self.settings.push.span)
        settings, obstacles = self.settings.push, self.ports.objects.outlines_of_others(target.object_id)
        rng = np.random.default_rng(self.request.seed)
        draws = (sample_push(target.shape, target.pose, rng, settings, obstacles) for _ in range(self.settings.n_plans))
        plan, refusal = self._first_plan(draws, q_now)
        if plan is None:
            raise PlanningError(PushCode.UNREACHABLE, f"none of {self.settings.n_plans} random pushes fits the arm; the last: {refusal}")
        return plan

    def _plan_path(self, target: TrackedObject, q_now: np.ndarray) -> ArmPlan:
        request, settings = self.request.path, self.settings
        if request is None:
            raise PlanningError(PushCode.INVALID_GOAL, "MODE_PATH without a path; give tool_path and corridor.")
        obstacles, motion = self.ports.objects.outlines_of_others(target.object_id), settings.motion
        if isinstance(request, ToolPath):
            push = push_with_both_ends(target.shape, target.pose, request, settings.push, obstacles, back_off=motion.back_off)
            return plan_turning_push(self.ports.arm.planner, q_now, push, request, motion, settings.push.span)
        if settings.push.span:
            raise PlanningError(PushCode.INVALID_GOAL, "tool_path has no yaws, and the tool has two contacts; give its yaw at each point.")
        push = push_along_path(target.shape, target.pose, request.path, settings.push, obstacles)
        return plan_path_push(self.ports.arm.planner, q_now, push, request.path, request.corridor, motion, settings.push)

    def _plan_recentring(self, target: TrackedObject, q_now: np.ndarray) -> ArmPlan:
        obstacles = self.ports.objects.outlines_of_others(target.object_id)
        pushes = recentring_pushes(target.shape, target.pose, self.settings.push, obstacles)
        plan, refusal = self._first_plan((push for _, push in zip(range(self.settings.n_plans), pushes, strict=False)), q_now)
        if plan is None:
            why = refusal or "no contact allows a push towards the middle"
            raise PlanningError(PushCode.UNREACHABLE, f"`{target.object_id}` cannot be pushed towards the middle: {why}")
        return plan

    def _first_plan(self, pushes: Iterable[PushPlan2D], q_now: np.ndarray) -> tuple[ArmPlan | None, PlanningError | None]:
        """The first push that the arm can make, or the last refusal."""
        refusal: PlanningError | None = None
        for push in self._while_wanted(pushes):
            try:
                return plan_push(self.ports.arm.planner, q_now, push, self.settings.motion, self.settings.push.span), None
            except PlanningError as error:
                refusal = error
        return None, refusal

    def _while_wanted(self, pushes: Iterable[PushPlan2D]) -> Iterable[PushPlan2D]:
        for push in pushes:
            self._check_wanted()
            yield push

    def _requested_push(self, target: TrackedObject) -> PushPlan2D:
        request, settings = self.request, self.settings
        point, direction = self._contact_in_table(target)
        distance, speed = request.distance or settings.push_distance, request.speed or settings.push_speed
        obstacles = self.ports.objects.outlines_of_others(target.object_id)
        return push_from_goal(target.shape, target.pose, point, direction, distance, speed, settings.push, obstacles)

    def _contact_in_table(self, target: TrackedObject) -> tuple[Float64Array, float]:
        """Contact point [m] and heading [rad] of the request in the table frame."""
        request, frame_of_object = self.request, object_frame(target.object_id)
        point = np.array(request.contact_point)
        if request.frame_id in ("", TABLE_FRAME):
            return point, float(request.direction)
        if request.frame_id == frame_of_object:
            return transform_points(target.pose, point[None])[0], float(request.direction + target.pose[2])
        raise PlanningError(PushCode.INVALID_GOAL, f"frame_id is `{request.frame_id}`, expected `{TABLE_FRAME}` or `{frame_of_object}`.")

    # ---- moving

    def _make(self, push: ExecutedPush, plan_from: PlanFrom, phase_at: Callable[[float], Phase]) -> None:
        """Make one push, planned again if the arm was moved, and report it if it has begun, however it ends.

        `phase_at` gives the phase to report for a time of the plan [s].
        """
        was_pushing = False
        try:
            try:
                self._move(push, plan_from, phase_at)
            finally:
                was_pushing, self.owner.is_pushing = self.owner.is_pushing, False
            self._check_contact(push)
        except PlanningError as failure:
            push.error = failure
        if was_pushing and push.error is not None and push.error.code in (PushCode.OBJECT_LOST, PushCode.CORRECTION):
            push.error = PlanningError(push.error.code, f"{push.error} {self._retreat(push)}")
        self._report(push)
        if push.error is not None:
            raise push.error

    def _report(self, push: ExecutedPush) -> None:
        if push.push_id and not push.is_reported:
            push.is_reported = True
            self.owner.on_push(push)

    def _move(self, push: ExecutedPush, plan_from: PlanFrom, phase_at: Callable[[float], Phase]) -> None:
        reported: tuple[Phase | None, float] = (None, -np.inf)

        def on_start(motion: ArmMotion, pacing: PathPacing) -> None:
            assert isinstance(motion, ArmPlan)
            push.push_id, push.plan, push.pacing = self.owner.begin(), motion, pacing
            push.started = push.ended = pacing.started
            if isinstance(motion, PathPlan):
                self._begin_steering(push.push_id, motion)

        def on_look(elapsed: float, time: float, state: ArmState, change: Change) -> None:
            nonlocal reported
            push.reached, push.ended, push.shift = elapsed, time, state.stamp - time
            self.owner.is_pushing = push.plan.lowered <= elapsed <= push.plan.rested
            push.observe_object(self.ports.objects.get(push.before.object_id, np.inf))
            if self.owner.is_pushing:
                push.observe(state)
                self._check_object(push)
            elif elapsed > push.plan.rested:
                self._observe_rest(push)
            phase, now = phase_at(elapsed), self.ports.clock.monotonic()
            if phase != reported[0] or now - reported[1] > self.settings.feedback_period:
                reported = (phase, now)
                if push.pacing is not None and np.isfinite(start := push.pacing.time_of(push.plan.departure)):
                    self.client.began(push.push_id, start)
                self.client.feedback(phase, elapsed / push.plan.duration)
            self._steer(push, elapsed, time, change)

        limits = self.settings.limits
        self.watch.run(push.plan, limits, replan=plan_from, check_wanted=self._check_wanted, on_start=on_start, on_look=on_look)
        if isinstance(push.plan, PathPlan):
            self.owner.is_pushing = False
            self._go_home(push, lambda: self._observe_rest(push))

    def _retreat(self, push: ExecutedPush) -> str:
        """Go home after an interrupted push, if a checked path leads there; the outcome as a sentence."""
        self.ports.clock.sleep(self.settings.standstill_time)
        try:
            self._go_home(push, lambda: None)
        except PlanningError as error:
            return f"The arm holds: {error}"
        return "The arm went home."

    def _go_home(self, push: ExecutedPush, on_look: Callable[[], None]) -> None:
        # A path that was interrupted may have another heading than at its end: back off from the object, not into it.
        settings, heading = self.settings.motion, push.plan.away_from(push.reached)
        keeps_yaw = bool(self.settings.push.span)

        def plan_from(q: np.ndarray) -> ArmMotion:
            return plan_retreat(self.ports.arm.planner, q, heading, settings, keeps_yaw=keeps_yaw)

        def look(elapsed: float, time: float, state: ArmState, change: Change) -> None:
            on_look()
            self.client.feedback(Phase.RETREAT, 1.0)

        self.watch.run(
            plan_from(self._posture()),
            self.settings.limits,
            replan=plan_from,
            check_wanted=self._check_wanted,
            on_start=lambda motion, pacing: None,
            on_look=look,
        )

    def _observe_rest(self, push: ExecutedPush) -> None:
        """A push is complete when the object was observed at rest after it, before the way home."""
        push.observe_object(self.ports.objects.get(push.before.object_id, np.inf))
        if not push.is_reported and not self._why_no_contact(push) and not self._why_elsewhere(push):
            self._report(push)

    # ---- corrections

    def _begin_steering(self, push_id: int, plan: PathPlan) -> None:
        request, settings = self.request.path, self.settings
        assert isinstance(request, PathRequest), "it was planned"
        object_id = self.outcome.object_id
        timeout = settings.limits.patience(request.correction_timeout) if request.correction_timeout else 0.0
        steering = Steering(request, settings.push, lambda: self.ports.objects.outlines_of_others(object_id), timeout)
        steering.begin(push_id, plan)
        self.owner.steering = steering

    def _steer(self, push: ExecutedPush, elapsed: float, time: float, change: Change) -> None:
        if (steering := self.owner.steering) is not None:
            push.plan = steering.look(elapsed, time, self.ports.clock.monotonic(), change)

    def _end_steering(self) -> None:
        steering, self.owner.steering = self.owner.steering, None
        if steering is not None:
            self.outcome.n_corrections, self.outcome.n_refused = steering.n_made, steering.refused.total()

    # ---- checks

    def _check_wanted(self) -> None:
        self.owner.check_open()
        if why := self.client.why_over:
            raise PlanningError(PushCode.CANCELED, f"{why}; the arm holds.")

    def _check_object(self, push: ExecutedPush) -> None:
        """Raise PlanningError OBJECT_LOST when there are no poses of the object any more, or its origin has left the workspace."""
        patience = self.settings.limits.patience(self.settings.lost_timeout)
        try:
            now = self.ports.objects.get(push.before.object_id, patience)
        except PlanningError as error:
            raise PlanningError(PushCode.OBJECT_LOST, f"lost during the push: {error}") from None
        excess, before = (self.settings.push.excess(pose[None, :2]) for pose in (now.pose, push.before.pose))
        if excess > before + self.settings.workspace_drift:
            x, y = now.pose[:2]
            raise PlanningError(PushCode.OBJECT_LOST, f"`{now.object_id}` left the workspace: it is at ({x:.3f}, {y:.3f}) m.")

    def _check_contact(self, push: ExecutedPush) -> None:
        """Raise PlanningError NO_CONTACT when the object stayed, OBJECT_LOST when no pose arrived that a push can have made."""
        clock = self.ports.clock
        deadline = clock.monotonic() + self.settings.pose_timeout
        while not push.is_reported and (reason := self._why_no_contact(push)):
            self.owner.check_open()
            if push.rest_after.n:
                raise PlanningError(PushCode.NO_CONTACT, reason)
            if clock.monotonic() > deadline:
                raise PlanningError(PushCode.OBJECT_LOST, f"no pose of `{push.before.object_id}` after the push.")
            clock.sleep(self.settings.limits.period)
            push.observe_object(self.ports.objects.get(push.before.object_id, np.inf))
        if not push.is_reported and (reason := self._why_elsewhere(push)):
            raise PlanningError(PushCode.OBJECT_LOST, f"`{push.before.object_id}` cannot be where its pose says after this push: {reason}")

    def _why_elsewhere(self, push: ExecutedPush) -> str:
        """Why this push cannot have caused the poses of the object after it; empty if it can."""
        (time, tip), tool = push.plan.tool_path, self.settings.push.tool
        before, after = push.rest_before, push.rest_after
        return why_impossible(
            push.before.shape,
            PusherPath(time, tip[:, :2], tool.radius, tool.polygon, push.plan.tool_yaw, tool.fingers),
            before.mean,
            after.mean,
            covariance_before=before.covariance * before.n,
            covariance_after=after.covariance * after.n,
        )

    def _why_no_contact(self, push: ExecutedPush) -> str:
        """Why a push did not move the object, by its poses; empty if it did."""
        if not push.rest_after.n:
            return "The object was not seen after the push."
        shift, turn, is_beyond_noise = displacement(push.rest_before, push.rest_after)
        if shift <= self.settings.min_object_shift and turn <= self.settings.min_object_turn:
            return f"`{push.before.object_id}` moved by {1e3 * shift:.1f} mm and {turn:.3f} rad only; was its pose right?"
        if is_beyond_noise:
            return ""
        return f"`{push.before.object_id}` moved by {1e3 * shift:.1f} mm and {turn:.3f} rad, no more than its poses are uncertain."


def phase_of(plan: ArmPlan, elapsed: float) -> Phase:
    """Phase of a push at a time of its plan [s]."""
    if elapsed < plan.lowered:
        return Phase.APPROACH
    if elapsed < plan.stop:
        return Phase.PUSH
    return Phase.REST if elapsed < plan.rested else Phase.RETREAT
