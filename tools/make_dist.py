"""Build the sdist and the wheel of push_ident, which need no ROS: `python tools/make_dist.py [FOLDER]`, into dist/ by default.

The package is copied first, its links to files elsewhere in the repository followed, so that nothing is left in the sources. The wheel is
built from the sdist, which proves that the sdist is complete.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "src" / "push_ident"
BUILD = "import sys; from setuptools import build_meta; print(getattr(build_meta, sys.argv[1])(sys.argv[2]))"
"""The standard hooks of setuptools (PEP 517), without a frontend."""


def hook(name: str, folder: Path, target: Path) -> Path:
    """Run a hook in a folder of sources; the file that it has written into the folder `target`."""
    call = [sys.executable, "-c", BUILD, name, str(target)]
    done = subprocess.run(call, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{name} failed:\n{done.stdout}{done.stderr}")
    return target / done.stdout.splitlines()[-1]


def make_dist(target: Path) -> tuple[Path, Path]:
    """Write sdist and wheel into a folder, which is made where it is missing."""
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / SOURCE.name
        shutil.copytree(SOURCE, copy, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
        sdist = hook("build_sdist", copy, target)
        unpacked = Path(scratch) / "unpacked"
        shutil.unpack_archive(sdist, unpacked, filter="data")
        return sdist, hook("build_wheel", next(unpacked.iterdir()), target)


if __name__ == "__main__":
    for file in make_dist(Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "dist").resolve()):
        print(f"written: {file} ({file.stat().st_size / 1e6:.1f} MB)")
