"""The life of a process of this package: quiet from its first line on, and never longer than the process that started it.

A supervisor starts its children with the stop signals blocked and with the reading end of a pipe whose writing end it alone has:

- Blocked signals wait until the child can handle them. Otherwise a Ctrl-C while Python starts is a traceback, or is lost.
- The pipe ends when the supervisor does, however it does: even by SIGKILL, and even before the child has begun to watch it.
  Linux' PR_SET_PDEATHSIG is lost where the parent dies before the child has set it, and it is sent when the *thread* that started
  the child ends.
"""

from __future__ import annotations

import multiprocessing
import os
import select
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import IntEnum
from pathlib import Path
from typing import Any, Final, NoReturn

from push_ident.nodes.base.settings import NODE

LIFELINE: Final = "PUSH_IDENT_LIFELINE"
"""Variable with the number of the open pipe that ends with the process that started this one."""
STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


class ExitCode(IntEnum):
    """Why a process of this package ended."""

    STOPPED = 0
    COULD_NOT_START = 1
    """As with a wrong parameter: the next start would end so, too."""
    NOT_STOPPED = 1
    """A node that did not close in time."""
    FAILED = 3
    """A node that ended by an error while it ran."""
    INTERRUPTED = 130
    """A command that Ctrl-C ended, as shells have it: 128 + SIGINT."""


class Lifetime:
    """When this process has to end. There is one for each process, `LIFETIME`.

    A separate thread waits for a signal or for the end of the lifeline: signals are handled even while the main thread is in a
    library that does not return, and nothing happens within a signal handler, which could interrupt anything.
    """

    def __init__(self) -> None:
        self.stop = threading.Event()
        """Set when the process has to end."""
        self.patience = NODE.stop_within
        """From a request to stop to the end by force [s], beside what a busy machine lets the main thread wait for a processor."""
        self._lock = threading.Lock()
        self._begun = False
        self._abandoned = False
        self._at_once = True
        self._code = 0

    def begin(self, code: int = 0) -> None:
        """Handle signals from now on: until `loaded`, one ends the process at once and silently, with exit code `code`.

        To be called first, in the main thread. A second call does nothing.
        """
        if self._begun:
            return
        self._begun, self._code = True, code
        lifeline = _taken_lifeline()
        waiting, wakeup = os.pipe()
        os.set_blocking(wakeup, False)
        threading.Thread(target=self._watch, args=(waiting, lifeline), name="lifetime", daemon=True).start()
        if threading.current_thread() is threading.main_thread():
            # Python itself writes the number of each signal to `wakeup`, at once; handlers have to wait for the main thread.
            signal.set_wakeup_fd(wakeup, warn_on_full_buffer=False)
            for number in STOP_SIGNALS:
                signal.signal(number, _nothing)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)

    def loaded(self) -> None:
        """From now on a request to stop sets `stop`, and the process has `patience` to end."""
        with self._lock:
            self._at_once = False

    def running(self) -> None:
        """From now on, not to end in time is a failure: exit code 1."""
        with self._lock:
            self._code = ExitCode.NOT_STOPPED

    def interruptible(self) -> None:
        """Turn this process into that of a command: Ctrl-C is a KeyboardInterrupt; SIGTERM ends it, unless the command handles it."""
        sys.unraisablehook = _quiet_unraisable
        with self._lock:
            self._at_once, self._code = False, ExitCode.INTERRUPTED
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def leave(self, code: int) -> NoReturn:
        """End the process with an exit code, without the finalisation of Python: threads that still print would abort it."""
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):
                stream.flush()
        with self._lock:  # never released: the watch must not end the process with another code
            self._end(code)

    def _watch(self, waiting: int, lifeline: int | None) -> None:
        self._abandoned = _await_end(waiting, lifeline)
        with self._lock:
            if self._at_once:
                self._end(self._code)
        self.stop.set()
        asked, waited = time.monotonic(), _waited_for_processor()
        while time.monotonic() - asked < self.patience + _waited_for_processor() - waited:
            time.sleep(NODE.spin_wait)
        with self._lock:
            if self._code == ExitCode.NOT_STOPPED:
                print(f"ended by force after {self.patience:g} s, in {_where_main_thread_is()}", file=sys.stderr, flush=True)
            self._end(self._code)

    def _end(self, code: int) -> NoReturn:
        for child in multiprocessing.active_children():
            child.kill()
        if self._abandoned and os.getpgrp() == os.getpid():
            os.killpg(0, signal.SIGKILL)  # whatever this process has started, and itself: its exit code is not awaited
        os._exit(code)


LIFETIME: Final = Lifetime()
"""Of this process. It does nothing until `begin`."""


@contextmanager
def stop_signals_blocked() -> Iterator[None]:
    """What is started within begins with SIGINT and SIGTERM blocked; they wait for its `Lifetime.begin`."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def stopping_in_order() -> Iterator[None]:
    """Within, SIGTERM and SIGHUP end the main thread as Ctrl-C does, by `SystemExit`; another thread changes nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, _leave) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def end_with_parent() -> None:
    """End this child of `multiprocessing` silently as soon as its parent is gone."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "only a child of multiprocessing has a parent to end with"

    def watch() -> None:
        parent.join()
        os._exit(0)

    threading.Thread(target=watch, name="lifetime", daemon=True).start()


def _taken_lifeline() -> int | None:
    """The end of the pipe that the starter has given, taken from the environment: the number means nothing to children."""
    number = os.environ.pop(LIFELINE, "")
    try:
        pipe = int(number)
        os.set_inheritable(pipe, False)
    except (ValueError, OSError):
        return None
    return pipe


def _await_end(waiting: int, lifeline: int | None) -> bool:
    """Wait for a stop signal or the end of the lifeline; whether it was the lifeline."""
    while True:
        readable, _, _ = select.select([waiting] if lifeline is None else [waiting, lifeline], [], [])
        if lifeline in readable:
            return True
        if any(number in STOP_SIGNALS for number in os.read(waiting, 64)):
            return False


def _waited_for_processor() -> float:
    """How long the main thread has waited for a processor so far [s]; 0 where the kernel does not say."""
    try:
        return 1e-9 * float(Path("/proc/self/schedstat").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return 0.0


def _where_main_thread_is() -> str:
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    calls = traceback.extract_stack(frame)[-4:] if frame is not None else []
    return " > ".join(f"{os.path.basename(call.filename)}:{call.lineno} {call.name}" for call in calls) or "an unknown place"


def _nothing(number: int, frame: object) -> None:
    """A handler, so that Python writes the signal to the wakeup descriptor."""


def _leave(number: int, frame: object) -> None:
    raise SystemExit(128 + number)


def _quiet_unraisable(unraisable: Any) -> None:
    """A Ctrl-C within a destructor cannot be raised; it is no error."""
    if not issubclass(unraisable.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
