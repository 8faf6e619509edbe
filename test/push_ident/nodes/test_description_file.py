"""`robot_description_file`: the arm of a file counts, whatever a driver publishes, and its joints may be of any number."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from rclpy.context import Context

from helpers.robots import robot_path
from push_ident.cli.robot import robot_for
from push_ident.errors import InputError
from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.perception.perception_node import PerceptionNode
from push_ident.nodes.push_executor.push_executor_node import PushExecutorNode


@pytest.fixture(scope="module")
def context() -> Iterator[Context]:
    context = Context()
    rclpy.init(context=context, domain_id=own_domain())
    yield context
    context.try_shutdown()


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


@pytest.mark.parametrize("kind", [PerceptionNode, PushExecutorNode])
def test_file_that_is_not_there_is_told(context: Context, kind: type[CellNode]) -> None:
    with pytest.raises(InputError, match=r"robot_description_file is /nowhere\.urdf"):
        kind(context=context, cli_args=["--ros-args", "-p", "robot_description_file:=/nowhere.urdf"])


def test_home_of_another_arm_than_neutral_is_refused(context: Context) -> None:
    with pytest.raises(InputError, match="home_posture has 6 joints and neutral_posture 7"):
        PushExecutorNode(context=context, cli_args=["--ros-args", "-p", "home_posture:=[0.0, 0.0, 0.0, 0.0, 0.0, 0.0]"])
