"""The execution of pushes, on a cell in memory with a clock of its own."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from helpers.memory_cell import CONTACT, PARKED, SETTINGS, Bench, Cell, code_of
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.executed_push import Purpose
from push_ident.pushing.ports import Phase
from push_ident.pushing.push import PushCode
from push_ident.pushing.push_request import ExecutionSettings, Mode, PushRequest


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
    assert bench.cell.pieces == [] and bench.pushes == []


def test_request_in_an_unknown_frame_or_mode_is_refused(bench: Bench) -> None:
    assert code_of(bench.push(PushRequest(Mode.CONTACT, "box", frame_id="camera"))) == PushCode.INVALID_GOAL
    assert code_of(bench.push(PushRequest(7, "box"))) == PushCode.INVALID_GOAL
    assert code_of(bench.push(PushRequest(Mode.RANDOM, "cup"))) == PushCode.UNKNOWN_OBJECT


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


@pytest.mark.parametrize(
    ("change", "code"),
    [({"force": 40.0}, PushCode.FORCE), ({"felt": 100.0}, PushCode.FORCE), ({"offset": np.full(7, 0.02)}, PushCode.TRACKING)],
    ids=["force too large", "force not measured any more", "arm off its path"],
)
def test_push_that_is_not_as_it_should_be_is_held(bench: Bench, change: dict[str, Any], code: PushCode) -> None:
    bench.when_pushing(lambda cell: [setattr(cell, name, value) for name, value in change.items()])
    assert code_of(bench.push()) == code
    assert len(bench.cell.holds) == 1


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
