"""Start, spin and stop of every node process."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any, Final

import rclpy
from rclpy.logging import get_logger
from rclpy.signals import SignalHandlerOptions

from push_ident.errors import PushIdentError
from push_ident.nodes.executors import make_executor
from push_ident.nodes.guard import Guard

__all__ = ["run_node", "settle_memory"]

_STOP_WITHIN: Final = 1.8
"""Longest time from the first signal to the end of the process, even if a callback is busy [s]."""

_WAIT: Final = 0.05
"""Time between two checks of the stop flag [s]; limits the delay of a stop while no message arrives."""

_YIELD: Final = 3e-4
"""Time for a worker thread to begin its callback [s]."""


def run_node(factory: Callable[[], Any], *, args: Sequence[str] | None = None, n_threads: int = 1) -> int:
    """Run one node until SIGINT or SIGTERM.

    The signal only raises a flag: the ROS context stays valid, so the component of the node can still publish there
    (hold the arm, end a bag) before it is destroyed. A process that still runs after 1.8 s is killed.

    Args:
        factory: Builds the node; `PushIdentError` raised there ends the process with one line and exit code 1.
        args: Command line for rclpy, default sys.argv.
        n_threads: Above 1 the callbacks run in a MultiThreadedExecutor of so many threads.

    Returns:
        Exit code: 0 after a signal, 1 when the node could not start.
    """
    stop = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        if not stop.is_set():
            deadline = threading.Timer(_STOP_WITHIN, os._exit, (1,))
            deadline.daemon = True
            deadline.start()
        stop.set()

    previous = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        try:
            return _spin(factory, stop, n_threads)
        finally:
            rclpy.try_shutdown()
    finally:
        if not stop.is_set():
            for number, handler in previous.items():
                signal.signal(number, handler)


def settle_memory() -> None:
    """Exclude all present objects from garbage collection: scanning modules and compiled kernels during a push takes some 50 ms."""
    gc.collect()
    gc.freeze()


def _spin(factory: Callable[[], Any], stop: threading.Event, n_threads: int) -> int:
    try:
        node = factory()
    except PushIdentError as error:
        get_logger(os.path.basename(sys.argv[0])).fatal(str(error))
        return 1
    guard = getattr(node, "guard", None) or Guard(node.get_logger)
    node.guard = guard
    executor = make_executor(n_threads)
    executor.add_node(node)
    settle_memory()
    try:
        while not stop.is_set() and rclpy.ok():
            with guard.watch("executor"):
                executor.spin_once(timeout_sec=_WAIT)
            if n_threads > 1:
                # Until a worker has taken a callback, rclpy returns the same one repeatedly, and this thread would block the
                # interpreter for the worker: 100 % of a core instead of 16 %.
                time.sleep(_YIELD)
    finally:
        close = getattr(node, "close", None)
        if close is not None:
            close()
        executor.shutdown(timeout_sec=0.5)
        node.destroy_node()
    return 0
