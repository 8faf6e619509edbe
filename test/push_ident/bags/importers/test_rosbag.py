"""Bags with other topics: what a topic holds is said by the user."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.commands import run_here
from helpers.recordings import table_file
from push_ident.bags.importers.rosbag import parse_map
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.bags.typestore import jazzy_typestore
from push_ident.bags.writer import BagWriter
from push_ident.errors import InputError
from push_ident.types import Float64Array, PushRecord

N = 6


def new(msgtype: str, *fields: Any) -> Any:
    return jazzy_typestore().types[msgtype](*fields)


def header(stamp: float, frame: str) -> Any:
    return new("std_msgs/msg/Header", new("builtin_interfaces/msg/Time", int(stamp), round(1e9 * (stamp % 1.0))), frame)


def quaternion(yaw: float) -> Any:
    return new("geometry_msgs/msg/Quaternion", 0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))


@pytest.fixture
def foreign(tmp_path: Path, rows: tuple[Float64Array, Float64Array]) -> Path:
    """Object as PoseStamped, tool as one of two transforms, force on the sensor."""
    poses, pusher = rows
    with BagWriter(tmp_path / "foreign") as writer:

        def write(topic: str, msgtype: str, stamp: float, *fields: Any) -> None:
            writer.write_raw(topic, msgtype, round(1e9 * stamp), jazzy_typestore().serialize_cdr(new(msgtype, *fields), msgtype))

        for t, x, y, yaw in (poses + np.array([10.0, 0, 0, 0])).tolist():
            pose = new("geometry_msgs/msg/Pose", new("geometry_msgs/msg/Point", x, y, 0.03), quaternion(yaw))
            write("/vrpn/hammer/pose", "geometry_msgs/msg/PoseStamped", t, header(t, "world"), pose)
        for t, x, y, _ in (pusher + np.array([10.0, 0, 0, 0])).tolist():
            transforms = [
                new(
                    "geometry_msgs/msg/TransformStamped",
                    header(t, "base"),
                    child,
                    new("geometry_msgs/msg/Transform", new("geometry_msgs/msg/Vector3", x + 9.0 * far, y, 0.01), quaternion(0.0)),
                )
                for far, child in enumerate(("tool0", "elbow"))
            ]
            write("/tf", "tf2_msgs/msg/TFMessage", t, transforms)
            vectors = [new("geometry_msgs/msg/Vector3", *v) for v in ((-1.0, 0.5, 0.0), (0.0, 0.0, 0.0))]
            write("/ft", "geometry_msgs/msg/WrenchStamped", t, header(t, "base"), new("geometry_msgs/msg/Wrench", *vectors))
    return tmp_path / "foreign"


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
    done = run_here(*arguments(foreign, tmp_path, pushed, *more))
    assert done.returncode == 1 and reason in done.stderr and done.stderr.count("\n") == 1, done.stderr
    assert not (tmp_path / "own").exists()


def test_roles_that_are_none_are_refused() -> None:
    assert parse_map(["/a=object", "/b=c=pusher"]) == {"object": "/a", "pusher": "/b=c"}
    for wrong in (["/a"], ["/a=arm"], ["=object"], ["/a=object", "/b=object", "/c=pusher"]):
        with pytest.raises(InputError, match="--map"):
            parse_map(wrong)
