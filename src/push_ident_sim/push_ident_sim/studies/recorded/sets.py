"""Sets of recorded pushes in a folder: bags of the contract, and files of the formats that an importer reads."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.bags.importers import ImportReport, import_cmu_icra16, import_cmu_mocap, import_mit, mit_sets
from push_ident.errors import InputError
from push_ident.offline.loading import load_pushes
from push_ident.types import PoseTrack, PushRecord

__all__ = ["Drawn", "RecordedSet", "draw_pushes", "find_sets", "known_of"]

KNOWN: Final = "known.json"
"""Beside the recordings: what their authors measured."""
_BAG_FILES: Final = (".mcap", ".db3")


@dataclass(frozen=True, slots=True)
class RecordedSet:
    """Pushes of one object on one surface."""

    name: str
    """Its place in the folder, such as `plywood-rect1`."""
    paths: tuple[Path, ...]
    """A bag, or files in order of their names."""
    read: Callable[[tuple[Path, ...], Path], ImportReport | None]
    """Makes a bag of such paths; None where they are a bag."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """Some pushes of a set, in the order in which they were made."""

    records: list[PushRecord]
    n_all: int
    """Pushes, or files, of the set."""
    mass: float | None
    """Of the object, where it was published [kg]."""
    notes: tuple[str, ...]
    """Of the import and of the bag."""


def find_sets(folder: Path) -> dict[str, RecordedSet]:
    """All sets in a folder and the folders in it, by name.

    A folder with a file of a ROS 2 bag is one set, and so is each file `*.txt` (CMU, ICRA 2016) and `*.bag` (CMU, motion capture). Files of
    the MIT pushing dataset are one set for each object on each surface.

    Raises InputError where there is none.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give --recordings DIR, the folder of the recordings.")
    found: list[RecordedSet] = []
    bags = sorted({path.parent for path in folder.rglob("*") if path.suffix in _BAG_FILES})
    found += [RecordedSet(_name(bag, folder), (bag,), _no_import) for bag in bags]
    found += [RecordedSet(_name(path, folder), (path,), _read_icra16) for path in sorted(folder.rglob("*.txt"))]
    found += [RecordedSet(_name(path, folder), (path,), _read_mocap) for path in sorted(folder.rglob("*.bag"))]
    found += [RecordedSet(f"{surface}-{shape}", paths, _read_mit) for (surface, shape), paths in mit_sets(folder).items()]
    if not found:
        raise InputError(f"{folder}: no recording in it; expected bags, files *.txt or *.bag of CMU, or files of the MIT pushing dataset.")
    return {one.name: one for one in found}


def draw_pushes(found: RecordedSet, n: int, rng: np.random.Generator, *, ends_only: bool, with_forces: bool) -> Drawn:
    """Random pushes of a set.

    Args:
        found: the set.
        n: how many; all where it has fewer.
        rng: draws them.
        ends_only: whether only the poses at rest before and after a push are kept.
        with_forces: whether measured forces are kept.

    Raises:
        PushIdentError: the set cannot be read.
    """
    paths = found.paths if len(found.paths) == 1 else _some(found.paths, n, rng)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        report = found.read(paths, bag)
        loaded = load_pushes([bag if report is not None else paths[0]])
    records = list(_some(tuple(loaded.records), n, rng)) if len(found.paths) == 1 else loaded.records
    if ends_only:
        records = [_ends_of(record) for record in records]
    if not with_forces:
        records = [replace(record, wrench=None) for record in records]
    n_all = len(loaded.records) if len(found.paths) == 1 else len(found.paths)
    notes = (() if report is None else report.notes) + tuple(loaded.notes)
    return Drawn(records, n_all, None if report is None else report.mass, notes)


def known_of(folder: Path, name: str) -> dict[str, Any]:
    """What the authors of a recording measured, by `known.json` in its folder: an object that has patterns of names as keys, and for each
    `friction`, `effects` (names, with words) and `source`, as far as they are known. Empty where it says nothing of a set.

    Raises InputError for a file of another form.
    """
    file = folder / KNOWN
    if not file.is_file():
        return {}
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: cannot be read as JSON ({error}).") from None
    if not isinstance(content, dict) or not all(isinstance(value, dict) for value in content.values()):
        raise InputError(f"{file}: expected an object of objects, a pattern of set names as each key.")
    return next((value for pattern, value in content.items() if fnmatch(name, pattern)), {})


def _name(path: Path, folder: Path) -> str:
    parts = path.relative_to(folder).with_suffix("").parts
    return "-".join(parts) or folder.resolve().name


def _some(items: tuple[Any, ...], n: int, rng: np.random.Generator) -> tuple[Any, ...]:
    """At most `n` of them, in their order."""
    return tuple(items[i] for i in np.sort(rng.permutation(len(items))[:n]))


def _ends_of(record: PushRecord) -> PushRecord:
    """The same push with one frame before and one after it."""
    poses, ends = record.poses, [0, -1]
    return replace(record, poses=PoseTrack(poses.time[ends], poses.pose[ends], poses.covariance[ends]))


def _no_import(paths: tuple[Path, ...], bag: Path) -> None:
    return None


def _read_icra16(paths: tuple[Path, ...], bag: Path) -> ImportReport:
    return import_cmu_icra16(paths[0], bag)


def _read_mocap(paths: tuple[Path, ...], bag: Path) -> ImportReport:
    return import_cmu_mocap(paths[0], bag)


def _read_mit(paths: tuple[Path, ...], bag: Path) -> ImportReport:
    return import_mit(paths, bag)
