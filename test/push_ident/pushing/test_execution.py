"""The execution of pushes, straight and along a path that is corrected on the way, on a cell in memory with a clock of its own."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from helpers.memory_cell import CONTACT, PARKED, SETTINGS, Bench, Cell, code_of
from push_ident.errors import InputError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.command_link import CommandLink
from push_ident.pushing.executed_push import Purpose, RestingPose, displacement
from push_ident.pushing.motion import PathPlan
from push_ident.pushing.ports import Phase
from push_ident.pushing.push import PushCode
from push_ident.pushing.push_request import ExecutionSettings, Mode, PushRequest
from push_ident.pushing.steering import PathRequest, ToolCorrection
from push_ident.pushing.tool_path import Corridor, ToolPath


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


def test_dry_run_plans_and_moves_nothing_and_its_random_push_is_that_of_its_seed(bench: Bench) -> None:
    plans = [bench.push(PushRequest(Mode.RANDOM, dry_run=True, seed=seed)).plan for seed in (7, 7, 8)]
    directions = [plan.push.direction for plan in plans if plan is not None]
    assert directions[0] == directions[1] != directions[2]
    assert bench.cell.pieces == [] and bench.pushes == []


@pytest.mark.parametrize(
    ("fault", "request_", "code"),
    [
        ({"hand_text": "the hand is open"}, {}, PushCode.HAND),
        ({"fault": "the disk is full"}, {}, PushCode.RECORDING),
        ({"rivals_found": ("/other",)}, {}, PushCode.BUSY),
        ({}, {"frame_id": "camera"}, PushCode.INVALID_GOAL),
        ({}, {"mode": 7}, PushCode.INVALID_GOAL),
        ({}, {"object_id": "cup"}, PushCode.UNKNOWN_OBJECT),
    ],
)
def test_no_push_begins_on_equipment_that_is_not_ready_or_for_an_impossible_request(
    bench: Bench, fault: dict[str, Any], request_: dict[str, Any], code: PushCode
) -> None:
    vars(bench.cell).update(fault)
    assert code_of(bench.push(replace(CONTACT, **request_))) == code
    assert bench.cell.pieces == [] and bench.pushes == []


def test_noise_of_the_poses_is_no_contact_and_the_record_says_what_the_result_says(bench: Bench) -> None:
    bench.cell.pose_std = np.array([2e-3, 2e-3, 0.02])
    bench.cell.is_box_fixed = True
    outcome = bench.push()
    assert code_of(outcome) == PushCode.NO_CONTACT and bench.pushes[0].error is outcome.error
    bench.cell.is_box_fixed = False
    assert code_of(bench.push()) == PushCode.NONE and bench.pushes[1].error is None


def test_arm_that_missed_pieces_goes_on_from_where_it_stands(bench: Bench) -> None:
    """Pieces that come too late are as good as none: the arm has braked, and must not jump to where the next one begins."""
    began, tips = [], []

    def deaf_for_a_while(cell: Cell) -> None:
        began.append(cell.time)
        cell.is_deaf = 0.3 < cell.time - began[0] < 0.5
        tips.append(cell.tip[:2].copy())

    start = bench.cell.box.copy()
    bench.when_pushing(deaf_for_a_while)
    outcome = bench.push()
    steps = np.linalg.norm(np.diff(tips, axis=0), axis=1)[: np.searchsorted(began, began[0] + 1.5)]
    assert code_of(outcome) == PushCode.NONE
    assert np.sum(steps[:80] < 1e-5) > 5, "it stood"
    assert steps.max() < 1.2 * 0.1 * 0.01, "no step is longer than at 0.1 m/s"
    assert bench.cell.box[1] - start[1] == pytest.approx(0.05, abs=0.004), "the whole push is made"


def test_arm_that_is_slow_to_begin_has_missed_nothing(bench: Bench) -> None:
    paths = []
    assert code_of(bench.push(replace(CONTACT, dry_run=False, distance=0.01))) == PushCode.NONE, "the first push takes the arm over"
    for delay in (0.0, 0.12):
        bench.cell.delay = delay
        began = bench.cell.time
        outcome = bench.push(PushRequest(Mode.CONTACT, "box", contact_point=(0.0, -0.01), direction=math.pi / 2, distance=0.02, speed=0.1))
        assert code_of(outcome) == PushCode.NONE
        paths.append(bench.cell.time - began)
    assert paths[1] == pytest.approx(paths[0], abs=0.13), "later by its delay, and no pause"


@pytest.mark.parametrize(
    ("target", "change", "code"),
    [
        ("client", {"is_cancel_requested": True}, PushCode.CANCELED),
        ("cell", {"is_silent": True}, PushCode.ARM_SILENT),
        ("cell", {"hand_text": "the hand is open"}, PushCode.HAND),
        ("cell", {"fault": "the disk is full", "is_there": False}, PushCode.RECORDING),  # the fault of a force sensor, if it is there
        ("cell", {"force": 40.0}, PushCode.FORCE),
        ("cell", {"felt": 100.0}, PushCode.FORCE),  # it is not measured any more
        ("cell", {"offset": np.full(7, 0.02)}, PushCode.TRACKING),
    ],
)
def test_arm_is_halted_on_its_path(bench: Bench, target: str, change: dict[str, object], code: PushCode) -> None:
    bench.when_pushing(lambda cell: vars(getattr(bench, target)).update(change))
    assert code_of(bench.push()) == code
    (q,) = bench.cell.holds
    motion = bench.pushes[0].plan
    assert motion.deviation(bench.cell.planner.forward(q)[:3, 3], 0.0, motion.duration) < 1e-4
    assert bench.cell.time - bench.cell.state.received < SETTINGS.limits.arm_timeout
    start, stop, end = bench.pushes[0].times()
    assert start <= stop <= end == bench.pushes[0].ended


@pytest.mark.parametrize("at", ["fresh_state", "take_peak", "why_no_fist"])
def test_process_that_stands_still_within_a_look_sends_nothing_more_and_says_why(bench: Bench, monkeypatch: Any, at: str) -> None:
    """All sensors seem silent to it then; the arm has braked meanwhile."""
    whole, n_pieces = getattr(bench.cell, at), []

    def stands_still(*args: Any, **kwargs: Any) -> Any:
        result = whole(*args, **kwargs)
        if bench.execution.is_pushing and len(bench.cell.pieces) > 20 and not n_pieces:
            bench.cell.felt = bench.cell.pose_received = bench.cell.time
            bench.cell.is_hidden = True
            bench.cell.sleep(1.5)
            n_pieces.append(len(bench.cell.pieces))
        return result

    monkeypatch.setattr(bench.cell, at, stands_still)
    outcome = bench.push()
    assert code_of(outcome) == PushCode.TRACKING and "was not watched for 1.5 s" in str(outcome.error)
    assert len(bench.cell.holds) == 1 and len(bench.cell.pieces) == n_pieces[0] + 1, "the hold is all that is sent after it"


def test_arm_moved_between_plan_and_start_is_planned_for_again(bench: Bench) -> None:
    steps = iter(range(10**6))
    bench.cell.events.append(lambda cell: setattr(cell, "q", cell.q + 0.05 * (next(steps) == 1)))
    assert code_of(bench.push()) == PushCode.NONE
    assert bench.pushes[0].plan.trajectory.position[0] == pytest.approx(np.array(PARKED) + 0.05)


def test_lost_object_ends_the_push_and_the_arm_goes_home(bench: Bench) -> None:
    bench.when_pushing(lambda cell: setattr(cell, "is_hidden", True))
    outcome = bench.push()
    assert code_of(outcome) == PushCode.OBJECT_LOST and "The arm went home." in str(outcome.error)
    assert len(bench.cell.holds) == 1 and bench.client.phases[-1] == Phase.RETREAT
    assert bench.cell.q == pytest.approx(PARKED, abs=1e-3)


def test_object_that_the_arm_hides_for_the_better_part_of_a_push_is_not_lost_by_default(bench: Bench) -> None:
    hidden: list[float] = []

    def hide(cell: Cell) -> None:
        hidden.append(cell.time)
        cell.is_hidden = 0.3 < cell.time - hidden[0] < 2.4

    bench.when_pushing(hide)
    default = next(field.default for field in fields(ExecutionSettings) if field.name == "lost_timeout")
    settings = replace(SETTINGS, lost_timeout=default)
    outcome = bench.push(replace(CONTACT, distance=0.1, speed=0.05), settings)
    assert code_of(outcome) == PushCode.NONE, outcome.error


def test_object_pushed_out_of_the_workspace_is_lost(bench: Bench) -> None:
    bench.when_pushing(lambda cell: cell.box.__setitem__(0, 0.3))
    outcome = bench.push()
    assert code_of(outcome) == PushCode.OBJECT_LOST and "left the workspace" in str(outcome.error)


def test_object_near_the_edge_is_recentred_before_a_random_push(bench: Bench) -> None:
    bench.cell.box[:] = 0.05, 0.2, 0.0
    bench.cell.step()
    outcome = bench.push(PushRequest(Mode.RANDOM, "box", seed=2))
    assert [push.purpose for push in bench.pushes] == [Purpose.RECENTRE, Purpose.REQUESTED]
    assert (outcome.recentre_push_id, outcome.push_id) == (1, 2) and Phase.RECENTRE in bench.client.phases
    bench.cell.box[:] = 0.05, 0.2, 0.0
    bench.cell.step()
    bench.push(PushRequest(Mode.CONTACT, "box", contact_point=(0.0, 0.2), direction=0.0, distance=0.05, speed=0.1))
    assert [push.purpose for push in bench.pushes[2:]] == [Purpose.REQUESTED], "a push given in the table frame is made as requested"


def test_stop_holds_the_arm_and_refuses_requests(bench: Bench) -> None:
    bench.when_pushing(lambda cell: bench.execution.stop(0.0))
    assert code_of(bench.push()) == PushCode.CANCELED and len(bench.cell.holds) == 1
    n_pieces = len(bench.cell.pieces)
    assert code_of(bench.push()) == PushCode.CANCELED and len(bench.cell.pieces) == n_pieces


@pytest.mark.parametrize("jump", [(0.25, 0.0, 0.0), (0.0, 0.12, 0.0)], ids=["aside", "ahead"])
def test_pose_that_no_push_can_have_made_is_no_success(bench: Bench, jump: tuple[float, float, float]) -> None:
    bench.when_pushing(lambda cell: setattr(cell, "pose_offset", np.array(jump)))
    settings = replace(SETTINGS, push=replace(SETTINGS.push, workspace=(-0.5, 0.5, -0.5, 0.5)))
    outcome = bench.push(CONTACT, settings)
    assert code_of(outcome) == PushCode.OBJECT_LOST and "cannot be where its pose says" in str(outcome.error)
    assert bench.pushes[0].error is outcome.error


@pytest.mark.parametrize(("behind", "rate"), [(0.0, 0.3), (3.0, 1.0), (3.0, 0.3)], ids=["slow", "behind", "slow and behind"])
def test_record_has_the_times_of_the_tool_where_the_clock_is_wrong(kinematics: ArmKinematics, behind: float, rate: float) -> None:
    bench = Bench(kinematics)
    lowered: list[float] = []

    def note(cell: Cell) -> None:
        if bench.execution.is_pushing:
            lowered.append(cell.time)

    bench.cell.events.append(note)
    bench.cell.now = lambda: 100.0 - behind + rate * (bench.cell.time - 100.0)  # type: ignore[method-assign]
    outcome = bench.push()
    assert outcome.error is None, outcome.error
    (push,) = bench.pushes
    start, stop, end = push.times()
    assert start == pytest.approx(lowered[0], abs=0.03) and end == pytest.approx(lowered[-1], abs=0.03)
    assert push.contact is not None and start < push.contact < stop < end
    assert end - stop == pytest.approx(SETTINGS.motion.rest, abs=0.05) and stop - start > CONTACT.distance / CONTACT.speed


# --- along a path

OUTWARD = np.array([math.sin(0.3), -math.cos(0.3)])
"""Of the long face of the box that is pushed along a path."""
TOUCH = np.array([0.0, 0.02]) + 0.048 * OUTWARD
WAY = ToolPath(np.array([0.0, 0.3, 1.1]), np.array([TOUCH + 0.03 * OUTWARD, TOUCH, TOUCH - 0.08 * OUTWARD]))
AROUND = Corridor(np.vstack([WAY.position, TOUCH - 0.18 * OUTWARD]), 0.07)
ASIDE = np.array([math.cos(0.3), math.sin(0.3)])
ALONG_PATH = PushRequest(Mode.PATH, "box", path=PathRequest(WAY, AROUND, 0.15))


class Corrector:
    """Publishes corrections every 30 ms from the contact on, which lead the tool aside and on, until it has come a way."""

    def __init__(self, bench: Bench, length: float = 0.10, last: float = math.inf) -> None:
        self.bench, self.length, self.last, self.n, self.refusals = bench, length, last, 0, 0
        bench.cell.events.append(self)

    def __call__(self, cell: Cell) -> None:
        if not (self.bench.execution.is_pushing and self.bench.client.begun):
            return
        push_id, start = self.bench.client.begun[-1]
        now = cell.time - start
        if now < 0.3 + 0.03 * self.n or now > self.last:
            return
        self.n += 1
        stamp = cell.time - 0.02
        way = -OUTWARD * 0.1 + ASIDE * 0.05 if now > 0.5 else -OUTWARD * 0.1
        tip = np.array([np.interp(now - 0.02, WAY.time, c) for c in WAY.position.T]) if now < 0.5 else cell.tip[:2] - 0.02 * way
        time = np.linspace(0.0, 0.5, 6)
        travel = float((cell.tip[:2] - TOUCH) @ -OUTWARD)
        stop = travel > self.length
        self.last = now if stop else self.last
        try:
            self.bench.execution.correct(ToolCorrection(push_id, stamp, stop, time, tip + np.outer(time, way)))
        except InputError:
            self.refusals += 1


def test_push_along_a_path_takes_corrections_until_it_is_told_to_stop(bench: Bench) -> None:
    before, corrector = bench.cell.box.copy(), Corrector(bench)
    outcome = bench.push(ALONG_PATH)
    assert code_of(outcome) == PushCode.NONE, outcome.error
    assert corrector.refusals <= 1 < 20 < outcome.n_corrections and outcome.n_refused == corrector.refusals
    # Further than the path that was sent, and aside as only the corrections say.
    moved = bench.cell.box[:2] - before[:2]
    assert moved @ -OUTWARD == pytest.approx(0.105, abs=0.012) and moved @ ASIDE > 0.025
    (push,) = bench.pushes
    start, stop, end = push.times()
    assert push.error is None and start < push.contact < stop < end <= push.ended
    assert push.plan.push.distance == pytest.approx(np.hypot(*moved), abs=0.012)
    assert bench.cell.q == pytest.approx(PARKED, abs=1e-3) and not bench.execution.is_pushing
    assert bench.client.begun[-1][0] == 1 and bench.execution.steering is None
    order = list(dict.fromkeys(bench.client.phases))
    assert order == [Phase.PLAN, Phase.APPROACH, Phase.PUSH, Phase.REST, Phase.RETREAT]


def test_corrections_that_stop_in_a_push_end_it_within_their_timeout_and_the_arm_goes_home(bench: Bench) -> None:
    stopped: list[tuple[float, float]] = []
    Corrector(bench, last=0.6)
    bench.cell.events.append(lambda cell: stopped.append((cell.time, float(cell.tip[1]))) if cell.holds and len(stopped) < 60 else None)
    outcome = bench.push(ALONG_PATH)
    assert code_of(outcome) == PushCode.CORRECTION and "The arm went home." in str(outcome.error)
    _, start = bench.client.begun[-1]
    # 0.2 s, twice the timeout of the arm, is the least patience; the arm stands 0.1 s later.
    assert stopped[0][0] - start == pytest.approx(0.6 + 0.2, abs=0.05)
    assert abs(stopped[12][1] - stopped[10][1]) < 1e-4
    assert bench.cell.q == pytest.approx(PARKED, abs=1e-3) and bench.pushes[0].error is outcome.error


def test_tool_backs_off_from_the_object_where_the_push_was_broken_off_and_not_where_its_path_would_have_led(bench: Bench) -> None:
    """The path turns round: at its end, backing off against the motion would be into the object."""
    place = np.array([(0.03, 0.0), (0.0, 0.0), (-0.04, 0.0), (-0.04, 0.05), (0.0, 0.05)])
    tool = TOUCH + place[:, :1] * OUTWARD + place[:, 1:] * ASIDE
    path = ToolPath(np.array([0.0, 0.3, 0.7, 1.2, 1.6]), tool)
    held: list[tuple[np.ndarray, np.ndarray]] = []
    bench.cell.events.append(lambda cell: held.append((cell.box.copy(), cell.tip.copy())) if cell.holds else None)
    outcome = bench.push(PushRequest(Mode.PATH, "box", path=PathRequest(path, Corridor(tool, 0.07), 0.15)))
    assert code_of(outcome) == PushCode.CORRECTION and "The arm went home." in str(outcome.error)
    box, tip = held[16]  # it stands
    assert (box[:2] - [0.0, 0.02]) @ -OUTWARD > 0.01, "it was pushed"
    np.testing.assert_allclose(bench.cell.box, box, atol=1e-4)
    low = [(place - tip)[:2] @ OUTWARD for _, place in held if place[2] < tip[2] + 1e-3]
    assert max(low) == pytest.approx(SETTINGS.motion.back_off, abs=1e-3) and min(low) > -2e-3


@pytest.mark.parametrize("seed", [0, 2, 5, 11])
def test_push_whose_corrections_are_planned_late_goes_on_and_ends(bench: Bench, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """A machine that is busy plans, now and then, for longer than the arm takes to where the paths part."""
    planned, rng = PathPlan.corrected, np.random.default_rng(seed)

    def late(plan: PathPlan, path: ToolPath, begin: float) -> PathPlan:
        events, bench.cell.events = bench.cell.events, [give_up]  # no correction is taken meanwhile
        bench.cell.sleep(max(rng.uniform(-0.1, 0.15), 0.0))
        bench.cell.events = events
        sway = np.column_stack([np.zeros(len(path.time)), path.time * rng.uniform(-0.04, 0.04)])
        return planned(plan, ToolPath(path.time, path.position + sway), begin)

    def give_up(cell: Cell) -> None:
        assert cell.time < 130.0, "the push does not end"

    monkeypatch.setattr(PathPlan, "corrected", late)
    bench.cell.events.append(give_up)
    Corrector(bench)
    outcome = bench.push(ALONG_PATH)
    assert code_of(outcome) in (PushCode.NONE, PushCode.CORRECTION), outcome.error
    assert bench.cell.q == pytest.approx(PARKED, abs=1e-3), "the arm went home"


def test_arm_that_cannot_go_on_within_its_limits_ends_the_push(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    move = CommandLink.move

    def refuse(link: CommandLink, *args: Any, **kwargs: Any) -> bool:
        return not bench.execution.is_pushing and move(link, *args, **kwargs)

    monkeypatch.setattr(CommandLink, "move", refuse)
    outcome = bench.push()
    assert code_of(outcome) == PushCode.TRACKING and "exceed a limit" in str(outcome.error)
    progress = bench.client.progress
    assert progress.count(progress[-1]) > 5, "an arm that stands is reported"


@pytest.mark.parametrize(("change", "code"), [({"is_cancel_requested": True}, PushCode.CANCELED), ({"force": 40.0}, PushCode.FORCE)])
def test_cancel_and_force_end_a_corrected_push_as_any_other(bench: Bench, change: dict[str, Any], code: PushCode) -> None:
    Corrector(bench)
    when: list[float] = []

    def meddle(cell: Cell) -> None:
        if bench.execution.is_pushing and bench.client.begun and cell.time - bench.client.begun[-1][1] > 0.7 and not when:
            when.append(cell.time)
            for name, value in change.items():
                setattr(bench.client if hasattr(bench.client, name) else cell, name, value)

    bench.cell.events.append(meddle)
    assert code_of(bench.push(ALONG_PATH)) == code
    assert len(bench.cell.holds) == 1 and bench.cell.time - when[0] <= 0.05


@pytest.mark.parametrize(
    ("request_", "code", "words"),
    [
        (PushRequest(Mode.PATH, "box"), PushCode.INVALID_GOAL, "tool_path"),
        (replace(ALONG_PATH, path=PathRequest(WAY, Corridor(WAY.position, 0.5))), PushCode.UNREACHABLE, "corridor"),
        (replace(ALONG_PATH, path=PathRequest(ToolPath(WAY.time, WAY.position - 0.01), AROUND)), PushCode.INVALID_GOAL, "mm"),
        (replace(ALONG_PATH, path=PathRequest(ToolPath(0.3 * WAY.time, WAY.position), AROUND)), PushCode.INVALID_GOAL, "m/s"),
    ],
    ids=["no path", "corridor out of reach", "beside the object", "too fast"],
)
def test_paths_that_cannot_be_made_are_refused_and_nothing_moves(bench: Bench, request_: PushRequest, code: PushCode, words: str) -> None:
    settings = replace(SETTINGS, push=replace(SETTINGS.push, workspace=(-0.9, 0.9, -0.9, 0.9)))
    outcome = bench.push(request_, settings)
    assert code_of(outcome) == code and words in str(outcome.error), outcome.error
    assert bench.cell.pieces == [] and bench.pushes == []
    with pytest.raises(InputError, match="no push along a path now"):
        bench.execution.correct(ToolCorrection(1, 0.0, True, np.empty(0), np.empty((0, 2))))


# --- whether an object was moved, from noisy poses at rest

COVARIANCE = np.diag([1e-3, 1e-3, np.radians(0.5)]) ** 2


def noisy(pose: np.ndarray, rng: np.random.Generator) -> Iterator[RestingPose]:
    """What thirty poses with noise have told after each."""
    found = RestingPose()
    for k, error in enumerate(rng.multivariate_normal(np.zeros(3), COVARIANCE, size=30)):
        found.add(float(k), pose + error, COVARIANCE)
        yield found


def test_noise_is_no_motion_however_often_it_is_looked_at() -> None:
    rng, pose = np.random.default_rng(0), np.array([0.1, -0.2, np.pi])
    befores = ([*noisy(pose, rng)][-1] for _ in range(300))
    assert sum(displacement(before, after)[2] for before in befores for after in noisy(pose, rng)) <= 3


def test_small_motion_is_seen_and_measured_across_the_wrap_of_yaw() -> None:
    rng = np.random.default_rng(1)
    pose = np.array([0.1, -0.2, np.pi])
    shift, turn, is_moved = displacement(*([*noisy(pose + share * np.array([0.003, 0.0, 0.02]), rng)][-1] for share in (0.0, 1.0)))
    assert is_moved and abs(shift - 0.003) < 1e-3 and abs(turn - 0.02) < 0.01


def test_exact_poses_are_compared_too_and_one_that_is_not_newer_is_not_counted_twice() -> None:
    rests = [RestingPose(), RestingPose()]
    for pose, exact in zip((0.0, 0.01), rests, strict=True):
        exact.add(0.0, np.array([pose, 0.0, 0.0]), np.zeros((3, 3)))
    assert displacement(*rests) == (0.01, 0.0, True)
    found = RestingPose()
    for _ in range(5):
        found.add(1.0, np.zeros(3), COVARIANCE)
    assert found.n == 1
