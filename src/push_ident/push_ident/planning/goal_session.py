"""Pushing an object to a goal: observe, explore, plan, push, learn, until it is there or a reason to end occurs.

The steps know the cell only through `GoalPorts`; the node has those of ROS, a test has its own. A step that takes time is begun and then
polled every 10 ms, so that a cancellation is noticed within that time during any step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Final, TypeVar

import numpy as np

from push_ident.errors import PlanningError
from push_ident.geometry.se2 import transform_points
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.physics.overhang import TableEdge
from push_ident.planning.edge_goal import EdgeGoal
from push_ident.planning.goal import CERTAIN, Goal, GoalCode, GoalRefusedError, Target
from push_ident.planning.goal_ports import (
    GoalOutcome,
    GoalPorts,
    GoalProgress,
    GoalRequest,
    GoalState,
    KnownModel,
    PushReport,
    PushUnderWay,
    SessionLimits,
    UnderWay,
    Wish,
)
from push_ident.planning.keep_out import overlapping
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.planner import GoalPush, PlanStatus
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.pushing.sampling import sample_push
from push_ident.types import Float64Array, ObjectShape

T = TypeVar("T")


class Ended(Exception):
    """A session ends: code and text."""

    def __init__(self, code: GoalCode, text: str) -> None:
        super().__init__(text)
        self.code, self.text = code, text


_WITHOUT_REMEDY: Final = frozenset({PushCode.HAND, PushCode.RECORDING, PushCode.BUSY, PushCode.FORCE, PushCode.TRACKING})
"""Failures of the executor that do not depend on the contact."""
_ANOTHER_CONTACT: Final = frozenset({PushCode.NO_CONTACT, PushCode.UNREACHABLE, PushCode.LIMIT, PushCode.INVALID_GOAL})
"""Failures that belong to this push: the object was missed, or the arm cannot make it."""


class GoalSession:
    """One goal; `on_progress` is called with the progress at each change and every 0.1 s."""

    def __init__(
        self,
        request: GoalRequest,
        ports: GoalPorts,
        limits: SessionLimits | None = None,
        *,
        on_progress: Callable[[GoalProgress], None] = lambda progress: None,
    ) -> None:
        self._request, self._ports, self._limits = request, ports, limits or SessionLimits()
        self._on_progress = on_progress
        assert not isinstance(request.goal, PathGoal), "that is for PathSession"
        self._choice = TargetChoice(request.goal, ports)
        self._observed: TrackedObject | None = None
        self._object_id = request.object_id
        self._started = ports.now()
        self._reported = -np.inf
        self._failed: list[PushPlan2D] = []
        self._refusals = 0
        self.progress = GoalProgress()

    def check(self) -> None:
        """Raise GoalRefusedError for a goal that cannot be reached whatever is pushed. Moves nothing; waits for an object of which nothing
        is known yet.

        The pose may be old: a push for another goal may hide the object.
        """
        try:
            observed = self._wait(lambda: self._ports.observe(self._object_id, np.inf, -np.inf), self._limits.unknown_patience)
            if observed is None:
                raise Ended(GoalCode.UNKNOWN_OBJECT, self._ports.why_unseen(self._object_id))
            self._check(observed)
        except Ended as end:
            raise GoalRefusedError(end.code, end.text) from None

    def run(self) -> GoalOutcome:
        """Carry it out. Returns, whatever happens in the cell; exceptions are errors of the program or of the ports."""
        try:
            self._run()
            code, text = GoalCode.NONE, "" if self.progress.pushes else f"already at the goal ({self._distance()}); nothing was pushed."
        except Ended as end:
            code, text = end.code, end.text
        self.progress.elapsed = self._ports.now() - self._started
        return GoalOutcome(code, text, self.progress)

    # ---- the steps

    def _run(self) -> None:
        observed = self._observe(-np.inf, GoalCode.UNKNOWN_OBJECT)
        self._check(observed)
        if not self._is_there(observed):
            # Identification may still process a push of another client, such as the goal before.
            self._learn(observed.object_id, self._ports.pushed_at(observed.object_id))
        if self._request.explore and not self._is_there(observed):
            observed = self._explore(self._certain(observed))
        self._go_to_pose(observed)

    def _go_to_pose(self, observed: TrackedObject) -> None:
        while not self._is_there(observed):
            observed = self._certain(observed)
            plan = self._plan(observed)
            if plan.status is PlanStatus.ARRIVED:
                return
            observed = self._push_to_goal(observed, plan)

    def _settings(self) -> PushSettings:
        settings = self._ports.push_settings()
        if settings is None:
            raise Ended(GoalCode.ARM_SILENT, "nothing was received on pusher/shape yet; is push_executor_node running?")
        return settings

    def _check(self, observed: TrackedObject) -> None:
        """End where the goal cannot be, or nothing is known and nothing may be explored. What is there needs neither arm nor model."""
        if self._is_there(observed):
            return
        settings, goal = self._settings(), self._request.goal
        if not isinstance(goal, Goal):
            self._check_edge(observed)
        else:
            at_goal, now = (settings.excess(transform_points(pose, observed.shape.outline)) for pose in (goal.pose, observed.pose))
            # The planner accepts no push after which the outline reaches further out than before it.
            if at_goal > max(now, 1e-6):
                raise Ended(
                    GoalCode.OUTSIDE_WORKSPACE,
                    f"at the goal `{observed.object_id}` would reach {1e3 * at_goal:.0f} mm out of the workspace {settings.workspace} m; "
                    "choose a goal further inside.",
                )
            self._check_clear(observed, goal.pose)
        self._check_known(observed)

    def _check_clear(self, observed: TrackedObject, poses: Float64Array) -> None:
        """End where the object would enter an obstacle at one of some poses, shape (..., 3)."""
        if entered := overlapping(observed.shape.outline, poses, self._ports.obstacles(observed.object_id)):
            raise Ended(
                GoalCode.UNREACHABLE,
                f"at the goal `{observed.object_id}` would overlap {', '.join(entered)}; move that away, or choose another goal.",
            )

    def _outlines(self, observed: TrackedObject) -> list[Float64Array]:
        """Of what must not be touched, table frame [m], each of shape (n, 2)."""
        return [one.outline for one in self._ports.obstacles(observed.object_id)]

    def _check_known(self, observed: TrackedObject) -> None:
        model = self._ports.model(observed.object_id)
        is_learning = model is not None and self._ports.pushed_at(observed.object_id) > model.stamp
        if model is not None and not model.is_known and not is_learning and not self._request.explore and not self._is_there(observed):
            raise self._nothing_known(observed)

    def _check_edge(self, observed: TrackedObject) -> None:
        """End where the object can be at no edge, by the present model."""
        if not self._choice.edges():
            raise Ended(
                GoalCode.EDGE_UNKNOWN,
                "the table's edge is not known; give the edge with the goal, or the corners of the table as parameter table_corners.",
            )
        if (model := self._ports.model(observed.object_id)) is None:
            return
        self._choice.forget()
        try:
            self._settle(model, observed)
        except Ended as end:
            # Exploring pushes will determine the centre of mass.
            if end.code is not GoalCode.NOT_HELD or not self._request.explore:
                raise

    @staticmethod
    def _nothing_known(observed: TrackedObject) -> Ended:
        return Ended(
            GoalCode.NOTHING_KNOWN,
            f"no push of `{observed.object_id}` was learned yet; allow exploring pushes (explore), push it first, or load a model.",
        )

    def _explore(self, observed: TrackedObject) -> TrackedObject:
        """Make the exploring pushes; the object after them."""
        # Another seed for each push that was learned: the same random push again would show little.
        made, seed = 0, 1000 * self._model(observed).n_pushes
        self._choice.forget()
        while made < self._request.explore:
            self._check_pushes()
            self.progress.plan = None
            self._enter(GoalState.EXPLORE)
            try:
                report = self._carry_out(self._ports.begin_push(observed.object_id, self._random_push(observed, seed)))
            except PlanningError as error:
                report = PushReport(PushCode.UNREACHABLE, str(error))
            seed += 1
            made += report.code is PushCode.NONE
            self._take_report(report, None)
            observed = self._after_push(observed, report)
            if self._is_there(observed):
                break
        return observed

    def _random_push(self, observed: TrackedObject, seed: int) -> PushPlan2D | int:
        """An exploring push. Beside obstacles it is chosen here: of those the executor keeps the tool clear, but not the object.

        Raises:
            PlanningError: none is possible.
        """
        outlines = self._outlines(observed)
        if self._choice.is_at_edge or not outlines:
            return self._choice.random_push(observed, seed)
        push = self._wait(self._ports.begin_random(self._model(observed), observed, outlines, seed).result)
        assert push is not None, "without a timeout"
        return push

    def _settle(self, model: KnownModel, observed: TrackedObject) -> None:
        """Choose the target, or judge it anew with a newer model."""
        if (work := self._choice.begin(model, observed)) is not None:
            self._choice.take(self._computed(work, observed), model)
            self._compare(observed)

    def _computed(self, work: UnderWay[T], observed: TrackedObject) -> T:
        try:
            result = self._wait(work.result)
            assert result is not None, "without a timeout"
            return result
        except Ended:
            raise
        except GoalRefusedError as error:
            raise Ended(error.code, str(error)) from error
        except Exception as error:
            raise Ended(
                GoalCode.MODEL,
                f"no push can be planned with the model of `{observed.object_id}` ({type(error).__name__}: {error}); push it or load "
                "another.",
            ) from error

    def _plan(self, observed: TrackedObject) -> GoalPush:
        self._check_pushes()
        model = self._model(observed)
        self._enter(GoalState.PLAN)

        def plan() -> GoalPush:
            self._settle(model, observed)
            assert self._choice.target is not None, "settled"
            obstacles = self._outlines(observed)
            return self._computed(self._ports.begin_plan(model, observed, self._choice.target, obstacles, list(self._failed)), observed)

        plan_made = plan()
        if plan_made.status is PlanStatus.UNHELD:
            # From the present pose and model, another pose may be nearer.
            self._choice.forget()
            plan_made = plan()
        return self._usable(plan_made, observed)

    def _usable(self, plan: GoalPush, observed: TrackedObject) -> GoalPush:
        """A plan with a push, or with the object at the goal; ends with the reason otherwise."""
        if plan.status is PlanStatus.UNHELD:
            raise Ended(GoalCode.NOT_HELD, f"{plan.status.value} (the least chance is {100 * plan.risk:.1f} %).")
        if plan.status is PlanStatus.BLOCKED or plan.status is PlanStatus.UNTOUCHED:
            names = ", ".join(one.name for one in self._ports.obstacles(observed.object_id))
            raise Ended(GoalCode.UNREACHABLE, f"{plan.status.value} (they are {names}).")
        if plan.status is PlanStatus.UNREACHABLE:
            tried = f", beside {len(self._failed)} that failed" if self._failed else ""
            risky = "; at the edge, each may risk its fall as well" if self._choice.is_at_edge else ""
            raise Ended(GoalCode.UNREACHABLE, f"{plan.status.value}{tried}{risky}.")
        if plan.status is PlanStatus.UNSURE:
            raise Ended(GoalCode.TOLERANCE, self._unsure(observed))
        return plan

    def _push_to_goal(self, observed: TrackedObject, plan: GoalPush) -> TrackedObject:
        """Make a planned push, learn from it, and observe the object."""
        assert plan.plan is not None, "the planner proposes a push"
        self.progress.plan, self.progress.step, self.progress.tool = plan, None, None
        self._enter(GoalState.PUSH)
        report = self._carry_out(self._ports.begin_push(observed.object_id, plan.path or plan.plan))
        self._take_report(report, plan.plan)
        return self._after_push(observed, report)

    def _after_push(self, before: TrackedObject, report: PushReport) -> TrackedObject:
        """The object after a push. At the goal, do not wait for identification: no push follows."""
        observed = self._observe(self._ports.now(), GoalCode.OBJECT_LOST)
        if report.code is PushCode.NONE and not self._is_there(observed):
            self._learn(observed.object_id, max(before.stamp, report.stamp))
        return observed

    def _learn(self, object_id: str, since: float) -> None:
        """Wait until identification has processed a push that began at `since` [s]; continue with the model before if it does not."""

        def learned() -> bool | None:
            model = self._ports.model(object_id)
            return True if model is not None and model.stamp > since else None

        if learned():
            return
        self._enter(GoalState.LEARN)
        if self._wait(learned, self._limits.learn_timeout) is None:
            self._say(f"identification did not learn the push within {self._limits.learn_timeout:g} s; going on with what was known")

    def _take_report(self, report: PushReport, push: PushPlan2D | None) -> None:
        """Go on after a push, after a failed one with another contact, or end. `push`: None where it was a random one."""
        if report.code is PushCode.NONE:
            self._refusals = 0
            if push is not None:
                self._failed.clear()
            return
        text = f"the push failed ({report.code.name}): {report.text}"
        if report.code is PushCode.ARM_SILENT:
            raise Ended(GoalCode.ARM_SILENT, f"{text} Is the arm's driver running, and push_executor_node active?")
        if report.code in _WITHOUT_REMEDY or report.code is PushCode.CANCELED:
            raise Ended(GoalCode.PUSH_FAILED, f"{text} Look at the cell, then send the goal again; what was learned is kept.")
        self._refusals += 1
        if self._refusals > self._limits.max_refusals:
            raise Ended(GoalCode.PUSH_FAILED, f"{self._refusals} pushes in a row failed; the last ({report.code.name}): {report.text}")
        self._say(text)
        if push is not None and report.code in _ANOTHER_CONTACT:
            self._failed.append(push)

    # ---- observing

    def _observe(self, after: float, code: GoalCode) -> TrackedObject:
        """The object by a pose received after `after`, monotonic [s]; ends with `code` where it does not come into view."""
        self._enter(GoalState.OBSERVE)
        patience = self._limits.object_patience
        observed = self._wait(lambda: self._ports.observe(self._object_id, self._limits.pose_timeout, after), patience)
        if observed is None:
            why = self._ports.why_unseen(self._object_id)
            if code is GoalCode.OBJECT_LOST and self._was_over_edge():
                raise self._fell(f"was lost while it overhung the table's edge: it fell, as far as is known ({why})")
            raise Ended(code, f"{why} It was waited for {patience:g} s: put the object into view of the camera, or look at perception.")
        if self._choice.is_off_table(observed.shape.outline, observed.pose):
            raise self._fell("is seen beside the table: it fell.")
        return self._note_observed(observed)

    def _fell(self, how: str) -> Ended:
        remedy = "Put it back on the table, then send the goal again, with less overhang or more of it held; what was learned is kept."
        return Ended(GoalCode.FELL, f"`{self._object_id}` {how} {remedy}")

    def _note_observed(self, observed: TrackedObject) -> TrackedObject:
        self._object_id = self.progress.object_id = observed.object_id
        self.progress.observed, self.progress.pose, self._observed = self.progress.pushes, observed.pose, observed
        self._compare(observed)
        self.report(at_once=True)
        return observed

    def _compare(self, observed: TrackedObject) -> None:
        """Update the errors of the progress."""
        target, progress = self._choice.target, self.progress
        progress.target = target
        if target is not None:
            progress.error, progress.chance = target.goal.error(observed.pose), target.goal.chance(observed.pose, observed.covariance)
            progress.margin = target.margin(observed.pose)
            progress.overhang = target.overhang(transform_points(observed.pose, observed.shape.outline))

    def _was_over_edge(self) -> bool:
        """Whether the object overhung the edge when it was last observed, or should after the push made then."""
        observed, plan = self._observed, self.progress.plan
        if observed is None:
            return False
        poses = [observed.pose] if plan is None or plan.plan is None else [observed.pose, plan.end]
        return self._choice.overhangs(observed.shape.outline, poses)

    def _is_there(self, observed: TrackedObject) -> bool:
        target = self._choice.target
        return target is not None and target.is_reached(observed.pose, observed.covariance)

    def _certain(self, observed: TrackedObject) -> TrackedObject:
        """The object by a pose that is certain enough for the tolerances."""

        def certain() -> TrackedObject | None:
            latest = self._ports.observe(self._object_id, self._limits.pose_timeout, -np.inf)
            return latest if latest is not None and self._can_tell(latest) else None

        if self._can_tell(observed):
            return observed
        latest = self._wait(certain, self._limits.blur_patience)
        if latest is None:
            raise Ended(GoalCode.TOLERANCE, self._unsure(observed))
        return self._note_observed(latest)

    def _can_tell(self, observed: TrackedObject) -> bool:
        tolerance = self._choice.tolerance
        return tolerance.chance(tolerance.pose, observed.covariance) >= CERTAIN

    def _unsure(self, observed: TrackedObject) -> str:
        std, tolerance = np.sqrt(np.diag(observed.covariance)), self._choice.tolerance
        return (
            f"the pose is known to {1e3 * float(np.hypot(std[0], std[1])):.1f} mm and {std[2]:.3f} rad (standard deviations): not enough "
            f"for the tolerance of {1e3 * tolerance.position:.1f} mm and {tolerance.yaw:.3f} rad; allow more, or bring the camera nearer."
        )

    def _model(self, observed: TrackedObject) -> KnownModel:
        """Model of the object; ends where identification publishes none."""

        def fitting() -> KnownModel | None:
            model = self._ports.model(observed.object_id)
            return model if model is not None and model.posterior.unknowns.shape.is_same_object(observed.shape) else None

        model = self._wait(fitting, self._limits.object_patience)
        if model is None and self._ports.model(observed.object_id) is not None:
            raise Ended(
                GoalCode.MODEL,
                f"the model of `{observed.object_id}` is of an object of another shape; look at identification, or load another.",
            )
        if model is None:
            raise Ended(
                GoalCode.UNKNOWN_OBJECT, f"identification has published no model of `{observed.object_id}`; is identification_node active?"
            )
        if not model.is_known and not self._request.explore:
            raise self._nothing_known(observed)
        return model

    # ---- waiting

    def _carry_out(self, push: PushUnderWay, look: Callable[[], None] = lambda: None) -> PushReport:
        """Wait for a push to end, and `look` again and again; the arm holds where the client cancels or the time is over."""

        def ended() -> PushReport | None:
            look()
            return push.report()

        try:
            report = self._wait(ended, finish=True)
            assert report is not None, "without a timeout"
        except Ended:
            deadline = self._ports.now() + self._limits.hold_timeout
            push.cancel()
            # Until the goal has reached the executor there is nothing to cancel there: it is asked again.
            while (held := push.report()) is None and self._ports.now() < deadline:
                self._ports.sleep(self._limits.poll)
                push.cancel()
            self.progress.pushes += 0 if held is None else held.n_made
            raise
        self.progress.pushes += report.n_made
        if report.code is PushCode.OBJECT_LOST:
            self._say(f"lost during a push: {report.text}")
        if self._ports.wish() is Wish.FINISH:
            raise self._preempted()
        return report

    def _wait(self, poll: Callable[[], T | None], timeout: float = np.inf, *, finish: bool = False) -> T | None:
        """Wait for a result of `poll`; None after `timeout` [s]. Ends where the client cancels, or time is over.

        `finish`: a newer goal does not end it.
        """
        deadline = self._ports.now() + timeout
        while True:
            self._check_wanted(finish)
            result = poll()
            if result is not None or self._ports.now() >= deadline:
                return result
            self.report()
            self._ports.sleep(self._limits.poll)

    def _check_wanted(self, finish: bool) -> None:
        wish = self._ports.wish()
        if wish is Wish.HOLD:
            raise Ended(GoalCode.CANCELED, "canceled on request; the arm holds. What was learned is kept.")
        if wish is Wish.FINISH and not finish:
            raise self._preempted()
        self.progress.elapsed = self._ports.now() - self._started
        if self.progress.elapsed > self._request.time_limit:
            raise Ended(
                GoalCode.TIME_LIMIT,
                f"not at the goal after {self._request.time_limit:g} s ({self._distance()}); the arm holds. Send the goal again: what was "
                "learned is kept.",
            )

    @staticmethod
    def _preempted() -> Ended:
        return Ended(GoalCode.PREEMPTED, "a newer goal took its place; what was learned is kept.")

    def _check_pushes(self) -> None:
        if self.progress.pushes >= self._request.max_pushes:
            raise Ended(
                GoalCode.MAX_PUSHES,
                f"not at the goal after {self.progress.pushes} pushes ({self._distance()}); send the goal again, what was learned is kept, "
                "or allow more tolerance.",
            )

    def _distance(self) -> str:
        position, yaw = self.progress.error
        return f"{1e3 * position:.1f} mm and {yaw:.3f} rad from it" if np.isfinite(position) else "no distance is known"

    def _enter(self, state: GoalState) -> None:
        self.progress.state = state
        self.report(at_once=True)

    def _say(self, text: str) -> None:
        self.progress.note = text
        self.report(at_once=True)
        self.progress.note = ""

    def report(self, *, at_once: bool = False) -> None:
        """Hand out the progress if that is due."""
        now = self._ports.now()
        if at_once or now - self._reported >= self._limits.feedback_period:
            self._reported = now
            self.progress.elapsed = now - self._started
            self._on_progress(self.progress)


def push_on_table(
    shape: ObjectShape,
    pose: Float64Array,
    seed: int,
    settings: PushSettings,
    edges: Sequence[TableEdge],
    obstacles: Sequence[Float64Array] = (),
    *,
    n_draws: int = 200,
    clearance: float = 0.01,
) -> PushPlan2D:
    """A random push after which the object, moved along all of it, is on the table; where it is not now, nearer to that.

    The outline may turn out over the edge; the centre of mass may not: no push moves it further than the tool goes. `pose`: of the object,
    shape (3,), table frame; `obstacles`: outlines of other objects, table frame [m], each of shape (n_vertices, 2); `clearance`: least
    distance of the outline from the edge after the push [m]: it slides on by up to 2.5 mm, and poses have errors.

    Raises:
        PlanningError: UNREACHABLE where no such push is found.
    """
    outline, rng = transform_points(pose, shape.outline), np.random.default_rng(seed)
    # Where it overhangs already, the push must lead back by the clearance.
    allowed = [max(-clearance, float(np.max(edge.beyond(outline))) - clearance) for edge in edges]
    for _ in range(n_draws):
        push = sample_push(shape, pose, rng, settings, obstacles)
        after = outline + push.distance * push.heading
        if all(float(np.max(edge.beyond(after))) <= most for edge, most in zip(edges, allowed, strict=True)):
            return push
    raise PlanningError(PushCode.UNREACHABLE, f"none of {n_draws} random pushes keeps the object on the table; move it away from the edge.")


class TargetChoice:
    """The target of one goal.

    At an edge it is chosen once, and again only after `forget`; what holds the object there is judged anew with each newer model.
    `target` is None before it was chosen; `tolerance` has the tolerances of the goal, about any pose.
    """

    def __init__(self, goal: Goal | EdgeGoal, ports: GoalPorts) -> None:
        self._goal, self._ports = goal, ports
        self.target = Target(goal) if isinstance(goal, Goal) else None
        self.tolerance = goal if isinstance(goal, Goal) else Goal(np.zeros(3), goal.position, goal.turn)
        self._judged_by: ModelPosterior | None = None

    @property
    def is_at_edge(self) -> bool:
        """Whether the goal is at an edge."""
        return isinstance(self._goal, EdgeGoal)

    def edges(self) -> Sequence[TableEdge]:
        """The edge of the goal, else those of the table."""
        given = self._goal.edge if isinstance(self._goal, EdgeGoal) else None
        return self._ports.known_edges() if given is None else [given]

    def forget(self) -> None:
        """At an edge another pose may be chosen."""
        if self.is_at_edge:
            self.target = None

    def begin(self, model: KnownModel, observed: TrackedObject) -> UnderWay[Target] | None:
        """Begin to choose or judge with a model; None if that is not needed. The result is for `take`."""
        if not isinstance(self._goal, EdgeGoal) or (self.target is not None and self._judged_by is model.posterior):
            return None
        return self._ports.begin_target(model, observed, self._goal, self.edges(), self.target)

    def take(self, target: Target, model: KnownModel) -> None:
        """Keep what came of `begin` with the same model."""
        self.target, self._judged_by = target, model.posterior

    def random_push(self, observed: TrackedObject, seed: int) -> PushPlan2D | int:
        """An exploring push; its seed where the executor may choose it. Beside an edge it may not: it knows of none.

        Raises:
            PlanningError: no random push keeps the object on the table.
        """
        settings = self._ports.push_settings()
        if not self.is_at_edge or settings is None:
            return seed
        outlines = [one.outline for one in self._ports.obstacles(observed.object_id)]
        return push_on_table(observed.shape, observed.pose, seed, settings, self.edges(), outlines)

    def is_off_table(self, outline: Float64Array, pose: Float64Array) -> bool:
        """Whether all of an outline, shape (n, 2), object frame, lies beyond the edge of the target at a pose, shape (3,)."""
        hold = None if self.target is None else self.target.hold
        return hold is not None and float(np.min(hold.edge.beyond(transform_points(pose, outline)))) > 0.0

    def overhangs(self, outline: Float64Array, poses: Iterable[Float64Array]) -> bool:
        """Whether an outline, shape (n, 2), object frame, overhangs the edge of the target at one of some poses, each of shape (3,)."""
        target = self.target
        return target is not None and any(target.overhang(transform_points(pose, outline)) > 0.0 for pose in poses)
