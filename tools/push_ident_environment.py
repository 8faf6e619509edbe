"""Environment with which every process of the virtual environment finds ROS, without sourcing a script.

`make setup` copies this module into site-packages beside a .pth file that calls `enter` at each start of the interpreter.
It runs before anything else, so it imports only os and sys.
"""

from __future__ import annotations

import os
import sys

__all__ = ["enter"]

_RESTARTED = "_PUSH_IDENT_RESTARTED"


def enter(libraries: list[str], prefixes: list[str], defaults: dict[str, str]) -> None:
    """Set the variables that ROS reads; restart the interpreter once if the loader does not know the libraries yet.

    Args:
        libraries: Folders for LD_LIBRARY_PATH. The loader reads that variable only when a process starts.
        prefixes: Folders for AMENT_PREFIX_PATH.
        defaults: Values of variables that are not set.
    """
    for name, value in defaults.items():
        os.environ.setdefault(name, value)
    _put_in_front("AMENT_PREFIX_PATH", prefixes)
    # Without this variable the ROS wheels would restart the interpreter once more.
    os.environ["_ROS_WHEELS_BOOTSTRAP_COMPLETE"] = "1"
    if not _put_in_front("LD_LIBRARY_PATH", libraries):
        return
    # exec keeps the process id: a second restart of the same process would be a loop.
    process = str(os.getpid())
    if sys.executable and os.environ.get(_RESTARTED) != process:
        os.environ[_RESTARTED] = process
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _put_in_front(variable: str, folders: list[str]) -> bool:
    """Add the missing folders to a path variable; return whether there were any."""
    known = [folder for folder in os.environ.get(variable, "").split(os.pathsep) if folder]
    missing = [folder for folder in folders if folder not in known]
    if missing:
        os.environ[variable] = os.pathsep.join([*missing, *known])
    return bool(missing)
