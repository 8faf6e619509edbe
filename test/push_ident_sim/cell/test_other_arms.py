"""The simulated cell with the arms of the robot files: each makes a push as it was planned."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.robots import NAMES, changed, robot_path
from helpers.sim_objects import block
from push_ident.errors import InputError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.motion import plan_push
from push_ident.pushing.robot.description import read_urdf
from push_ident.pushing.robot.robot_file import motion_settings, push_settings, read_robot
from push_ident.pushing.sampling import push_from_goal
from push_ident_sim.cell.robot import cell_robot
from push_ident_sim.cell.world import CellWorld
from push_ident_sim.recordings.truth import true_model


@pytest.mark.parametrize("name", NAMES)
def test_arm_of_a_robot_file_pushes_as_planned(name: str) -> None:
    robot, arm_in_cell = read_robot(robot_path(name)), cell_robot(str(robot_path(name)))
    sim_object = block(4, friction=0.35)
    arm = ArmKinematics(arm_in_cell.description, neutral=arm_in_cell.neutral)
    outline, distance = true_model(sim_object).shape, 0.05
    push = push_from_goal(outline, [0.0, 0.0, 0.0], [-0.1, 0.0], 0.0, distance, 0.15, push_settings(robot))
    plan = plan_push(arm, arm_in_cell.start, push, motion_settings(robot))
    # From the lowered tool on: the way there and back is the same for every push.
    begin = plan.departure - 0.05
    (start,), _ = plan.trajectory.follow(np.array([begin]))
    world = CellWorld(sim_object, robot=replace(arm_in_cell, start=tuple(start)))
    try:
        deviation = 0.0
        while begin + world.time < plan.stop + 0.1:
            time = begin + world.time + world.config.time_step
            (position,), (velocity,) = plan.trajectory.follow(np.array([time]))
            world.set_joint_targets(position, velocity)
            world.step()
            deviation = max(deviation, float(np.max(np.abs(world.joint_state()[0] - position))))
        assert deviation < 1e-3
        assert world.tool_tip() == pytest.approx([*push.tool_end, robot.file.push_height], abs=1e-3)
        # Pushed at the middle of a side, the block goes straight ahead and stays at the tool.
        assert world.object_pose() == pytest.approx([distance, 0.0, 0.0], abs=2e-3)
    finally:
        world.close()


def test_arm_whose_meshes_are_not_there_is_refused(tmp_path: Path) -> None:
    urdf = read_urdf(read_robot(robot_path("ur5e"))).path.read_text()
    (tmp_path / "arm.urdf").write_text(urdf)
    path = changed(tmp_path, lambda c: c.update(description={"file": "arm.urdf", "root": "base_link"}))
    with pytest.raises(InputError, match=r"the mesh visual/base_cable_labels\.obj is no file"):
        cell_robot(str(path))
