"""Disks that are full or read-only: small file systems in memory, and folders mounted read-only. Both need root."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from push_ident_sim.faults.fault import Impossible

__all__ = ["fill", "read_only", "small_disk"]


@contextmanager
def small_disk(folder: Path, mebibytes: int) -> Iterator[Path]:
    """A file system of so many MiB at `folder`. Raises Impossible without the right to mount."""
    folder.mkdir(parents=True, exist_ok=True)
    _mount("a small disk", "-t", "tmpfs", "-o", f"size={mebibytes}m", "tmpfs", str(folder))
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False, capture_output=True)


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """`folder` cannot be written to, not even by root. Raises Impossible without the right to mount."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    _mount("a read-only folder", "--bind", str(folder), str(folder))
    try:
        _mount("a read-only folder", "-o", "remount,ro,bind", str(folder))
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False, capture_output=True)


def fill(folder: Path, leave_mebibytes: float = 0.0) -> Path:
    """Write a file until so much of the disk of `folder` is free."""
    import shutil

    path, left = folder / "ballast", int(leave_mebibytes * 2**20)
    with path.open("ab") as file:
        while (free := shutil.disk_usage(folder).free) > left:
            file.write(b"\0" * min(1 << 16, max(4096, free - left)))
            file.flush()
    return path


def _mount(what: str, *arguments: str) -> None:
    try:
        done = subprocess.run(["mount", *arguments], check=False, capture_output=True, text=True)
    except OSError as error:
        raise Impossible(f"{what} needs the program `mount`: {error}") from None
    if done.returncode:
        raise Impossible(f"{what} needs the right to mount: {done.stderr.strip()}; run it as root")
