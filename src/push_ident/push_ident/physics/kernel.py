"""How kernels are compiled, and kept on disk honestly.

Numba files a compiled kernel under the content of its own source and does not notice that a kernel of another file, which it has
compiled in, changed. Therefore any change of a source of this package, or of an effect, drops all of its compiled kernels. Kernels with
effects of other folders (`effect_folders.py`) are kept apart, so that the kernels without them stay.
"""

from __future__ import annotations

import hashlib
from functools import partial
from pathlib import Path

from numba import config, njit

from push_ident.physics.effect_folders import extra_effect_files

__all__ = ["fast_kernel", "kernel"]

_EXTRA_FILES = extra_effect_files()
if _EXTRA_FILES:
    # numba asks for the folder where a function is decorated.
    config.CACHE_DIR = str(Path(config.CACHE_DIR or Path(__file__).parent / "__pycache__") / "with_extra_effects")

kernel = partial(njit, cache=True, error_model="numpy", nogil=True)
"""Compiles a function; division by zero gives infinity, as in numpy. Other threads go on while it runs: those of a node that listens, and
those that simulate other pushes."""

fast_kernel = partial(kernel, fastmath={"nnan", "ninf", "nsz", "arcp", "contract", "reassoc"})
"""For sums over cells: their order is free, so that they run in vector registers. Not for code that meets NaN or infinity."""


@kernel
def _probe() -> int:
    """Its compiled form lies where numba keeps the kernels of this folder."""
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
        # A folder that cannot be written holds no kernels that a change of the sources could make stale.
        return


if not config.DISABLE_JIT:
    _drop_stale_kernels()
