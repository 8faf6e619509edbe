"""Whatever a message holds, its conversion gives a value that keeps its promises or refuses it, and raises nothing else."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.fuzzing import fuzzed
from helpers.fuzzing.messages import messages_like
from helpers.fuzzing.right import OBJECT, right_goals, right_messages
from push_ident.bags.decode import is_covariance
from push_ident.errors import PushIdentError
from push_ident.limits import LIMITS
from push_ident.nodes.convert import messages
from push_ident.nodes.convert.markers import goal_markers_from_msg, refusals_from_msg
from push_ident.nodes.convert.model import posterior_from_msg, pusher_path_from_msg
from push_ident.nodes.convert.table import edge_from_msg, table_from_msg
from push_ident.nodes.convert.tool_path import correction_from_msg, path_request_from_goal
from push_ident.nodes.goal_pushing.convert_goal import request_from_msg
from push_ident.nodes.goal_pushing.parameters import PARAMETERS
from push_ident.types import PusherShape

RIGHT = right_messages()
STEERED = right_goals()["execute_push"][1]
GOALS = right_goals()["push_to_goal"]
POSE, CELLS, OUTLINE = (RIGHT[f"objects/{OBJECT}/{name}"] for name in ("pose", "cells", "outline"))
IMAGE, INFO = RIGHT["depth/image_rect"], RIGHT["depth/camera_info"]
WORKSPACE = messages.occupancy_to_msg(np.zeros((3, 4), dtype=np.int8), 0.002, (-0.4, -0.4), POSE.header.stamp)
GOAL_DEFAULTS = {parameter.name: parameter.default for parameter in PARAMETERS}
LARGEST = LIMITS.COORDINATE.value


def finite(value: Any) -> bool:
    return bool(np.isfinite(value).all())


def near(value: Any) -> bool:
    """Coordinates that a table can have [m]."""
    return bool((np.abs(value) <= LARGEST).all())


def is_pose(value: Any) -> bool:
    stamp, pose, covariance = value
    return stamp >= 0 and near(pose) and is_covariance(covariance)


def is_shape(shape: Any) -> bool:
    return 1 <= len(shape.cells) <= LIMITS.CELLS.value and len(shape.outline) >= 3 and near(shape.cells.centres)


def is_rotation(matrix: Any) -> bool:
    return bool(np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)) and near(matrix)


def is_posterior(value: Any) -> bool:
    posterior = value[1]
    return bool((posterior.model.mass >= 0).all()) and finite(posterior.z) and bool(np.linalg.eigvalsh(posterior.covariance).min() > -1e-9)


def is_request(request: Any) -> bool:
    return len(request.object_id) <= LIMITS.STRING.value and request.goal is not None


CONVERSIONS: dict[str, tuple[Any, Callable[[Any], Any], Callable[[Any], bool]]] = {
    "stamp": (POSE.header.stamp, messages.stamp_from_msg, lambda stamp: 0 <= stamp <= 2**31),  # rounded
    "pose": (POSE, messages.planar_pose_from_msg, is_pose),
    "position": (RIGHT["pusher/pose"], messages.position_from_msg, lambda value: value[0] >= 0 and near(value[1])),
    "transform": (RIGHT["tool/pose"], messages.transform_from_msg, is_rotation),
    "force": (RIGHT["pusher/wrench"], messages.force_from_msg, lambda value: finite(value[1])),
    "tool": (RIGHT["pusher/shape"], messages.pusher_shape_from_msg, lambda shape: 0 <= shape.radius <= 1 and near(shape.core)),
    "camera accuracy": (RIGHT["depth/camera_accuracy"], messages.camera_accuracy_from_msg, lambda found: 0 <= found.position < np.inf),
    "cells": (CELLS, messages.shape_from_msgs, is_shape),
    "cells with outline": (CELLS, lambda msg: messages.shape_from_msgs(msg, OUTLINE), is_shape),
    "outline": (OUTLINE, lambda msg: messages.shape_from_msgs(CELLS, msg), is_shape),
    "outline alone": (OUTLINE, messages.outline_from_msg, near),
    "deviations of an outline": (RIGHT[f"objects/{OBJECT}/outline_std"], messages.outline_std_from_msg, lambda std: finite(std)),
    "image": (IMAGE, lambda msg: messages.depth_frame_from_msgs(msg, INFO), lambda frame: frame.depth.shape == (6, 8)),
    "camera": (INFO, lambda msg: messages.depth_frame_from_msgs(IMAGE, msg), lambda frame: 0 < frame.intrinsics.fx < np.inf),
    "joints": (RIGHT["joint_states"], messages.joints_from_msg, lambda value: finite(list(value[1].values()))),
    "record": (RIGHT["push_record"], messages.push_interval_from_msg, lambda push: push.end - push.start <= LIMITS.PUSH_SECONDS.value),
    "path of the pusher": (
        RIGHT[f"objects/{OBJECT}/next_push"],
        lambda msg: pusher_path_from_msg(msg, PusherShape(0.01)),
        lambda path: all(one < two for one, two in pairwise(path.time)) and finite(path.position),
    ),
    "posterior": (RIGHT[f"objects/{OBJECT}/model"], posterior_from_msg, is_posterior),
    "table": (RIGHT["workspace/table"], table_from_msg, lambda table: finite(table.corners)),
    "edge": (RIGHT["workspace/edge"], edge_from_msg, lambda edge: near(edge.ends)),
    "occupancy of the workspace": (WORKSPACE, messages.workspace_from_msg, lambda grid: grid.cells.size > 0 and near(grid.pose[:2])),
    "refusals": (RIGHT["workspace/refused"], refusals_from_msg, lambda found: all(near(line) for line, _ in found)),
    "goal markers": (RIGHT["push_to_goal/markers"], goal_markers_from_msg, lambda drawing: drawing is None or near(drawing.goal)),
    # Its numbers are checked where the push that it corrects is known.
    "correction": (RIGHT["push_correction"], correction_from_msg, lambda value: len(value.time) == len(value.position)),
    "push along a path": (STEERED, path_request_from_goal, lambda request: finite(request.path.position)),
    **{f"goal of kind {goal.kind}": (goal, lambda msg: request_from_msg(msg, GOAL_DEFAULTS), is_request) for goal in GOALS},
}


@st.composite
def changed_messages(draw: st.DrawFn) -> tuple[str, Any]:
    name = draw(st.sampled_from(list(CONVERSIONS)))
    return name, draw(messages_like(CONVERSIONS[name][0]))


@pytest.mark.fuzz
@fuzzed(1200)
@given(changed_messages())
def test_any_message_is_converted_or_refused(changed: tuple[str, Any]) -> None:
    name, msg = changed
    _, convert, keeps = CONVERSIONS[name]
    try:
        value = convert(msg)
    except PushIdentError as error:
        assert str(error) and len(str(error)) < 2000
    else:
        assert keeps(value), name


def test_the_messages_themselves_are_converted() -> None:
    assert [name for name, (base, convert, keeps) in CONVERSIONS.items() if not keeps(convert(base))] == []
