"""Parameters of the nodes from a robot file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from push_ident.errors import InputError
from push_ident.pushing.robot.description import TIP_LINK
from push_ident.pushing.robot.robot_file import Robot, push_settings


def node_parameters(robot: Robot, description_file: Path | None = None) -> dict[str, dict[str, Any]]:
    """Parameters by node.

    Args:
        description_file: the file with `cell_description`; None where the cell publishes it, as the simulated one does.

    Raises InputError where the further parameters of the file contradict what it states itself.
    """
    file = robot.file
    joints, tool = file.joints, file.tool
    camera = {"camera_position": file.camera.position, "camera_quaternion": file.camera.quaternion}
    described = {} if description_file is None else {"robot_description_file": str(description_file)}
    parameters: dict[str, dict[str, Any]] = {
        "perception_node": {
            **camera,
            **described,
            "tool_radius": push_settings(robot).tool.reach,
            "tool_length": tool.pusher_height,
            "tool_reach": [file.push_height, file.push_height + tool.pusher_height],
            "hand_radius": tool.hand_radius,
        },
        "push_executor_node": dict(
            described,
            tip_frame=TIP_LINK,
            neutral_posture=joints.neutral,
            home_posture=joints.home,
            joint_acceleration_limits=joints.acceleration,
            pusher_radius=tool.pusher_radius,
            finger_distance=tool.finger_distance,
            plate_length=tool.plate_length,
            pusher_height=tool.pusher_height,
            push_height=file.push_height,
            workspace=file.workspace,
            hand=tool.hand,
        ),
        "goal_pushing_node": {"workspace": file.workspace},
        "bag_recorder_node": dict(camera),
        "sim_cell_node": {**camera, "robot": str(robot.path.resolve()), "sensor": file.camera.sensor},
    }
    for node, values in file.parameters.items():
        if twice := sorted(values.keys() & parameters.get(node, {}).keys()):
            raise InputError(f"{robot.path}: parameters.{node}.{twice[0]} is given by the robot file elsewhere; take it out there.")
    return {node: {**parameters.get(node, {}), **file.parameters.get(node, {})} for node in {**parameters, **file.parameters}}
