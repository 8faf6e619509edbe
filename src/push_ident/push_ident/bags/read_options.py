"""What a user says of a bag that does not keep to the contract: which topic has which role, and the unit of its depth images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from os.path import commonpath
from typing import Final

from push_ident.bags.contract import OBJECT_ROLES, Role, TopicRole, role_of
from push_ident.bags.decode import depth_encoding_of
from push_ident.bags.opening import Connection, OpenBag
from push_ident.errors import InputError
from push_ident.limits import check_object_id, plain_text

ROLE_WORDS: Final = {role.name.lower(): role for role in Role}
"""Roles as a user writes them; of an object followed by a colon and its id, as `pose:hammer`."""
MAPPING: Final = "`push-ident look`, `identify`, `predict`, `diagnose`, `fleet` and `replay` take"
"""Begin of a remedy, which other commands may print as well."""
_COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"
_POSES: Final = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry", "Pose", "TFMessage", "tfMessage")


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How a bag is read."""

    topics: Mapping[str, TopicRole] = field(default_factory=dict)
    """Role of topics, by name without slashes around it. Such a topic takes the place of one that has the role by its name."""
    depth_unit: float | None = None
    """Metres per unit of a depth image; None: by its encoding (REP 118)."""
    pose_std: tuple[float, float] | None = None
    """Standard deviations of position [m] and yaw [rad] of poses that lack a covariance; None: from the frames at rest."""

    def __post_init__(self) -> None:
        if self.pose_std is not None and not all(0 < std < math.inf for std in self.pose_std):
            raise InputError(f"standard deviations of a pose are {self.pose_std}, expected two positive numbers in metres and radians.")
        if self.depth_unit is not None and not 0 < self.depth_unit < 1000:
            raise InputError(f"unit of the depth is {self.depth_unit:g}, expected metres per unit, such as 0.001 for millimetres.")

    def role_of(self, topic: str) -> TopicRole | None:
        """Role of a recorded topic; None for one without."""
        if mapped := self.topics.get(topic.strip("/")):
            return mapped
        role = role_of(topic)
        return None if role in self.topics.values() else role

    def with_camera_info(self, bag: OpenBag) -> ReadOptions:
        """With the camera info beside a depth topic that was mapped, where it has one: one with the role by name may be that of another."""
        words = TopicRole(Role.DEPTH), TopicRole(Role.CAMERA_INFO)
        if words[1] in self.topics.values():
            return self
        beside = {_camera_info_beside(topic) for topic, role in self.topics.items() if role == words[0]}
        found = {
            name: words[1]
            for topic in bag.topics
            if topic.msgtype == Role.CAMERA_INFO.msgtype and (name := topic.topic.strip("/")) in beside
        }
        return replace(self, topics={**self.topics, **found})


def parse_maps(texts: Sequence[str], name: str) -> dict[str, TopicRole]:
    """Texts `TOPIC=ROLE` of the option or parameter `name`, for `ReadOptions.topics`. Raises InputError for another form."""
    roles: dict[str, str] = {}
    for text in texts:
        topic, equals, role = (part.strip() for part in text.rpartition("="))
        if not (equals and topic) or topic in roles:
            what = "names a topic twice" if topic in roles else "expected TOPIC=ROLE, such as /camera/depth/image_raw=depth"
            raise InputError(f"{name} is `{plain_text(text)}`, {what}.")
        roles[topic] = role
    return parse_topics(roles)


def parse_topics(roles: Mapping[str, str]) -> dict[str, TopicRole]:
    """Topic -> role as a user writes it, for `ReadOptions.topics`. Raises InputError for a role that is none."""
    topics = {}
    for topic, text in roles.items():
        word, colon, object_id = text.partition(":")
        role = ROLE_WORDS.get(word)
        if role is None or not topic.strip("/") or (colon and role not in OBJECT_ROLES):
            raise InputError(
                f"topic {plain_text(topic)} has the role `{plain_text(text)}`, expected one of {', '.join(ROLE_WORDS)}; "
                f"those of an object with its id, as pose:hammer."
            )
        topics[topic.strip("/")] = TopicRole(role, check_object_id(object_id or "1") if role in OBJECT_ROLES else "")
    return topics


def word_of(role: TopicRole) -> str:
    """A role as a user writes it."""
    return role.role.name.lower() + (f":{role.object_id}" if role.object_id else "")


def message_types(role: Role) -> tuple[str, ...]:
    """Types that the messages of a role may have."""
    return (role.msgtype, _COMPRESSED) if role is Role.DEPTH else (role.msgtype,)


def map_hint(bag: OpenBag, missing: Sequence[Role], options: ReadOptions) -> str:
    """How to name topics of an open bag for roles that are missing, or what to record."""
    wanted = [Role.DEPTH, *missing] if Role.POSE in missing else list(missing)
    free = [topic for topic in _each_once(bag) if not options.role_of(topic.topic)]
    maps: dict[Role, list[str]] = {}
    without = []
    for role in wanted:
        # Depth images may stand for poses.
        named = maps.setdefault(Role.POSE if role is Role.DEPTH else role, [])
        fitting = [topic for topic in free if topic.msgtype in message_types(role) and (role is not Role.DEPTH or _is_depth(bag, topic))]
        without += [role.name.lower()] if not fitting and role in missing and role is not Role.POSE else []
        for topic in fitting[:4]:
            name = plain_text(topic.topic)
            named.append(f"--map {name}={role.name.lower()}{':ID' if role in OBJECT_ROLES else ''}")
            if role is Role.DEPTH and not _has_camera_info(bag, topic.topic, options):
                named[-1] += "".join(f" --map {plain_text(info)}=camera_info" for info in _nearest(topic.topic, _camera_infos(free))[:1])
    if any(maps.values()):
        listed = ", and ".join(" or ".join(named) for named in maps.values() if named)
        lacking = f" There is none for {' and '.join(without)}: record it." if without else ""
        return f"{MAPPING} other topics as {listed}.{lacking}"
    if any(topic.msgtype.rpartition("/")[2] in _POSES for topic in free) and {Role.POSE, Role.PUSHER} & set(missing):
        return "`push-ident import rosbag` converts poses of other topics and types, with the outline of the object."
    if Role.CAMERA_INFO in missing:
        return "Record depth images together with their camera info."
    return f"Record {'depth images (16UC1, 32FC1 or compressedDepth) with their camera info' if Role.DEPTH in missing else 'these topics'}."


def _each_once(bag: OpenBag) -> list[Connection]:
    """One connection with messages for each topic."""
    return list({topic.topic: topic for topic in bag.topics if topic.msgcount}.values())


def _camera_infos(topics: Sequence[Connection]) -> list[str]:
    return [topic.topic for topic in topics if topic.msgtype == Role.CAMERA_INFO.msgtype]


def _nearest(topic: str, others: list[str]) -> list[str]:
    """Other topics, those that share most of their name with a topic first."""
    return sorted(others, key=lambda other: -len(commonpath([f"/{topic.strip('/')}", f"/{other.strip('/')}"])))


def _has_camera_info(bag: OpenBag, image: str, options: ReadOptions) -> bool:
    names = _camera_infos(_each_once(bag))
    return any(options.role_of(name) for name in names) or _camera_info_beside(image.strip("/")) in {name.strip("/") for name in names}


def _camera_info_beside(image: str) -> str:
    """Where image_transport has the camera info of a topic of images, both without slashes around them."""
    for transport in ("/compressedDepth", "/compressed"):
        image = image.removesuffix(transport)
    return f"{image.rpartition('/')[0]}/camera_info".strip("/")


def _is_depth(bag: OpenBag, topic: Connection) -> bool:
    """Whether the first message of a topic of images is a depth image."""
    from push_ident.perception.frame.compressed_depth import is_depth_format  # OpenCV, for a remedy alone

    try:
        bag.register([topic])
        return any(is_depth_format(depth_encoding_of(image)) for _, _, image in islice(bag.messages([topic]), 1))
    except Exception:  # Foreign topics may be damaged in any manner; the error at hand is another one.
        return False
