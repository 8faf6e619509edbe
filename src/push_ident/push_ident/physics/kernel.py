"""Compilation of kernels, a cache on disk that is never stale, and the folders of effects beside those of this package.

Numba's cache checks only the source file of a kernel itself. It does not detect changes of kernels in other files that the compiler
inlined. Therefore any change of a source of this package, or of an effect, drops all of its compiled kernels. Kernels compiled with
effects of other folders have a cache of their own, so that the kernels without these effects stay valid.

Every `.py` file in a folder of `PUSH_IDENT_EFFECTS`, a list separated as in PATH, holds one effect as `EFFECT`, like the files of
`effects/`, and is a full member of the catalogue. The variable has to be set before the first import of this package, in every process
that simulates.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from numba import config, njit

VARIABLE = "PUSH_IDENT_EFFECTS"


def extra_effect_folders() -> list[Path]:
    """The folders that the environment names.

    Raises:
        ImportError: one of them does not exist.
    """
    folders = [Path(part).expanduser().resolve() for part in os.environ.get(VARIABLE, "").split(os.pathsep) if part]
    for folder in folders:
        if not folder.is_dir():
            raise ImportError(f"{VARIABLE} names {folder}, which is no folder; correct the variable, or unset it.")
    return folders


def extra_effect_files() -> list[Path]:
    """The files in those folders, in a fixed order."""
    return [file for folder in extra_effect_folders() for file in sorted(folder.glob("*.py"))]


_EXTRA_FILES = extra_effect_files()
_EXTRA_CACHE = str(Path(config.CACHE_DIR or Path(__file__).parent / "__pycache__") / "with_extra_effects")


def kernel(function: Callable[..., Any], **options: Any) -> Any:
    """Compile a function. Division by zero gives infinity, as in numpy.

    A kernel releases Python's global lock, so that a node's other threads and simulations of other pushes run beside it.
    """
    usual = config.CACHE_DIR
    try:
        # numba reads the setting when it decorates a function. Kernels of other packages, which know no effects, keep their cache.
        config.CACHE_DIR = _EXTRA_CACHE if _EXTRA_FILES else usual
        return njit(function, cache=True, error_model="numpy", nogil=True, **options)
    finally:
        config.CACHE_DIR = usual


fast_kernel = partial(kernel, fastmath={"nnan", "ninf", "nsz", "arcp", "contract", "reassoc"})
"""For sums over cells: the compiler may reorder them for vector registers. Not for code that must handle NaN or infinity."""


@kernel
def _probe() -> int:
    """Locates the folder in which numba stores the kernels of this package."""
    return 0


def _drop_stale_kernels() -> None:
    sources = [*sorted(Path(__file__).parent.rglob("*.py")), *_EXTRA_FILES]
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
    folder = Path(_probe.stats.cache_path)
    stamp = folder / "kernels.sha256"
    try:
        if stamp.exists() and stamp.read_text() == digest:
            return
        for source in sources:
            for index in folder.glob(f"{source.stem}.*.nbi"):
                index.unlink(missing_ok=True)
        folder.mkdir(parents=True, exist_ok=True)
        stamp.write_text(digest)
    except OSError:
        # A folder that cannot be written holds no kernels that a change of the sources could invalidate.
        return


if not config.DISABLE_JIT:
    _drop_stale_kernels()
