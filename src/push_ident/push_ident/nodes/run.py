"""How every node process starts, spins and stops."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Final

import rclpy
from rclpy.executors import Executor, ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from push_ident.errors import PushIdentError

__all__ = ["run_node", "settle_memory"]

_STOP_WITHIN: Final = 1.8
"""[s] after the first signal the process is gone, whatever a callback is busy with."""

_WAIT: Final = 0.05
"""[s] between two looks at the stop flag; bounds the delay of a stop while nothing arrives."""

_YIELD: Final = 3e-4
"""[s] in which a worker thread can begin its callback."""


def run_node(factory: Callable[[], Node], *, args: Sequence[str] | None = None, n_threads: int = 1) -> int:
    """Run one node until SIGINT or SIGTERM.

    The signal only raises a flag: the ROS context stays valid, so a node that has a method `close()` can still publish there
    (hold the arm, end a bag) before it is destroyed. A process that is not done after 1.8 s is ended hard.

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
    """Take what was made so far out of the garbage collector's rounds: modules and compiled kernels stay, and going through them again
    in the middle of a push takes some 50 ms."""
    gc.collect()
    gc.freeze()


def _spin(factory: Callable[[], Node], stop: threading.Event, n_threads: int) -> int:
    try:
        node = factory()
    except PushIdentError as error:
        get_logger(os.path.basename(sys.argv[0])).fatal(str(error))
        return 1
    executor: Executor = SingleThreadedExecutor() if n_threads == 1 else MultiThreadedExecutor(n_threads)
    executor.add_node(node)
    settle_memory()
    try:
        while not stop.is_set() and rclpy.ok():
            executor.spin_once(timeout_sec=_WAIT)
            if n_threads > 1:
                # Until a worker has taken a callback, rclpy hands the same one out again and again, and this thread would keep
                # the interpreter from the worker: 100% of a core where 16% do.
                time.sleep(_YIELD)
    except ExternalShutdownException:
        pass  # The node ended the context itself.
    finally:
        close = getattr(node, "close", None)
        if close is not None:
            close()
        executor.shutdown(timeout_sec=0.5)
        node.destroy_node()
    return 0
