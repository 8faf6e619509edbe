"""The links of an arm in space, as one cylinder per solid of its URDF: enough to separate arm and object in a depth image."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from push_ident.errors import InputError
from push_ident.geometry.frames import TABLE_FRAME
from push_ident.geometry.rod import Rod
from push_ident.types import Float64Array


class ArmShape:
    """All solids of a URDF whose root link is `table`, placed by joint positions.

    A cylinder stands for itself, spheres and boxes are replaced by a cylinder around them. Meshes are not read: such a link is a rod
    from its joint to the next one. Not safe to share between threads.
    """

    def __init__(self, urdf_xml: str, link_radius: float = 0.1) -> None:
        """Read the text of a URDF; `link_radius` [m] is the radius of links given as meshes.

        Raises InputError when it cannot be parsed or has no link `table`.
        """
        try:
            self._model = pin.buildModelFromXML(urdf_xml)
            tree = ET.fromstring(urdf_xml)
            links, joints = tree.findall("link"), tree.findall("joint")
        except (ValueError, RuntimeError, ET.ParseError) as error:
            raise InputError(f"The robot description is not a valid URDF: {str(error).strip()}") from None
        if TABLE_FRAME not in [link.get("name") for link in links]:
            raise InputError(f"The robot description has no link `{TABLE_FRAME}`; root it there, so that its poses are in the table frame.")
        self._data = self._model.createData()
        # A joint with more numbers, which floats or slides in a plane, has no single position, and is never known.
        single = [(name, self._model.joints[number]) for number, name in enumerate(self._model.names) if number > 0]
        self._place = {name: joint for name, joint in single if joint.nq <= 2}
        self._mimicked = {joint.attrib["name"]: _followed(mimic) for joint in joints if (mimic := joint.find("mimic")) is not None}
        self._rods = [
            (self._model.getFrameId(link.attrib["name"]), rod)
            for link in links
            for collision in link.iter("collision")
            for rod in self._solid(link.attrib["name"], collision, link_radius)
        ]
        self._needed = {frame: self._joints_of(frame) for frame, _ in self._rods}

    def at(self, positions: Mapping[str, float]) -> list[Rod]:
        """The solids in the table frame for joint positions by name [rad, m]; those behind a joint without one are left out."""
        q, known = pin.neutral(self._model), self._with_mimics(positions)
        for name, joint in self._place.items():
            if name in known:
                # A joint without limits is held as cosine and sine.
                value = [known[name]] if joint.nq == 1 else [np.cos(known[name]), np.sin(known[name])]
                q[joint.idx_q : joint.idx_q + joint.nq] = value
        pin.forwardKinematics(self._model, self._data, q)
        pin.updateFramePlacements(self._model, self._data)
        placed = [(frame, rod) for frame, rod in self._rods if self._needed[frame] <= known.keys()]
        return [rod.moved(np.array(self._data.oMf[frame].homogeneous)) for frame, rod in placed]

    def joints_without(self, positions: Mapping[str, float]) -> list[str]:
        """Joints that place some solid and have no position, in the order of the description."""
        known, needed = self._with_mimics(positions), frozenset[str]().union(*self._needed.values())
        return [name for name in self._model.names if name in needed - known.keys()]

    def _with_mimics(self, positions: Mapping[str, float]) -> dict[str, float]:
        """Positions, and those of the joints that follow others, as those of a gripper do."""
        known = {name: value for name, value in positions.items() if name in self._place}
        for name, (followed, multiplier, offset) in self._mimicked.items():
            if name in self._place and name not in known and followed in known:
                known[name] = multiplier * known[followed] + offset
        return known

    def _joints_of(self, frame: int) -> frozenset[str]:
        """Names of the joints between the table and a frame."""
        joint, names = self._model.frames[frame].parentJoint, set()
        while joint > 0:
            names.add(self._model.names[joint])
            joint = self._model.parents[joint]
        return frozenset(names)

    def _solid(self, link: str, collision: ET.Element, link_radius: float) -> list[Rod]:
        """The rods of one collision element, frame of its link."""
        solid = collision.find("geometry/*")
        if solid is None:
            return []
        origin = collision.find("origin")
        placed = np.eye(4)
        if origin is not None:
            placed[:3, 3] = _numbers(origin.get("xyz", "0 0 0"))
            placed[:3, :3] = pin.rpy.rpyToMatrix(*_numbers(origin.get("rpy", "0 0 0")))
        if solid.tag == "mesh":
            return self._between_joints(link, link_radius)
        if solid.tag == "cylinder":
            half, radius = 0.5 * float(solid.attrib["length"]), float(solid.attrib["radius"])
            axis = 2
        elif solid.tag == "sphere":
            half = radius = float(solid.attrib["radius"])
            axis = 2
        else:
            edges = _numbers(solid.attrib["size"])
            axis = int(np.argmax(edges))
            half, radius = 0.5 * float(edges[axis]), 0.5 * float(np.linalg.norm(np.delete(edges, axis)))
        direction = half * np.eye(3)[axis]
        return [Rod(-direction, direction, radius).moved(placed)]

    def _between_joints(self, link: str, radius: float) -> list[Rod]:
        """Rods from the origin of the link to each of its child joints, or one around its origin where it has none."""
        frame = self._model.frames[self._model.getFrameId(link)]
        joint, in_link, start = frame.parentJoint, frame.placement.inverse(), np.zeros(3)
        ends = [np.array(in_link.act(self._model.jointPlacements[child].translation)) for child in self._model.children[joint]]
        rods = []
        for end in ends or [start]:
            length = float(np.linalg.norm(end - start))
            direction = (end - start) / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
            rods.append(Rod(start - radius * direction, end + radius * direction, radius))
        return rods


def _followed(mimic: ET.Element) -> tuple[str, float, float]:
    """Name of the joint that another one follows, multiplier and offset: numbers, or the parser would have refused the description."""
    return mimic.get("joint", ""), float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))


def _numbers(text: str) -> Float64Array:
    return np.array([float(word) for word in text.split()])
