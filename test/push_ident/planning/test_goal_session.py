"""The steps of pushing to a goal and along a path, with a cell in memory whose object goes where it is pushed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from helpers.objects import hammer
from push_ident.errors import InputError
from push_ident.identification.results.posterior import prior_posterior
from push_ident.physics.overhang import TableEdge
from push_ident.planning.curved_planner import CurvedPush
from push_ident.planning.edge_goal import EdgeGoal
from push_ident.planning.goal import EdgeHold, Goal, GoalCode, GoalRefusedError, Target
from push_ident.planning.goal_ports import GoalOutcome, GoalProgress, GoalRequest, GoalState, KnownModel, PushReport, SessionLimits, Wish
from push_ident.planning.goal_session import GoalSession
from push_ident.planning.obstacle import Obstacle
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_planner import PathPush, PathStatus
from push_ident.planning.path_session import PathSession
from push_ident.planning.path_steps import PathStep
from push_ident.planning.planner import GoalPush, PlanStatus
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.types import Float64Array

GOAL = Goal(np.array([0.05, 0.05, 0.5]))
SHAPE = hammer(1).shape
PUSH_SECONDS = 8.0
LEARN_SECONDS = 2.0
POSTERIOR = prior_posterior(SHAPE)
FAR = np.array([-0.15, -0.15, 0.0])
EDGE = TableEdge.between(np.array([0.15, -0.3]), np.array([0.15, 0.3]))
OVER = EdgeGoal(EDGE)
UNHELD = GoalRefusedError(GoalCode.NOT_HELD, "it might fall")
NO_HELD_PUSH = GoalPush(PlanStatus.UNHELD, 0.0, risk=0.04)


def place(x: float, y: float, yaw: float) -> Goal:
    return Goal(np.array([x, y, yaw]), OVER.position, OVER.turn)


AT_EDGE = place(*GOAL.pose)


@dataclass
class Computed:
    """What is there after a while: a result, or an exception."""

    cell: Cell
    found: Any
    ready: float

    def result(self) -> Any:
        if self.cell.now() < self.ready:
            return None
        if isinstance(self.found, Exception):
            raise self.found
        return self.found


@dataclass
class Push:
    """A push that leads the object for a while, until it ends or is cancelled."""

    cell: Cell
    outcome: PushReport
    lead: Callable[[float], Float64Array]
    """Pose after a share of the time."""
    seconds: float = PUSH_SECONDS
    first: float = 0.0
    travel: float = 0.0
    """Of the path [m]: what is behind at first, and how much more at the end."""
    is_over: bool = False
    cancelled_at: float | None = None
    n_corrections: int = 30
    tool: Float64Array | None = None

    def __post_init__(self) -> None:
        self.begun = self.cell.time

    @property
    def share(self) -> float:
        return min((self.cell.time - self.begun) / self.seconds, 1.0)

    @property
    def done(self) -> float:
        return self.first + self.travel * self.share

    def report(self) -> PushReport | None:
        if self.cancelled_at is not None:
            return PushReport(PushCode.CANCELED, "canceled on request; the arm holds.", 1)
        if self.outcome.n_made:
            self.cell.pose = self.lead(self.share)
        if self.share < 1.0:
            return None
        if not self.is_over:
            self.is_over = True
            if self.outcome.code is PushCode.NONE:
                self.cell.learned = (self.cell.now() + LEARN_SECONDS, self.cell.now())
        return replace(self.outcome, stamp=self.begun)

    def cancel(self) -> None:
        self.cancelled_at = self.cancelled_at or self.cell.now()


@dataclass
class Cell:
    """`GoalPorts` in memory. Each push to the goal takes away all but a tenth of the error."""

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
    wants: Callable[[Any], Wish] = lambda cell: Wish.GO_ON
    learns: bool = True
    pushed: float = -np.inf
    """Start of a push that somebody made before."""
    motion: Float64Array | None = None
    """Of a push; None: towards the goal."""
    settings: PushSettings | None = field(default_factory=PushSettings)
    pushes: list[Any] = field(default_factory=list)
    asked: list[PushPlan2D | int] = field(default_factory=list)
    edges: list[TableEdge] = field(default_factory=list)
    """Of the table."""
    targets: list[Goal | Exception] = field(default_factory=list)
    """What is chosen at an edge, one after another; the last one again and again."""
    in_the_way: list[Obstacle] = field(default_factory=list)
    """What must not be touched."""
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

    def obstacles(self, object_id: str) -> list[Obstacle]:
        return self.in_the_way

    def begin_random(self, model: KnownModel, seen: TrackedObject, obstacles: Any, seed: int) -> Computed:
        return Computed(self, PushPlan2D(np.zeros(2), np.zeros(2), 0.0, 0.05, 0.1), self.time + 1.0)

    def model(self, object_id: str) -> KnownModel | None:
        stamp = self.learned[1] if self.learns and self.time >= self.learned[0] else 0.0
        return KnownModel(POSTERIOR, stamp, 0, self.is_known or stamp > 0)

    def pushed_at(self, object_id: str) -> float:
        return self.pushed

    def push_settings(self) -> PushSettings | None:
        return self.settings

    def known_edges(self) -> list[TableEdge]:
        return self.edges

    def begin_target(self, model: KnownModel, seen: TrackedObject, goal: EdgeGoal, edges: Sequence[TableEdge], chosen: Any) -> Computed:
        found = chosen or (self.targets.pop(0) if len(self.targets) > 1 else self.targets[0])
        if isinstance(found, Goal):
            found = Target(found, EdgeHold(edges[0], goal.held), SHAPE.cells.centres, np.zeros((1, 2)))
        return Computed(self, found, self.time)

    def begin_plan(self, model: KnownModel, seen: TrackedObject, target: Target, obstacles: Any, failed: list[PushPlan2D]) -> Computed:
        self.failed.append(len(failed))
        if self.plans:
            return Computed(self, self.plans.pop(0), self.time + 1.0)
        push = PushPlan2D(np.array([0.1 * len(failed), 0.0]), np.zeros(2), 0.0, 0.05, 0.1)
        return Computed(self, GoalPush(PlanStatus.PUSH, 0.8, push, target.goal.pose, target.goal.pose[None]), self.time + 1.0)

    def begin_push(self, object_id: str, push: PushPlan2D | int) -> Any:
        self.asked.append(push)
        outcome, first = self.outcomes.pop(0) if self.outcomes else PushReport(PushCode.NONE, "", 1), self.pose
        motion = np.array([0.02, 0.0, 0.1]) if isinstance(push, int) else 0.9 * (GOAL.pose - first)
        motion = (outcome.code is PushCode.NONE) * (motion if self.motion is None else self.motion)
        self.pushes.append(Push(self, outcome, lambda share: first + share * motion))
        return self.pushes[-1]

    def wish(self) -> Wish:
        return self.wants(self)


def run(cell: Cell, **fields: object) -> tuple[GoalOutcome, list[GoalProgress]]:
    seen: list[GoalProgress] = []
    request = GoalRequest(**{"object_id": "", "goal": GOAL, **fields})  # type: ignore[arg-type]
    session = GoalSession(request, cell, SessionLimits(), on_progress=lambda p: seen.append(replace(p)))
    return session.run(), seen


def test_object_is_pushed_until_it_is_there_and_each_push_is_learned() -> None:
    cell = Cell(pose=FAR)
    outcome, seen = run(cell)
    assert outcome.code is GoalCode.NONE and outcome.text == ""
    assert outcome.progress.pushes == len(cell.pushes) == 2
    states = [p.state for i, p in enumerate(seen) if not i or p.state != seen[i - 1].state]
    once = [GoalState.OBSERVE, GoalState.PLAN, GoalState.PUSH, GoalState.OBSERVE]
    assert states == [*once, GoalState.LEARN, *once[1:]]
    # The pushes took their time, and the model was waited for after the first; at the goal nobody plans with it.
    assert outcome.progress.elapsed == pytest.approx(2 * (1.0 + PUSH_SECONDS) + LEARN_SECONDS, abs=0.2)
    assert outcome.progress.error[0] < GOAL.position and outcome.progress.observed == 2
    # A push that is not learned does not end the goal.
    outcome, seen = run(Cell(learns=False, pose=FAR))
    assert outcome.code is GoalCode.NONE and any("did not learn" in p.note for p in seen)
    assert outcome.progress.elapsed == pytest.approx(2 * (1.0 + PUSH_SECONDS) + SessionLimits().learn_timeout, abs=0.2)


def test_exploring_pushes_come_first_and_nothing_is_pushed_that_is_there() -> None:
    cell = Cell(is_known=False)
    assert run(cell, explore=2)[0].code is GoalCode.NONE
    assert [isinstance(push, int) for push in cell.asked] == [True, True, False]
    assert cell.asked[0] != cell.asked[1]


def test_object_that_is_at_the_goal_already_needs_neither_arm_nor_model_and_the_text_says_so() -> None:
    there = Cell(pose=GOAL.pose.copy(), is_known=False, settings=None)
    outcome, _ = run(there, explore=2)
    assert outcome.code is GoalCode.NONE and not there.pushes
    assert outcome.text == "already at the goal (0.0 mm and 0.000 rad from it); nothing was pushed."


@pytest.mark.parametrize(
    ("change", "fields", "code", "word"),
    [
        ({"is_known": False}, {}, GoalCode.NOTHING_KNOWN, "exploring"),
        ({"settings": None}, {}, GoalCode.ARM_SILENT, "push_executor_node"),
        ({}, {"goal": Goal(np.array([0.14, 0.0, 0.0]))}, GoalCode.OUTSIDE_WORKSPACE, "further inside"),
        ({}, {"object_id": "o7"}, GoalCode.UNKNOWN_OBJECT, "o1"),
    ],
)
def test_goal_that_cannot_be_is_refused_before_anything_moves(change: Any, fields: Any, code: GoalCode, word: str) -> None:
    cell = Cell(**change)
    with pytest.raises(GoalRefusedError, match=word) as refused:
        GoalSession(GoalRequest(**{"object_id": "", "goal": GOAL, **fields}), cell).check()
    assert refused.value.code is code
    assert run(cell, **fields)[0].code is code and not cell.pushes


def test_goal_for_an_object_of_which_nothing_is_known_yet_waits_for_it() -> None:
    cell = Cell(is_visible=lambda time: time > 102.0)
    GoalSession(GoalRequest("", GOAL), cell).check()
    assert cell.time < 102.1
    with pytest.raises(GoalRefusedError):
        GoalSession(GoalRequest("", GOAL), Cell(is_visible=lambda time: time > 104.0)).check()


@pytest.mark.parametrize(
    ("change", "code", "word"),
    [
        ({"targets": []}, GoalCode.EDGE_UNKNOWN, "table_corners"),
        ({"targets": [UNHELD]}, GoalCode.NOT_HELD, "might fall"),
        ({"targets": [AT_EDGE], "plans": [NO_HELD_PUSH] * 2}, GoalCode.NOT_HELD, "4.0 %"),
        ({"std": 0.02}, GoalCode.TOLERANCE, "28.3 mm"),
        ({"plans": [GoalPush(PlanStatus.UNREACHABLE, 0.0)]}, GoalCode.UNREACHABLE, ""),
        ({"plans": [FloatingPointError("the model is nowhere")]}, GoalCode.MODEL, "nowhere"),
        ({"outcomes": [PushReport(PushCode.ARM_SILENT, "no joint states.")]}, GoalCode.ARM_SILENT, "no joint states."),
        ({"outcomes": [PushReport(PushCode.FORCE, "70 N.", 1)]}, GoalCode.PUSH_FAILED, "70 N."),
        ({"outcomes": [PushReport(PushCode.HAND, "no fist.")]}, GoalCode.PUSH_FAILED, "no fist."),
        ({"is_visible": lambda time: time < 105.0}, GoalCode.OBJECT_LOST, "o1"),
    ],
)
def test_goal_ends_with_its_code_where_neither_another_contact_nor_waiting_helps(change: Any, code: GoalCode, word: str) -> None:
    cell = Cell(**change)
    at_edge = {"goal": EdgeGoal(None) if not cell.targets else OVER} if "targets" in change else {}
    outcome, _ = run(cell, **at_edge)
    assert outcome.code is code and word in outcome.text and len(cell.pushes) <= 1
    # Hidden by the arm for a while is not lost.
    assert run(Cell(is_visible=lambda time: not 105.0 < time < 118.0))[0].code is GoalCode.NONE


def test_failed_push_is_passed_to_the_planner_and_forgotten_after_one_that_moved_the_object() -> None:
    missed, refused = PushReport(PushCode.NO_CONTACT, "it moved by 0.1 mm", 1), PushReport(PushCode.UNREACHABLE, "no posture")
    cell = Cell(outcomes=[missed, refused], pose=FAR, std=1e-4)
    outcome, seen = run(cell, goal=Goal(GOAL.pose, 0.003))
    assert outcome.code is GoalCode.NONE and cell.failed == [0, 1, 2, 0]
    assert outcome.progress.pushes == 3  # the refused one moved nothing
    assert next(p.note for p in seen if p.note).startswith("the push failed (NO_CONTACT)")
    cell = Cell(outcomes=[refused] * 50)
    assert run(cell)[0].code is GoalCode.PUSH_FAILED and len(cell.pushes) == SessionLimits().max_refusals + 1


def test_push_made_before_is_learned_first() -> None:
    cell = Cell(is_known=False, pushed=98.0, learned=(103.0, 99.0))
    GoalSession(GoalRequest("", GOAL), cell).check()
    outcome, seen = run(cell)
    assert outcome.code is GoalCode.NONE
    assert outcome.progress.elapsed == pytest.approx(3.0 + 1.0 + PUSH_SECONDS, abs=0.2)
    assert seen[0].state is GoalState.OBSERVE and any(p.state is GoalState.LEARN and not p.pushes for p in seen)
    never = Cell(is_known=False, pushed=98.0)
    assert run(never)[0].code is GoalCode.NOTHING_KNOWN and not never.pushes


def test_pushes_and_time_are_limited_and_impossible_limits_refused() -> None:
    outcome, _ = run(Cell(std=1e-4), goal=Goal(GOAL.pose, 0.0025), max_pushes=1)
    assert outcome.code is GoalCode.MAX_PUSHES and outcome.progress.pushes == 1 and "14.1 mm" in outcome.text
    cell = Cell()
    assert run(cell, time_limit=5.0)[0].code is GoalCode.TIME_LIMIT and cell.pushes[0].cancelled_at is not None
    for name, fields in (("time_limit", {"time_limit": np.nan}), ("explore", {"explore": 5, "max_pushes": 4})):
        with pytest.raises(InputError, match=name):
            GoalRequest("", GOAL, **fields)  # type: ignore[arg-type]


@pytest.mark.parametrize("at", [100.5, 104.0, 109.8], ids=["planning", "pushing", "learning"])
def test_cancellation_is_noticed_at_once_whatever_is_under_way(at: float) -> None:
    cell = Cell(pose=FAR, wants=lambda cell: Wish.HOLD if cell.time >= at else Wish.GO_ON)
    outcome, _ = run(cell)
    assert outcome.code is GoalCode.CANCELED and cell.time - at < 0.05
    if at == 104.0:
        assert cell.pushes[0].cancelled_at is not None and cell.pushes[0].cancelled_at - at < 0.05
        assert outcome.progress.pushes == 1


def test_newer_goal_lets_the_push_under_way_end() -> None:
    cell = Cell(wants=lambda cell: Wish.FINISH if cell.time >= 104.0 else Wish.GO_ON)
    outcome, _ = run(cell)
    assert outcome.code is GoalCode.PREEMPTED and outcome.progress.pushes == 1
    assert cell.pushes[0].is_over and cell.pushes[0].cancelled_at is None
    assert cell.time == pytest.approx(101.0 + PUSH_SECONDS, abs=0.1)


# --- at the edge of the table


def test_place_at_an_edge_is_chosen_when_the_object_is_known_well_enough() -> None:
    """Refused before anything is known, which exploring may cure; then chosen once, after the exploring pushes."""
    cell = Cell(is_known=False, targets=[UNHELD, AT_EDGE])
    outcome, seen = run(cell, goal=OVER, explore=2)
    assert outcome.code is GoalCode.NONE and not cell.targets[1:]
    explored = [push for push in cell.asked if isinstance(push, PushPlan2D)][:2]
    assert len(explored) == 2, "the executor chooses none: it knows of no edge"
    assert outcome.progress.target is not None and outcome.progress.overhang < 0.0 < outcome.progress.margin
    assert seen[0].target is None and np.isnan(seen[0].error[0])


def test_where_each_push_would_risk_a_fall_another_place_is_chosen_once() -> None:
    outcome, _ = run(Cell(targets=[place(0.0, 0.1, 0.0), AT_EDGE], plans=[NO_HELD_PUSH]), goal=OVER)
    assert outcome.code is GoalCode.NONE and outcome.progress.target is not None
    np.testing.assert_array_equal(outcome.progress.target.goal.pose, AT_EDGE.pose)


def test_object_that_is_lost_at_the_edge_fell() -> None:
    gone = {"is_visible": lambda time: time < 105.0}
    outcome, _ = run(Cell(targets=[place(0.13, 0.0, 0.0)], **gone), goal=OVER)  # type: ignore[arg-type]
    assert outcome.code is GoalCode.FELL and "less overhang" in outcome.text and outcome.progress.pushes == 1
    outcome, _ = run(Cell(targets=[place(0.4, 0.0, 0.0)], motion=np.array([0.4, 0.0, 0.0])), goal=OVER)
    assert outcome.code is GoalCode.FELL and "beside the table" in outcome.text
    # Far from the edge it is only lost.
    assert run(Cell(targets=[place(0.0, 0.1, 0.0)], **gone), goal=OVER)[0].code is GoalCode.OBJECT_LOST  # type: ignore[arg-type]


def test_codes_are_those_of_the_action() -> None:
    action = pytest.importorskip("push_ident_msgs.action").PushToGoal
    codes = {name: int(code) for name, code in GoalCode.__members__.items() if name != "SUCCESS"}  # the action says NONE: no error
    assert codes == {name: getattr(action.Result, name) for name in codes}
    assert all(getattr(action.Feedback, f"STATE_{state.name}") == state.value for state in GoalState)


# --- along a path

PATH = PathGoal(np.array([[-0.06, 0.0, 0.0], [0.06, 0.0, 0.0]]), 0.05, 0.003, 0.035)
PUSH = PushPlan2D(np.zeros(2), np.zeros(2), 0.0, 0.03, 0.05)
STEERED = CurvedPush(PathStatus.PUSH, 0.0, PUSH, expected_error=0.3)
STRAIGHT = PathPush(PathStatus.PUSH, 0.0, PUSH)


@dataclass
class PathCell(Cell):
    """`PathPorts` in memory; `travels` says how far each push brings the object [m] and how it ends."""

    travels: list[tuple[float, PushCode]] = field(default_factory=list)
    pose: Float64Array = field(default_factory=lambda: PATH.poses[0].copy())
    std: float = 1e-4
    settings: PushSettings | None = field(default_factory=lambda: PushSettings(workspace=(-0.3, 0.3, -0.3, 0.3)))
    steers: list[bool] = field(default_factory=list)
    """As each plan was asked for."""
    planned: list[Float64Array] = field(default_factory=list)
    """Poses that pushes to the end were planned for."""
    beside: float = 0.002
    """Of the path [m]: where the object is led."""
    unreachable: bool = False

    def begin_step(self, model: Any, seen: TrackedObject, path: PathGoal, done: float, *others: Any, steers: bool) -> Computed:
        self.steers.append(steers)
        now = max(done, float(path.error(seen.pose, done, 0.2)[0]))
        step = PathStep(PathStatus.PUSH, now, STEERED if steers else None, None if steers else STRAIGHT)
        if path.length - now < 0.004 or self.unreachable:
            step = PathStep(PathStatus.UNREACHABLE if self.unreachable else PathStatus.ARRIVED, now)
        return Computed(self, step, self.time)

    def begin_plan(self, model: Any, seen: TrackedObject, target: Target, obstacles: Any, failed: Any) -> Computed:
        self.planned.append(target.goal.pose)
        self.beside = 0.0
        return super().begin_plan(model, seen, target, obstacles, failed)

    def begin_steered(self, *arguments: Any) -> Push:
        travel, code = self.travels.pop(0)
        first = float(PATH.error(self.pose, 0.0, 1.0)[0])
        lead = lambda share: PATH.at(first + share * travel) + np.array([0.0, self.beside, 0.0])  # noqa: E731
        self.pushes.append(Push(self, PushReport(code, "as told", 1), lead, 2.0, first, travel))
        return self.pushes[-1]

    def begin_push(self, object_id: str, push: PushPlan2D | int) -> Push:
        return self.begin_steered()


def follow(*travels: tuple[float, PushCode], cell: PathCell | None = None, **changes: Any) -> tuple[GoalOutcome, PathCell]:
    cell = cell or PathCell()
    cell.travels = list(travels)
    return PathSession(GoalRequest("", PATH, **changes), cell).run(), cell  # type: ignore[arg-type]


def test_path_is_followed_to_its_end_and_its_error_is_that_of_the_poses_on_the_way() -> None:
    outcome, cell = follow((0.07, PushCode.NONE), (0.05, PushCode.NONE))
    assert outcome.code is GoalCode.NONE and outcome.progress.done == 1.0 and outcome.progress.pushes == 2
    assert outcome.progress.corrections == 60 and cell.steers == [True, True, True]
    assert outcome.progress.path is PATH and outcome.progress.step is not None and outcome.progress.step.steered is STEERED
    np.testing.assert_allclose(outcome.progress.rms, [0.002, 0.0], atol=2e-4)


def test_object_that_is_beside_the_end_of_its_path_is_pushed_there_as_to_a_goal() -> None:
    outcome, cell = follow((0.12, PushCode.NONE), (0.0, PushCode.NONE), cell=PathCell(beside=0.006))
    assert outcome.code is GoalCode.NONE and outcome.progress.pushes == 2 and outcome.progress.done == 1.0
    np.testing.assert_array_equal(cell.planned, PATH.poses[-1:])
    np.testing.assert_allclose(cell.pose, PATH.poses[-1], atol=1e-9)
    limited, _ = follow((0.12, PushCode.NONE), cell=PathCell(beside=0.006), max_pushes=1)
    assert limited.code is GoalCode.MAX_PUSHES and limited.progress.done == 1.0


def test_after_a_steered_push_that_brought_nothing_a_straight_one_comes_first_and_after_a_broken_one_another_contact() -> None:
    outcome, cell = follow((0.002, PushCode.NONE), (0.03, PushCode.NONE), (0.09, PushCode.NONE))
    assert outcome.code is GoalCode.NONE and cell.steers == [True, False, True, True]
    outcome, _ = follow((0.04, PushCode.CORRECTION), (0.08, PushCode.NONE))
    assert outcome.code is GoalCode.NONE and outcome.progress.pushes == 2


def test_path_that_cannot_be_gone_on_with_says_how_much_is_behind() -> None:
    outcome, _ = follow((0.06, PushCode.NONE), cell=PathCell(unreachable=True))
    assert outcome.code is GoalCode.UNREACHABLE and "0 % of it" in outcome.text
    broken, _ = follow((0.02, PushCode.FORCE))
    assert broken.code is GoalCode.PUSH_FAILED and 0.1 < broken.progress.done < 0.3
    limited, _ = follow((0.03, PushCode.NONE), max_pushes=1)
    assert limited.code is GoalCode.MAX_PUSHES and limited.progress.done == pytest.approx(0.25, abs=0.02)


def test_path_that_cannot_be_followed_is_refused_before_anything_moves_and_a_cancellation_is_passed_on_within_a_look() -> None:
    away, turning = PATH.poses + np.array([0.5, 0.0, 0.0]), np.array([[0.0, 0.0, 0.0], [0.001, 0.0, 3.0]])
    for path, code, remedy in (
        (PathGoal(away), GoalCode.OUTSIDE_WORKSPACE, "shrink the path"),
        (PathGoal(turning, 0.2), GoalCode.INVALID_GOAL, "go at 0.* m/s or less"),
    ):
        with pytest.raises(GoalRefusedError, match=remedy) as refused:
            PathSession(GoalRequest("", path), PathCell()).check()  # type: ignore[arg-type]
        assert refused.value.code is code
    cell = PathCell(wants=lambda cell: Wish.HOLD if cell.time > 101.0 else Wish.GO_ON)
    outcome, _ = follow((0.12, PushCode.NONE), cell=cell)
    assert outcome.code is GoalCode.CANCELED and cell.pushes[0].cancelled_at is not None and cell.time < 103.0


# --- obstacles


def box_at(x: float, y: float) -> Obstacle:
    return Obstacle("`o2`", np.array([[x - 0.02, y - 0.02], [x + 0.02, y - 0.02], [x + 0.02, y + 0.02], [x - 0.02, y + 0.02]]))


def test_goal_on_an_obstacle_is_refused_by_its_name_before_anything_moves() -> None:
    cell = Cell(in_the_way=[box_at(*GOAL.pose[:2])])
    outcome, _ = run(cell)
    assert outcome.code is GoalCode.UNREACHABLE and "would overlap `o2`" in outcome.text and not cell.asked
    assert run(Cell(in_the_way=[box_at(-0.2, 0.2)]))[0].code is GoalCode.NONE
    # Along a path, at any of its poses.
    path = PathGoal(np.array([[-0.06, 0.0, 0.0], [0.06, 0.0, 0.0]]))
    request = GoalRequest(object_id="", goal=path)
    refused = PathSession(request, PathCell(in_the_way=[box_at(0.0, 0.0)])).run()
    assert refused.code is GoalCode.UNREACHABLE and "`o2`" in refused.text


@pytest.mark.parametrize("status", [PlanStatus.BLOCKED, PlanStatus.UNTOUCHED])
def test_plan_without_a_way_names_what_is_in_it(status: PlanStatus) -> None:
    outcome, _ = run(Cell(in_the_way=[box_at(-0.2, 0.2)], plans=[GoalPush(status, 0.0)]))
    assert outcome.code is GoalCode.UNREACHABLE and status.value in outcome.text and "`o2`" in outcome.text


def test_exploring_pushes_beside_obstacles_are_chosen_here_as_the_executor_keeps_only_the_tool_clear() -> None:
    alone, beside = Cell(is_known=False), Cell(is_known=False, in_the_way=[box_at(-0.2, 0.2)])
    for cell, kind in ((alone, int), (beside, PushPlan2D)):
        run(cell, explore=1)
        assert isinstance(cell.asked[0], kind)
