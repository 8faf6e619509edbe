"""`push-ident doctor --robot`: whether a robot file fits its URDF, table and camera, and the cell that runs, if one does."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import Any, Final

import yaml
from rich.table import Table

from push_ident.cli.output import console, write_json
from push_ident.cli.robot import check_nodes
from push_ident.cli.robot_live import find_live
from push_ident.cli.robot_parameters import check_parameters
from push_ident.extras import need
from push_ident.files import write_whole
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.robot.checks import check_reach, check_robot
from push_ident.pushing.robot.description import cell_description, read_urdf
from push_ident.pushing.robot.finding import Finding, Level
from push_ident.pushing.robot.node_parameters import node_parameters
from push_ident.pushing.robot.reach import Reach, Trial, find_reach
from push_ident.pushing.robot.reach_picture import draw_reach
from push_ident.pushing.robot.robot_file import Robot, motion_settings, push_settings, read_robot

__all__ = ["examine_robot"]

_LOOKS: Final = {Level.OK: "green", Level.NOT_CHECKED: "cyan", Level.WARNING: "yellow", Level.WRONG: "bold red"}


def examine_robot(file: Path, *, spacing: float, seconds: float, out: Path | None, json: Path | None) -> int:
    """Check a robot file, print the findings and write the reach; exit status 1 where something is wrong.

    Args:
        file: Robot file.
        spacing: Largest distance of the places at which pushes are planned [m].
        seconds: How long to listen to a running cell [s].
        out: Folder for picture, description and parameters; None writes none.
        json: File for the findings; None writes none.
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
    if json is not None:
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
    table = Table(title=f"robot {robot.file.name}")
    for heading in ("about", "result", "found"):
        table.add_column(heading, overflow="fold")
    for finding in findings:
        table.add_row(finding.about, finding.level.value, finding.text, style=_LOOKS[finding.level])
    console.print(table)
    counts = {level: sum(finding.level is level for finding in findings) for level in Level}
    console.print(", ".join(f"{n} {level.value}" for level, n in counts.items()), highlight=False)


def _write(robot: Robot, reach: Reach, out: Path) -> None:
    """The picture, and what `up` makes of the file, for `ros2 launch`."""
    description = (out / "robot.urdf").resolve()
    write_whole(description, cell_description(robot, read_urdf(robot)), "the robot description")
    write_whole(out / "parameters.yaml", _parameter_text(robot, description), "the parameters")
    write_whole(out / "reach.png", draw_reach(reach, robot), "the reach")
    console.print(f"written: {', '.join(str(out / name) for name in ('reach.png', 'robot.urdf', 'parameters.yaml'))}", soft_wrap=True)


def _parameter_text(robot: Robot, description: Path) -> str:
    """Parameter file of ROS 2 for the nodes beside a real arm."""
    nodes = {node: values for node, values in node_parameters(robot, description).items() if not node.startswith("sim_")}
    # Through JSON: a list that two nodes share would become an alias of YAML, which ROS does not read.
    content = jsonlib.loads(jsonlib.dumps({f"/**/{node}": {"ros__parameters": values} for node, values in nodes.items()}))
    return f"# Made from {robot.path} by `push-ident doctor --robot`.\n{yaml.safe_dump(content, sort_keys=False, default_flow_style=None)}"


def _content(robot: Robot, findings: list[Finding], reach: Reach | None) -> dict[str, Any]:
    content: dict[str, Any] = {
        "robot": robot.file.name,
        "findings": [
            {"about": f.about, "level": f.level.value, "what": f.what, "expected": f.expected, "remedy": f.remedy} for f in findings
        ],
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
