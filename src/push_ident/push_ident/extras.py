"""Packages that only some features import: which extra of the wheel brings each, and one line where one is missing."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Final

from push_ident.errors import PushIdentError

EXTRAS: Final = {
    "arm": ("pinocchio",),
    "bullet": ("pybullet",),
    "fleet": ("ray", "pyarrow"),
    "mit": ("h5py",),
    "mujoco": ("mujoco",),
    "pcd": ("open3d",),
    "report": ("jinja2", "matplotlib"),
    "torch": ("torch",),
    "viewer": ("rerun",),
}
"""Extra of the wheel (`setup.py`): the modules that it brings."""
_ROS: Final = frozenset({"ament_index_python", "builtin_interfaces", "rclpy", "push_ident_msgs", "rosgraph_msgs"})
_ROS_SUFFIXES: Final = ("_msgs", "_interfaces", "_srvs")
_GET_ROS: Final = (
    "run `make setup` in a clone of the repository, which needs no ROS install, or source ROS 2 Jazzy and a workspace built from it"
)


class MissingPackageError(PushIdentError):
    """A feature needs a package that is not installed."""


def how_to_get(module: str) -> str | None:
    """One line about a module that is not installed; None where it belongs to no extra and not to ROS."""
    name = module.partition(".")[0]
    for extra, modules in EXTRAS.items():
        if name in modules:
            return f"{name} is not installed; run `pip install 'push_ident[{extra}]'`."
    if name in _ROS or name.endswith(_ROS_SUFFIXES):
        return f"this needs ROS 2, and {name} is not installed; {_GET_ROS}."
    return None


def need(extra: str) -> None:
    """Raise MissingPackageError where a module of an extra is not installed; nothing is imported."""
    for name in EXTRAS[extra]:
        if find_spec(name) is None:
            raise MissingPackageError(str(how_to_get(name)))


def need_ros() -> None:
    """Raise MissingPackageError where ROS 2 or the messages of this project are not installed; nothing is imported."""
    for name in ("rclpy", "push_ident_msgs"):
        if find_spec(name) is None:
            raise MissingPackageError(str(how_to_get(name)))
