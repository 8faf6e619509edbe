"""`push-ident experiment pushing`: its measures, on a push whose deviations are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import Point
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from push_ident.geometry.kinematics import ArmKinematics
from push_ident.nodes.convert.messages import stamp_to_msg
from push_ident.pushing.motion import ArmPlan, MotionSettings, plan_push
from push_ident.pushing.pacing import PathPacing
from push_ident.pushing.push import PushCode, PushPlan2D
from push_ident_msgs.msg import PushRecord
from push_ident_sim.cell.robot import HOME, robot_description
from push_ident_sim.studies.common.experiment import Case, CaseResult
from push_ident_sim.studies.pushing import study as pushing
from push_ident_sim.studies.pushing.live_cell import Heard

LAG, START = 0.030, 100.0
PARKED = (1.4, *HOME[1:])


@pytest.fixture(scope="module")
def arm() -> ArmKinematics:
    return ArmKinematics(robot_description(), neutral=HOME)


@pytest.fixture(scope="module")
def plan(arm: ArmKinematics) -> ArmPlan:
    push = PushPlan2D(np.array([0.0, 0.0]), np.array([-0.018, 0.0]), 0.0, 0.06, 0.15)
    return plan_push(arm, PARKED, push, MotionSettings(home=PARKED))


def command_of(plan: ArmPlan) -> JointTrajectory:
    msg = JointTrajectory(joint_names=list(plan.limits.names))
    for time, position, velocity in zip(plan.trajectory.time, plan.trajectory.position, plan.trajectory.velocity, strict=True):
        point = JointTrajectoryPoint(positions=position.tolist(), velocities=velocity.tolist())
        point.time_from_start.sec, point.time_from_start.nanosec = int(time), int((time % 1) * 1e9)
        msg.points.append(point)
    return msg


def heard_of(plan: ArmPlan, *, joint_error: float, shift: float) -> Heard:
    """An arm that follows LAG late with one joint off, and an object that is pushed aside."""
    heard = Heard()
    offset = joint_error * np.eye(7)[0]
    for time in np.arange(0.0, plan.duration + 0.2, 0.01):
        (before, now, after), _ = plan.trajectory.follow(time - LAG + np.array([-0.005, 0.0, 0.005]))
        q, speed = now + offset, (after - before) / 0.01
        heard.states.append((START + time, START + time, q, speed))
        moved = shift if time > plan.contact else 0.0
        heard.truth.append((START + time, moved, 0.0, 0.0))
        heard.forces.append((START + time, 5.0 if plan.contact < time < plan.stop else 0.1))
    return heard


def record_of(plan: ArmPlan) -> PushRecord:
    record = PushRecord(push_id=1, object_id="truth", speed=0.15, contact_point=Point())
    times = {"start": plan.lowered, "contact": plan.contact, "stop": plan.stop, "end": plan.rested}
    for name, time in times.items():
        setattr(record, name, stamp_to_msg(START + time))
    return record


def test_measures_find_the_deviation_the_lag_and_the_motion_of_the_object(arm: ArmKinematics, plan: ArmPlan) -> None:
    heard = heard_of(plan, joint_error=1e-3, shift=0.04)
    values = pushing.measure(arm, heard, record_of(plan), START, command_of(plan), np.inf)
    # Turning the first joint by 1 mrad moves the tip by 1 mrad times its distance from the axis, across the push.
    off = 1e-3 * np.hypot(0.02 + 0.44, 0.0)
    assert values["cross_rms_m"] == pytest.approx(off, rel=0.1)
    assert values["late_rms_m"] == pytest.approx(off, rel=0.1)
    assert values["lag_s"] == pytest.approx(LAG, abs=0.003)
    assert values["moved"] and values["shift_m"] == pytest.approx(0.04)
    assert values["peak_force_n"] == 5.0
    assert values["lowest_tip_m"] == pytest.approx(0.012, abs=1e-4)
    assert 0.9 < values["velocity_share"] <= 1.01
    assert values["beyond_workspace_m"] < 0


def test_push_past_the_object_counts_as_no_contact_and_all_is_summed_up(arm: ArmKinematics, plan: ArmPlan, tmp_path: Path) -> None:
    hit = pushing.measure(arm, heard_of(plan, joint_error=0.0, shift=0.04), record_of(plan), START, command_of(plan), np.inf)
    record = record_of(plan)
    record.error_code = int(PushCode.NO_CONTACT)
    miss = pushing.measure(arm, heard_of(plan, joint_error=2e-3, shift=0.0), record, START, command_of(plan), np.inf)
    refused = {"code": int(PushCode.UNREACHABLE), "text": "too far", "purpose": 0, "made": False}
    held = {"kind": "cancel", "spurious": False, "hold_s": 0.015, "still_s": 0.04, "commands_after": 0, "is_hold": True}
    late = {"kind": "silence", "spurious": False, "hold_s": 0.12, "still_s": 0.15, "commands_after": 0, "is_hold": True}
    results = [
        CaseResult(Case("book", 0, "pushes"), {"pushes": [hit, miss, refused]}),
        CaseResult(Case("book", 0, "cancel"), {"stops": [held]}),
        CaseResult(Case("book", 0, "silence"), {"stops": [late, {"kind": "silence", "spurious": True, "code": 0, "text": ""}]}),
    ]
    summary = pushing.STUDY.summarise(results)
    row = summary["all"]
    assert (row["asked"], row["refused"], row["contact"], row["succeeded"]) == (2, 1, 1, 1)
    assert row["cross_max_m"] == miss["cross_max_m"]
    assert summary["codes"] == {"SUCCESS": 1, "NO_CONTACT": 1}
    assert summary["stops"]["silence"]["within"] == 0 and summary["stops"]["silence"]["spurious"] == {"SUCCESS": 1}
    text = pushing.STUDY.tables(summary)
    assert "50.0 %" in text and "1 of 1" in text and "0 of 1" in text
    for picture in pushing.STUDY.draw(summary, tmp_path):
        assert (tmp_path / picture).stat().st_size > 10_000


def test_pieces_of_a_motion_add_up_to_what_was_planned(plan: ArmPlan) -> None:
    pacing, commands, received = PathPacing(plan.trajectory, plan.limits.planned.acceleration, 0.08, 0.0), [], START
    while not pacing.is_complete:
        piece = pacing.piece(received - START)
        msg = JointTrajectory(joint_names=list(plan.limits.names))
        for time, position in zip(piece.time, piece.position, strict=True):
            point = JointTrajectoryPoint(positions=position.tolist())
            point.time_from_start.nanosec = int(1e9 * time)
            msg.points.append(point)
        commands.append((received, msg))
        received += 0.02
    ((first, whole),) = pushing.joined(commands)
    assert first == START
    time = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in whole.points])
    assert np.all(np.diff(time) > 0) and time[-1] == pytest.approx(plan.duration, abs=0.01)
    planned, _ = plan.trajectory.follow(np.asarray(time))
    assert np.array([p.positions for p in whole.points]) == pytest.approx(planned, abs=1e-3)
