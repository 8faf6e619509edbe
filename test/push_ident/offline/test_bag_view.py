"""A bag as Rerun shows it: every topic, objects and pusher drawn, each view with data. The release test opens it in the real viewer."""

from __future__ import annotations

import re
import socket
import subprocess
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from helpers.bags import header_msg, make_record, new, write_push, write_raw
from helpers.commands import check_refused, run_here
from helpers.paths import EXAMPLE_BAG
from push_ident.bags.records import write_records
from push_ident.bags.writer import BagWriter

rerun = pytest.importorskip("rerun")
OPENS_WITHIN = 120.0
"""Longest time for the viewer to start and draw without a graphics card, on a loaded machine [s]."""
VIEWS = {
    "camera": ["Table", "Depth", "Force on the object [N]"],
    "tracked": ["Table", "Force on the object [N]", "Position of the object [m]"],
}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Of the example bag, which has depth images, and of a bag with poses."""
    folder = tmp_path_factory.mktemp("views")
    write_records(folder / "tracked", [make_record(1.0, object_id="7"), make_record(4.0, object_id="7")])
    bags = {"camera": EXAMPLE_BAG, "tracked": folder / "tracked"}
    for name, bag in bags.items():
        done = run_here("view", bag, "--out", folder / f"{name}.rrd")
        assert done.returncode == 0 and f"({', '.join(VIEWS[name])})" in done.stdout, done.stdout + done.stderr
    return {name: folder / f"{name}.rrd" for name in bags}


COLOURS = {"camera": ((213, 94, 0), (0, 114, 178)), "tracked": ((213, 94, 0), (0, 114, 178), (0, 158, 115))}
"""Forces along x and y, the pusher like the second; of a tracked object its outline."""


def missing(client: Any, name: str) -> str:
    """What the picture of a viewer lacks, and what its views complain of; empty when all is there."""
    state = client.get_state()
    if not state.views or state.loading:
        return "the recording"
    # At its end: before the first message of a topic Rerun has no frame for it, and says so.
    (line,) = (line for line in state.recordings[0].timelines if line.name == "message_log_time")
    client.set_time(line.name, timestamp=np.datetime64(line.end, "ns"), play_state="paused")
    shot = cv2.imdecode(np.frombuffer(client.take_screenshot(), np.uint8), cv2.IMREAD_COLOR)
    difference = [np.abs(shot[:, :, ::-1].astype(int) - colour).max(axis=2) for colour in COLOURS[name]]
    lacking = [str(colour) for colour, values in zip(COLOURS[name], difference, strict=True) if np.count_nonzero(values < 30) < 10]
    reports = [f"{view.name}: {report.summary}" for view in client.get_state().views for report in view.reports]
    return "; ".join([*lacking, *reports, *sorted({view.name for view in state.views} ^ set(VIEWS[name]))])


def components(recording: Path) -> dict[str, set[str]]:
    """Components of each entity of a recording."""
    from rerun.chunk import RrdReader

    found: dict[str, set[str]] = {}
    for column in RrdReader(recording).store().schema().component_columns():
        found.setdefault(column.entity_path, set()).add(column.component)
    return found


def test_recording_has_what_each_view_shows(recordings: dict[str, Path]) -> None:
    camera, tracked = (components(recordings[name]) for name in ("camera", "tracked"))
    assert {"DepthImage:buffer", "CoordinateFrame:frame"} <= camera["/depth/image_rect"]
    assert {"Pinhole:image_from_camera", "Pinhole:parent_frame"} <= camera["/depth/camera_info"]
    assert "Transform3D:child_frame" in camera["/tf_static"] and "/push_record" in camera
    for found in (camera, tracked):
        assert "geometry_msgs.msg.WrenchStamped:message" in found["/pusher/wrench"]
        assert {"InstancePoses3D:translations", "Cylinders3D:radii"} <= found["/pusher/pose"]
    assert "geometry_msgs.msg.PoseWithCovarianceStamped:message" in tracked["/objects/7/pose"]
    assert {"LineStrips3D:strips", "CoordinateFrame:frame"} <= tracked["/objects/7/outline"]
    assert {"Transform3D:parent_frame", "Transform3D:child_frame"} <= tracked["/frames/object_7"]
    assert "GridMap:data" in tracked["/objects/7/cells"]


def test_frame_that_a_bag_knows_is_not_given_twice(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        write_push(writer, 1.0)
        moved = [new("geometry_msgs/msg/" + kind, 0.1, 0.2, 0.0, *rest) for kind, rest in (("Vector3", ()), ("Quaternion", (1.0,)))]
        transform = new("geometry_msgs/msg/Transform", *moved)
        of_object = new("geometry_msgs/msg/TransformStamped", header_msg(1.0, "table"), "object_7", transform)
        write_raw(writer, "tf2_msgs/msg/TFMessage", "/tf", 10**9, [of_object])
    assert run_here("view", tmp_path / "bag", "--out", tmp_path / "bag.rrd").returncode == 0
    found = components(tmp_path / "bag.rrd")
    assert "/frames/object_7" not in found and "Transform3D:child_frame" in found["/tf"]


def test_what_rerun_cannot_read_is_refused_with_the_way_out(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "other.mcap") as writer:
        writer.write_raw("/light", "std_msgs/msg/Bool", 0, b"\x00\x01\x00\x00\x01")
    check_refused("none of its topics", "view", tmp_path / "other.mcap", "--out", tmp_path / "other.rrd")
    (tmp_path / "link.rrd").symlink_to(tmp_path / "target")
    check_refused("is a link", "view", EXAMPLE_BAG, "--out", tmp_path / "link.rrd")


@pytest.mark.release
@pytest.mark.parametrize("name", VIEWS)
def test_rerun_itself_shows_every_view_without_an_error(recordings: dict[str, Path], name: str, tmp_path: Path) -> None:
    """The real viewer, without a window; it draws with Vulkan, on the processor where Debian's mesa-vulkan-drivers is installed."""
    from rerun.experimental import ViewerClient

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    call = ["rerun", "--headless", "--window-size", "1200x800", "--bind", "127.0.0.1", "--port", str(port), str(recordings[name])]
    log = tmp_path / "log"
    with log.open("w") as output, subprocess.Popen(call, stdout=output, stderr=subprocess.STDOUT) as viewer:
        try:
            deadline, lacking = time.monotonic() + OPENS_WITHIN, "a viewer"
            while lacking and time.monotonic() < deadline:
                if viewer.poll() is not None:
                    assert re.search("graphics adapter|render context", log.read_text()), log.read_text()
                    pytest.skip("nothing here can draw; install mesa-vulkan-drivers")
                time.sleep(0.2)
                try:
                    lacking = missing(ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy"), name)
                except Exception as error:  # until it listens
                    lacking = str(error)
            assert lacking == ""
        finally:
            viewer.kill()
