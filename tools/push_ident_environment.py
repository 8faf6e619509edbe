"""Environment with which every process of the virtual environment finds ROS, without sourcing a script.

`make setup` copies this module into site-packages beside a .pth file that calls `enter` at each start of the interpreter.
It runs before anything else, so it imports only what is built in, and os.
"""

from __future__ import annotations

import _signal
import os
import sys

__all__ = ["enter"]

_RESTARTED = "_PUSH_IDENT_RESTARTED"
_STOP_SIGNALS = (_signal.SIGINT, _signal.SIGTERM)
_NODES = ("push_ident.nodes", "push_ident_sim")
"""Modules that run as nodes, with `python -m`; the executables are in `lib/PACKAGE`."""
_COMMANDS = ("push_ident.cli", "push-ident")
_INTERRUPTED = 130
"""Exit code of a command that Ctrl-C ended: 128 + SIGINT."""


def enter(libraries: list[str], prefixes: list[str], defaults: dict[str, str]) -> None:
    """Set the variables that ROS reads; restart the interpreter once if the loader does not know the libraries yet.

    Args:
        libraries: Folders for LD_LIBRARY_PATH. The loader reads that variable only when a process starts.
        prefixes: Folders for AMENT_PREFIX_PATH.
        defaults: Values of variables that are not set.
    """
    code = _code_of_interrupt(sys.orig_argv[1:])
    if code is None:
        _enter(libraries, prefixes, defaults)
        return
    # Ctrl-C while Python starts would be a traceback. Blocked signals wait, through a restart, too.
    _signal.pthread_sigmask(_signal.SIG_BLOCK, _STOP_SIGNALS)
    _enter(libraries, prefixes, defaults)
    for number in _STOP_SIGNALS:
        _signal.signal(number, lambda number, frame: os._exit(code))
    _signal.pthread_sigmask(_signal.SIG_UNBLOCK, _STOP_SIGNALS)


def _code_of_interrupt(arguments: list[str]) -> int | None:
    """Exit code with which Ctrl-C ends a program of push_ident that is being loaded; None for other programs."""
    words = arguments[1:] if arguments[:1] == ["-m"] else [os.path.basename(part) for part in arguments[:1]] + arguments[1:]
    if not words:
        return None
    if words[0] in _COMMANDS:
        return 0 if words[1:2] == ["up"] else _INTERRUPTED
    folder = os.path.basename(os.path.dirname(arguments[0]))
    return 0 if words[0] in _NODES or (folder in ("push_ident", "push_ident_sim") and words[0].endswith("_node")) else None


def _enter(libraries: list[str], prefixes: list[str], defaults: dict[str, str]) -> None:
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
