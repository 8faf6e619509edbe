"""Start, spin and stop of every node process."""

from __future__ import annotations

import gc
import os
import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import rclpy
from rclpy.executors import Executor
from rclpy.logging import get_logger
from rclpy.signals import SignalHandlerOptions

from push_ident.errors import PushIdentError
from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.base.executors import make_executor
from push_ident.nodes.base.lifetime import LIFETIME, ExitCode
from push_ident.nodes.base.settings import NODE


def run_node(factory: Callable[[], CellNode], *, n_threads: int = 1, yields: bool = True, in_turn: bool = False) -> int:
    """Run one node until SIGINT or SIGTERM, or until the process that started it is gone. To be called in the main thread.

    The request to stop only raises a flag: the ROS context stays valid, so the component of the node can still publish
    there (hold the arm, end a bag) before it is destroyed. A process that still runs after 1.8 s is ended by force.

    Args:
        factory: Builds the node; an exception raised there ends the process with one line and exit code 1.
        n_threads: Above 1 the callbacks run in a MultiThreadedExecutor of so many threads.
        yields: Whether the node gives way to the nodes that move the arm, where processors are short.
        in_turn: As `CellNode.in_turn`.

    Returns:
        An `ExitCode`: `STOPPED` after a request to stop.
    """
    LIFETIME.begin()
    LIFETIME.loaded()
    if yields:
        _give_way()
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # fails where security is enforced without keys
        node = factory()
    except Exception as error:
        _report(error)
        rclpy.try_shutdown()
        return ExitCode.COULD_NOT_START
    LIFETIME.running()
    try:
        _spin(node, make_executor(n_threads, in_turn=in_turn), n_threads)
    except Exception as error:
        _report(error)
        return ExitCode.FAILED
    finally:
        rclpy.try_shutdown()
    return 0


def _give_way() -> None:
    os.nice(max(0, NODE.niceness - os.nice(0)))
    # Linux schedules sessions against each other first: niceness alone counts only within one. Only a session that this process leads is
    # changed.
    if os.getsid(0) == os.getpid():
        with suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(NODE.niceness), encoding="ascii")


def settle_memory() -> None:
    """Exclude all present objects from garbage collection: scanning modules and compiled kernels during a push takes some 50 ms."""
    gc.collect()
    gc.freeze()


def _spin(node: CellNode, executor: Executor, n_threads: int) -> None:
    executor.add_node(node)
    settle_memory()

    def spin_while(condition: Callable[[], bool], is_closing: bool = False) -> None:
        while condition():
            # What `close` destroys while a wait set is built fails there: no fault, and to log one may take rclpy a second.
            with suppress(Exception) if is_closing else node.guard.watch("executor"):
                executor.spin_once(timeout_sec=NODE.spin_wait)
            if n_threads > 1:
                # Until a worker has taken a callback, rclpy returns the same one repeatedly, and this thread would block the
                # interpreter for the worker: 100 % of a core instead of 16 %.
                time.sleep(NODE.worker_start)

    try:
        spin_while(lambda: not LIFETIME.stop.is_set() and rclpy.ok())
    finally:
        if n_threads > 1:
            # The clients of goals under way still get their results.
            with ThreadPoolExecutor(1) as pool:
                closing = pool.submit(node.close)
                spin_while(lambda: not closing.done(), is_closing=True)
            closing.result()
        else:
            node.close()
        executor.shutdown(timeout_sec=0.5)
        node.destroy_node()


def _report(error: Exception) -> None:
    """One line for the operator; the traceback for a developer, at the level debug."""
    logger = get_logger(os.path.basename(sys.argv[0]))
    text = str(error) if isinstance(error, PushIdentError) else f"{type(error).__name__}: {error}"
    logger.fatal(text)
    logger.debug("".join(traceback.format_exception(error)))
