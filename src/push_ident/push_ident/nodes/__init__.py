"""ROS 2 nodes around the other stages: they convert, call and publish."""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path
from types import FrameType

__all__ = ["end_quietly_while_loading"]


def end_quietly_while_loading() -> None:
    """In a process that is a node, let SIGINT end it with exit code 0 until `run_node` takes over, as `run_node` does.

    Loading a node takes seconds, and a Ctrl-C in them would print where the imports were. Other programs that import a node (commands,
    tests) keep their handlers, as does a process that was started to ignore the signal.
    """
    # The words of the command line less those that are handed on: `python -m package.x_node` names the module there, an executable itself.
    program = Path(sys.orig_argv[-len(sys.argv) :][0]).name
    is_node = program.removesuffix(".py").endswith("_node")
    in_main = threading.current_thread() is threading.main_thread()
    if is_node and in_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def _end(number: int, frame: FrameType | None) -> None:
    # Not by an exception: one raised within an import is printed, or caught by the module that is loaded.
    os._exit(0)


end_quietly_while_loading()
