"""The layouts for RViz and Foxglove name topics, fields and frames that exist, in the types and with the durability of their publishers.

Neither program runs here: their formats are what is written in the files themselves.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterator
from typing import Any

import yaml

from helpers.fuzzing.right import right_messages
from helpers.paths import CONFIG
from helpers.tools import tool
from push_ident.geometry.frames import TABLE_FRAME
from push_ident_msgs import msg as messages

TYPES = {
    "Map": "OccupancyGrid",
    "MarkerArray": "MarkerArray",
    "Path": "Path",
    "PoseWithCovariance": "PoseWithCovarianceStamped",
    "RobotModel": "String",
    "Wrench": "WrenchStamped",
}
"""Message that a display of RViz (rviz_default_plugins) takes."""
DRAWN = {*TYPES.values(), "PolygonStamped", "PoseStamped", "PointCloud2"}
"""Messages that the 3D panel of Foxglove draws."""
OF_A_SENSOR = {"pusher/wrench", "depth/image_rect", "depth/camera_info", "joint_states"}
"""Drivers may publish these as sensor data (best effort)."""
TF = {"tf": "TFMessage", "tf_static": "TFMessage, latched"}


@functools.cache
def published() -> dict[str, str]:
    """Type of each topic that a node publishes, as the reference has it; of `<id>` for an object."""
    tools = tool("document_nodes")
    known = tools.modules(("push_ident/nodes", "push_ident/bags", "push_ident_sim/cell"))
    found = dict(TF)
    for module in known.values():
        if "create_publisher" in module.path.read_text(encoding="utf-8"):
            found |= {topic.removeprefix("/"): kind for verb, topic, kind in tools.entities(module, known) if verb == "publishes"}
    return found


def type_of(topic: str) -> str:
    return published()[re.sub("^objects/[^/]+", "objects/<id>", topic.removeprefix("/"))]


def displays() -> Iterator[dict[str, Any]]:
    todo = list(yaml.safe_load((CONFIG / "push_ident.rviz").read_text(encoding="utf-8"))["Visualization Manager"]["Displays"])
    while todo:
        display = todo.pop()
        todo += display.get("Displays", [])
        yield display


def test_displays_of_rviz_take_what_is_published_and_latched_messages_that_were_sent_before() -> None:
    topics = 0
    for display in displays():
        topic = display.get("Topic") or display.get("Description Topic")
        if topic is None:
            assert display["Class"] in ("rviz_common/Group", "rviz_default_plugins/Grid", "rviz_default_plugins/TF"), display["Name"]
            continue
        name, wanted = topic["Value"], TYPES[display["Class"].removeprefix("rviz_default_plugins/")]
        kind, _, latched = type_of(name).partition(", ")
        assert kind == wanted, name
        assert topic["Durability Policy"] == ("Transient Local" if latched else "Volatile"), name
        assert topic["Reliability Policy"] == ("Best Effort" if name.removeprefix("/") in OF_A_SENSOR else "Reliable"), name
        topics += 1
    assert topics >= 10


def test_what_rviz_shows_is_in_its_fixed_frame_unless_it_follows_frames() -> None:
    manager = yaml.safe_load((CONFIG / "push_ident.rviz").read_text(encoding="utf-8"))["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == TABLE_FRAME == manager["Views"]["Current"]["Target Frame"]
    shown = list(displays())
    if any(display["Class"].endswith("/TF") for display in shown):
        return
    for topic in (display["Topic"]["Value"].removeprefix("/") for display in shown if "Topic" in display):
        message = right_messages().get(topic)
        of_header = [message.header.frame_id] if hasattr(message, "header") else []
        frames = {*of_header, *(marker.header.frame_id for marker in getattr(message, "markers", ()))}
        assert frames <= {TABLE_FRAME}, topic


def test_panels_of_foxglove_name_topics_and_fields_that_exist() -> None:
    layout = json.loads((CONFIG / "foxglove_layout.json").read_text(encoding="utf-8"))
    panels = layout["configById"]

    def placed(part: Any) -> list[str]:
        return [part] if isinstance(part, str) else [*placed(part["first"]), *placed(part["second"])]

    assert sorted(placed(layout["layout"])) == sorted(panels)
    scene, image = panels["3D!table"], panels["Image!depth"]["imageMode"]
    assert scene["followTf"] == TABLE_FRAME == scene["layers"]["grid"]["frameId"]
    assert {type_of(topic).partition(",")[0] for topic in scene["topics"]} <= DRAWN
    assert [type_of(image[f"{kind}Topic"]) for kind in ("image", "calibration")] == ["Image", "CameraInfo"]
    assert type_of(panels["DiagnosticSummary!health"]["topicToRender"]) == "DiagnosticArray"
    assert type_of(panels["RawMessages!map"]["topicPath"]) == "MassFrictionMap, latched"
    curves = [path["value"] for path in panels["Plot!error"]["paths"]]
    assert len(curves) == 3
    for topic, _, field in (curve.partition(".") for curve in curves):
        fields = getattr(messages, type_of(topic).partition(",")[0]).get_fields_and_field_types()
        assert fields.get(field) == "double", f"{topic}.{field}"
