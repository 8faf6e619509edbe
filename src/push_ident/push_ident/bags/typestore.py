"""Message definitions for writing bags, and for reading bags without definitions."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import Final

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from push_ident.errors import BagError

_PACKAGE: Final = "push_ident_msgs"


def _own_definitions() -> list[Path]:
    """The .msg files of push_ident_msgs: from the sourced ROS workspace, else those that this package brings."""
    shares = [Path(prefix) / "share" / _PACKAGE for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    for folder in [*shares, Path(__file__).parent]:
        if files := sorted((folder / "msg").glob("*.msg")):
            return files
    return []


@cache
def jazzy_typestore() -> Typestore:
    """The messages of ROS 2 Jazzy, and those of push_ident_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for file in _own_definitions():
        types.update(get_types_from_msg(file.read_text(encoding="utf-8"), f"{_PACKAGE}/msg/{file.stem}"))
    store.register(types)
    return store


def definition_of(msgtype: str) -> str:
    """Full text of a message definition and of those it uses, as in MCAP files (`ros2msg`).

    Raises BagError for an unknown type.
    """
    store = jazzy_typestore()
    if msgtype not in store.fielddefs:
        raise BagError(f"message type {msgtype!r} is unknown, expected one of ROS 2 Jazzy or {_PACKAGE}.")
    return store.generate_msgdef(msgtype, ros_version=2)[0]
