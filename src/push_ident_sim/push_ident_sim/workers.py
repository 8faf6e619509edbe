"""Processes with one thread each, so that measured times compare."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import platform
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from push_ident.nodes.base.lifetime import end_with_parent

_SINGLE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


@contextmanager
def single_threads(jobs: int = 1, *, fresh: bool = False) -> Iterator[ProcessPoolExecutor]:
    """Up to `jobs` processes side by side; `fresh`: a new one for every call, so that no call inherits the state of another one."""
    # Libraries read these variables when the children import them.
    before = {name: os.environ.get(name) for name in _SINGLE_THREAD}
    os.environ.update(_SINGLE_THREAD)
    pool = ProcessPoolExecutor(
        jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_prepare, max_tasks_per_child=1 if fresh else None
    )
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _prepare() -> None:
    """Ctrl-C, or the end of the command, ends a worker at once and silently.

    Bullet does not print either, which would break the progress bar of the command.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    end_with_parent()
    nowhere, errors = os.open(os.devnull, os.O_WRONLY), os.dup(2)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    importlib.import_module("pybullet")
    os.dup2(errors, 2)


def describe_machine(jobs: int) -> dict[str, Any]:
    """What times depend on: `processor, cores, jobs, python` and `load`, the mean number of runnable processes in the last minute."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": names[0] if names else platform.machine(),
        "cores": os.cpu_count(),
        "jobs": jobs,
        "python": platform.python_version(),
        "load": round(os.getloadavg()[0], 2),
    }
