"""The steps of pushing along a path, with a cell that lives in memory, and which kind of push is chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from helpers.objects import hammer
from push_ident.identification.results.posterior import prior_posterior
from push_ident.planning.belief import Belief
from push_ident.planning.curved_planner import CurvedPush
from push_ident.planning.goal import GoalCode, GoalRefusedError, Target
from push_ident.planning.goal_ports import GoalOutcome, GoalRequest, KnownModel, PushReport, Wish
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_planner import PathPush, PathStatus
from push_ident.planning.path_session import PathSession
from push_ident.planning.path_steps import PathStep, PathSteps
from push_ident.planning.planner import GoalPush, PlanStatus
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.types import Float64Array
from push_ident_sim.studies.common.objects import plate

SHAPE = hammer(1).shape
PATH = PathGoal(np.array([[-0.06, 0.0, 0.0], [0.06, 0.0, 0.0]]), 0.05, 0.003, 0.035)
PUSH = PushPlan2D(np.zeros(2), np.zeros(2), 0.0, 0.03, 0.05)
STEERED = CurvedPush(PathStatus.PUSH, 0.0, PUSH, expected_error=0.3)
STRAIGHT = PathPush(PathStatus.PUSH, 0.0, PUSH)
SECONDS = 2.0


@dataclass
class Now:
    """What is computed at once."""

    found: Any

    def result(self) -> Any:
        return self.found


@dataclass
class Push:
    """A push that carries the object along the path for two seconds, beside it."""

    cell: Cell
    travel: float
    code: PushCode
    first: float
    begun: float
    n_corrections: int = 0
    tool: Float64Array | None = None

    @property
    def done(self) -> float:
        return self.first + self.travel * min((self.cell.time - self.begun) / SECONDS, 1.0)

    def report(self) -> PushReport | None:
        self.cell.pose = PATH.at(self.done) + np.array([0.0, self.cell.beside, 0.0])
        self.n_corrections = 30
        return PushReport(self.code, "as told", 1, self.begun) if self.cell.time >= self.begun + SECONDS else None

    def cancel(self) -> None:
        self.cell.cancelled = True


@dataclass
class Cell:
    """`PathPorts` in memory; `travels` says how far each push brings the object [m] and how it ends."""

    travels: list[tuple[float, PushCode]]
    time: float = 100.0
    pose: Float64Array = field(default_factory=lambda: PATH.poses[0].copy())
    steers: list[bool] = field(default_factory=list)
    """As each plan was asked for."""
    targets: list[Float64Array] = field(default_factory=list)
    """Poses that pushes to the end were planned for."""
    beside: float = 0.002
    """Of the path [m]: where the object is led."""
    unreachable: bool = False
    cancelled: bool = False
    wants: Wish = Wish.GO_ON

    def now(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds

    def observe(self, object_id: str, max_age: float, after: float) -> TrackedObject | None:
        return TrackedObject("o1", SHAPE, self.time, self.pose, np.eye(3) * 1e-8)

    def why_unseen(self, object_id: str) -> str:
        return "it is there"

    def obstacles(self, object_id: str) -> list[Float64Array]:
        return []

    def model(self, object_id: str) -> KnownModel:
        return KnownModel(prior_posterior(SHAPE), np.inf, 1, True)

    def pushed_at(self, object_id: str) -> float:
        return -np.inf

    def push_settings(self) -> PushSettings:
        return PushSettings(workspace=(-0.3, 0.3, -0.3, 0.3))

    def begin_step(
        self,
        model: KnownModel,
        seen: TrackedObject,
        path: PathGoal,
        done: float,
        obstacles: Any,
        failed: Sequence[PushPlan2D],
        *,
        steers: bool,
    ) -> Now:
        self.steers.append(steers)
        place, _ = path.error(seen.pose, done, 0.2)
        now = max(done, float(place))
        if path.length - now < 0.004:
            return Now(PathStep(PathStatus.ARRIVED, now))
        if self.unreachable:
            return Now(PathStep(PathStatus.UNREACHABLE, now))
        return Now(PathStep(PathStatus.PUSH, now, STEERED if steers else None, None if steers else STRAIGHT))

    def begin_plan(self, model: KnownModel, seen: TrackedObject, target: Target, obstacles: Any, failed: Any) -> Now:
        self.targets.append(target.goal.pose)
        self.beside = 0.0
        return Now(GoalPush(PlanStatus.PUSH, 0.9, PUSH, target.goal.pose, target.goal.pose[None], 1.0))

    def _begin(self) -> Push:
        travel, code = self.travels.pop(0)
        place, _ = PATH.error(self.pose, 0.0, 1.0)
        return Push(self, travel, code, float(place), self.time)

    def begin_steered(self, seen: TrackedObject, step: PathStep, path: PathGoal) -> Push:
        return self._begin()

    def begin_push(self, object_id: str, push: PushPlan2D | int) -> Push:
        return self._begin()

    def wish(self) -> Wish:
        return self.wants


def follow(cell: Cell, **changes: Any) -> GoalOutcome:
    return PathSession(GoalRequest("", PATH, **changes), cell).run()  # type: ignore[arg-type]


def test_path_is_followed_to_its_end_and_its_error_is_that_of_the_poses_on_the_way() -> None:
    cell = Cell([(0.07, PushCode.NONE), (0.05, PushCode.NONE)])
    outcome = follow(cell)
    assert outcome.code is GoalCode.NONE and outcome.progress.done == 1.0 and outcome.progress.pushes == 2
    assert outcome.progress.corrections == 60 and cell.steers == [True, True, True]
    assert outcome.progress.path is PATH and outcome.progress.step is not None and outcome.progress.step.steered is STEERED
    np.testing.assert_allclose(outcome.progress.rms, [0.002, 0.0], atol=2e-4)


def test_object_that_is_beside_the_end_of_its_path_is_pushed_there_as_to_a_goal() -> None:
    cell = Cell([(0.12, PushCode.NONE), (0.0, PushCode.NONE)], beside=0.006)
    outcome = follow(cell)
    assert outcome.code is GoalCode.NONE and outcome.progress.pushes == 2 and outcome.progress.done == 1.0
    np.testing.assert_array_equal(cell.targets, PATH.poses[-1:])
    np.testing.assert_allclose(cell.pose, PATH.poses[-1], atol=1e-9)
    limited = follow(Cell([(0.12, PushCode.NONE)], beside=0.006), max_pushes=1)
    assert limited.code is GoalCode.MAX_PUSHES and limited.progress.done == 1.0


def test_after_a_steered_push_that_brought_nothing_a_straight_one_comes_first() -> None:
    cell = Cell([(0.002, PushCode.NONE), (0.03, PushCode.NONE), (0.09, PushCode.NONE)])
    assert follow(cell).code is GoalCode.NONE
    assert cell.steers == [True, False, True, True]


def test_push_whose_corrections_stopped_is_followed_by_another_contact() -> None:
    cell = Cell([(0.04, PushCode.CORRECTION), (0.08, PushCode.NONE)])
    outcome = follow(cell)
    assert outcome.code is GoalCode.NONE and outcome.progress.pushes == 2
    broken = follow(Cell([(0.02, PushCode.FORCE)]))
    assert broken.code is GoalCode.PUSH_FAILED and 0.1 < broken.progress.done < 0.3


def test_path_that_cannot_be_gone_on_with_says_how_much_is_behind() -> None:
    cell = Cell([(0.06, PushCode.NONE)])
    cell.unreachable = True
    outcome = follow(cell)
    assert outcome.code is GoalCode.UNREACHABLE and "0 % of it" in outcome.text
    limited = follow(Cell([(0.03, PushCode.NONE)]), max_pushes=1)
    assert limited.code is GoalCode.MAX_PUSHES and limited.progress.done == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize(
    ("path", "code"),
    [
        (PathGoal(PATH.poses + np.array([0.5, 0.0, 0.0])), GoalCode.OUTSIDE_WORKSPACE),
        (PathGoal(np.array([[0.0, 0.0, 0.0], [0.001, 0.0, 3.0]]), 0.2), GoalCode.INVALID_GOAL),
    ],
    ids=["out of reach", "turns too fast"],
)
def test_path_that_cannot_be_followed_is_refused_before_anything_moves(path: PathGoal, code: GoalCode) -> None:
    with pytest.raises(GoalRefusedError) as refused:
        PathSession(GoalRequest("", path), Cell([])).check()  # type: ignore[arg-type]
    assert refused.value.code is code


def test_cancellation_in_the_middle_of_a_push_is_passed_on_within_a_look() -> None:
    cell = Cell([(0.12, PushCode.NONE)])
    session = PathSession(
        GoalRequest("", PATH), cell, on_progress=lambda progress: setattr(cell, "wants", Wish.HOLD if cell.time > 101.0 else Wish.GO_ON)
    )  # type: ignore[arg-type]
    outcome = session.run()
    assert outcome.code is GoalCode.CANCELED and cell.cancelled and cell.time < 103.0


def test_steered_pushes_are_chosen_where_a_face_holds_the_line_and_straight_ones_where_none_does() -> None:
    model = plate(8, 3)
    settings, belief = PushSettings(workspace=(-0.5, 0.5, -0.5, 0.5), pusher_radius=0.008, clearance=0.02), Belief.certain(model)
    steps = PathSteps(model.shape, settings, 0.06)
    ahead = PathGoal(np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]), 0.05, 0.003, 0.035)
    step = steps.plan(belief, ahead.poses[0], ahead, 0.0)
    assert step.steered is not None and step.follower is not None and step.expected_done > 0.05
    only = steps.plan(belief, ahead.poses[0], ahead, 0.0, steers=False)
    assert only.steered is None and only.straight is not None and only.contact is only.straight.plan
    # Turned by 45 degrees, no face of a square is across the line.
    beside = replace(ahead, poses=ahead.poses + np.array([0.0, 0.0, np.pi / 4]))
    held = steps.plan(belief, beside.poses[0], beside, 0.0)
    assert held.straight is not None and held.steered is None
    end = steps.plan(belief, ahead.poses[-1], ahead, ahead.length - 0.1)
    assert end.status is PathStatus.ARRIVED and end.contact is None and np.isnan(end.expected_done)
