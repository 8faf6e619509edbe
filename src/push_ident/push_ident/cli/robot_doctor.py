"""`push-ident doctor --robot`: whether a robot file fits its URDF, table and camera, and the cell that runs, if one does."""

from __future__ import annotations

import difflib
import importlib
import json as jsonlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import yaml
from rich.table import Column, Table

from push_ident.cli.output import console, say, write_json
from push_ident.cli.robot import check_nodes
from push_ident.errors import PushIdentError
from push_ident.extras import need
from push_ident.files import write_whole
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.limits import plain_text
from push_ident.nodes.executables import NODES
from push_ident.pushing.robot.checks import Finding, Level, check_reach, check_robot
from push_ident.pushing.robot.description import cell_description, read_urdf
from push_ident.pushing.robot.node_parameters import node_parameters
from push_ident.pushing.robot.reach import Reach, Trial, find_reach
from push_ident.pushing.robot.reach_page import write_reach_page
from push_ident.pushing.robot.robot_file import Camera, Robot, motion_settings, push_settings, read_robot
from push_ident.pushing.state_intake import no_positions
from push_ident.types import DepthFrame

if TYPE_CHECKING:
    from push_ident.nodes.base.parameters import Parameter
    from push_ident.nodes.client.listen import CellNames, Heard

_ROLES: Final = ("joint_states", "joint_trajectory", "depth/image_rect")
_TRAJECTORY: Final = "trajectory_msgs/msg/JointTrajectory"
_LOOKS: Final = {Level.OK: "green", Level.NOT_CHECKED: "cyan", Level.WARNING: "yellow", Level.WRONG: "bold red"}


def examine_robot(file: Path, *, spacing: float, seconds: float, out: Path | None, json: Path | None) -> int:
    """Check a robot file, print the findings and write the reach; exit status 1 where something is wrong.

    Pushes are planned at places at most `spacing` apart [m]; a running cell is listened to for `seconds` [s]. The folder `out` gets page,
    description and parameters, the file `json` the findings.
    """
    if out is not None:
        need("report")
    robot = read_robot(file)
    check_nodes(robot)
    findings, kinematics = check_robot(robot)
    if not any(finding.about == "parameters" for finding in findings):
        findings += check_parameters(robot)
    reach = None if kinematics is None else _reach(robot, kinematics, spacing)
    if reach is None:
        findings.append(Finding("reach", Level.NOT_CHECKED, "no kinematics", remedy="mend first what is wrong above"))
    else:
        findings += check_reach(reach, push_settings(robot).workspace)
    with console.status("listening to a cell"):
        findings += find_live(robot, kinematics, seconds)
    _show(robot, findings)
    if out is not None and reach is not None:
        _write(robot, reach, out)
    write_json(json, _content(robot, findings, reach))
    return int(any(finding.level is Level.WRONG for finding in findings))


def _reach(robot: Robot, kinematics: ArmKinematics, spacing: float) -> Reach:
    executor, default = robot.file.parameters.get("push_executor_node", {}), Trial()
    trial = Trial(float(executor.get("push_distance", default.distance)), float(executor.get("push_speed", default.speed)))
    with console.status("planning pushes") as status:

        def on_step(share: float) -> None:
            status.update(f"planning pushes over the workspace: {100 * share:.0f} %")

        return find_reach(kinematics, motion_settings(robot), push_settings(robot), spacing=spacing, trial=trial, on_step=on_step)


def _show(robot: Robot, findings: list[Finding]) -> None:
    table = Table(*(Column(heading, overflow="fold") for heading in ("about", "result", "found")), title=f"robot {robot.file.name}")
    for finding in findings:
        table.add_row(finding.about, finding.level.value, finding.text, style=_LOOKS[finding.level])
    console.print(table)
    counts = {level: sum(finding.level is level for finding in findings) for level in Level}
    say(", ".join(f"{n} {level.value}" for level, n in counts.items()))


def _write(robot: Robot, reach: Reach, out: Path) -> None:
    """The page of the reach, and what `up` makes of the file, for `ros2 launch`."""
    description = (out / "robot.urdf").resolve()
    write_whole(description, cell_description(robot, read_urdf(robot)), "the robot description")
    write_whole(out / "parameters.yaml", _parameter_text(robot, description), "the parameters")
    write_reach_page(out / "reach.html", reach, robot)
    console.print(f"written: {', '.join(str(out / name) for name in ('reach.html', 'robot.urdf', 'parameters.yaml'))}", soft_wrap=True)


def _parameter_text(robot: Robot, description: Path) -> str:
    nodes = {node: values for node, values in node_parameters(robot, description).items() if not node.startswith("sim_")}
    # Through JSON: a list that two nodes share would become an alias of YAML, which ROS does not read.
    content = jsonlib.loads(jsonlib.dumps({f"/**/{node}": {"ros__parameters": values} for node, values in nodes.items()}))
    return f"# Made from {robot.path} by `push-ident doctor --robot`.\n{yaml.safe_dump(content, sort_keys=False, default_flow_style=None)}"


def _content(robot: Robot, findings: list[Finding], reach: Reach | None) -> dict[str, Any]:
    content: dict[str, Any] = {
        "robot": robot.file.name,
        "findings": [asdict(finding) | {"level": finding.level.value} for finding in findings],
    }
    if reach is not None:
        content["reach"] = {
            "x_m": reach.x.tolist(),
            "y_m": reach.y.tolist(),
            "along_x": reach.outcome[0].tolist(),
            "along_y": reach.outcome[1].tolist(),
            "largest_workspace_m": reach.largest,
        }
    return content


def check_parameters(robot: Robot) -> list[Finding]:
    """Compare each value with the table of its node. Raises InputError where the file gives a value twice."""
    values = {node: given for node, given in node_parameters(robot, Path("robot.urdf")).items() if node in NODES}
    try:
        tables = {node: {row.name: row for row in importlib.import_module(NODES[node]).PARAMETERS} for node in values}
    except ImportError as error:
        return [Finding("parameters", Level.NOT_CHECKED, f"ROS cannot be imported ({error})", remedy="run `make setup`, or source ROS 2")]
    found = [finding for node, given in values.items() for finding in _of_node(node, given, tables[node])]
    return found or [
        Finding("parameters", Level.OK, f"{sum(map(len, values.values()))} values for {len(values)} nodes, within their ranges")
    ]


def _of_node(node: str, given: dict[str, Any], table: dict[str, Parameter]) -> Iterator[Finding]:
    for name, value in given.items():
        row = table.get(name)
        if row is None:
            near = difflib.get_close_matches(name, table, n=1)
            remedy = f"did you mean {near[0]}?" if near else "take it out"
            yield Finding("parameters", Level.WRONG, f"{node} has no parameter {plain_text(name)}", remedy=remedy)
            continue
        fault = row.fault(value) if row.has_type(value) else row.expected_type(value)
        if fault:
            what = f"{node}.{name} is {plain_text(repr(value))} ({row.description})"
            yield Finding("parameters", Level.WRONG, what, fault.removeprefix("expected "), "correct it")


def find_live(robot: Robot, kinematics: ArmKinematics | None, seconds: float) -> list[Finding]:
    """Compare the file with an arm and a camera that run, under the names of the file or of the bag contract; say so where none does.

    `kinematics` is None where the file gives none; `seconds` is how long to listen [s].
    """
    try:
        from push_ident.nodes.client.listen import CellNames, listen_to_arms
    except ImportError as error:
        return [Finding("cell", Level.NOT_CHECKED, f"ROS cannot be imported ({error})", remedy="run `make setup`, or source ROS 2")]
    # A simulated cell has the names of the contract, whatever the driver of the real arm has.
    cells = dict.fromkeys([CellNames(*(robot.file.topics.get(role, role) for role in _ROLES)), CellNames(*_ROLES)])
    try:
        heard = listen_to_arms(list(cells), seconds)
    except PushIdentError as error:
        return [Finding("cell", Level.WRONG, str(error))]
    # A driver and the simulated cell may have one name for joint states: then the one that is commanded counts.
    arms = sorted((one for one in heard if one.n_arms), key=lambda one: not one.controllers)
    cameras = [one for one in heard if one.n_cameras]
    found = list(_arm(robot, kinematics, arms[0])) if arms else [_silent("arm", heard[0].names.states)]
    return found + (_camera(robot, cameras[0].names, seconds) if cameras else [_silent("camera", heard[0].names.images)])


def _silent(about: str, topic: str) -> Finding:
    remedy = f"start the driver of the {about}, or `push-ident up sim --robot FILE`, and check ROS_DOMAIN_ID"
    return Finding(about, Level.NOT_CHECKED, f"nothing publishes on {plain_text(topic)}", remedy=remedy)


def _arm(robot: Robot, kinematics: ArmKinematics | None, heard: Heard) -> Iterator[Finding]:
    states, commands = plain_text(heard.names.states), plain_text(heard.names.commands)
    joints = robot.file.joints.names
    missing = [name for name in joints if name not in heard.positions]
    without = [name for name in joints if not np.isfinite(heard.positions.get(name, 0.0))]
    if not heard.n_states:
        yield Finding("arm", Level.WRONG, f"{states} has a publisher, and no message came", remedy="see the log of the driver")
    elif missing:
        has = plain_text(", ".join(heard.positions)) or "none"
        yield Finding("arm", Level.WRONG, f"{states} has no joint {', '.join(missing)}; it has {has}", "joints.names", "correct the names")
    elif without:
        yield Finding("arm", Level.WRONG, f"{states}: {no_positions(without)}")
    else:
        yield Finding("arm", Level.OK, f"{states}: {len(joints)} joints, {heard.n_states} messages")
        if kinematics is not None:
            yield from _position(kinematics, np.array([heard.positions[name] for name in joints]))
    if not heard.controllers:
        yield Finding("arm", Level.WRONG, f"nobody listens to {commands}", "a trajectory controller", "start it, or correct topics")
    elif _TRAJECTORY not in heard.controllers:
        yield Finding("arm", Level.WRONG, f"{commands} takes {plain_text(', '.join(heard.controllers))}", _TRAJECTORY, "correct topics")
    else:
        yield Finding("arm", Level.OK, f"{commands} is listened to")


def _position(kinematics: ArmKinematics, q: np.ndarray) -> Iterator[Finding]:
    """Where the arm stands now, to be compared with the real one by eye; a joint at its limit may be reported 1 mrad beyond it."""
    for name, value, low, high in zip(kinematics.joint_names, q, kinematics.position_lower, kinematics.position_upper, strict=True):
        if not low - 1e-3 <= value <= high + 1e-3:
            expected = f"{low:.3f} to {high:.3f} rad"
            yield Finding("arm", Level.WRONG, f"{name} stands at {value:.3f} rad", expected, "move it, or widen joints.lower and upper")
    x, y, z = kinematics.forward(q)[:3, 3]
    yield Finding("arm", Level.OK, f"by the joints its tip is at ({x:.3f}, {y:.3f}, {z:.3f}) m in `table`: compare with the real one")


def _camera(robot: Robot, names: CellNames, seconds: float) -> list[Finding]:
    from push_ident.nodes.client.depth_capture import DepthCapture

    try:
        with DepthCapture(names.images, seconds=seconds) as capture:
            frame = next(iter(capture.frames()))
    except PushIdentError as error:
        return [Finding("camera", Level.WRONG, str(error))]
    return list(_images(robot.file.camera, frame, names.images))


def _images(camera: Camera, frame: DepthFrame, topic: str) -> Iterator[Finding]:
    """Frame and field of view of the images [rad]; data sheets give it to 3 degrees, 0.052 rad (RealSense D435: 87 +- 3 degrees)."""
    size, intrinsics = (frame.intrinsics.width, frame.intrinsics.height), frame.intrinsics
    share = float(np.mean(np.isfinite(frame.depth)))
    yield Finding("camera", Level.OK, f"{topic}: {size[0]} x {size[1]} pixels, {100 * share:.0f} % of them with a depth")
    if frame.frame_id != camera.frame:
        level, what = Level.WRONG, f"its images are in the frame {plain_text(frame.frame_id)}"
        if not frame.frame_id:
            level, what = Level.WARNING, "its images have no frame_id"
        yield Finding("camera", level, what, f"camera.frame, {plain_text(camera.frame)}", "correct one of them")
    view = [2.0 * np.arctan(0.5 * pixels / focal) for pixels, focal in zip(size, (intrinsics.fx, intrinsics.fy), strict=True)]
    if max(abs(a - b) for a, b in zip(view, camera.field_of_view, strict=True)) > 0.06:
        what = f"its images have a field of view of [{view[0]:.3f}, {view[1]:.3f}] rad"
        yield Finding("camera", Level.WARNING, what, f"camera.field_of_view, {camera.field_of_view}", "correct camera.field_of_view")
