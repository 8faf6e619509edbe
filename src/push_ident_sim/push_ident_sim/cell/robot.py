"""The arm with its hand or tool, rooted in the `table` frame: the one that every cell has, or that of a robot file."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np

from push_ident.errors import InputError
from push_ident.limits import plain_text
from push_ident.pushing.robot.description import PUSHER_LINK, cell_description, read_urdf
from push_ident.pushing.robot.robot_file import push_settings, read_robot
from push_ident.types import Float64Array, PusherShape

JOINT_NAMES = tuple(f"lbr_iiwa_joint_{i}" for i in range(1, 8))
BASE_POSITION = (-0.44, 0.0, 0.43)
"""Base of the arm in `table` [m]: on a pedestal, so that the elbow limits leave all of the workspace within reach."""
PUSHER_RADIUS = 0.018
"""Of the cylinder that pushes, as in `hand.urdf` [m]."""
PUSHER_LENGTH = 0.080
CONTACT_LINK = "hand_contact"
"""Only in Bullet: what touches the object in place of the cylinder."""
_WRIST = ("lbr_iiwa_link_5", "lbr_iiwa_link_6", "lbr_iiwa_link_7")
HOME = (0.0, 1.001, 0.0, -1.923, 0.0, 0.2176, 0.0)
"""Joint positions [rad] with the tip 0.28 m above the middle of the workspace, tool down."""


@dataclass(frozen=True, slots=True)
class CellRobot:
    """An arm that stands in the simulated cell."""

    description: str
    """URDF, root link `table`, with absolute paths of meshes."""
    joint_names: tuple[str, ...]
    """In the order in which the arm reports them."""
    start: tuple[float, ...]
    """Posture at the start [rad], one value per joint."""
    neutral: tuple[float, ...]
    """Posture over the workspace with the tool down [rad]."""
    pusher_link: str
    """Link of the cylinder that pushes: origin at its upper end, z down."""
    tool: PusherShape
    """What pushes, in the frame of that link."""
    pusher_length: float
    """[m]"""
    low_links: tuple[str, ...]
    """Links that collide with the table: those of the tool and of the wrist."""


@cache
def iiwa_with_hand() -> CellRobot:
    """The arm of every cell that names no other."""
    description = robot_description()
    low = [name for name in _link_names(description) if name.startswith("hand_") or name in _WRIST]
    return CellRobot(description, JOINT_NAMES, HOME, HOME, "hand_pusher", PusherShape(PUSHER_RADIUS), PUSHER_LENGTH, tuple(low))


def cell_robot(file: str) -> CellRobot:
    """The arm of a robot file; without one the iiwa. Raises InputError where the file cannot be used."""
    return robot_from_file(Path(file)) if file else iiwa_with_hand()


def robot_from_file(path: Path) -> CellRobot:
    """The arm of a robot file, parked at its home. Raises InputError where the file cannot be used."""
    robot = read_robot(path)
    joints, tool = robot.file.joints, robot.file.tool
    urdf = read_urdf(robot)
    if missing := urdf.missing_meshes:
        raise InputError(f"{urdf.path}: the mesh {plain_text(missing[0])} is no file; install the package that has it, or source it.")
    chain = urdf.chain(tool.link)
    # What hangs on the third joint from the end may come down to the table.
    moving = [joint.get("name", "") for joint in chain if joint.get("type") != "fixed"][-3:]
    first = next((i for i, joint in enumerate(chain) if joint.get("name") in moving), 0)
    wrist = {child.get("link", "") for joint in chain[first:] if (child := joint.find("child")) is not None}
    description = _with_masses(cell_description(robot, urdf))
    low = [name for name in _link_names(description) if name in wrist or name.startswith("tool_")]
    return CellRobot(
        description,
        tuple(joints.names),
        tuple(joints.home),
        tuple(joints.neutral),
        PUSHER_LINK,
        push_settings(robot).tool,
        tool.pusher_height,
        tuple(low),
    )


@cache
def robot_description() -> str:
    """URDF of pedestal, arm and hand with absolute mesh paths; the root link is `table`, so its forward kinematics are in that frame."""
    import pybullet_data

    arm_folder = Path(pybullet_data.getDataPath()) / "kuka_iiwa"
    arm = ET.parse(arm_folder / "model.urdf").getroot()
    for mesh in arm.iter("mesh"):
        mesh.set("filename", str(arm_folder / mesh.attrib["filename"]))
    hand = ET.fromstring((files("push_ident_sim.cell") / "urdf" / "hand.urdf").read_text())

    robot = ET.Element("robot", name="push_cell")
    _massless(ET.SubElement(robot, "link", name="table"))
    x, y, z = BASE_POSITION
    pedestal = ET.SubElement(robot, "link", name="pedestal")
    _massless(pedestal)
    for role in ("visual", "collision"):
        solid = ET.SubElement(pedestal, role)
        ET.SubElement(solid, "origin", xyz=f"0 0 {z / 2}")
        ET.SubElement(ET.SubElement(solid, "geometry"), "box", size=f"0.2 0.2 {z}")
    _fixed_joint(robot, "pedestal_joint", "table", "pedestal", f"{x} {y} 0")
    _fixed_joint(robot, "base_joint", "pedestal", "lbr_iiwa_link_0", f"0 0 {z}")
    robot.extend(arm)
    # From the last joint frame to the mounting face of the iiwa.
    _fixed_joint(robot, "hand_joint", "lbr_iiwa_link_7", "hand_palm", "0 0 0.045")
    robot.extend(hand)
    return ET.tostring(robot, encoding="unicode", xml_declaration=True)


def bullet_description(arm: CellRobot, *, turning_finger: bool = False) -> str:
    """Description with a ball in the pusher that touches objects in its place, on a fixed joint or on one that turns about the tool's axis.

    Fingers have one each, a plate a row of them. A ball touches an upright wall where the cylinder would, but in one point. Of the contacts
    along a cylinder Bullet keeps some with the normal that the wall had before it turned, and the pusher drags.
    """
    robot = ET.fromstring(arm.description)
    link = ET.SubElement(robot, "link", name=CONTACT_LINK)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value="0.01")
    ET.SubElement(inertial, "inertia", ixx="1e-6", ixy="0", ixz="0", iyy="1e-6", iyz="0", izz="1e-6")
    for x, y in _balls(arm.tool).tolist():
        collision = ET.SubElement(link, "collision")
        ET.SubElement(collision, "origin", xyz=f"{x} {y} 0")
        ET.SubElement(ET.SubElement(collision, "geometry"), "sphere", radius=str(arm.tool.radius))
    # 4 mm above the tip: low enough for the flattest object at the height at which the tool pushes.
    at = f"0 0 {arm.pusher_length - 0.004}"
    joint = _fixed_joint(robot, f"{CONTACT_LINK}_joint", arm.pusher_link, CONTACT_LINK, at)
    if turning_finger:
        joint.set("type", "continuous")
        ET.SubElement(joint, "axis", xyz="0 0 1")
    return ET.tostring(robot, encoding="unicode", xml_declaration=True)


def _balls(tool: PusherShape) -> Float64Array:
    """Middles of the balls that stand for a tool [m], shape (n, 2): of a plate so near to each other that its sides are even to 1 % of its
    radius."""
    if tool.polygon is None:
        return tool.core
    length = float(np.linalg.norm(tool.polygon[1] - tool.polygon[0]))
    return np.linspace(tool.polygon[0], tool.polygon[1], 1 + math.ceil(length / (0.28 * tool.radius)))


def _link_names(description: str) -> list[str]:
    return [link.attrib["name"] for link in ET.fromstring(description).findall("link")]


def _with_masses(description: str) -> str:
    """Give links without inertia a mass of zero."""
    robot = ET.fromstring(description)
    for link in robot.findall("link"):
        if link.find("inertial") is None:
            _massless(link)
    return ET.tostring(robot, encoding="unicode", xml_declaration=True)


def _massless(link: ET.Element) -> None:
    """Give a fixed link without inertia a mass of zero; Bullet assumes 1 kg where none is given."""
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value="0")
    ET.SubElement(inertial, "inertia", ixx="0", ixy="0", ixz="0", iyy="0", iyz="0", izz="0")


def _fixed_joint(robot: ET.Element, name: str, parent: str, child: str, xyz: str) -> ET.Element:
    joint = ET.SubElement(robot, "joint", name=name, type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=xyz, rpy="0 0 0")
    return joint
