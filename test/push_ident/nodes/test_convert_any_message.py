"""Whatever a message holds, its conversion gives a value that keeps its promises or refuses it, and raises nothing else."""

from __future__ import annotations

import random
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_msgs.msg import Path
from sensor_msgs.msg import JointState

from helpers.objects import hammer_shape
from push_ident.errors import PushIdentError
from push_ident.geometry.table import Table
from push_ident.limits import LIMITS
from push_ident.nodes.convert.messages import (
    cylinder_radius_from_msg,
    cylinder_to_msg,
    depth_frame_from_msgs,
    depth_frame_to_msgs,
    force_from_msg,
    force_to_msg,
    joints_from_msg,
    planar_pose_from_msg,
    planar_pose_to_msg,
    position_from_msg,
    position_to_msg,
    push_interval_from_msg,
    shape_from_msgs,
    shape_to_msgs,
    stamp_to_msg,
    transform_from_msg,
)
from push_ident.nodes.convert.model import pusher_path_from_msg
from push_ident.nodes.convert.table import table_from_msg, table_to_msg
from push_ident.types import CameraIntrinsics, DepthFrame
from push_ident_msgs.msg import PushRecord
from push_ident_sim.fuzz.mutate_message import mutate_message

STAMP = stamp_to_msg(12.5)
CELLS, OUTLINE = shape_to_msgs(hammer_shape(), "o1", STAMP)
IMAGE, INFO = depth_frame_to_msgs(DepthFrame(0.0, np.full((6, 8), 0.8, np.float32), CameraIntrinsics(8, 6, 9.0, 9.0, 3.5, 2.5)), STAMP)
LARGEST = LIMITS.COORDINATE.value


def a_pose(value: Any) -> bool:
    stamp, pose, covariance = value
    return stamp >= 0 and bool(np.abs(pose).max() <= LARGEST) and bool(np.linalg.eigvalsh(covariance).min() > 0)


def a_position(value: Any) -> bool:
    return value[0] >= 0 and bool(np.abs(value[1]).max() <= LARGEST)


def a_shape(shape: Any) -> bool:
    return 1 <= len(shape.cells) <= LIMITS.CELLS.value and len(shape.outline) >= 3 and bool(np.abs(shape.cells.centres).max() <= LARGEST)


def a_record() -> PushRecord:
    record = PushRecord(push_id=1, object_id="o1", start=stamp_to_msg(11.0), end=STAMP)
    record.header.frame_id = "table"
    return record


def a_path() -> Path:
    path = Path(poses=[position_to_msg(stamp_to_msg(t), [t, 0.0, 0.0]) for t in (1.0, 1.5, 2.0)])
    path.header.frame_id = "table"
    return path


TABLE = Table.rectangle(np.array([-0.5, 0.15, -0.4, 0.4]))
CONVERSIONS: dict[str, tuple[Any, Callable[[Any], Any], Callable[[Any], bool]]] = {
    "pose": (planar_pose_to_msg(STAMP, [0.1, 0.2, 0.3], 1e-6 * np.eye(3)), planar_pose_from_msg, a_pose),
    "position": (position_to_msg(STAMP, [0.1, 0.2, 0.3]), position_from_msg, a_position),
    "transform": (
        position_to_msg(STAMP, [0.1, 0.2, 0.3]),
        transform_from_msg,
        lambda matrix: bool(np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)) and bool(np.abs(matrix).max() <= LARGEST),
    ),
    "force": (force_to_msg(STAMP, [1.0, 2.0]), force_from_msg, lambda value: bool(np.isfinite(value[1]).all())),
    "pusher": (cylinder_to_msg(0.01, 0.1), cylinder_radius_from_msg, lambda radius: 0 <= radius < 1),
    "cells": (CELLS, shape_from_msgs, a_shape),
    "cells with outline": (CELLS, lambda msg: shape_from_msgs(msg, OUTLINE), a_shape),
    "table": (
        table_to_msg(Table.rectangle(np.array([-0.5, 0.15, -0.4, 0.4])), STAMP),
        table_from_msg,
        lambda table: np.isfinite(table.corners).all(),
    ),
    "outline": (OUTLINE, lambda msg: shape_from_msgs(CELLS, msg), a_shape),
    "image": (IMAGE, lambda msg: depth_frame_from_msgs(msg, INFO), lambda frame: frame.depth.shape == (6, 8)),
    "camera": (
        INFO,
        lambda msg: depth_frame_from_msgs(IMAGE, msg),
        lambda frame: np.isfinite(frame.intrinsics.fx) and frame.intrinsics.fx > 0,
    ),
    "joints": (
        JointState(name=["a", "b"], position=[0.1, 0.2]),
        joints_from_msg,
        lambda value: bool(np.isfinite(list(value[1].values())).all()),
    ),
    "record": (a_record(), push_interval_from_msg, lambda push: push.end - push.start <= LIMITS.PUSH_SECONDS.value),
    "path": (
        a_path(),
        lambda msg: pusher_path_from_msg(msg, 0.01),
        lambda path: all(one < two for one, two in pairwise(path.time)) and bool(np.isfinite(path.position).all()),
    ),
}


@pytest.mark.parametrize("name", CONVERSIONS)
@settings(max_examples=150, deadline=None, derandomize=True, database=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_any_message_is_converted_or_refused(name: str, seed: int) -> None:
    base, convert, keeps = CONVERSIONS[name]
    mutated, changed = mutate_message(base, random.Random(seed))
    try:
        value = convert(mutated)
    except PushIdentError as error:
        assert str(error) and len(str(error)) < 2000
    else:
        assert keeps(value), f"{changed} of {name}"


@pytest.mark.parametrize("name", CONVERSIONS)
def test_the_message_itself_is_converted(name: str) -> None:
    base, convert, keeps = CONVERSIONS[name]
    assert keeps(convert(base))
