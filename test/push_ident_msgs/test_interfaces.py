"""Every interface file is a Python type, and its messages survive the middleware's encoding."""

from __future__ import annotations

import importlib

import pytest
from rclpy.serialization import deserialize_message, serialize_message

from helpers.paths import SOURCE

FILES = sorted(path for kind in ("msg", "srv", "action") for path in (SOURCE / "push_ident_msgs" / kind).iterdir())
PARTS = {"msg": ("",), "srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.stem)
def test_interface_is_a_type_whose_messages_are_read_as_they_were_written(file) -> None:
    kind = file.suffix[1:]
    interface = getattr(importlib.import_module(f"push_ident_msgs.{kind}"), file.stem)
    for part in PARTS[kind]:
        message = getattr(interface, part)() if part else interface()
        assert deserialize_message(serialize_message(message), type(message)) == message
