"""What `push-ident push-to` and `demo --goal` say and draw."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from helpers.commands import check_refused
from push_ident.cli.goal_report import GoalReport, PathReport, edge_message, goal_message, last_feedback, path_message
from push_ident.cli.push_to import goals_of, parse_edge, parse_goal, parse_tolerance
from push_ident.errors import InputError
from push_ident.geometry.se2 import quaternion_of_yaw
from push_ident.planning.goal_page import write_goal_page
from push_ident_msgs.action import PushToGoal


def feedback(number: int, *, predicted: bool) -> PushToGoal.Feedback:
    msg = PushToGoal.Feedback(pushes=number, position_error=0.0123, yaw_error=0.1, is_predicted=predicted, expected_chance=0.8)
    for pose, (x, yaw) in ((msg.pose, (0.1, 0.2)), (msg.expected_pose, (0.104, 0.2 + np.radians(2.0)))):
        pose.position.x = x
        pose.orientation.z, pose.orientation.w = (float(value) for value in quaternion_of_yaw(yaw)[2:])
    return msg


def ended(**result: object) -> GoalReport:
    report = GoalReport(goal_message(np.array([0.05, 0.06, 0.6]), object_id="o1", tolerance_mm=10.0))
    report.result = PushToGoal.Result(**result)
    return report


def test_report_names_its_code() -> None:
    reports = ended(error_code=-11), GoalReport(goal_message(np.zeros(3))), ended(error_code=-99)
    assert [report.content()["code"] for report in reports] == ["MAX_PUSHES", "CANCELED", "-99"]
    assert not any(report.content()["reached"] for report in reports)
    content = ended().content()
    assert content["code"] == "SUCCESS" and content["reached"] and content["start"] is None and content["outline"] is None
    assert content["tolerance_m"] == pytest.approx(0.01)
    np.testing.assert_allclose(content["goal"], [0.05, 0.06, 0.6])


def test_push_whose_feedback_came_too_late_is_in_the_report() -> None:
    report, under_way = ended(pushes=1, position_error=0.005, yaw_error=0.03), feedback(0, predicted=True)
    for _ in range(2):  # also where that feedback did come
        report.take(last_feedback(report.result, under_way, np.array([0.11, 0.0, 0.2])))
    (push,) = report.content()["pushes"]
    assert (push["number"], push["position_error_m"], push["chance"]) == (1, 0.005, 0.8)
    np.testing.assert_allclose([push["seen"], push["expected"]], [[0.11, 0.0, 0.2], [0.104, 0.0, 0.2 + np.radians(2.0)]])
    for unseen in (ended(pushes=1, position_error=np.nan), ended(pushes=1, position_error=0.2, error_code=PushToGoal.Result.FELL)):
        unseen.take(last_feedback(unseen.result, under_way, np.zeros(3)))
        assert unseen.lines == []


def test_list_and_count_of_pushes_agree_where_nothing_was_reported_of_some(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A push back to the middle comes with the exploring push after it, in one report; the last one hid the object."""
    report = ended(pushes=4, error_code=PushToGoal.Result.OBJECT_LOST, position_error=np.nan)
    report.start, report.outline = np.zeros(3), np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]])
    report.take(feedback(2, predicted=False))
    report.take(feedback(3, predicted=True))
    report.count_up_to(4)
    content = report.content()
    assert [push["number"] for push in content["pushes"]] == [1, 2, 3, 4] and content["n_pushes"] == 4
    assert [push["seen"] is None for push in content["pushes"]] == [True, False, False, True]
    assert capsys.readouterr().out.count("its end was not reported") == 2
    write_goal_page(tmp_path / "page.html", content)
    assert all(f"push&nbsp;{number}" in (tmp_path / "page.html").read_text() for number in (1, 2, 3, 4))


def test_goal_of_the_command_line_becomes_that_of_the_action() -> None:
    msg = goal_message(parse_goal("0.05,-0.1,1.5"), object_id="o1", tolerance_mm=10.0, tolerance_deg=9.0, explore=2)
    assert (msg.goal.header.frame_id, msg.object_id, msg.explore) == ("table", "o1", 2)
    assert msg.position_tolerance == pytest.approx(0.01) and msg.yaw_tolerance == pytest.approx(np.radians(9.0))
    assert (msg.goal.pose.position.x, msg.goal.pose.position.y) == (0.05, -0.1)
    assert 2 * np.arctan2(msg.goal.pose.orientation.z, msg.goal.pose.orientation.w) == pytest.approx(1.5)
    for text in ("", "1,2", "1,2,3,4", "a,b,c", "nan,0,0"):
        with pytest.raises(InputError, match="X,Y,YAW"):
            parse_goal(text)
    np.testing.assert_allclose(parse_goal("5cm,-100mm,90deg"), [0.05, -0.1, np.pi / 2])
    check_refused("X,Y,YAW", "demo", "--goal", "1,2")


def test_tolerance_is_a_length_and_perhaps_an_angle() -> None:
    assert parse_tolerance("0.02") == parse_tolerance("20mm") == (20.0, None)
    assert parse_tolerance("2cm,5deg") == pytest.approx((20.0, 5.0)) and parse_tolerance("0.02,0.1")[1] == pytest.approx(np.degrees(0.1))
    for text in ("20", "0", "20mm,-1deg", "20mm,90", "20mm,1deg,1", ""):
        with pytest.raises(InputError, match="--tolerance is"):
            parse_tolerance(text)
    check_refused("one of both forms", "push-to", "--x", 0, "--y", 0, "--yaw", 0, "--tolerance", "20mm", "--tolerance-deg", 5)


def test_goals_are_one_pose_or_lie_in_a_row_along_a_path(tmp_path: Path) -> None:
    np.testing.assert_array_equal(goals_of(0.1, 0.2, 0.3, None, 40.0), [[0.1, 0.2, 0.3]])
    file = tmp_path / "path.csv"
    file.write_text("0, 0, 0.5\n0.1, 0, 0.5\n", encoding="utf-8")
    np.testing.assert_allclose(goals_of(None, None, None, file, 40.0), [[0.1 * k / 3, 0.0, 0.5] for k in (1, 2, 3)])
    assert len(goals_of(None, None, None, file, None)) == 26, "followed, not pushed to"
    for options, word in (((0.1, 0.2, None, None), "missing"), ((0.1, None, None, file), "beside"), ((0.1, 0.2, np.nan, None), "finite")):
        with pytest.raises(InputError, match=word):
            goals_of(*options, 40.0)


def test_goal_at_an_edge_becomes_that_of_the_action_and_its_report_has_what_the_node_chose() -> None:
    msg = edge_message(None, parse_edge("0.15,-0.3,0.15,0.3"), overhang_mm=50.0, held_mm=12.0, tolerance_deg=15.0)
    assert (msg.kind, msg.use_heading, msg.overhang, msg.held) == (msg.KIND_EDGE, False, pytest.approx(0.05), pytest.approx(0.012))
    assert [(point.x, point.y) for point in msg.edge] == [(0.15, -0.3), (0.15, 0.3)]
    turned = edge_message(0.4, None, overhang_mm=40.0, held_mm=10.0)
    assert turned.use_heading and not turned.edge and turned.goal.pose.orientation.z == pytest.approx(np.sin(0.2))
    report = GoalReport(msg)
    assert report.content()["goal"] is None and report.content()["edge"] is None
    seen = feedback(1, predicted=True)
    seen.edge, seen.overhang, seen.margin, seen.risk = msg.edge, 0.031, 0.022, 0.004
    seen.target.position.x = 0.12
    report.take(seen)
    content = report.content()
    assert (content["kind"], content["overhang_m"], content["margin_m"]) == ("edge", 0.031, 0.022)
    assert content["goal"][0] == 0.12 and content["edge"] == [[0.15, -0.3], [0.15, 0.3]] and content["pushes"][0]["risk"] == 0.004


def test_path_becomes_a_goal_of_the_action_and_its_report_says_how_closely_it_was_followed() -> None:
    poses = np.array([[0.0, 0.0, 0.5], [0.1, 0.0, 0.7]])
    msg = path_message(poses, 0.08, tolerance_mm=3.0, tolerance_deg=2.0)
    assert (msg.kind, msg.speed, msg.position_tolerance) == (msg.KIND_PATH, 0.08, pytest.approx(0.003)) and len(msg.path.poses) == 2
    report, seen = GoalReport(msg), feedback(1, predicted=False)
    seen.done = 0.45
    report.take(seen)
    report.result = PushToGoal.Result(done=1.0, rms_position=0.002, rms_yaw=float("nan"), corrections=70, pushes=1)
    content = report.content()
    assert (content["kind"], content["done"], content["rms_position_m"], content["n_corrections"]) == ("path", 1.0, 0.002, 70)
    np.testing.assert_allclose(content["path"], poses)
    assert content["rms_yaw_rad"] is None and content["reached"]


def test_options_and_files_that_make_no_goal_are_refused_before_the_cell_is_looked_for(tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    for text, word in (
        ("1, 2\n", "Line 1"),
        ("0, 0, 0\n0.1, 0, 90\n", "90 degrees are 1.571 rad"),
        ("0, 0, 0\n", "no path"),
        ("0, 0, 0\n0, 0, 0\n", "0.0 mm long"),
    ):
        file.write_text(text, encoding="utf-8")
        check_refused(word, "push-to", "--path", file)
    for options, word in (
        (("--edge-line", "0,0,0,1"), "without --edge"),
        (("--overhang-mm", 30), "without --edge"),
        (("--edge", "--x", 0.1), "--x"),
        (("--edge", "--path", "path.csv"), "--path"),
        (("--edge", "--edge-line", "0,0,1"), "X1,Y1,X2,Y2"),
        (("--edge", "--edge-line", "0,0,0,0.001"), "two finite points"),
    ):
        check_refused(word, "push-to", *options)


def test_report_of_a_path_says_how_near_its_goals_the_object_came() -> None:
    good = [ended(position_error=e, yaw_error=0.1, pushes=2) for e in (0.003, 0.004)]
    failed = ended(error_code=-4, position_error=0.1)
    whole, part = PathReport(good, 2), PathReport([*good, failed], 5)
    assert whole.is_reached and whole.content()["rms_position_m"] == pytest.approx(np.sqrt(12.5) * 1e-3)
    assert whole.content()["n_pushes"] == 4
    assert not part.is_reached and part.content()["n_reached"] == 2 and not PathReport(good, 3).is_reached
    assert PathReport([failed], 1).content()["rms_position_m"] is None
