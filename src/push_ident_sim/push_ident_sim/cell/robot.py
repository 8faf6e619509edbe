"""Description of the arm with its hand, rooted in the `table` frame."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from functools import cache
from importlib.resources import files
from pathlib import Path

__all__ = [
    "BASE_POSITION",
    "CONTACT_LINK",
    "HOME",
    "JOINT_NAMES",
    "PUSHER_LENGTH",
    "PUSHER_RADIUS",
    "bullet_description",
    "robot_description",
]

JOINT_NAMES = tuple(f"lbr_iiwa_joint_{i}" for i in range(1, 8))
BASE_POSITION = (-0.44, 0.0, 0.43)
"""Base of the arm in `table` [m]: on a pedestal, so that the elbow limits leave all of the workspace within reach."""
FLANGE_OFFSET = 0.045
"""From the last joint frame to the mounting face of the iiwa [m]."""
PUSHER_RADIUS = 0.018
"""Of the cylinder that pushes, as in `hand.urdf` [m]."""
PUSHER_LENGTH = 0.080
CONTACT_LINK = "hand_contact"
"""Only in Bullet: what touches the object in place of the cylinder."""
_CONTACT_ABOVE_TIP = 0.004
"""[m]: low enough for the flattest object at the height at which the tool pushes."""
HOME = (0.0, 1.001, 0.0, -1.923, 0.0, 0.2176, 0.0)
"""Joint positions [rad] with the tip 0.28 m above the middle of the workspace, tool down."""


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
    _fixed_joint(robot, "hand_joint", "lbr_iiwa_link_7", "hand_palm", f"0 0 {FLANGE_OFFSET}")
    robot.extend(hand)
    return ET.tostring(robot, encoding="unicode", xml_declaration=True)


def bullet_description(*, turning_finger: bool = False) -> str:
    """The same with a ball in the pusher that touches objects in its place, on a fixed joint or on one that turns about the tool's axis.

    A ball touches an upright wall where the cylinder would, but in one point. Of the contacts along a cylinder Bullet keeps some with the
    normal that the wall had before it turned, and the pusher drags.
    """
    robot = ET.fromstring(robot_description())
    link = ET.SubElement(robot, "link", name=CONTACT_LINK)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value="0.01")
    ET.SubElement(inertial, "inertia", ixx="1e-6", ixy="0", ixz="0", iyy="1e-6", iyz="0", izz="1e-6")
    ET.SubElement(ET.SubElement(ET.SubElement(link, "collision"), "geometry"), "sphere", radius=str(PUSHER_RADIUS))
    joint = _fixed_joint(robot, f"{CONTACT_LINK}_joint", "hand_pusher", CONTACT_LINK, f"0 0 {PUSHER_LENGTH - _CONTACT_ABOVE_TIP}")
    if turning_finger:
        joint.set("type", "continuous")
        ET.SubElement(joint, "axis", xyz="0 0 1")
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
