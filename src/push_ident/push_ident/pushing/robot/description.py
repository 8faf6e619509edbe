"""The description that the nodes use: the URDF of an arm, placed in `table`, with the limits of the robot file and the tool that pushes."""

from __future__ import annotations

import copy
import importlib.util
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET
from xml.parsers import expat

import numpy as np
import pinocchio as pin

from push_ident.errors import InputError
from push_ident.files import read_regular
from push_ident.geometry.frames import TABLE_FRAME
from push_ident.limits import LIMITS, plain_text
from push_ident.pushing.push import tool_shape
from push_ident.pushing.robot.robot_file import Joints, Robot, Tool

TIP_LINK: Final = "tool_tip"
"""Link at the bottom centre of the pusher, z down the tool."""
PUSHER_LINK: Final = "tool_pusher"
"""Link of the cylinder that pushes; its origin is the centre of the upper end."""
_HAND_LINK: Final = "tool_hand"


@dataclass(frozen=True, slots=True)
class Urdf:
    """A URDF that was read."""

    path: Path
    root: ET.Element
    """The element `robot`. Names with a prefix, which belong to other tools, are left out."""

    @property
    def links(self) -> list[str]:
        """Names of all links."""
        return [link.get("name", "") for link in self.root.findall("link")]

    @property
    def joints(self) -> dict[str, ET.Element]:
        """All joints by name."""
        return {joint.get("name", ""): joint for joint in self.root.findall("joint")}

    @property
    def roots(self) -> list[str]:
        """Links that are no child of a joint."""
        children = {_end(joint, "child") for joint in self.root.findall("joint")}
        return [link for link in self.links if link not in children]

    @property
    def missing_meshes(self) -> list[str]:
        """Names of meshes that are no files, each once. Only pictures and simulators read meshes."""
        names = dict.fromkeys(mesh.get("filename", "") for mesh in self.root.iter("mesh"))
        return [name for name in names if not Path(name).is_file()]

    def chain(self, link: str) -> list[ET.Element]:
        """Joints from the root to a link. Raises InputError for a loop."""
        above = {_end(joint, "child"): joint for joint in self.root.findall("joint")}
        joints: list[ET.Element] = []
        while (joint := above.get(link)) is not None:
            if joint in joints:
                raise InputError(f"{self.path}: the joints above {plain_text(link)} form a loop, expected a tree.")
            joints.append(joint)
            link = _end(joint, "parent")
        return joints[::-1]


def read_urdf(robot: Robot) -> Urdf:
    """Find and read the URDF that a robot file names; paths of meshes become absolute where the meshes exist.

    Raises InputError: there is no such package or file, or it is no URDF.
    """
    path = _find(robot)
    try:
        content = read_regular(path, LIMITS.DESCRIPTION.value)
        root = _parse(content)
    except (OSError, expat.ExpatError, UnicodeDecodeError, ValueError) as error:
        reason = plain_text(" ".join(str(error).split()))[:150]
        remedy = " Expand it first: `xacro FILE > robot.urdf`." if path.suffix == ".xacro" else ""
        raise InputError(f"description: {path} cannot be read ({reason}), expected a URDF.{remedy}") from None
    if b"<xacro:" in content:
        raise InputError(f"description: {path} is xacro, expected a URDF. Expand it first: `xacro FILE > robot.urdf`.")
    if root.tag != "robot" or root.find("link") is None:
        raise InputError(f"description: {path} has no element `robot` with links, expected a URDF.")
    for mesh in root.iter("mesh"):
        mesh.set("filename", str(_mesh(mesh.get("filename", ""), path.parent)))
    return Urdf(path, root)


def cell_description(robot: Robot, urdf: Urdf) -> str:
    """URDF whose root link is `table` and whose link `tool_tip` is the bottom centre of the pusher.

    Raises InputError where a link or joint of the robot file is not in the URDF, or a name of the cell is taken there.
    """
    file = robot.file
    cell = ET.Element("robot", name="push_cell")
    if file.description.root != TABLE_FRAME:
        if file.base is None:
            raise InputError(f"base is missing: the root link of the URDF is {file.description.root}, and not `table`.")
        ET.SubElement(cell, "link", name=TABLE_FRAME)
        _fixed_joint(cell, "table_base_joint", (TABLE_FRAME, file.description.root), file.base.position, file.base.rpy)
    for element in urdf.root:
        if element.tag in ("link", "joint", "material"):
            cell.append(copy.deepcopy(element))
    known = {joint.get("name", ""): joint for joint in cell.findall("joint")}
    for index, name in enumerate(file.joints.names):
        if name not in known:
            raise InputError(f"joints.names has {plain_text(name)}, which the URDF does not have.")
        _limit(known[name], file.joints, index)
    _add_tool(cell, file.tool, urdf.links)
    ET.indent(cell)  # Bullet reads lines of at most 1 kB, and breaks longer ones in the middle of a word.
    return ET.tostring(cell, encoding="unicode", xml_declaration=True)


def _add_tool(cell: ET.Element, tool: Tool, links: list[str]) -> None:
    if tool.link not in links:
        raise InputError(f"tool.link is {plain_text(tool.link)}, which the URDF does not have.")
    if taken := [name for name in (TIP_LINK, PUSHER_LINK, _HAND_LINK) if name in links]:
        raise InputError(f"The URDF has a link {taken[0]} already, a name that the cell needs for its tool; take it out of the URDF.")
    down = pin.rpy.rpyToMatrix(*tool.tip_rpy)[:, 2]
    top = np.array(tool.tip_position) - tool.pusher_height * down
    pusher = ET.SubElement(cell, "link", name=PUSHER_LINK)
    ends = tool_shape(tool.pusher_radius, tool.finger_distance, tool.plate_length).core
    for at in ends.tolist():
        _cylinder(pusher, tool.pusher_radius, tool.pusher_height, 0.5 * tool.pusher_height, at)
    if tool.plate_length:
        size = _words([2 * tool.pusher_radius, tool.plate_length, tool.pusher_height])
        _solid(pusher, "box", [0.0, 0.0, 0.5 * tool.pusher_height], size=size)
    _fixed_joint(cell, f"{PUSHER_LINK}_joint", (tool.link, PUSHER_LINK), top, tool.tip_rpy)
    if tool.hand_length > 0:
        hand = ET.SubElement(cell, "link", name=_HAND_LINK)
        _cylinder(hand, tool.hand_radius, tool.hand_length, -0.5 * tool.hand_length)
        _fixed_joint(cell, f"{_HAND_LINK}_joint", (PUSHER_LINK, _HAND_LINK), [0.0] * 3, [0.0] * 3)
    ET.SubElement(cell, "link", name=TIP_LINK)
    _fixed_joint(cell, f"{TIP_LINK}_joint", (PUSHER_LINK, TIP_LINK), [0.0, 0.0, tool.pusher_height], [0.0] * 3)


def _limit(joint: ET.Element, joints: Joints, index: int) -> None:
    """Write the limits of the robot file into a joint; a continuous one with limits is a revolute one."""
    limit = joint.find("limit")
    if limit is None:
        limit = ET.SubElement(joint, "limit", effort="0", velocity="0")
    for name, values in (("lower", joints.lower), ("upper", joints.upper), ("velocity", joints.velocity)):
        if values is not None:
            limit.set(name, repr(values[index]))
    if joint.get("type") == "continuous" and joints.lower is not None and joints.upper is not None:
        joint.set("type", "revolute")


def _cylinder(link: ET.Element, radius: float, length: float, middle: float, at: Sequence[float] = (0.0, 0.0)) -> None:
    _solid(link, "cylinder", [*at, middle], radius=repr(radius), length=repr(length))


def _solid(link: ET.Element, kind: str, middle: Sequence[float], **sizes: str) -> None:
    for role in ("visual", "collision"):
        solid = ET.SubElement(link, role)
        ET.SubElement(solid, "origin", xyz=_words(middle), rpy="0 0 0")
        ET.SubElement(ET.SubElement(solid, "geometry"), kind, dict(sizes))


def _fixed_joint(cell: ET.Element, name: str, ends: tuple[str, str], xyz: object, rpy: object) -> None:
    joint = ET.SubElement(cell, "joint", name=name, type="fixed")
    ET.SubElement(joint, "parent", link=ends[0])
    ET.SubElement(joint, "child", link=ends[1])
    ET.SubElement(joint, "origin", xyz=_words(xyz), rpy=_words(rpy))


def _words(numbers: object) -> str:
    return " ".join(repr(float(number)) for number in np.asarray(numbers, dtype=np.float64))


def _end(joint: ET.Element, which: str) -> str:
    end = joint.find(which)
    return "" if end is None else end.get("link", "")


def _parse(content: bytes) -> ET.Element:
    """The element tree of a URDF. Namespaces are ignored: descriptions use prefixes of other tools that they do not declare."""
    builder = ET.TreeBuilder()
    depth = 0  # of elements with a prefix, which are left out with all that is in them

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += depth > 0 or ":" in name
        if not depth:
            builder.start(name, {key: value for key, value in attributes.items() if ":" not in key and key != "xmlns"})

    def end(name: str) -> None:
        nonlocal depth
        if not depth:
            builder.end(name)
        depth -= depth > 0

    def refuse(*_: object) -> None:
        raise ValueError("it declares entities")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler, parser.EntityDeclHandler = start, end, refuse
    parser.Parse(content, True)
    return builder.close()


def _find(robot: Robot) -> Path:
    description = robot.file.description
    if not description.package:
        path = robot.path.parent / description.file
        if not path.is_file():
            raise InputError(f"description.file is {plain_text(description.file)}, and {path} is no file; correct the path.")
        return path.resolve()
    folders = list(_package_folders(description.package))
    for folder in folders:
        if (folder / description.file).is_file():
            return (folder / description.file).resolve()
    name, file = plain_text(description.package), plain_text(description.file)
    if not folders:
        raise InputError(f"description.package is {name}, which is not installed; install it, or give description.file alone.")
    raise InputError(f"description.file is {file}, which the package {name} does not have in {folders[0]}; correct the path.")


def _package_folders(name: str) -> Iterator[Path]:
    if name.isidentifier() and (spec := importlib.util.find_spec(name)) is not None:
        yield from (Path(folder) for folder in spec.submodule_search_locations or ())
    shares = (Path(prefix) / "share" / name for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix)
    if "/" not in name:
        yield from (share for share in shares if share.is_dir())


def _mesh(name: str, folder: Path) -> Path | str:
    """Absolute path of a mesh; the name as it is where there is no such file."""
    scheme, _, rest = name.partition("://")
    if not rest:
        candidates = [folder / name]
    else:
        package, _, inside = rest.partition("/")
        candidates = [Path("/", rest)] if scheme == "file" else [share / inside for share in _package_folders(package)]
        # Copied descriptions keep `package://` where the package is a folder above them, or is not named at all.
        candidates += [above / rest for above in (folder, *folder.parents)]
    return next((path.resolve() for path in candidates if path.is_file()), name)
