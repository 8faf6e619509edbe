"""The steps of pushing to a goal, with a cell that lives in memory: an object that goes where it is pushed, and a clock that is set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

import numpy as np
import pytest

from helpers.objects import hammer
from push_ident.errors import InputError
from push_ident.identification.results.posterior import ModelPosterior, prior_posterior
from push_ident.physics.overhang import TableEdge
from push_ident.planning.edge_goal import EdgeGoal
from push_ident.planning.goal import Goal, GoalCode, GoalRefusedError, Target
from push_ident.planning.goal_ports import (
    GoalOutcome,
    GoalProgress,
    GoalRequest,
    GoalState,
    KnownModel,
    PushReport,
    SessionLimits,
    Wish,
)
from push_ident.planning.goal_session import GoalSession
from push_ident.planning.hold import EdgeHold
from push_ident.planning.planner import GoalPush, PlanStatus
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.types import Float64Array

GOAL = Goal(np.array([0.05, 0.05, 0.5]))
SHAPE = hammer(1).shape
PUSH_SECONDS = 8.0
LEARN_SECONDS = 2.0
T = TypeVar("T")


@pytest.fixture(scope="module")
def posterior() -> ModelPosterior:
    return prior_posterior(SHAPE)


@dataclass
class Computed(Generic[T]):
    """What is there after a while."""

    cell: Cell
    found: T | Exception
    ready: float

    def result(self) -> T | None:
        if self.cell.now() < self.ready:
            return None
        if isinstance(self.found, Exception):
            raise self.found
        return self.found


@dataclass
class Push:
    """A push that ends after a while, or when it is cancelled."""

    cell: Cell
    outcome: PushReport
    motion: Float64Array
    ends: float
    is_over: bool = False
    cancelled_at: float | None = None

    def report(self) -> PushReport | None:
        if self.cancelled_at is not None:
            return PushReport(PushCode.CANCELED, "canceled on request; the arm holds.", 1)
        if self.cell.now() < self.ends:
            return None
        if not self.is_over:
            self.is_over = True
            if self.outcome.code is PushCode.NONE:
                self.cell.pose = self.cell.pose + self.motion
                self.cell.learned = (self.cell.now() + LEARN_SECONDS, self.cell.now())
        return replace(self.outcome, stamp=self.ends - 1.0)

    def cancel(self) -> None:
        if self.cancelled_at is None:
            self.cancelled_at = self.cell.now()


@dataclass
class Cell:
    """`GoalPorts` in memory. Each push to the goal takes away all but a tenth of the error."""

    posterior: ModelPosterior
    time: float = 100.0
    pose: Float64Array = field(default_factory=lambda: np.array([-0.05, -0.05, 0.0]))
    std: float = 1e-3
    is_known: bool = True
    learned: tuple[float, float] = (-1.0, 0.0)
    """When the model becomes known, and its stamp then."""
    outcomes: list[PushReport] = field(default_factory=list)
    """Of the next pushes; then all succeed."""
    plans: list[GoalPush | Exception] = field(default_factory=list)
    """The next plans; then they are made."""
    is_visible: Callable[[float], bool] = lambda time: True
    wants: Callable[[Cell], Wish] = lambda cell: Wish.GO_ON
    learns: bool = True
    pushed: float = -np.inf
    """Start of a push that somebody made before."""
    settings: PushSettings | None = field(default_factory=PushSettings)
    pushes: list[Push] = field(default_factory=list)
    asked: list[PushPlan2D | int] = field(default_factory=list)
    edges: list[TableEdge] = field(default_factory=list)
    """Of the table."""
    targets: list[Goal | Exception] = field(default_factory=list)
    """What is chosen at an edge, one after another; the last one again and again."""
    failed: list[int] = field(default_factory=list)
    """Number of failed pushes passed to each plan."""

    def now(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds

    def observe(self, object_id: str, max_age: float, after: float) -> TrackedObject | None:
        if object_id not in ("", "o1") or not self.is_visible(self.time):
            return None
        return TrackedObject("o1", SHAPE, self.time, self.pose, self.std**2 * np.eye(3))

    def why_unseen(self, object_id: str) -> str:
        return f"no object `{object_id}`; known: o1."

    def obstacles(self, object_id: str) -> list[Float64Array]:
        return []

    def model(self, object_id: str) -> KnownModel | None:
        stamp = self.learned[1] if self.learns and self.time >= self.learned[0] else 0.0
        return KnownModel(self.posterior, stamp, 0, self.is_known or stamp > 0)

    def pushed_at(self, object_id: str) -> float:
        return self.pushed

    def push_settings(self) -> PushSettings | None:
        return self.settings

    def known_edges(self) -> list[TableEdge]:
        return self.edges

    def begin_target(
        self, model: KnownModel, seen: TrackedObject, goal: EdgeGoal, edges: Sequence[TableEdge], chosen: Target | None
    ) -> Computed[Target]:
        if chosen is not None:
            return Computed(self, chosen, self.time)
        found = self.targets.pop(0) if len(self.targets) > 1 else self.targets[0]
        if isinstance(found, Exception):
            return Computed(self, found, self.time)
        centre = np.zeros((1, 2))
        return Computed(self, Target(found, EdgeHold(edges[0], goal.held), SHAPE.cells.centres, centre), self.time)

    def begin_plan(
        self, model: KnownModel, seen: TrackedObject, target: Target, obstacles: list[Float64Array], failed: list[PushPlan2D]
    ) -> Computed[GoalPush]:
        self.failed.append(len(failed))
        if self.plans:
            return Computed(self, self.plans.pop(0), self.time + 1.0)
        push = PushPlan2D(np.array([0.1 * len(failed), 0.0]), np.zeros(2), 0.0, 0.05, 0.1)
        return Computed(self, GoalPush(PlanStatus.PUSH, 0.8, push, target.goal.pose, target.goal.pose[None], 1.3), self.time + 1.0)

    def begin_push(self, object_id: str, push: PushPlan2D | int) -> Push:
        self.asked.append(push)
        outcome = self.outcomes.pop(0) if self.outcomes else PushReport(PushCode.NONE, "", 1)
        motion = np.array([0.02, 0.0, 0.1]) if isinstance(push, int) else 0.9 * (GOAL.pose - self.pose)
        self.pushes.append(Push(self, outcome, motion, self.time + PUSH_SECONDS))
        return self.pushes[-1]

    def wish(self) -> Wish:
        return self.wants(self)


def run(cell: Cell, **fields: object) -> tuple[GoalOutcome, list[GoalProgress]]:
    seen: list[GoalProgress] = []
    request = GoalRequest(**{"object_id": "", "goal": GOAL, **fields})  # type: ignore[arg-type]
    session = GoalSession(request, cell, SessionLimits(), on_progress=lambda p: seen.append(replace(p)))
    return session.run(), seen


def test_object_is_pushed_until_it_is_there_and_each_push_is_learned(posterior: ModelPosterior) -> None:
    cell = Cell(posterior, pose=np.array([-0.15, -0.15, 0.0]))
    outcome, seen = run(cell)
    assert outcome.code is GoalCode.NONE and outcome.text == ""
    assert outcome.progress.pushes == len(cell.pushes) == 2
    states = [p.state for i, p in enumerate(seen) if not i or p.state != seen[i - 1].state]
    once = [GoalState.OBSERVE, GoalState.PLAN, GoalState.PUSH, GoalState.OBSERVE]
    assert states == [*once, GoalState.LEARN, *once[1:]]
    # The pushes took their time, and the model was waited for after the first; at the goal nobody plans with it.
    assert outcome.progress.elapsed == pytest.approx(2 * (1.0 + PUSH_SECONDS) + LEARN_SECONDS, abs=0.2)
    assert outcome.progress.error[0] < GOAL.position and outcome.progress.observed == 2


def test_exploring_pushes_come_first_and_nothing_is_pushed_that_is_there(posterior: ModelPosterior) -> None:
    cell = Cell(posterior, is_known=False)
    outcome, _ = run(cell, explore=2)
    assert outcome.code is GoalCode.NONE
    assert [isinstance(push, int) for push in cell.asked] == [True, True, False]
    assert cell.asked[0] != cell.asked[1]
    there = Cell(posterior, pose=GOAL.pose.copy(), is_known=False)
    assert run(there, explore=2)[0].code is GoalCode.NONE and not there.pushes


@pytest.mark.parametrize(
    ("change", "fields", "code", "word"),
    [
        ({"is_known": False}, {}, GoalCode.NOTHING_KNOWN, "exploring"),
        ({"settings": None}, {}, GoalCode.ARM_SILENT, "push_executor_node"),
        ({}, {"goal": Goal(np.array([0.14, 0.0, 0.0]))}, GoalCode.OUTSIDE_WORKSPACE, "further inside"),
        ({}, {"object_id": "o7"}, GoalCode.UNKNOWN_OBJECT, "o1"),
    ],
)
def test_goal_that_cannot_be_is_refused_before_anything_moves(
    posterior: ModelPosterior, change: dict[str, object], fields: dict[str, object], code: GoalCode, word: str
) -> None:
    cell = Cell(posterior, **change)  # type: ignore[arg-type]
    request = GoalRequest(**{"object_id": "", "goal": GOAL, **fields})  # type: ignore[arg-type]
    with pytest.raises(GoalRefusedError, match=word) as refused:
        GoalSession(request, cell).check()
    assert refused.value.code is code
    outcome, _ = run(cell, **fields)
    assert outcome.code is code and not cell.pushes


def test_goal_for_an_object_of_which_nothing_is_known_yet_waits_for_it(posterior: ModelPosterior) -> None:
    cell = Cell(posterior, is_visible=lambda time: time > 102.0)
    GoalSession(GoalRequest(object_id="", goal=GOAL), cell).check()
    assert cell.time < 102.1
    with pytest.raises(GoalRefusedError):
        GoalSession(GoalRequest(object_id="", goal=GOAL), Cell(posterior, is_visible=lambda time: time > 104.0)).check()


def test_tolerance_below_what_the_poses_allow_is_said(posterior: ModelPosterior) -> None:
    outcome, _ = run(Cell(posterior, std=0.02))
    assert outcome.code is GoalCode.TOLERANCE and "28.3 mm" in outcome.text


def test_plan_says_why_there_is_none(posterior: ModelPosterior) -> None:
    outcome, _ = run(Cell(posterior, plans=[GoalPush(PlanStatus.UNREACHABLE, 0.0)]))
    assert outcome.code is GoalCode.UNREACHABLE
    outcome, _ = run(Cell(posterior, plans=[FloatingPointError("the model is nowhere")]))
    assert outcome.code is GoalCode.MODEL and "nowhere" in outcome.text


def test_failed_push_is_passed_to_the_planner_and_forgotten_after_one_that_moved_the_object(posterior: ModelPosterior) -> None:
    missed = PushReport(PushCode.NO_CONTACT, "it moved by 0.1 mm", 1)
    refused = PushReport(PushCode.UNREACHABLE, "no posture")
    cell = Cell(posterior, outcomes=[missed, refused], pose=np.array([-0.15, -0.15, 0.0]), std=1e-4)
    outcome, seen = run(cell, goal=Goal(GOAL.pose, 0.003))
    assert outcome.code is GoalCode.NONE
    assert cell.failed == [0, 1, 2, 0]
    assert outcome.progress.pushes == 3  # the refused one moved nothing
    assert next(p.note for p in seen if p.note).startswith("the push failed (NO_CONTACT)")


@pytest.mark.parametrize(
    ("report", "code"),
    [
        (PushReport(PushCode.ARM_SILENT, "no joint states."), GoalCode.ARM_SILENT),
        (PushReport(PushCode.FORCE, "70 N.", 1), GoalCode.PUSH_FAILED),
        (PushReport(PushCode.HAND, "no fist."), GoalCode.PUSH_FAILED),
    ],
)
def test_failure_that_another_contact_does_not_cure_ends_the_goal(posterior: ModelPosterior, report: PushReport, code: GoalCode) -> None:
    cell = Cell(posterior, outcomes=[report])
    outcome, _ = run(cell)
    assert outcome.code is code and report.text in outcome.text and len(cell.pushes) == 1


def test_refusals_in_a_row_end_the_goal(posterior: ModelPosterior) -> None:
    cell = Cell(posterior, outcomes=[PushReport(PushCode.UNREACHABLE, "no posture")] * 50)
    outcome, _ = run(cell)
    assert outcome.code is GoalCode.PUSH_FAILED and len(cell.pushes) == SessionLimits().max_refusals + 1


def test_object_that_does_not_come_back_into_view_is_lost(posterior: ModelPosterior) -> None:
    outcome, _ = run(Cell(posterior, is_visible=lambda time: time < 105.0))
    assert outcome.code is GoalCode.OBJECT_LOST
    # Hidden by the arm for a while is not lost.
    outcome, _ = run(Cell(posterior, is_visible=lambda time: not 105.0 < time < 118.0))
    assert outcome.code is GoalCode.NONE


def test_push_made_before_is_learned_first(posterior: ModelPosterior) -> None:
    cell = Cell(posterior, is_known=False, pushed=98.0, learned=(103.0, 99.0))
    GoalSession(GoalRequest("", GOAL), cell).check()
    outcome, seen = run(cell)
    assert outcome.code is GoalCode.NONE
    assert outcome.progress.elapsed == pytest.approx(3.0 + 1.0 + PUSH_SECONDS, abs=0.2)
    assert seen[0].state is GoalState.OBSERVE and any(p.state is GoalState.LEARN and not p.pushes for p in seen)
    never = Cell(posterior, is_known=False, pushed=98.0)
    assert run(never)[0].code is GoalCode.NOTHING_KNOWN and not never.pushes


def test_push_that_is_not_learned_does_not_end_the_goal(posterior: ModelPosterior) -> None:
    outcome, seen = run(Cell(posterior, learns=False, pose=np.array([-0.15, -0.15, 0.0])))
    assert outcome.code is GoalCode.NONE
    assert any("did not learn" in p.note for p in seen)
    assert outcome.progress.elapsed == pytest.approx(2 * (1.0 + PUSH_SECONDS) + SessionLimits().learn_timeout, abs=0.2)


def test_pushes_and_time_are_limited(posterior: ModelPosterior) -> None:
    strict = Goal(GOAL.pose, 0.0025)
    outcome, _ = run(Cell(posterior, std=1e-4), goal=strict, max_pushes=1)
    assert outcome.code is GoalCode.MAX_PUSHES and outcome.progress.pushes == 1 and "14.1 mm" in outcome.text
    cell = Cell(posterior)
    outcome, _ = run(cell, time_limit=5.0)
    assert outcome.code is GoalCode.TIME_LIMIT and cell.pushes[0].cancelled_at is not None


@pytest.mark.parametrize("at", [100.5, 104.0, 109.8], ids=["planning", "pushing", "learning"])
def test_cancellation_is_noticed_at_once_whatever_is_under_way(posterior: ModelPosterior, at: float) -> None:
    start = np.array([-0.15, -0.15, 0.0])
    cell = Cell(posterior, pose=start, wants=lambda cell: Wish.HOLD if cell.time >= at else Wish.GO_ON)
    outcome, _ = run(cell)
    assert outcome.code is GoalCode.CANCELED
    assert cell.time - at < 0.05
    if at == 104.0:
        assert cell.pushes[0].cancelled_at is not None and cell.pushes[0].cancelled_at - at < 0.05
        assert outcome.progress.pushes == 1


def test_newer_goal_lets_the_push_under_way_end(posterior: ModelPosterior) -> None:
    cell = Cell(posterior, wants=lambda cell: Wish.FINISH if cell.time >= 104.0 else Wish.GO_ON)
    outcome, _ = run(cell)
    assert outcome.code is GoalCode.PREEMPTED and outcome.progress.pushes == 1
    assert cell.pushes[0].is_over and cell.pushes[0].cancelled_at is None
    assert cell.time == pytest.approx(101.0 + PUSH_SECONDS, abs=0.1)


def test_goal_with_impossible_limits_is_refused() -> None:
    with pytest.raises(InputError, match="time_limit"):
        GoalRequest("", GOAL, time_limit=np.nan)
    with pytest.raises(InputError, match="explore"):
        GoalRequest("", GOAL, explore=5, max_pushes=4)


EDGE = TableEdge.between(np.array([0.15, -0.3]), np.array([0.15, 0.3]))
TOLD_EDGE = EdgeGoal(EDGE)
AT_EDGE = Goal(GOAL.pose, TOLD_EDGE.position, TOLD_EDGE.turn)
UNHELD = GoalRefusedError(GoalCode.NOT_HELD, "it might fall")
NEVER_HELD = GoalPush(PlanStatus.UNHELD, 0.0, risk=0.04)


def test_place_at_an_edge_is_chosen_when_the_object_is_known_well_enough(posterior: ModelPosterior) -> None:
    """Refused before anything is known, which exploring may cure; then chosen once, after the exploring pushes."""
    cell = Cell(posterior, is_known=False, targets=[UNHELD, AT_EDGE])
    outcome, seen = run(cell, goal=TOLD_EDGE, explore=2)
    assert outcome.code is GoalCode.NONE and not cell.targets[1:]
    explored = [push for push in cell.asked if isinstance(push, PushPlan2D)][:2]
    assert len(explored) == 2, "the executor chooses none: it knows of no edge"
    assert outcome.progress.target is not None and outcome.progress.overhang < 0.0 < outcome.progress.margin
    assert seen[0].target is None and np.isnan(seen[0].error[0])


@pytest.mark.parametrize(
    ("change", "fields", "code", "word"),
    [
        ({}, {"goal": EdgeGoal(None)}, GoalCode.EDGE_UNKNOWN, "table_corners"),
        ({"targets": [UNHELD]}, {"goal": TOLD_EDGE}, GoalCode.NOT_HELD, "might fall"),
        ({"targets": [UNHELD]}, {"goal": TOLD_EDGE, "explore": 1}, GoalCode.NOT_HELD, "might fall"),
        (
            {"targets": [AT_EDGE], "plans": [GoalPush(PlanStatus.UNHELD, 0.0, risk=0.04)] * 2},
            {"goal": TOLD_EDGE},
            GoalCode.NOT_HELD,
            "4.0 %",
        ),
    ],
)
def test_goal_at_an_edge_that_cannot_be_ends_with_its_code(
    posterior: ModelPosterior, change: dict[str, object], fields: dict[str, object], code: GoalCode, word: str
) -> None:
    outcome, _ = run(Cell(posterior, **change), **fields)  # type: ignore[arg-type]
    assert outcome.code is code and word in outcome.text


def test_where_each_push_would_risk_a_fall_another_place_is_chosen_once(posterior: ModelPosterior) -> None:
    cell = Cell(posterior, targets=[Goal(np.array([0.0, 0.1, 0.0])), AT_EDGE], plans=[GoalPush(PlanStatus.UNHELD, 0.0)])
    outcome, _ = run(cell, goal=TOLD_EDGE)
    assert outcome.code is GoalCode.NONE and outcome.progress.target is not None
    np.testing.assert_array_equal(outcome.progress.target.goal.pose, AT_EDGE.pose)


@dataclass
class Falling(Cell):
    """Its object is seen where it was pushed to, which is beside the table."""

    def begin_push(self, object_id: str, push: PushPlan2D | int) -> Push:
        begun = super().begin_push(object_id, push)
        begun.motion = np.array([0.4, 0.0, 0.0])
        return begun


def test_object_that_is_lost_at_the_edge_fell(posterior: ModelPosterior) -> None:
    over = Goal(np.array([0.13, 0.0, 0.0]), TOLD_EDGE.position, TOLD_EDGE.turn)
    gone = {"is_visible": lambda time: time < 105.0, "targets": [over]}
    outcome, _ = run(Cell(posterior, **gone), goal=TOLD_EDGE)  # type: ignore[arg-type]
    assert outcome.code is GoalCode.FELL and "less overhang" in outcome.text and outcome.progress.pushes == 1
    beside = Goal(np.array([0.4, 0.0, 0.0]), TOLD_EDGE.position, TOLD_EDGE.turn)
    outcome, _ = run(Falling(posterior, targets=[beside]), goal=TOLD_EDGE)
    assert outcome.code is GoalCode.FELL and "beside the table" in outcome.text
    # Far from the edge it is only lost.
    outcome, _ = run(Cell(posterior, **gone | {"targets": [Goal(np.array([0.0, 0.1, 0.0]))]}), goal=TOLD_EDGE)  # type: ignore[arg-type]
    assert outcome.code is GoalCode.OBJECT_LOST


def test_codes_are_those_of_the_action() -> None:
    action = pytest.importorskip("push_ident_msgs.action").PushToGoal
    codes = {name: int(code) for name, code in GoalCode.__members__.items() if name != "SUCCESS"}  # the action says NONE: no error
    assert codes == {name: getattr(action.Result, name) for name in codes}
    assert all(getattr(action.Feedback, f"STATE_{state.name}") == state.value for state in GoalState)
