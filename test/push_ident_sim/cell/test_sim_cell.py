"""The simulated cell: what its physics, its camera and its robot descriptions must be before anything may be learned from it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.robots import NAMES, changed, robot_path, with_urdf
from helpers.sim_objects import CAMERA, block, points_in_table
from push_ident.errors import InputError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.geometry.outline import signed_distance
from push_ident.nodes.base.network import own_domain
from push_ident.physics.body import body_of_cells
from push_ident.planning.stable import Support, contact_on_face, stable_pushes, stable_turns
from push_ident.pushing.motion import ArmPlan, MotionSettings, plan_push, plan_turning_push
from push_ident.pushing.push import PushPlan2D
from push_ident.pushing.robot.robot_file import motion_settings, push_settings, read_robot
from push_ident.pushing.sampling import push_from_goal, push_with_both_ends
from push_ident.pushing.tool_path import ToolPath
from push_ident_sim.cell.camera import DepthCamera, DepthNoise
from push_ident_sim.cell.robot import HOME, PUSHER_RADIUS, cell_robot, robot_description
from push_ident_sim.cell.trajectory import JointTrajectory
from push_ident_sim.cell.world import CellWorld, WorldConfig
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import OBJECT_NAMES, SimObject, make_object, outline_rectangles
from push_ident_sim.recordings.truth import true_model

G = 9.81


@contextmanager
def cell(sim_object: SimObject, **config: Any) -> Iterator[CellWorld]:
    world = CellWorld(sim_object, WorldConfig(**config))
    try:
        for _ in range(10):
            world.step()
        yield world
    finally:
        world.close()


def following(world: CellWorld, plan: ArmPlan, begin: float, end: float) -> Iterator[float]:
    """The times of a plan, while the arm follows it from one to another [s]."""
    ahead = begin - world.time + world.config.time_step
    while (time := world.time + ahead) < end:
        (position,), (velocity,) = plan.trajectory.follow(np.array([time]))
        world.set_joint_targets(position, velocity)
        world.step()
        yield time


def push(world: CellWorld) -> np.ndarray:
    """Push a block by its left face along x; rows of time, commanded and true tip (x, y), object pose, force of the pusher (x, y)."""
    arm, face = ArmKinematics(robot_description(), neutral=HOME), np.array([-0.06, 0.0])
    way = PushPlan2D(face, face - [PUSHER_RADIUS, 0.0], 0.0, 0.06, 0.1)
    plan, rows = plan_push(arm, HOME, way, MotionSettings(home=HOME)), []
    for time in following(world, plan, 0.0, plan.stop - 0.06):
        tip, force = arm.forward(plan.trajectory.follow(np.array([time]))[0][0])[:2, 3], world.take_pusher_force()[:2]
        rows.append([time, *tip, *world.tool_tip()[:2], *world.object_pose(), *force])
    return np.array([row for row in rows if row[0] > plan.departure])


@pytest.mark.parametrize("name", OBJECT_NAMES)
def test_every_side_of_the_outline_lies_on_one_rectangle(name: str) -> None:
    item, rng = make_object(name), np.random.default_rng(0)
    boxes = [np.concatenate([centre - edges / 2, centre + edges / 2]) for centre, edges in outline_rectangles(item.cells, item.cell_size)]
    points = rng.uniform(item.outline.min(axis=0), item.outline.max(axis=0), (3000, 2))
    in_a_box = np.any([np.all((box[:2] < points) & (points < box[2:]), axis=1) for box in boxes], axis=0)
    np.testing.assert_array_equal(in_a_box, signed_distance(points, item.outline) < 0)
    for a, b in zip(item.outline, np.roll(item.outline, -1, axis=0), strict=True):
        holding = [box for box in boxes if np.all((box[:2] - 1e-9 <= [a, b]) & ([a, b] <= box[2:] + 1e-9))]
        # Along one side of it, not through its middle.
        assert any(np.min(np.abs(box.reshape(2, 2) - a) + np.abs(box.reshape(2, 2) - b)) < 2e-9 for box in holding)


def test_object_refuses_cells_that_are_not_one_piece_on_a_grid() -> None:
    ones = np.ones(2)
    for step, reason in ((0.05, "one piece"), (0.014, "lattice")):
        with pytest.raises(InputError, match=reason):
            SimObject("two", 0.01, np.array([[0.0, 0.0], [step, 0.0]]), ones, ones, ones, 0.3)
    with pytest.raises(InputError, match="expected one of hammer"):
        make_object("spoon")


def test_turning_and_sliding_hammer_feels_coulomb_friction_on_every_cell() -> None:
    sim_object = make_object("hammer", 0)
    centre = sim_object.mass @ sim_object.cells / sim_object.mass.sum()
    arms = sim_object.cells - centre
    inertia = sim_object.mass @ (np.sum(arms**2, axis=1) + sim_object.cell_size**2 / 6)
    with cell(sim_object) as world:
        world.place_object((0, 0, 0), (0.3, 0.25, 1.5))
        for _ in range(2):
            world.step()
        n_steps, lost, expected = 6, np.zeros(3), np.zeros(3)
        across = np.array([[0.0, -1.0], [1.0, 0.0]])

        def at_centre() -> tuple[np.ndarray, np.ndarray]:
            yaw, twist = world.object_pose()[2], world.object_velocity()
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            return np.array([*(twist[:2] + twist[2] * across @ turn @ centre), twist[2]]), arms @ turn.T

        before, _ = at_centre()
        for _ in range(n_steps):
            world.step()
            twist, turned = at_centre()
            slip = twist[:2] + twist[2] * turned @ across.T
            force = -(sim_object.mass * sim_object.friction * G / np.linalg.norm(slip, axis=1))[:, None] * slip
            torque = np.sum(turned[:, 0] * force[:, 1] - turned[:, 1] * force[:, 0])
            expected += world.config.time_step * np.array([*force.sum(axis=0) / sim_object.mass.sum(), torque / inertia])
        lost = at_centre()[0] - before
    # Bullet's friction without its correction is 13 % off in the torque.
    np.testing.assert_allclose(lost, expected, rtol=0.03)


def test_central_push_needs_the_sliding_friction_force_and_effects_act_on_tool_and_table() -> None:
    """The tool is not where the arm has it, and wears the table from push to push."""
    sliding, effects = 0.35 * 0.6 * G, InjectedEffects.of({"wear": 0.1, "tool_offset": (0.003, 0.0)})
    with cell(block(friction=0.35, mass=0.6), effects=effects) as world:
        for force in (sliding, 1.1 * sliding):
            rows = push(world)
            steady = rows[len(rows) * 2 // 3 :, 8:].mean(axis=0)
            assert steady[0] == pytest.approx(force, rel=0.02) and abs(steady[1]) < 0.05
            np.testing.assert_allclose(rows[-1, 3:5] - rows[-1, 1:3], [0.003, 0.0], atol=3e-4)
            # To two time steps.
            assert rows[np.argmax(rows[:, 8] > 0.01), 3] == pytest.approx(-0.06 - PUSHER_RADIUS, abs=8e-4)
            world.place_object((0.2, 0.2, 0.0))
            for _ in range(150):  # the tool touches nothing meanwhile
                world.step()
            world.set_joint_targets(HOME, np.zeros(7))
            for _ in range(240):
                world.step()
            world.place_object((0.0, 0.0, 0.0))


def test_object_is_put_back_or_replaced_unless_the_pusher_is_there() -> None:
    first, second = block(friction=0.35), make_object("book", 3)
    with cell(first) as world:
        world.replace_object(second, (0.05, 0.0, 0.4))
        np.testing.assert_allclose(world.object_pose(), (0.05, 0.0, 0.4))
        for _ in range(10):
            world.step()
        np.testing.assert_allclose(world.cell_loads(), second.mass * G, rtol=1e-3)
        world.replace_object(first, (0.0, 0.0, 0.0))
        world.place_object((0.1, 0.0, 1.0))
        world.reset_object()
        np.testing.assert_array_equal(world.object_pose(), np.zeros(3))
        rows = push(world)
        assert rows[-1, 5] == pytest.approx(rows[-1, 3] + 0.06 + PUSHER_RADIUS, abs=1e-3)
        for put in (world.reset_object, lambda: world.replace_object(second, (0.0, 0.0, 0.0))):
            with pytest.raises(InputError, match="pusher occupies"):
                put()
        np.testing.assert_allclose(world.object_pose(), rows[-1, 5:8])


def test_trajectory_passes_its_points_and_starts_from_where_the_arm_is() -> None:
    position, velocity = np.array([[1.0, 2.0], [3.0, 2.0], [3.0, 5.0]]), np.array([[0.5, 0.0], [0.0, -1.0], [0.0, 0.0]])
    cubic = JointTrajectory(np.array([1.0, 2.0, 4.0]), position, velocity)
    for t, q, v in zip(cubic.time, position, velocity, strict=True):
        np.testing.assert_allclose(cubic.sample(t - 1e-9)[0], q, atol=1e-7)
        if 1.0 < t < 4.0:
            np.testing.assert_allclose(cubic.sample(t)[1], v, atol=1e-7)
    np.testing.assert_allclose(cubic.sample(9.0)[0], position[-1])
    np.testing.assert_array_equal(cubic.sample(9.0)[1], 0)
    h = 1e-6
    slope = (cubic.sample(2.7 + h)[0] - cubic.sample(2.7 - h)[0]) / (2 * h)
    np.testing.assert_allclose(cubic.sample(2.7)[1], slope, atol=1e-6)
    straight = JointTrajectory(np.array([1.0]), np.array([[2.0]])).from_state(10.0, np.array([0.0]), np.array([0.0]))
    assert straight.sample(10.5)[0] == pytest.approx(1.0) and straight.sample(11.0)[0] == pytest.approx(2.0)
    # Two commands within one tick of the clock: the second goes on from the velocity of the first.
    moving = cubic.from_state(2.0, *cubic.sample(2.0), start=0.0)
    np.testing.assert_array_equal(moving.sample(2.0), cubic.sample(2.0))
    with pytest.raises(InputError, match="increase strictly"):
        JointTrajectory(np.array([1.0, 1.0]), np.zeros((2, 7)))


def test_perfect_camera_sees_a_flat_table_and_cells_of_their_height() -> None:
    sim_object = make_object("hammer")
    camera = DepthCamera(sim_object, CAMERA)
    table = points_in_table(camera.render((5.0, 5.0, 0.0), {}))
    assert np.mean(np.isfinite(table[..., 2])) > 0.98
    assert np.nanmax(np.abs(table[..., 2])) < 1e-5
    assert np.nanmin(table[..., 0]) < -0.3 and np.nanmax(table[..., 0]) > 0.3

    pose = np.array([0.05, -0.04, 0.6])
    points = points_in_table(camera.render(pose, {}))
    in_object = (points[..., :2] - pose[:2]) @ np.array([[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]])
    for (x, y), height in zip(sim_object.cells, sim_object.height, strict=True):
        on_top = np.all(np.abs(in_object - (x, y)) < 0.4 * sim_object.cell_size, axis=-1) & (points[..., 2] > 1e-3)
        assert on_top.sum() >= 4
        np.testing.assert_allclose(points[on_top][:, 2], height, atol=1e-4)


@pytest.mark.parametrize("name", ["", "ur5e"])
def test_camera_sees_the_pusher_where_the_arm_has_it(name: str) -> None:
    robot, sim_object = cell_robot(str(robot_path(name)) if name else ""), block(friction=0.35)
    world = CellWorld(sim_object, robot=replace(robot, start=robot.neutral))
    camera = DepthCamera(sim_object, CAMERA, description=robot.description)
    points, tip = points_in_table(camera.render((5.0, 5.0, 0.0), world.robot_link_poses())), world.tool_tip()
    world.close()
    beside = np.hypot(*np.moveaxis(points[..., :2] - tip[:2], 2, 0))
    distance = beside[(points[..., 2] > tip[2] + 0.002) & (points[..., 2] < tip[2] + 0.03) & (beside < 0.03)]
    assert len(distance) > 100 and robot.tool.radius - 3e-4 < distance.min() <= distance.max() < robot.tool.radius + 1e-4


def test_depth_noise_has_the_published_spread_whole_millimetres_and_a_seed() -> None:
    depth = np.full((480, 640), 1.2, dtype=np.float32)
    noisy = DepthNoise().apply(depth, np.random.default_rng(1))
    np.testing.assert_array_equal(noisy, DepthNoise().apply(depth, np.random.default_rng(1)))
    # Nguyen, Izadi & Lovell 2012, and the spread of rounding to steps of disparity (z^2 / 8 / 43.5 px m) and to 1 mm.
    expected = np.sqrt((0.0012 + 0.0019 * 0.8**2) ** 2 + ((1.2**2 / 8 / 43.5) ** 2 + 1e-3**2) / 12)
    assert noisy.std() == pytest.approx(expected, rel=0.06)
    np.testing.assert_allclose(noisy * 1e3, np.rint(noisy * 1e3), atol=1e-3)
    depth[:, 320:] = 1.1
    holes = np.isnan(DepthNoise(edge_dropout=0.5).apply(depth, np.random.default_rng(2)))
    assert holes[:, 319:321].mean() == pytest.approx(0.5, abs=0.1) and not holes[:, :319].any()


@pytest.mark.live
def test_node_without_camera_publishes_the_truth_replaces_the_object_and_ends_without_a_traceback(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from nav_msgs.msg import OccupancyGrid
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_srvs.srv import Trigger

    from helpers.node_process import NodeProcess, Talker

    domain = own_domain()
    chosen = {"camera_rate": 0.0, "truth_as_perception": True, "real_time_factor": 0.0, "effects.table_tilt": [0.01, 0.0]}
    node = NodeProcess("sim_cell_node", "push_ident_sim", chosen, domain, tmp_path)
    cells: list[OccupancyGrid] = []
    poses: list[PoseWithCovarianceStamped] = []
    try:
        with Talker(domain) as talker:
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            talker.node.create_subscription(OccupancyGrid, "objects/truth/cells", cells.append, latched)
            talker.node.create_subscription(PoseWithCovarianceStamped, "objects/truth/pose", poses.append, 10)
            # Long before they ask: a server that has not found the reading end of a client drops its answer.
            reset, spawn = (talker.node.create_client(Trigger, f"/sim_cell_node/{name}") for name in ("reset", "spawn"))
            setting = talker.node.create_client(SetParameters, "/sim_cell_node/set_parameters")
            talker.until(lambda: cells and len(poses) > 5 and "processor, physics [s/s]" in talker.values())
            assert float(talker.values()["real time factor"]) > 0 and "effect table_tilt" in talker.values()
            assert sum(v == 100 for v in cells[0].data) == len(make_object("hammer"))
            assert talker.ask(reset, Trigger.Request()).success
            values = (Parameter("object", value="book"), Parameter("start_pose", value=[0.05, -0.1, 0.5]))
            request = SetParameters.Request(parameters=[value.to_parameter_msg() for value in values])
            assert all(result.successful for result in talker.ask(setting, request).results)
            assert talker.ask(spawn, Trigger.Request()).success
            talker.until(lambda: len(cells) == 2)
            assert sum(v == 100 for v in cells[1].data) == len(make_object("book"))
            poses.clear()
            talker.until(lambda: len(poses) > 3)
            at = poses[-1].pose.pose.position
            assert (at.x, at.y) == pytest.approx((0.05, -0.1), abs=5e-3)
    finally:
        code = node.stop()
    assert code == 0 and "Traceback" not in node.output


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
        for time in following(world, plan, begin, plan.stop + 0.1):
            (position,), _ = plan.trajectory.follow(np.array([time]))
            deviation = max(deviation, float(np.max(np.abs(world.joint_state()[0] - position))))
        assert deviation < 1e-3
        assert world.tool_tip() == pytest.approx([*push.tool_end, robot.file.push_height], abs=1e-3)
        # Pushed at the middle of a side, the block goes straight ahead and stays at the tool.
        assert world.object_pose() == pytest.approx([distance, 0.0, 0.0], abs=2e-3)
    finally:
        world.close()


@pytest.mark.parametrize("sizes", [{"finger_distance": 0.05}, {"plate_length": 0.05}], ids=["fingers", "plate"])
def test_arm_carries_a_block_to_its_goal_with_both_ends_of_its_tool(tmp_path: Path, sizes: dict[str, float]) -> None:
    """By a path that is stable for its even load; both ends touch the long side from where they reach it to the end."""
    file = changed(tmp_path, lambda c: c["tool"].update(pusher_radius=0.008, **sizes), "iiwa")
    robot, arm_in_cell = read_robot(file), cell_robot(str(file))
    sim_object, tool = block(), push_settings(robot).tool
    arm = ArmKinematics(arm_in_cell.description, neutral=arm_in_cell.neutral)
    model, goal = true_model(sim_object), np.array([0.02, 0.18, 0.3])
    shape = model.shape
    support = Support.of_bodies(shape.cells.centres, [body_of_cells(shape, model.mass, model.friction)])
    contacts = (contact_on_face(shape, tool, face, 0.06 if face % 2 == 0 else 0.036) for face in range(4))
    turns = [stable_turns(contact, support, model.pusher_friction, 0.05) for contact in contacts if contact is not None]
    ways = [way for one in turns if one for way in stable_pushes(one, np.zeros(3), goal, tool, speed=0.05, clearance=0.03)]
    way = min((way for way in ways if np.ptp(way.poses[:, 2]) < np.pi), key=lambda way: way.length)
    settings = replace(push_settings(robot), workspace=(-0.3, 0.3, -0.3, 0.3))
    path = ToolPath(way.path.time, way.path.position, way.path.yaw)
    push = push_with_both_ends(shape, np.zeros(3), path, settings, back_off=0.015)
    plan = plan_turning_push(arm, arm_in_cell.start, push, path, motion_settings(robot), settings.span)
    (start,), _ = plan.trajectory.follow(np.array([plan.departure - 0.05]))
    world = CellWorld(sim_object, robot=replace(arm_in_cell, start=tuple(start)))
    try:
        for _ in following(world, plan, plan.departure - 0.05, plan.stop + 0.1):
            pass
        assert world.object_pose() == pytest.approx(goal, abs=4e-3)
    finally:
        world.close()


def test_finger_that_rolls_is_none_of_two(tmp_path: Path) -> None:
    arm = cell_robot(str(changed(tmp_path, lambda c: c["tool"].update(finger_distance=0.05), "iiwa")))
    with pytest.raises(InputError, match="single disc"):
        CellWorld(block(), WorldConfig(effects=InjectedEffects.of({"rolling_finger": 1.0})), robot=arm)


def test_arm_whose_meshes_are_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the mesh visual/base_cable_labels\.obj is no file"):
        cell_robot(str(with_urdf(tmp_path, lambda text: text)))
