"""Messages and types: what goes in comes out; what cannot be at all: `test_convert_any_message.py`."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point32
from std_msgs.msg import Header

from helpers.wrong_poses import wrong_poses
from push_ident.errors import FrameError, InputError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.nodes.convert import messages
from push_ident.pushing.executed_push import Purpose
from push_ident.pushing.ports import Phase
from push_ident.pushing.push import PushCode, tool_shape, tool_sizes
from push_ident.pushing.push_request import Mode
from push_ident.types import CameraAccuracy, CameraIntrinsics, DepthFrame, ObjectShape, PusherShape
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import PushRecord

STAMP = Time(sec=12, nanosec=345678901)
COVARIANCE = np.array([[2e-6, 3e-7, -1e-7], [3e-7, 1e-6, 2e-7], [-1e-7, 2e-7, 4e-6]])
L_SHAPE = np.array([(-0.03, -0.02), (0.05, -0.02), (0.05, 0.01), (0.0, 0.01), (0.0, 0.04), (-0.03, 0.04)])


def test_stamps_are_exact_to_the_nanosecond_and_carry_over():
    for sec, nanosec in ((0, 999_999_999), (12, 345_678_901), (999_999, 1)):
        assert messages.stamp_to_msg(messages.stamp_from_msg(Time(sec=sec, nanosec=nanosec))) == Time(sec=sec, nanosec=nanosec)
    assert messages.stamp_to_msg(1.9999999999) == Time(sec=2, nanosec=0)
    with pytest.raises(InputError, match=r"-0.5 s, expected 0"):
        messages.stamp_to_msg(-0.5)
    with pytest.raises(InputError, match=r"10\^9"):
        messages.stamp_from_msg(Time(sec=0, nanosec=10**9))


def test_planar_poses_come_back_and_their_full_covariance_is_positive_definite():
    msg = messages.planar_pose_to_msg(STAMP, [0.12, -0.34, 2.5], COVARIANCE)
    assert (msg.pose.pose.position.x, msg.pose.pose.position.y) == (0.12, -0.34)
    assert 2 * np.arctan2(msg.pose.pose.orientation.z, msg.pose.pose.orientation.w) == pytest.approx(2.5)
    assert (msg.pose.covariance[1], msg.pose.covariance[5], msg.pose.covariance[35]) == (3e-7, -1e-7, 4e-6)
    stamp, pose, covariance = messages.planar_pose_from_msg(msg)
    assert stamp == pytest.approx(12.345678901, abs=1e-9)
    np.testing.assert_allclose(pose, [0.12, -0.34, 2.5], rtol=1e-12)
    np.testing.assert_allclose(covariance, COVARIANCE)
    assert np.linalg.eigvalsh(np.reshape(msg.pose.covariance, (6, 6)))[0] > 0


@pytest.mark.parametrize(
    ("entries", "value", "unknown"),
    [
        (range(36), 0.0, [0, 1, 2]),
        ([0], -1.0, [0, 1, 2]),  # as sensor_msgs/Imu
        ([35], 0.0, [2]),
        ([0, 7], 0.0, [0, 1]),
        ([7], 0.0, [0, 1]),
    ],
)
def test_what_of_a_covariance_is_zero_is_unknown(entries, value, unknown):
    msg = messages.planar_pose_to_msg(STAMP, [0.12, -0.34, 2.5], COVARIANCE)
    msg.pose.covariance[list(entries)] = value
    _, _, covariance = messages.planar_pose_from_msg(msg)
    expected = COVARIANCE.copy()
    expected[unknown] = expected[:, unknown] = 0.0
    np.testing.assert_allclose(covariance, expected)


@pytest.mark.parametrize("name", wrong_poses())
def test_poses_that_cannot_be_are_refused(name):
    with pytest.raises(InputError) as caught:
        messages.planar_pose_from_msg(wrong_poses()[name])
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    ("msg", "convert", "value"),
    [
        (messages.position_to_msg(STAMP, [0.1, -0.2, 0.3], yaw=1.0), lambda msg: messages.position_from_msg(msg)[1], [0.1, -0.2, 0.3]),
        (messages.force_to_msg(STAMP, [1.5, -2.5]), lambda msg: messages.force_from_msg(msg)[1], [1.5, -2.5]),
        (
            messages.pusher_shape_to_msg(PusherShape(0.018), 0.1),
            lambda msg: [*msg.dimensions, messages.pusher_shape_from_msg(msg).radius],
            [0.1, 0.018, 0.018],
        ),  # height first
        (
            messages.camera_accuracy_to_msg(CameraAccuracy(2e-3, 5e-3), STAMP),
            lambda msg: astuple(messages.camera_accuracy_from_msg(msg)),
            [2e-3, 5e-3],
        ),
    ],
)
def test_positions_forces_pusher_and_accuracy_of_the_camera_come_back(msg, convert, value):
    assert list(convert(msg)) == pytest.approx(value, rel=1e-12)


def test_deviations_of_an_outline_come_back_and_those_of_another_outline_are_left_out():
    shape = ObjectShape(cells_in_outline(L_SHAPE, 0.007), L_SHAPE, np.linspace(1e-4, 2e-3, len(L_SHAPE)))
    cells, outline = messages.shape_to_msgs(shape, "o1", STAMP)
    msg = messages.outline_std_to_msg(shape)
    assert (msg.layout.dim[0].label, msg.layout.dim[0].size) == ("edge", len(L_SHAPE))
    np.testing.assert_allclose(messages.shape_from_msgs(cells, outline, msg).outline_std, shape.outline_std, rtol=1e-6)
    del msg.data[0]
    assert messages.shape_from_msgs(cells, outline, msg).outline_std is None
    msg.data[0] = 0.0
    with pytest.raises(InputError, match="eviation"):
        messages.shape_from_msgs(cells, outline, msg)
    assert (
        messages.shape_from_msgs(cells, outline, messages.outline_std_to_msg(ObjectShape(shape.cells, shape.outline))).outline_std is None
    )


def test_shapes_come_back_with_their_cells_in_the_same_order():
    shape = ObjectShape(cells_in_outline(L_SHAPE, 0.007), L_SHAPE)
    cells, outline = messages.shape_to_msgs(shape, "o1", STAMP)
    assert cells.header.frame_id == outline.header.frame_id == "object_o1"
    assert sorted(set(cells.data)) == [0, 100]
    back = messages.shape_from_msgs(cells, outline)
    np.testing.assert_allclose(back.cells.centres, shape.cells.centres, atol=1e-8)
    np.testing.assert_allclose(back.outline, shape.outline, atol=1e-8)
    traced = messages.shape_from_msgs(cells)
    assert np.abs(traced.outline[:, 0].min() - L_SHAPE[:, 0].min()) < 0.007


def test_pusher_that_is_a_box_is_refused():
    msg = messages.pusher_shape_to_msg(PusherShape(0.018), 0.1)
    msg.type = msg.BOX
    with pytest.raises(InputError, match="CYLINDER or a PRISM"):
        messages.pusher_shape_from_msg(msg)


@pytest.mark.parametrize("sizes", [(0.018,), (0.003, 0.024), (0.003, 0.0, 0.06)], ids=["cylinder", "fingers", "plate"])
def test_tools_come_back_with_their_sizes(sizes):
    shape = messages.pusher_shape_from_msg(messages.pusher_shape_to_msg(tool_shape(*sizes), 0.1))
    assert list(tool_sizes(shape).values()) == pytest.approx([*sizes, 0.0, 0.0][:3], abs=1e-8)


def test_two_fingers_are_a_cylinder_with_two_points():
    msg = messages.pusher_shape_to_msg(PusherShape(0.003), 0.1)
    msg.polygon.points = [Point32(x=0.0, y=0.012), Point32(x=0.0, y=-0.012)]
    shape = messages.pusher_shape_from_msg(msg)
    assert shape.radius == 0.003 and shape.fingers == pytest.approx(np.array([[0.0, 0.012], [0.0, -0.012]]), abs=1e-9)
    msg.dimensions = [20.0, 0.003]
    with pytest.raises(InputError, match="0 to 10 m"):
        messages.pusher_shape_from_msg(msg)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_depth_frames_come_back(encoding):
    depth = np.array([[0.5, np.nan, 1.25], [0.751, 2.0, 0.004]], np.float32)
    frame = DepthFrame(12.345678901, depth, CameraIntrinsics(3, 2, 600.5, 601.5, 1.1, 0.9))
    image, info = messages.depth_frame_to_msgs(frame, STAMP, encoding=encoding)
    back = messages.depth_frame_from_msgs(image, info)
    np.testing.assert_allclose(back.depth, depth, atol=1e-6)
    assert (back.stamp, back.intrinsics, back.frame_id) == (pytest.approx(frame.stamp, abs=1e-9), frame.intrinsics, frame.frame_id)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda image, info: setattr(image, "encoding", "mono16"), "'mono16', expected one of 16UC1, 32FC1"),
        (lambda image, info: setattr(image, "height", 3), "3 x 3 pixels, its camera info is for 3 x 2"),
        (lambda image, info: setattr(image, "step", 7), "step is 7"),
        (lambda image, info: (setattr(info, "p", [0.0] * 12), setattr(info, "d", [0.1] * 5)), "not rectified"),
        (lambda image, info: setattr(info, "header", Header(frame_id="elsewhere")), "its camera info in 'elsewhere'"),
    ],
)
def test_images_and_infos_that_do_not_belong_together_are_refused(change, text):
    frame = DepthFrame(0.0, np.ones((2, 3), np.float32), CameraIntrinsics(3, 2, 600.0, 600.0, 1.0, 1.0))
    image, info = messages.depth_frame_to_msgs(frame, STAMP)
    change(image, info)
    with pytest.raises(FrameError, match=text):
        messages.depth_frame_from_msgs(image, info)


def test_modes_phases_purposes_and_codes_of_pushes_are_those_of_the_messages():
    assert {mode: getattr(ExecutePush.Goal, f"MODE_{mode.name}") for mode in Mode} == {mode: mode.value for mode in Mode}
    assert {phase: getattr(ExecutePush.Feedback, f"PHASE_{phase.name}") for phase in Phase} == {phase: phase.value for phase in Phase}
    assert {why: getattr(PushRecord, f"PURPOSE_{why.name}") for why in Purpose} == {why: why.value for why in Purpose}
    codes = {name: int(code) for name, code in PushCode.__members__.items() if name != "SUCCESS"}  # the action says NONE: no error
    assert codes == {name: getattr(ExecutePush.Result, name) for name in codes}
