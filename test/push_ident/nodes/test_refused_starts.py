"""What a node says that cannot start with its parameters: one line, with which its process ends (`test_run.py`); a robot file counts."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
from rclpy.context import Context

from helpers.paths import CONFIG
from helpers.robots import robot_path
from push_ident.cli.robot import robot_for
from push_ident.errors import InputError
from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.perception.perception_node import PerceptionNode
from push_ident.nodes.push_executor.push_executor_node import PushExecutorNode
from push_ident.nodes.recording.bag_recorder_node import BagRecorderNode
from push_ident.nodes.viewer.viewer_node import ViewerNode

FULL = 10_000_000
"""[MiB] that no disk has free."""
REFUSED: tuple[tuple[type[CellNode], tuple[str, ...], str], ...] = (
    (PerceptionNode, ("min_object_height:=7.0",), "min_object_height of perception_node is 7.0: expected 0.002 to 0.5"),
    (PerceptionNode, ("extra_cameras:=[side]",), "Give side.camera_position and side.camera_quaternion"),
    (PerceptionNode, ("extra_cameras:=[2nd]",), "extra_cameras has '2nd', expected different names of letters"),
    (PushExecutorNode, ("push_height:=0.2",), "heights must rise"),
    (PushExecutorNode, ("home_posture:=[0.0, 0.0]",), "home_posture has 2 joints and neutral_posture 7"),
    *(
        (kind, ("robot_description_file:=/nowhere.urdf",), "robot_description_file is /nowhere.urdf")
        for kind in (PerceptionNode, PushExecutorNode)
    ),
    (ViewerNode, ("output:=file", "file:=view.txt"), "expected a path that ends with .rrd"),
)


def refusal(node: type[CellNode], context: Context, *parameters: str) -> str:
    """Why a node does not start with these parameters and those of the installed file."""
    given = [word for parameter in parameters for word in ("-p", parameter)]
    with pytest.raises(InputError) as caught:
        node(context=context, cli_args=["--ros-args", "--params-file", str(CONFIG / "push_ident.yaml"), *given])
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(("node", "parameters", "line"), REFUSED, ids=[f"{node.__name__}-{given[-1]}" for node, given, _ in REFUSED])
def test_impossible_parameters_are_refused_in_one_line(
    context: Context, node: type[CellNode], parameters: tuple[str, ...], line: str
) -> None:
    assert line in refusal(node, context, *parameters)


@pytest.mark.skipif(importlib.util.find_spec("tf2_ros") is not None, reason="tf2_ros is installed here")
def test_extrinsics_from_tf_need_tf(context: Context) -> None:
    assert "tf2_ros is not installed; give camera_position" in refusal(PerceptionNode, context, "extrinsics:=tf")


def test_nothing_is_recorded_where_the_disk_is_low_already_or_the_bag_exists(context: Context, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    assert "MiB free" in refusal(BagRecorderNode, context, f"bag:={bag}", f"min_free_mib:={FULL}")
    assert not bag.exists()
    bag.mkdir()
    assert "exists already and is not overwritten" in refusal(BagRecorderNode, context, f"bag:={bag}", "min_free_mib:=1")
    assert not list(bag.iterdir())


def subscribed(node: CellNode) -> set[str]:
    return {subscription.topic_name for subscription in node.subscriptions}


@pytest.mark.parametrize(("name", "kind"), [("perception_node", PerceptionNode), ("push_executor_node", PushExecutorNode)])
def test_node_takes_the_arm_of_a_robot_file_and_does_not_listen_for_another(
    context: Context, tmp_path: Path, name: str, kind: type[CellNode]
) -> None:
    values = robot_for("arm", robot_path("ur5e")).parameters(tmp_path, ())[name]
    parameters = [part for key, value in values.items() for part in ("-p", f"{key}:={value}")]
    for arguments, listens in (([], True), (["--ros-args", *parameters], False)):
        node = kind(context=context, cli_args=arguments)
        try:
            assert ("/robot_description" in subscribed(node)) is listens
        finally:
            node.close()
            node.destroy_node()
