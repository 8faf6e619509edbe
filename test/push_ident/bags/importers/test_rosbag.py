"""Bags with other topics: what a topic holds is said by the user."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.bags import header_msg, new, pose_msg, write_raw
from helpers.commands import check_refused, run_here
from helpers.recordings import table_file
from push_ident.bags.importers.rosbag import parse_map
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.bags.writer import BagWriter
from push_ident.errors import InputError
from push_ident.types import Float64Array, PushRecord

N = 6


@pytest.fixture
def foreign(tmp_path: Path, rows: tuple[Float64Array, Float64Array]) -> Path:
    """Object as PoseStamped, tool as one of two transforms, force on the sensor."""
    poses, pusher = rows
    still = new("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    force, torque = new("geometry_msgs/msg/Vector3", -1.0, 0.5, 0.0), new("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    with BagWriter(tmp_path / "foreign") as writer:
        for t, x, y, yaw in np.add(poses, [10.0, 0, 0, 0]).tolist():
            write(writer, "/vrpn/hammer/pose", "geometry_msgs/msg/PoseStamped", t, header_msg(t, "world"), pose_msg(x, y, 0.03, yaw))
        for t, x, y, _ in np.add(pusher, [10.0, 0, 0, 0]).tolist():
            places = ("tool0", new("geometry_msgs/msg/Vector3", x, y, 0.01)), ("elbow", new("geometry_msgs/msg/Vector3", x + 9.0, y, 0.01))
            own = header_msg(t, "base")
            transforms = [
                new("geometry_msgs/msg/TransformStamped", own, child, new("geometry_msgs/msg/Transform", place, still))
                for child, place in places
            ]
            write(writer, "/tf", "tf2_msgs/msg/TFMessage", t, transforms)
            write(writer, "/ft", "geometry_msgs/msg/WrenchStamped", t, own, new("geometry_msgs/msg/Wrench", force, torque))
    return tmp_path / "foreign"


def write(writer: BagWriter, topic: str, msgtype: str, stamp: float, *fields: Any) -> None:
    write_raw(writer, msgtype, topic, round(1e9 * stamp), *fields)


def arguments(bag: Path, folder: Path, pushed: list[PushRecord], *more: object) -> list[object]:
    outline = table_file(folder / "outline.csv", "x_mm,y_mm", 1e3 * pushed[0].shape.outline)
    given = ("--outline", outline, "--radius", 0.008, "--cell-size", 0.011, "--position-std", 2e-4, "--yaw-std", 2e-3)
    return ["import", "rosbag", bag, *given, "--out", folder / "own", *more]


MAP = ("--map", "/vrpn/hammer/pose=object", "--map", "/tf#tool0=pusher")


def test_mapped_topics_become_a_bag_of_the_contract(tmp_path: Path, foreign: Path, pushed: list[PushRecord]) -> None:
    more = ("--map", "ft=wrench", "--wrench-on-sensor", "--pusher-frame", "0,0,0", "--object", "hammer")
    done = run_here(*arguments(foreign, tmp_path, pushed, *MAP, *more))
    assert done.returncode == 0 and "warning" not in done.stderr, done.stderr
    pushes = split_pushes(read_bag(tmp_path / "own"), "hammer")
    assert len(pushes) == N and (tmp_path / "own_import.html").exists()
    for push, record in zip(pushes, pushed, strict=True):
        np.testing.assert_allclose(push.pusher.position[[0, -1]], record.pusher.position[[0, -1]], atol=1e-3)
        np.testing.assert_allclose(push.poses.pose[[0, -1], :2], record.poses.pose[[0, -1], :2], atol=2e-3)
        assert push.wrench is not None and (push.wrench.force == [1.0, -0.5]).all()


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        (MAP, "--pusher-frame X,Y,YAW"),
        (("--map", "/vrpn/hammer/pose=object", "--map", "/tf=pusher"), "/tf#FRAME"),
        (("--map", "/vrpn/hammer/pose=object", "--map", "/tf#nose=pusher"), "elbow, tool0"),
        (("--map", "/ft=object", "--map", "/tf#tool0=pusher"), "needs poses"),
        ((*MAP, "--pusher-frame", "1,2"), "X,Y,YAW"),
        (("--map", "/tf#tool0=pusher"), "no topic for object"),
        ((*MAP, "--pusher-frame", "500,0,0"), "at most 100 m"),
    ],
)
def test_what_a_map_gets_wrong_ends_in_one_line(
    tmp_path: Path, foreign: Path, pushed: list[PushRecord], more: tuple[str, ...], reason: str
) -> None:
    check_refused(reason, *arguments(foreign, tmp_path, pushed, *more))
    assert not (tmp_path / "own").exists()


def test_roles_that_are_none_are_refused() -> None:
    assert parse_map(["/a=object", "/b=c=pusher"]) == {"object": "/a", "pusher": "/b=c"}
    for wrong in (["/a"], ["/a=arm"], ["=object"], ["/a=object", "/b=object", "/c=pusher"]):
        with pytest.raises(InputError, match="--map"):
            parse_map(wrong)
