"""The execution of pushes, on a cell in memory with a clock of its own."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest

from push_ident.errors import PlanningError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.geometry.outline import cells_in_outline, signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.pushing.executed_push import ExecutedPush, Purpose
from push_ident.pushing.execution import PushExecution
from push_ident.pushing.motion import ArmMotion, MotionSettings
from push_ident.pushing.ports import ArmState, ExecutionPorts, Phase, TrackedObject
from push_ident.pushing.push import PushCode, PushSettings
from push_ident.pushing.push_request import ExecutionSettings, Mode, PushOutcome, PushRequest
from push_ident.pushing.trajectory import JointTrajectory
from push_ident.pushing.watch import WatchLimits
from push_ident.types import Float64Array, ObjectShape
from push_ident_sim.cell.robot import HOME, robot_description
from push_ident_sim.cell.trajectory import JointTrajectory as Followed

RADIUS = 0.018
BOX = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
PARKED = (0.5, *HOME[1:])
SETTINGS = ExecutionSettings(
    push=PushSettings(workspace=(-0.1, 0.2, -0.25, 0.25), pusher_radius=RADIUS),
    motion=MotionSettings(home=PARKED, free_speed=0.5, settle=0.2, rest=0.4),
    limits=WatchLimits(force_limit=30.0),
    lost_timeout=0.4,
)
CONTACT = PushRequest(Mode.CONTACT, "box", contact_point=(0.0, -0.01), direction=math.pi / 2, distance=0.05, speed=0.1)


class Cell:
    """An arm that follows every trajectory exactly, and a box that the tool carries along while it overlaps: all ports in one.

    `events` are called at each step of 10 ms with the cell; they play the faults.
    """

    state: ArmState | None = None

    def __init__(self, kinematics: ArmKinematics) -> None:
        self.planner = kinematics
        self.time = 100.0
        self.q = np.array(PARKED)
        self.box = np.array([0.0, 0.02, 0.3])
        self.tip = kinematics.forward(self.q)[:3, 3]
        self.followed = Followed.hold(self.q)
        self.commands: list[ArmMotion] = []
        self.pieces: list[JointTrajectory] = []
        self.holds: list[Float64Array] = []
        self.events: list[Callable[[Cell], None]] = []
        self.is_silent = self.is_hidden = self.is_box_fixed = False
        self.offset = np.zeros(7)
        self.force, self.felt = 1.0, 100.0
        self.hand_text = self.fault = ""
        self.rivals_found: tuple[str, ...] = ()
        self.pose_received = 100.0
        self.pose = self.box.copy()
        self.pose_std = np.zeros(3)
        self.rng = np.random.default_rng(0)
        self.step()

    # ---- the world

    def step(self) -> None:
        self.time += 0.01
        for event in self.events:
            event(self)
        if self.pieces:
            self.q = self.followed.sample(self.time)[0]
        before, self.tip = self.tip, self.planner.forward(self.q)[:3, 3]
        touches = self.tip[2] < 0.05 and signed_distance(self.tip[None, :2], transform_points(self.box, BOX))[0] < RADIUS
        if touches and not self.is_box_fixed:
            self.box[:2] += self.tip[:2] - before[:2]
        if not self.is_silent:
            q = self.q + self.offset
            self.state = ArmState(self.time, q, self.planner.forward(q), self.time)
        if not self.is_hidden:
            self.pose, self.pose_received = self.box + self.pose_std * self.rng.normal(size=3), self.time

    # ---- clock

    def now(self) -> float:
        return self.time

    def monotonic(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        end = self.time + seconds - 1e-9
        while self.time < end:
            self.step()

    # ---- arm

    def fresh_state(self, timeout: float, *, is_late: bool = False) -> ArmState:
        if self.state is None or self.time - self.state.received > timeout - 0.03:
            raise PlanningError(PushCode.ARM_SILENT, "no joint states.")
        return self.state

    def next_state(self, timeout: float) -> ArmState:
        self.step()
        return self.fresh_state(timeout)

    def rivals(self) -> tuple[str, ...]:
        return self.rivals_found

    def stamp_now(self) -> float:
        return self.time

    def in_use(self) -> nullcontext[None]:
        return nullcontext()

    def open(self, motion: ArmMotion) -> Cell:
        self.commands.append(motion)
        return self

    def move(self, piece: JointTrajectory, start: float | None) -> None:
        state = self.followed.sample(self.time) if self.pieces else (self.q, np.zeros(7))
        self.followed = Followed(piece.time, piece.position, piece.velocity).from_state(self.time, *state)
        self.pieces.append(piece)

    def hold(self, piece: JointTrajectory) -> None:
        self.holds.append(piece.position[-1])
        self.move(piece, None)

    # ---- hand, force, recorder

    def why_no_fist(self) -> str:
        return self.hand_text

    def close_fist(self, timeout: float, is_over: Callable[[], bool]) -> str:
        self.sleep(0.5)
        self.hand_text = ""
        return ""

    @property
    def silence(self) -> float:
        return self.time - self.felt if self.felt < math.inf else 0.0

    def take_peak(self) -> float:
        return self.force

    # ---- objects

    def get(self, object_id: str, max_age: float) -> TrackedObject:
        if object_id not in ("", "box"):
            raise PlanningError(PushCode.UNKNOWN_OBJECT, f"no object `{object_id}`.")
        if self.time - self.pose_received > max_age:
            raise PlanningError(PushCode.UNKNOWN_OBJECT, "the pose is too old.")
        shape = ObjectShape(cells_in_outline(BOX, 0.01), BOX)
        return TrackedObject("box", shape, self.pose_received, self.pose, np.diag(self.pose_std**2))

    def outlines_of_others(self, object_id: str) -> list[Float64Array]:
        return []


class Client:
    def __init__(self) -> None:
        self.is_cancel_requested = False
        self.phases: list[Phase] = []
        self.progress: list[float] = []

    def feedback(self, phase: Phase, progress: float) -> None:
        self.phases.append(phase)
        self.progress.append(progress)


@pytest.fixture(scope="module")
def kinematics() -> ArmKinematics:
    return ArmKinematics(robot_description(), neutral=HOME)


class Bench:
    """An execution on a cell, with what it reported."""

    def __init__(self, kinematics: ArmKinematics) -> None:
        self.cell = cell = Cell(kinematics)
        cell.felt = math.inf  # the force is measured all the time
        self.pushes: list[ExecutedPush] = []
        self.warnings: list[str] = []
        self.client = Client()
        ports = ExecutionPorts(cell, cell, cell, cell, cell, cell)
        self.execution = PushExecution(ports, on_push=self.pushes.append, on_warning=self.warnings.append)

    def push(self, request: PushRequest = CONTACT, settings: ExecutionSettings = SETTINGS) -> PushOutcome:
        return self.execution.execute(request, settings, self.client)

    def when_pushing(self, action: Callable[[Cell], None]) -> None:
        """Do something at every step while the tool is lowered, from the first such step on."""
        began = []

        def event(cell: Cell) -> None:
            if self.execution.is_pushing or began:
                began.append(True)
                action(cell)

        self.cell.events.append(event)


@pytest.fixture
def bench(kinematics: ArmKinematics) -> Bench:
    return Bench(kinematics)


def code_of(outcome: PushOutcome) -> int:
    return PushCode.NONE if outcome.error is None else outcome.error.code


def test_push_carries_the_box_along_and_reports_each_phase(bench: Bench) -> None:
    before = bench.cell.box.copy()
    outcome = bench.push()
    assert code_of(outcome) == PushCode.NONE and outcome.push_id == 1
    assert bench.cell.box[1] - before[1] == pytest.approx(0.05, abs=0.004)
    order = list(dict.fromkeys(bench.client.phases))
    assert order == [Phase.PLAN, Phase.APPROACH, Phase.PUSH, Phase.REST, Phase.RETREAT]
    assert bench.cell.q == pytest.approx(PARKED, abs=1e-3)
    (push,) = bench.pushes
    start, stop, end = push.times()
    assert push.purpose == Purpose.REQUESTED and push.error is None
    assert start < push.contact < stop < end <= push.ended
    assert push.contact - push.started == pytest.approx(push.plan.contact, abs=0.02)
    assert not bench.execution.is_pushing and bench.execution.is_idle


def test_dry_run_plans_and_moves_nothing(bench: Bench) -> None:
    outcome = bench.push(PushRequest(Mode.RANDOM, dry_run=True, seed=3))
    assert code_of(outcome) == PushCode.NONE and outcome.plan is not None
    assert outcome.push_id == 0 and bench.cell.commands == [] and bench.pushes == []


def test_same_seed_gives_the_same_random_push(bench: Bench) -> None:
    plans = [bench.push(PushRequest(Mode.RANDOM, dry_run=True, seed=seed)).plan for seed in (7, 7, 8)]
    directions = [plan.push.direction for plan in plans if plan is not None]
    assert directions[0] == directions[1] != directions[2]


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ({"hand_text": "the hand is open"}, PushCode.HAND),
        ({"fault": "the disk is full"}, PushCode.RECORDING),
        ({"rivals_found": ("/other",)}, PushCode.BUSY),
    ],
)
def test_no_push_begins_on_equipment_that_is_not_ready(bench: Bench, fault: dict[str, Any], code: PushCode) -> None:
    for name, value in fault.items():
        setattr(bench.cell, name, value)
    assert code_of(bench.push()) == code
    assert bench.cell.commands == [] and bench.pushes == []


def test_request_in_an_unknown_frame_or_mode_is_refused(bench: Bench) -> None:
    assert code_of(bench.push(PushRequest(Mode.CONTACT, "box", frame_id="camera"))) == PushCode.INVALID_GOAL
    assert code_of(bench.push(PushRequest(7, "box"))) == PushCode.INVALID_GOAL
    assert code_of(bench.push(PushRequest(Mode.RANDOM, "cup"))) == PushCode.UNKNOWN_OBJECT


def test_object_that_stays_is_no_contact(bench: Bench) -> None:
    bench.cell.is_box_fixed = True
    outcome = bench.push()
    assert code_of(outcome) == PushCode.NO_CONTACT and outcome.push_id == 1
    assert bench.pushes[0].error is outcome.error


def test_noise_of_the_poses_is_no_contact_and_the_record_says_what_the_result_says(bench: Bench) -> None:
    bench.cell.pose_std = np.array([2e-3, 2e-3, 0.02])
    bench.cell.is_box_fixed = True
    for number in range(3):
        outcome = bench.push()
        assert code_of(outcome) == PushCode.NO_CONTACT
        assert bench.pushes[number].error is outcome.error
    bench.cell.is_box_fixed = False
    assert code_of(bench.push()) == PushCode.NONE and bench.pushes[3].error is None


def test_cancel_halts_the_arm_on_its_path(bench: Bench) -> None:
    bench.when_pushing(lambda cell: setattr(bench.client, "is_cancel_requested", True))
    outcome = bench.push()
    assert code_of(outcome) == PushCode.CANCELED
    assert len(bench.cell.holds) == 1 and bench.cell.holds[0] == pytest.approx(bench.cell.state.q, abs=0.02)
    assert_on_path(bench, bench.cell.holds[0])
    start, stop, end = bench.pushes[0].times()
    assert start <= stop <= end == bench.pushes[0].ended


def assert_on_path(bench: Bench, q: Float64Array) -> None:
    (motion,) = bench.cell.commands
    tip = bench.cell.planner.forward(q)[:3, 3]
    assert motion.deviation(tip, 0.0, motion.duration) < 1e-4


def test_silent_arm_is_halted_on_its_path(bench: Bench) -> None:
    bench.when_pushing(lambda cell: setattr(cell, "is_silent", True))
    outcome = bench.push()
    assert code_of(outcome) == PushCode.ARM_SILENT
    (q,) = bench.cell.holds
    assert_on_path(bench, q)
    assert bench.cell.time - bench.cell.state.received < SETTINGS.limits.arm_timeout


@pytest.mark.parametrize("change", [{"force": 40.0}, {"felt": 100.0}], ids=["too large", "not measured any more"])
def test_force_ends_the_push(bench: Bench, change: dict[str, float]) -> None:
    bench.when_pushing(lambda cell: [setattr(cell, name, value) for name, value in change.items()])
    assert code_of(bench.push()) == PushCode.FORCE
    assert len(bench.cell.holds) == 1


def test_arm_that_leaves_its_path_is_held(bench: Bench) -> None:
    bench.when_pushing(lambda cell: cell.offset.__iadd__(0.002))
    assert code_of(bench.push()) == PushCode.TRACKING


def test_arm_moved_between_plan_and_start_is_planned_for_again(bench: Bench) -> None:
    def nudge(cell: Cell) -> None:
        if bench.cell.time == times[2]:
            cell.q = cell.q + 0.05

    times = [bench.cell.time]
    for _ in range(3):
        times.append(times[-1] + 0.01)
    bench.cell.events.append(nudge)
    assert code_of(bench.push()) == PushCode.NONE
    assert bench.cell.commands[0].trajectory.position[0] == pytest.approx(np.array(PARKED) + 0.05)


def test_lost_object_ends_the_push_and_the_arm_goes_home(bench: Bench) -> None:
    bench.when_pushing(lambda cell: setattr(cell, "is_hidden", True))
    outcome = bench.push()
    assert code_of(outcome) == PushCode.OBJECT_LOST and "The arm went home." in str(outcome.error)
    assert len(bench.cell.holds) == 1 and len(bench.cell.commands) == 2
    assert bench.cell.q == pytest.approx(PARKED, abs=1e-3)
    assert bench.client.phases[-1] == Phase.RETREAT


def test_object_pushed_out_of_the_workspace_is_lost(bench: Bench) -> None:
    bench.when_pushing(lambda cell: cell.box.__setitem__(0, 0.3))
    outcome = bench.push()
    assert code_of(outcome) == PushCode.OBJECT_LOST and "left the workspace" in str(outcome.error)


def test_object_near_the_edge_is_recentred_before_a_random_push(bench: Bench) -> None:
    bench.cell.box[:] = 0.05, 0.2, 0.0
    bench.cell.step()
    outcome = bench.push(PushRequest(Mode.RANDOM, "box", seed=2))
    assert [push.purpose for push in bench.pushes] == [Purpose.RECENTRE, Purpose.REQUESTED]
    assert (outcome.recentre_push_id, outcome.push_id) == (1, 2)
    assert Phase.RECENTRE in bench.client.phases


def test_push_given_in_the_table_frame_is_made_as_requested_at_the_edge(bench: Bench) -> None:
    bench.cell.box[:] = 0.05, 0.2, 0.0
    bench.cell.step()
    request = PushRequest(Mode.CONTACT, "box", contact_point=(0.0, 0.2), direction=0.0, distance=0.05, speed=0.1)
    bench.push(request)
    assert [push.purpose for push in bench.pushes] == [Purpose.REQUESTED]


def test_one_request_at_a_time(bench: Bench) -> None:
    second: list[PushOutcome] = []

    def ask_again(cell: Cell) -> None:
        if not second:
            thread = threading.Thread(target=lambda: second.append(bench.push()))
            thread.start()
            thread.join()
            assert bench.execution.close_hand(1.0)

    bench.when_pushing(ask_again)
    assert code_of(bench.push()) == PushCode.NONE
    assert code_of(second[0]) == PushCode.BUSY


def test_stop_holds_the_arm_and_refuses_requests(bench: Bench) -> None:
    bench.when_pushing(lambda cell: bench.execution.stop(0.0))
    assert code_of(bench.push()) == PushCode.CANCELED
    assert len(bench.cell.holds) == 1
    assert code_of(bench.push()) == PushCode.CANCELED
    assert len(bench.cell.commands) == 1
