"""Linear algebra of a call in one thread, whatever program it is called from."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from typing import Final, ParamSpec, TypeVar

__all__ = ["in_one_thread"]

_P = ParamSpec("_P")
_R = TypeVar("_R")
_CHOSEN: Final = "OPENBLAS_NUM_THREADS"


def in_one_thread(call: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let numpy and scipy use one thread while a function runs, in the whole process, and as many as before afterwards.

    The matrices of an identification are small: with the two threads that OpenBLAS starts on two cores it takes half as long again, and
    how they share a sum decides how it is rounded. The command line and the nodes choose one thread before numpy is loaded;
    a notebook has loaded it. What `OPENBLAS_NUM_THREADS` says is kept. Without the package `threadpoolctl`, which a ROS installation does
    not bring, nothing is changed.
    """

    @wraps(call)
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if _CHOSEN in os.environ:
            return call(*args, **kwargs)
        try:
            from threadpoolctl import threadpool_limits
        except ModuleNotFoundError:
            return call(*args, **kwargs)
        with threadpool_limits(limits=1, user_api="blas"):
            return call(*args, **kwargs)

    return called
