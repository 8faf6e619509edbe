"""Tools that are no cylinder, in bags: written, read back, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from push_ident.bags.contract import Role
from push_ident.bags.decode import pusher_shape_of
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.bags.records import write_records
from push_ident.bags.typestore import jazzy_typestore
from push_ident.errors import InputError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.types import ObjectShape, PoseTrack, PusherPath, PusherShape, PushRecord

LINE = np.array([[0.0, 0.012], [0.0, -0.012]])
TOOLS = {
    "cylinder": PusherShape(0.008),
    "fingers": PusherShape(0.003, fingers=LINE),
    "plate": PusherShape(0.003, polygon=LINE),
    "prism": PusherShape(0.0, polygon=np.array([[0.0, 0.0], [0.02, 0.0], [0.0, 0.02]])),
}


def record(tool: PusherShape) -> PushRecord:
    outline = np.array([[-0.03, -0.02], [0.03, -0.02], [0.03, 0.02], [-0.03, 0.02]])
    time = np.linspace(2.0, 3.0, 11)
    # Through half a turn, where a yaw in a message jumps.
    yaw = None if tool.is_cylinder else np.linspace(2.8, 3.6, 11)
    path = PusherPath(time, np.column_stack([0.1 * time, 0.2 * time]), tool.radius, tool.polygon, yaw, tool.fingers)
    poses = PoseTrack(np.array([2.0, 3.0]), np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.1]]), np.tile(1e-6 * np.eye(3), (2, 1, 1)))
    return PushRecord("1", ObjectShape(cells_in_outline(outline, 0.01), outline), poses, path)


@pytest.mark.parametrize("name", TOOLS)
def test_a_tool_and_its_heading_are_read_as_they_were_written(name: str, tmp_path: Path) -> None:
    written = record(TOOLS[name])
    write_records(tmp_path / "bag", [written])
    contents = read_bag(tmp_path / "bag")
    (push,) = split_pushes(contents, "1")
    assert contents.pusher_radius == pytest.approx(TOOLS[name].radius)
    assert push.pusher.shape.core == pytest.approx(TOOLS[name].core, abs=1e-9)
    assert (push.pusher.fingers is None, push.pusher.polygon is None) == (name != "fingers", name not in ("plate", "prism"))
    assert push.pusher.position == pytest.approx(written.pusher.position, abs=1e-12)
    if name == "cylinder":
        assert push.pusher.yaw is None
    else:
        assert push.pusher.yaw == pytest.approx(written.pusher.yaw, abs=1e-9)


def test_pushes_of_different_tools_share_no_bag(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="different pushers"):
        write_records(tmp_path / "bag", [record(TOOLS["plate"]), record(TOOLS["fingers"])])


def primitive(kind: int, dimensions: list[float], points: list[tuple[float, float]]) -> Any:
    types: Any = jazzy_typestore().types
    corners = [types["geometry_msgs/msg/Point32"](x, y, 0.0) for x, y in points]
    return types[Role.PUSHER_SHAPE.msgtype](kind, np.array(dimensions), types["geometry_msgs/msg/Polygon"](corners))


def test_shapes_that_no_tool_has_are_refused_and_others_say_nothing() -> None:
    box, cylinder, prism = 1, 3, 5
    assert pusher_shape_of(primitive(box, [0.1, 0.1, 0.1], [])) is None
    assert pusher_shape_of(primitive(cylinder, [0.1], [])) is None and pusher_shape_of(primitive(prism, [], [])) is None
    square = [(0.0, 0.0), (0.01, 0.0), (0.01, 0.01), (0.0, 0.01)]
    for kind, dimensions, points, words in (
        (cylinder, [0.1, 0.003], [(0.0, 0.01)], "fingers"),
        (cylinder, [0.1, 0.003], [(0.0, 0.01), (0.0, 0.011)], "diameter"),
        (cylinder, [0.1, 0.003], [(0.0, 10.0), (0.0, -10.0)], "metres"),
        (cylinder, [0.1, np.nan], [], "radius"),
        (prism, [0.1, 0.0], square[:2], "two ends of a plate"),
        (prism, [0.1, 0.0], square[::-1], "counter-clockwise"),
        (prism, [0.1, 0.0], [(np.nan, 0.0), *square[1:]], "metres"),
    ):
        with pytest.raises(InputError, match=words):
            pusher_shape_of(primitive(kind, dimensions, points))
