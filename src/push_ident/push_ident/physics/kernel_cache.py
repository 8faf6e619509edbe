"""Keep numba's on-disk cache honest about kernels that call kernels of other files."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["renew_cache"]


def renew_cache(file: str, *callees: str) -> None:
    """Make `file` as new as the files of the kernels it calls, named relative to it.

    Numba files a compiled kernel under the time stamp of its own source and does not notice that a callee changed. Call it after
    the imports and before the first kernel: a callee that was itself renewed is then seen as new. Does nothing where files cannot be
    written, since there sources do not change either.
    """
    here = Path(file)
    newest = max(here.with_name(name).stat().st_mtime for name in callees)
    if here.stat().st_mtime < newest and os.access(here, os.W_OK):
        os.utime(here, (newest, newest))
