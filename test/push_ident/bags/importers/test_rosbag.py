"""Bags with other topics: what a topic holds is said by the user."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.bags import header_msg, new, pose_msg, write_raw
from helpers.commands import check_refused, run_here
from helpers.recordings import PERIOD, table_file
from push_ident.bags.importers.recording import without_lost
from push_ident.bags.importers.rosbag import parse_map
from push_ident.bags.opening import open_bag
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
    assert done.returncode == 0 and done.stderr.count("warning") == done.stderr.count(CONSTANT), done.stderr
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
        ((*MAP, "--pusher-frame", "500m,0,0"), "at most 100 m"),
    ],
)
def test_what_a_map_gets_wrong_ends_in_one_line(
    tmp_path: Path, foreign: Path, pushed: list[PushRecord], more: tuple[str, ...], reason: str
) -> None:
    check_refused(reason, *arguments(foreign, tmp_path, pushed, *more))
    assert not (tmp_path / "own").exists()


@dataclass(frozen=True)
class Message:
    """A message of the object (x, y, yaw), of the tool (x, y), or of a force."""

    topic: str
    logged: float
    """[s]"""
    stamp: float
    """[s]; 0: none."""
    values: tuple[float, ...]


def write_messages(bag: Path, messages: Sequence[Message], *, frames: Mapping[str, str] = {}) -> Path:
    """All in `world` unless `frames` names the frame of a topic; a yaw of NaN stands for a quaternion of zeros."""
    with BagWriter(bag) as writer:
        for message in messages:
            topic, logged, stamp, values = message.topic, message.logged, message.stamp, message.values
            if topic == "/ft":
                vectors = (new("geometry_msgs/msg/Vector3", *values, 0.0), new("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0))
                fields: tuple[Any, ...] = (header_msg(stamp, frames.get(topic, "world")), new("geometry_msgs/msg/Wrench", *vectors))
                write(writer, topic, "geometry_msgs/msg/WrenchStamped", logged, *fields)
                continue
            x, y, yaw = (*values, 0.0)[:3]
            pose = pose_msg(x, y, 0.0, 0.0 if np.isnan(yaw) else yaw)
            if np.isnan(yaw):
                pose.orientation.w = 0.0
            write(writer, topic, "geometry_msgs/msg/PoseStamped", logged, header_msg(stamp, frames.get(topic, "world")), pose)
    return bag


def messages_of(rows: tuple[Float64Array, Float64Array]) -> list[Message]:
    poses, pusher = (np.add(table, [10.0, 0, 0, 0]) for table in rows)
    body = [Message("/body", t, t, (x, y, yaw)) for t, x, y, yaw in poses.tolist()]
    tool = [Message("/tool", t, t, (x, y)) for t, x, y, _ in pusher.tolist()]
    return [*body, *tool, *(Message("/ft", t, t, (1.0, 0.0)) for t in pusher[:, 0].tolist())]


OWN_MAP = ("--map", "/body=object", "--map", "/tool=pusher")
WITH_FORCE = (*OWN_MAP, "--map", "/ft=wrench")


def late(messages: list[Message]) -> list[Message]:
    """Every tenth message comes after the next of its topic, unless the tool had paused."""
    for at in range(0, len(messages) - 1, 10):
        if messages[at].topic == messages[at + 1].topic and messages[at + 1].stamp - messages[at].stamp < 0.5:
            one, next_one = messages[at], messages[at + 1]
            messages[at : at + 2] = replace(next_one, logged=one.logged), replace(one, logged=next_one.logged)
    return messages


def unstamped(messages: list[Message]) -> list[Message]:
    return [replace(m, stamp=0.0, logged=1.7e9) if at % 50 == 0 else m for at, m in enumerate(messages)]


def lost(messages: list[Message]) -> list[Message]:
    zeros = {"/body": (0.0, 0.0, np.nan), "/tool": (0.0, 0.0), "/ft": (1.0, 0.0)}
    return [replace(m, values=zeros[m.topic]) if at % 40 == 5 else m for at, m in enumerate(messages)]


@pytest.mark.parametrize(("change", "note"), [(late, "are sorted"), (unstamped, "have no stamp; left out"), (lost, "tracking was lost")])
def test_messages_of_a_real_network_and_tracker_are_cleaned_with_a_note(
    tmp_path: Path,
    rows: tuple[Float64Array, Float64Array],
    pushed: list[PushRecord],
    change: Callable[[list[Message]], list[Message]],
    note: str,
) -> None:
    bag = write_messages(tmp_path / "changed", change(messages_of(rows)))
    done = run_here(*arguments(bag, tmp_path, pushed, *WITH_FORCE))
    assert done.returncode == 0 and note in done.stderr + done.stdout, done.stderr
    pushes = split_pushes(read_bag(tmp_path / "own"), "1")
    assert len(pushes) == N
    for push, record in zip(pushes, pushed, strict=True):
        np.testing.assert_allclose(push.poses.pose[[0, -1], :2], record.poses.pose[[0, -1], :2], atol=2e-3)


def test_a_force_in_a_frame_of_its_own_needs_its_axes(
    tmp_path: Path, rows: tuple[Float64Array, Float64Array], pushed: list[PushRecord]
) -> None:
    bag = write_messages(tmp_path / "turned", messages_of(rows), frames={"/ft": "ft_sensor_link"})
    check_refused("--wrench-axes", *arguments(bag, tmp_path, pushed, *WITH_FORCE))
    done = run_here(*arguments(bag, tmp_path, pushed, *WITH_FORCE, "--wrench-axes", "-y,x,z"))
    assert done.returncode == 0, done.stderr
    push = split_pushes(read_bag(tmp_path / "own"), "1")[0]
    assert push.wrench is not None and (push.wrench.force == [0.0, 1.0]).all()


@pytest.mark.parametrize(
    ("unnamed", "options", "n_notes", "refusal"),
    [
        (("/body", "/tool", "/ft"), (), 3, ""),
        (("/body", "/tool", "/ft"), ("--pusher-frame", "0,0,0", "--wrench-axes", "x,y,z"), 0, ""),
        (("/tool",), (), 0, "(/tool: no frame_id, taken as `table`), and no transforms"),
        (("/tool",), ("--pusher-frame", "0,0,0", "--wrench-axes", "x,y,z"), 0, ""),
        (("/body",), (), 0, "say with --pusher-frame X,Y,YAW"),
        (("/ft",), (), 0, "say with --wrench-axes"),
    ],
)
def test_a_frame_without_a_name_is_table_with_a_note_and_no_other_frame(
    tmp_path: Path,
    rows: tuple[Float64Array, Float64Array],
    pushed: list[PushRecord],
    unnamed: tuple[str, ...],
    options: tuple[str, ...],
    n_notes: int,
    refusal: str,
) -> None:
    bag = write_messages(tmp_path / "unnamed", messages_of(rows), frames=dict.fromkeys(unnamed, ""))
    if refusal:
        check_refused(refusal, *arguments(bag, tmp_path, pushed, *WITH_FORCE, *options))
        return
    done = run_here(*arguments(bag, tmp_path, pushed, *WITH_FORCE, *options, "--json", tmp_path / "report.json"))
    assert done.returncode == 0, done.stderr
    notes = json.loads((tmp_path / "report.json").read_text())["notes"]
    assert sum("no frame_id; taken as in `table`. If it is in another frame, give --" in note for note in notes) == n_notes, notes


def test_two_transforms_without_names_of_their_frames_do_not_meet(
    tmp_path: Path, rows: tuple[Float64Array, Float64Array], pushed: list[PushRecord]
) -> None:
    bag = write_messages(tmp_path / "bag", messages_of(rows), frames={"/tool": "base"})
    with BagWriter(tmp_path / "linked") as writer, open_bag(bag) as recorded:
        links = [turned_msg(child, parent, 1.0, *Cell().base) for child, parent in (("", "world"), ("base", ""))]
        write(writer, "/tf_static", "tf2_msgs/msg/TFMessage", 1.0, links)
        for topic, stamp, data in recorded.raw_messages():
            writer.write_raw(topic.topic, topic.msgtype, stamp, bytes(data))
    check_refused("no transforms of the bag lead from one to the other", *arguments(tmp_path / "linked", tmp_path, pushed, *OWN_MAP))


def test_a_force_on_another_clock_is_refused(tmp_path: Path, rows: tuple[Float64Array, Float64Array], pushed: list[PushRecord]) -> None:
    messages = [replace(m, stamp=0.0, logged=m.logged + 1.7e9) if m.topic == "/ft" else m for m in messages_of(rows)]
    bag = write_messages(tmp_path / "clocks", messages)
    check_refused("leave the force out", *arguments(bag, tmp_path, pushed, *WITH_FORCE))


def test_roles_that_are_none_are_refused() -> None:
    assert parse_map(["/a=object", "/b=c=pusher"]) == {"object": "/a", "pusher": "/b=c"}
    for wrong in (["/a"], ["/a=arm"], ["=object"], ["/a=object", "/b=object", "/c=pusher"]):
        with pytest.raises(InputError, match="--map"):
            parse_map(wrong)


def scaled(messages: list[Message], factor: float, topics: tuple[str, ...] = ("/body", "/tool")) -> list[Message]:
    return [replace(m, values=(factor * m.values[0], factor * m.values[1], *m.values[2:])) if m.topic in topics else m for m in messages]


@pytest.mark.parametrize(
    ("factor", "topics", "options", "words", "mended"),
    [
        (1e3, ("/body", "/tool"), (), "Then give --length-unit mm or cm", ("--length-unit", "mm")),
        (1e3, ("/tool",), (), "Then give --pusher-length-unit mm or cm", ("--pusher-length-unit", "mm")),
        (1e2, ("/body", "/tool"), (), "poses and pusher are in cm: check --length-unit", ("--length-unit", "cm")),
        (1e2, ("/tool",), (), "pusher are in cm: check --pusher-length-unit", ("--pusher-length-unit", "cm")),
        (1e3, ("/body", "/tool"), ("--length-unit", "cm"), "are in mm instead of cm: check --length-unit", ("--length-unit", "mm")),
        (1.0, ("/body", "/tool"), ("--length-unit", "mm"), "another --length-unit given", ()),
    ],
)
def test_lengths_in_another_unit_are_named_with_an_option_that_mends_them(
    tmp_path: Path,
    rows: tuple[Float64Array, Float64Array],
    pushed: list[PushRecord],
    factor: float,
    topics: tuple[str, ...],
    options: tuple[str, ...],
    words: str,
    mended: tuple[str, ...],
) -> None:
    bag = write_messages(tmp_path / "units", scaled(messages_of(rows), factor, topics))
    wrong = run_here(*arguments(bag, tmp_path, pushed, *OWN_MAP, *options, "--out", tmp_path / "wrong"))
    assert words in wrong.stderr and "--angle-unit" not in wrong.stderr, wrong.stderr
    done = run_here(*arguments(bag, tmp_path, pushed, *OWN_MAP, *mended))
    assert done.returncode == 0 and done.stderr.count("warning") == done.stderr.count(CONSTANT), done.stderr
    for push, record in zip(split_pushes(read_bag(tmp_path / "own"), "1"), pushed, strict=True):
        np.testing.assert_allclose(push.poses.pose[[0, -1], :2], record.poses.pose[[0, -1], :2], atol=2e-3)


@pytest.mark.parametrize("role", ["object", "pusher", "wrench"])
def test_a_message_of_another_type_is_named_and_the_bag_not_called_damaged(
    tmp_path: Path, rows: tuple[Float64Array, Float64Array], pushed: list[PushRecord], role: str
) -> None:
    bag = write_messages(tmp_path / "types", messages_of(rows))
    with BagWriter(tmp_path / "with_joints") as writer, open_bag(bag) as recorded:
        for topic, stamp, data in recorded.raw_messages():
            writer.write_raw(topic.topic, topic.msgtype, stamp, bytes(data))
        numbers = np.zeros(2)
        write(writer, "/joints", "sensor_msgs/msg/JointState", 10.0, header_msg(10.0, "world"), ["a", "b"], numbers, numbers, numbers)
    maps = {"object": "/body", "pusher": "/tool", "wrench": "/ft"} | {role: "/joints"}
    options = [word for own, topic in maps.items() for word in ("--map", f"{topic}={own}")]
    done = run_here(*arguments(tmp_path / "with_joints", tmp_path, pushed, *options))
    assert done.returncode == 1 and "holds JointState (sensor_msgs/msg/JointState); expected one of" in done.stderr, done.stderr
    assert not {"salvage", "damaged", "recovered"} & set(done.stderr.replace("`", " ").split())


def turned_msg(child: str, parent: str, stamp: float, shift: Sequence[float], turn: Rotation) -> Any:
    pose = new("geometry_msgs/msg/Vector3", *map(float, shift)), new("geometry_msgs/msg/Quaternion", *map(float, turn.as_quat()))
    return new("geometry_msgs/msg/TransformStamped", header_msg(stamp, parent), child, new("geometry_msgs/msg/Transform", *pose))


@dataclass(frozen=True)
class Cell:
    """A camera that looks down obliquely, and an arm that moves: `world` -> `rig` -> `eye`, `world` -> `base` -> `arm` -> `tool`."""

    rig: tuple[tuple[float, ...], Rotation] = ((0.3, -0.2, 0.8), Rotation.from_euler("xyz", [2.4, 0.1, 0.5]))
    eye: tuple[tuple[float, ...], Rotation] = ((0.0, 0.02, 0.01), Rotation.from_euler("z", -0.4))
    base: tuple[tuple[float, ...], Rotation] = ((-0.5, 0.1, 0.05), Rotation.from_euler("z", 1.1))
    tool: tuple[tuple[float, ...], Rotation] = ((0.01, 0.02, 0.1), Rotation.from_euler("x", np.pi))

    def in_world(self, *links: str) -> tuple[Rotation, Float64Array]:
        turn, shift = Rotation.identity(), np.zeros(3)
        for link in links:
            own_shift, own_turn = getattr(self, link)
            turn, shift = turn * own_turn, shift + turn.apply(own_shift)
        return turn, shift

    def write(
        self, bag: Path, rows: tuple[Float64Array, Float64Array], *, with_links: tuple[str, ...] = ("rig", "eye", "base", "tool")
    ) -> Path:
        """Poses in `eye`, forces in `tool`, the arm as a transform that turns while it moves."""
        poses, pusher = (np.add(table, [10.0, 0, 0, 0]) for table in rows)
        parents = {"rig": "world", "eye": "rig", "base": "world", "tool": "arm"}
        zero = new("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        with BagWriter(bag) as writer:
            static = [turned_msg(child, parents[child], 1.0, *getattr(self, child)) for child in with_links]
            if static:
                write(writer, "/tf_static", "tf2_msgs/msg/TFMessage", 1.0, static)
            camera, at = self.in_world("rig", "eye")
            for t, x, y, yaw in poses.tolist():
                turn = (camera.inv() * Rotation.from_euler("z", yaw)).as_quat()
                place = new("geometry_msgs/msg/Point", *map(float, camera.inv().apply(np.array([x, y, 0.02]) - at)))
                pose = new("geometry_msgs/msg/Pose", place, new("geometry_msgs/msg/Quaternion", *map(float, turn)))
                write(writer, "/body", "geometry_msgs/msg/PoseStamped", t, header_msg(t, "eye"), pose)
            base, at = self.in_world("base")
            for t, x, y, _ in pusher.tolist():
                spin = Rotation.from_euler("z", 0.3 * t)
                arm = base.inv() * spin
                tip = base.inv().apply(np.array([x, y, 0.03]) - at)
                write(writer, "/tf", "tf2_msgs/msg/TFMessage", t, [turned_msg("arm", "base", t, tip - arm.apply(self.tool[0]), arm)])
                force = (spin * self.tool[1]).inv().apply([1.0, -0.5, 0.0])
                vectors = new("geometry_msgs/msg/Vector3", *map(float, force)), zero
                write(writer, "/ft", "geometry_msgs/msg/WrenchStamped", t, header_msg(t, "tool"), new("geometry_msgs/msg/Wrench", *vectors))
        return bag


CONSTANT = "warning: no force is measured while the pusher drives"
"""What is said of the force of these bags, which is the same with contact and without."""
IN_TF = ("--map", "/body=object", "--map", "/tf_static#tool=pusher", "--map", "/ft=wrench")


@pytest.mark.parametrize("topic", ["/tf", "/tf_static"])
def test_frames_are_followed_through_the_transforms_of_the_bag(
    tmp_path: Path, rows: tuple[Float64Array, Float64Array], pushed: list[PushRecord], topic: str
) -> None:
    bag = Cell().write(tmp_path / "cell", rows)
    done = run_here(*arguments(bag, tmp_path, pushed, *(word.replace("/tf_static", topic) for word in IN_TF)))
    assert done.returncode == 0 and done.stderr.count("warning") == done.stderr.count(CONSTANT), done.stderr
    assert "from `eye` to `world`" in done.stdout and "from `tool` to `world` by the transforms of the bag at the time" in done.stdout
    pushes = split_pushes(read_bag(tmp_path / "own"), "1")
    assert len(pushes) == N
    for push, record in zip(pushes, pushed, strict=True):
        np.testing.assert_allclose(push.pusher.position[[0, -1]], record.pusher.position[[0, -1]], atol=1e-3)
        np.testing.assert_allclose(push.poses.pose[[0, -1]], record.poses.pose[[0, -1]], atol=1e-2)
        assert push.wrench is not None
        np.testing.assert_allclose(push.wrench.force, np.tile([1.0, -0.5], (len(push.wrench.force), 1)), atol=1e-6)


@pytest.mark.parametrize(
    ("lacking", "more", "reason", "offered"),
    [
        ("rig", (), "no transforms of the bag lead", False),  # the arm moves in `base`
        ("tool", (), "holds transforms of base, eye, rig", False),
        ("", ("--frame", "rig"), "define the rigid body with z up", False),
        ("", ("--frame", "nose"), "it has arm, base, eye", False),
    ],
)
def test_what_transforms_lack_ends_in_one_line_without_a_remedy_that_cannot_be(
    tmp_path: Path,
    rows: tuple[Float64Array, Float64Array],
    pushed: list[PushRecord],
    lacking: str,
    more: tuple[str, ...],
    reason: str,
    offered: bool,
) -> None:
    bag = Cell().write(tmp_path / "cell", rows, with_links=tuple(name for name in ("rig", "eye", "base", "tool") if name != lacking))
    done = run_here(*arguments(bag, tmp_path, pushed, *IN_TF, *more))
    assert done.returncode == 1 and reason in done.stderr and done.stderr.strip().count("\n") == 0, done.stderr
    assert ("--pusher-frame" in done.stderr) is offered


def test_transforms_that_go_round_in_a_circle_or_are_of_another_time_are_refused(
    tmp_path: Path, rows: tuple[Float64Array, Float64Array], pushed: list[PushRecord]
) -> None:
    bag = Cell().write(tmp_path / "cell", rows)
    for name, child, parent, shift in (("circle", "world", "eye", 0.0), ("times", "base", "world", 1e4)):
        with BagWriter(tmp_path / name) as writer, open_bag(bag) as recorded:
            for topic, stamp, data in recorded.raw_messages():
                writer.write_raw(topic.topic, topic.msgtype, stamp, bytes(data))
            for stamp in (100.0, 101.0):
                one = turned_msg(child, parent, stamp + shift, *Cell().base)
                write(writer, "/tf", "tf2_msgs/msg/TFMessage", stamp, [one])
        reason = "round in a circle" if name == "circle" else "are of other times"
        check_refused(reason, *arguments(tmp_path / name, tmp_path, pushed, *IN_TF))


@pytest.mark.parametrize("turn", [(), (0.0, 0.0, 0.0, 1.0)])
def test_a_lost_pusher_is_told_from_one_that_is_moved_afar_in_a_pause_or_passes_the_origin(turn: tuple[float, ...]) -> None:
    rng, dt = np.random.default_rng(0), 0.01
    time = np.concatenate([k * 5.0 + dt * np.arange(100) for k in range(4)])
    along = np.tile(np.linspace(-0.05, 0.05, 100), 4)
    across = np.repeat([0.1, -0.2, 0.3, 0.0], 100)  # in the pauses it goes farther than to the origin
    rows = np.column_stack([time, along, across, np.full(400, 0.01), np.tile(turn, (400, 1))])
    rows[:, 1:3] += rng.normal(scale=1e-4, size=(400, 2))
    lost = rows.copy()
    at = np.r_[20:25, 130, 180:199, 260]
    lost[at, 1:4] = 0.0
    notes: list[str] = []
    found = without_lost(lost, "/tool", notes)
    assert np.flatnonzero(np.isnan(found[:, 1])).tolist() == at.tolist() and len(notes) == 1
    passing = rows.copy()
    passing[:, 3] = 0.0
    passing[349, 1:3] = 0.0  # on its path
    assert not np.isnan(without_lost(passing, "/tool", notes)).any()


def one_push_each(folder: Path, messages: list[Message], *, reset: bool = False) -> list[Path]:
    """Bags of one push each; `reset`: on a clock that began anew before each."""
    bags = []
    for number in range(N):
        start = 10.0 + PERIOD * number
        own = [m for m in messages if start <= m.stamp < start + PERIOD]
        shift = PERIOD * number if reset else 0.0
        bags.append(write_messages(folder / f"push_{number}", [replace(m, stamp=m.stamp - shift, logged=m.logged - shift) for m in own]))
    return bags


@pytest.mark.parametrize("reset", [False, True])
def test_bags_of_one_push_each_become_one_bag_in_order_of_their_starts(
    tmp_path: Path, rows: tuple[Float64Array, Float64Array], pushed: list[PushRecord], reset: bool
) -> None:
    bags = one_push_each(tmp_path, messages_of(rows), reset=reset)
    given = bags if reset else [*bags[3:], *bags[:3]]
    command = arguments(given[0], tmp_path, pushed, *WITH_FORCE, "--json", tmp_path / "report.json")
    done = run_here(*command[:3], *given[1:], *command[3:])
    assert done.returncode == 0 and done.stderr.count("warning") == done.stderr.count(CONSTANT), done.stderr
    notes = json.loads((tmp_path / "report.json").read_text())["notes"]
    assert sum("its times are moved by" in note for note in notes) == (N - 1 if reset else 0), notes
    pushes = split_pushes(read_bag(tmp_path / "own"), "1")
    assert len(pushes) == N
    for push, record in zip(pushes, pushed, strict=True):
        np.testing.assert_allclose(push.poses.pose[[0, -1], :2], record.poses.pose[[0, -1], :2], atol=2e-3)
        np.testing.assert_allclose(push.pusher.position[[0, -1]], record.pusher.position[[0, -1]], atol=1e-3)
        assert push.wrench is not None


ZERO_TWIST = new("geometry_msgs/msg/Twist", *[new("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)] * 2)


@dataclass(frozen=True)
class Other:
    """What is different about the second of two bags."""

    frame: str = "world"
    child: str = "box"
    height: float = 0.0
    number: int = 1


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        (Other(frame="map"), "object poses are in `map`, expected `world` as in"),
        (Other(child="hammer"), "the object's poses are those of `hammer`, expected `box` as in"),
        (Other(height=0.05), "at a height of 50 mm, expected 0 mm within 10 mm as in"),
        (Other(number=0), "the same poses as in"),
    ],
)
def test_bags_of_two_objects_or_tables_or_one_given_twice_are_refused(
    tmp_path: Path, rows: tuple[Float64Array, Float64Array], pushed: list[PushRecord], other: Other, reason: str
) -> None:
    bags = []
    for name, own in (("first", Other(number=0)), ("second", other)):
        bags.append(tmp_path / name)
        with BagWriter(bags[-1]) as writer:
            for m in messages_of(rows):
                if own.number * PERIOD <= m.stamp - 10.0 < (own.number + 1) * PERIOD and m.topic != "/ft":
                    pose, header = pose_msg(m.values[0], m.values[1], own.height, (*m.values, 0.0)[2]), header_msg(m.stamp, own.frame)
                    covered = new("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36))
                    twist = new("geometry_msgs/msg/TwistWithCovariance", ZERO_TWIST, np.zeros(36))
                    write(writer, m.topic, "nav_msgs/msg/Odometry", m.stamp, header, own.child, covered, twist)
    command = arguments(bags[0], tmp_path, pushed, *OWN_MAP)
    check_refused(reason, *command[:3], bags[1], *command[3:])
    check_refused("is given twice, expected each bag once", *command[:3], bags[0], *command[3:])
    assert not (tmp_path / "own").exists()


def test_a_bag_without_a_push_among_others_is_named(
    tmp_path: Path, rows: tuple[Float64Array, Float64Array], pushed: list[PushRecord]
) -> None:
    away = [replace(m, values=(m.values[0] + 0.5, m.values[1])) if m.topic == "/tool" and m.stamp < 16.0 else m for m in messages_of(rows)]
    bags = one_push_each(tmp_path, [replace(m, values=(0.2, 0.1, 0.0)) if m.topic == "/body" and m.stamp < 16.0 else m for m in away])
    command = arguments(bags[0], tmp_path, pushed, *OWN_MAP)
    done = run_here(*command[:3], *bags[1:], *command[3:])
    assert done.returncode == 0 and f"warning: {bags[0]} /body: no push in it, expected one" in done.stderr, done.stderr
    assert len(split_pushes(read_bag(tmp_path / "own"), "1")) == N - 1
