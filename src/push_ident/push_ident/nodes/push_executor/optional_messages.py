"""Messages of drivers and controllers, which a ROS need not have."""

from __future__ import annotations

import importlib
from typing import Any

from push_ident.errors import InputError


def import_messages(module: str, parameter: str, value: str, remedy: str) -> Any:
    """A module of messages or actions that a value of a parameter needs. Raises InputError with a remedy where it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise InputError(
            f"Parameter {parameter} is {value}, which needs {module.partition('.')[0]}, but that cannot be imported; {remedy}."
        ) from None


def import_control_messages(kind: str, parameter: str, value: str) -> Any:
    """`msg` or `action` of control_msgs; raises InputError as `import_messages`."""
    return import_messages(f"control_msgs.{kind}", parameter, value, f"install ros-jazzy-control-msgs, or leave {parameter} at its default")
