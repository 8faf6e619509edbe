"""Where tool and arm were when an image was taken."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.geometry.arm_shape import ArmShape
from push_ident.perception.frame.robot import Cylinder, RobotHistory
from push_ident_sim.cell.robot import HOME, robot_description

NAMES = [f"lbr_iiwa_joint_{number}" for number in range(1, 8)]


@pytest.fixture
def history() -> RobotHistory:
    return RobotHistory(tool_radius=0.018, tool_length=0.08)


def test_without_states_nothing_is_masked(history: RobotHistory) -> None:
    assert history.tool_at(1.0, 0.09) == () and history.arm_at(1.0, 10.0) == () and history.joints_at(1.0) == {}
    assert history.tool_age(1.0) is None and history.joints_age(1.0) is None


def test_tool_and_hand_are_interpolated_between_poses_and_held_outside(history: RobotHistory) -> None:
    history.add_tool(1.0, np.array([0.1, 0.2, 0.3]))
    history.add_tool(2.0, np.array([0.2, 0.0, 0.1]))
    tool, hand = history.tool_at(1.25, 0.09)
    assert isinstance(tool, Cylinder) and isinstance(hand, Cylinder)
    assert (tool.x, tool.y, tool.z_min) == pytest.approx((0.125, 0.15, 0.25)) and tool.radius == 0.018
    assert (hand.x, hand.y, hand.z_min) == pytest.approx((0.125, 0.15, 0.33)) and hand.radius == 0.09
    assert history.tool_at(9.0, 0.09)[0].x == 0.2 and history.tool_at(0.0, 0.09)[0].x == 0.1
    assert history.tool_age(2.5) == 0.5


def test_joints_are_interpolated_between_states_and_held_outside(history: RobotHistory) -> None:
    for stamp, value in ((1.0, 0.0), (2.0, 1.0), (3.0, 0.0)):
        history.add_joints(stamp, ["a", "b"], np.array([value, -value]))
    assert history.joints_at(1.75) == pytest.approx({"a": 0.75, "b": -0.75})
    assert history.joints_at(2.25) == pytest.approx({"a": 0.75, "b": -0.75})
    assert history.joints_at(0.0)["a"] == 0.0 and history.joints_at(2.0)["a"] == 1.0 and history.joints_at(7.0)["a"] == 0.0


def test_one_state_is_held(history: RobotHistory) -> None:
    history.add_joints(1.0, ["a"], np.array([0.5]))
    assert history.joints_at(0.0) == history.joints_at(5.0) == {"a": 0.5}


def test_time_set_back_and_other_joints_begin_anew(history: RobotHistory) -> None:
    history.add_tool(5.0, np.zeros(3))
    history.add_tool(1.0, np.ones(3))
    assert history.tool_age(1.0) == 0.0 and history.tool_at(5.0, 0.1)[0].x == 1.0
    history.add_joints(5.0, ["a"], np.zeros(1))
    history.add_joints(6.0, ["a", "b"], np.ones(2))
    assert history.joints_at(5.0) == {"a": 1.0, "b": 1.0}
    history.add_joints(2.0, ["a", "b"], np.zeros(2))
    assert history.joints_at(9.0) == {"a": 0.0, "b": 0.0}


@pytest.mark.parametrize("position", [[0.0], [0.0, np.nan]], ids=["too few", "not finite"])
def test_states_that_cannot_be_used_are_refused(history: RobotHistory, position: list[float]) -> None:
    with pytest.raises(InputError, match="positions for 2 joints"):
        history.add_joints(1.0, ["a", "b"], np.array(position))
    assert history.joints_at(1.0) == {}


def test_links_of_the_arm_follow_the_joints_and_those_above_every_object_are_left_out(history: RobotHistory) -> None:
    history.arm_shape = shape = ArmShape(robot_description())
    history.add_joints(1.0, NAMES, np.array(HOME))
    history.add_joints(2.0, NAMES, np.array([0.5, *HOME[1:]]))
    everything = history.arm_at(1.5, 10.0)
    expected = shape.at(dict(zip(NAMES, [0.25, *HOME[1:]], strict=True)))
    assert len(everything) == len(expected) > 3
    for rod, other in zip(everything, expected, strict=True):
        assert rod.start == pytest.approx(other.start) and rod.end == pytest.approx(other.end)
    low = history.arm_at(1.5, 0.12)
    assert 0 < len(low) < len(everything) and all(rod.lowest < 0.12 for rod in low)
