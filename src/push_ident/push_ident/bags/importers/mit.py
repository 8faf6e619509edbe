"""Files of the MIT pushing dataset, one push each.

K.-T. Yu, M. Bauza, N. Fazeli, A. Rodriguez, "More than a million ways to be pushed: a high-fidelity experimental dataset of planar
pushing", IROS 2016; http://web.mit.edu/mcube/push-dataset/. Outlines and masses are those that the authors publish with their programs
(`shape_db.py`, `probe_db.py` of github.com/mcubelab/push-est-public); the outline of `butter` is a table of points there and is not
repeated here.

The robot's base frame becomes `table`: x and y unchanged, z up. The object frame is that of the dataset. `ft_wrench` is the force on the
probe: in a published file it points against the motion of the probe. The force on the object is its negative.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.bags.importers.recording import ascending
from push_ident.bags.importers.report import ImportReport
from push_ident.bags.importers.shapes import pose_covariance, shape_of_outline
from push_ident.bags.records import write_records
from push_ident.checking.contact import contact_of, contact_tolerance, contact_warnings
from push_ident.errors import BagError, InputError
from push_ident.extras import need
from push_ident.files import read_regular
from push_ident.geometry.outline import polygon_centroid
from push_ident.limits import LIMITS, check_coordinates, plain_text
from push_ident.types import Float64Array, ObjectShape, PoseTrack, PusherPath, PushRecord, WrenchTrack

_OBJECT_ID: Final = "1"
_FIELDS: Final = ("object_pose", "tip_pose", "ft_wrench")
_SUFFIXES: Final = (".json", ".h5")
_YAW_JUMP: Final = float(np.radians(8.0))
"""Turn between two frames that only a change of the tracked markers makes [rad]; the least that github.com/mcubelab/pdproc removes."""
_NAME: Final = re.compile(r"(?:motion_)?surface=(?P<surface>[a-z]+)_shape=(?P<shape>[a-z]+\d?)(?:_.*)?")


def _rectangle(x: float, y: float) -> Float64Array:
    return 0.5 * np.array([[x, y], [-x, y], [-x, -y], [x, -y]])


def _triangle(leg_x: float, leg_y: float) -> Float64Array:
    """With its right-angle corner at x = y = 45 mm in the object frame."""
    return 0.045 + np.array([[0.0, 0.0], [-leg_x, 0.0], [0.0, -leg_y]])


def _ellipse(x: float, y: float, n: int = 180) -> Float64Array:
    """With `n` vertices, of which 180 keep the chords of the largest within 0.02 mm of the arc."""
    angle = np.arange(n) * 2.0 * np.pi / n
    return 0.5 * np.column_stack([x * np.cos(angle), y * np.sin(angle)])


@dataclass(frozen=True, slots=True)
class _MitShape:
    """A published object: a plate of stainless steel, 13 mm thick."""

    mass: float
    """[kg]"""
    outline: Float64Array | None
    """[m], shape (n_vertices, 2), object frame; None: to be given."""


MIT_SHAPES: Final[dict[str, _MitShape]] = {
    "rect1": _MitShape(0.8374, _rectangle(0.090, 0.090)),
    "rect2": _MitShape(1.045, _rectangle(0.08991, 0.11258)),
    "rect3": _MitShape(1.2508, _rectangle(0.13501, 0.08994)),
    "tri1": _MitShape(0.8028, _triangle(0.12590, 0.12587)),
    "tri2": _MitShape(0.9826, _triangle(0.15100, 0.12587)),
    "tri3": _MitShape(1.1326, _triangle(0.1765, 0.12561)),
    "ellip1": _MitShape(0.8937, _ellipse(0.105, 0.105)),
    "ellip2": _MitShape(1.1104, _ellipse(0.105, 0.13089)),
    "ellip3": _MitShape(1.3338, _ellipse(0.105, 0.157)),
    "hex": _MitShape(0.9827, _ellipse(0.121, 0.121, 6)),
    "butter": _MitShape(1.1974, None),
}
"""Name in the file names -> object."""


@dataclass(frozen=True, slots=True)
class MitOptions:
    """What the files do not say."""

    shape: str = ""
    """One of `MIT_SHAPES`; empty: by the file names."""
    outline: Float64Array | None = None
    """[m], shape (n_vertices, 2), object frame, in place of the published one."""
    radius: float = 0.00475
    """Of the probe [m]; `probe_db.py`, probes 3 to 5."""
    position_std: float = 0.5e-3
    """Standard deviation of a position of the object [m]: the distance between probe and outline in contact in a published file."""
    yaw_std: float = field(default=float(np.radians(0.3)))
    """Standard deviation of a yaw of the object [rad]: 0.5 mm at the rim of an object."""
    ends_only: bool = False
    """Whether only the first and the last pose of a push are kept."""


@dataclass(frozen=True, slots=True)
class _Push:
    """One file; time from its first sample."""

    pose: Float64Array
    """Rows (time, x, y, yaw) of the object [s, m, m, rad]."""
    tip: Float64Array
    """Rows (time, x, y) of the probe [s, m, m]."""
    force: Float64Array
    """Rows (time, fx, fy) on the object [s, N, N]; may have none."""
    recorded: float
    """When the first sample was stamped [s], Unix time."""


def import_mit(paths: Sequence[Path], out_bag: Path, *, options: MitOptions | None = None) -> ImportReport:
    """Convert files of the MIT pushing dataset, `.json` or `.h5`, or folders of them, to one new contract bag.

    All files show one object on one surface. They follow each other in the order in which they were recorded, so that what changes from
    push to push (wear) can be seen, with pauses of 2 s; a push record gives the interval of each. Files without poses, and pushes in which
    the tracker jumps, are left out with a note.

    Raises BagError for a file of another form, InputError for files of several objects, an unknown shape or options out of range.
    """
    options = options or MitOptions()
    files = _files_in(paths)
    surface, name = _named(files, options.shape)
    shape, mass = _shape_of(name, options.outline)
    LIMITS.PUSHER_RADIUS.check(options.radius, "the probe", remedy="Is it in millimetres?")
    covariance = pose_covariance(options.position_std, options.yaw_std)
    tolerance = contact_tolerance(shape, position_std=options.position_std, yaw_std=options.yaw_std)
    records, contacts, left_out = [], [], []
    for file, push in sorted(((file, _read(file)) for file in files), key=lambda read: read[1].recorded):
        if reason := _unusable(push):
            left_out.append(f"{file.name} is left out: {reason}")
            continue
        contacts.append(contact_of(push.pose[:, 0], push.pose[:, 1:], push.tip, shape=shape, radius=options.radius, tolerance=tolerance))
        records.append(_record(push, shape, covariance, options))
    if not records:
        raise BagError(f"none of {len(files)} files holds a usable push; {left_out[0]}.")
    write_records(out_bag, records)
    return ImportReport(
        bag=out_bag,
        n_pushes=len(records),
        contact_distance=np.array([contact.distance for contact in contacts]),
        tolerance=tolerance,
        mass=mass,
        centre_of_mass=np.array(polygon_centroid(shape.outline)),
        surface=surface,
        notes=(
            "the plate lies on its whole base; the centre of mass is the centroid of its outline",
            "poses, probe and force have the stamps of their devices, whose delays are not known",
            *(("object poses are known before and after each push only",) if options.ends_only else ()),
            *left_out,
        ),
        warnings=contact_warnings(dict(enumerate(contacts)), tolerance),
    )


def mit_sets(folder: Path) -> dict[tuple[str, str], tuple[Path, ...]]:
    """Files of the dataset below a folder, by surface and object, in order of their names; other files are passed over."""
    sets: dict[tuple[str, str], list[Path]] = {}
    for file in _files_below(folder):
        if match := _NAME.fullmatch(file.stem):
            sets.setdefault((match["surface"], match["shape"]), []).append(file)
    return {key: tuple(files) for key, files in sorted(sets.items())}


def _files_in(paths: Sequence[Path]) -> list[Path]:
    """The files, those of folders by name; of one push that is there in both formats the JSON file."""
    files: list[Path] = []
    for path in map(Path, paths):
        if path.is_dir():
            found = _files_below(path)
            if not found:
                raise BagError(f"{path}: no files *.json or *.h5 in it; unpack the archives of the dataset there.")
            files += found
        elif path.suffix not in _SUFFIXES:
            raise BagError(f"{path}: suffix is `{path.suffix}`, expected .json or .h5 (or a folder of such files).")
        else:
            files.append(path)
    if not files:
        raise InputError("no files are given; name files of the dataset, or a folder of them.")
    LIMITS.PUSHES.check(len(files), "the files of the dataset", remedy="Name fewer files, such as those of one speed.")
    return files


def _files_below(folder: Path) -> list[Path]:
    """By name; of one push that is there in both formats the JSON file."""
    found = sorted(p for p in folder.rglob("*") if p.suffix in _SUFFIXES)
    stems = {p.with_suffix("") for p in found if p.suffix == ".json"}
    return [p for p in found if p.suffix == ".json" or p.with_suffix("") not in stems]


def _named(files: Sequence[Path], shape: str) -> tuple[str, str]:
    """Surface and shape by the file names; `shape` replaces the latter. Raises InputError where they differ or are unknown."""
    found = [match for file in files if (match := _NAME.fullmatch(file.stem))]
    surfaces, shapes = ({match[part] for match in found} for part in ("surface", "shape"))
    for what, names in (("surface", surfaces), ("object", {shape} if shape else shapes)):
        if len(names) > 1:
            raise InputError(f"the files show {what}s {', '.join(sorted(names))}, expected one; import each into a bag of its own.")
    if not (shape or shapes):
        raise InputError(f"{files[0].name} does not name its object as in `surface=abs_shape=rect1_…`; give --shape.")
    return next(iter(surfaces), ""), shape or next(iter(shapes))


def _shape_of(name: str, outline: Float64Array | None) -> tuple[ObjectShape, float | None]:
    """Shape and mass [kg] of an object; raises InputError for an unknown one, and where the outline has to be given."""
    known = MIT_SHAPES.get(name)
    if outline is not None:
        return shape_of_outline(outline), known.mass if known else None
    if known is None:
        raise InputError(f"there is no object `{plain_text(name)}` in the dataset; it has {', '.join(MIT_SHAPES)}. Or give --outline.")
    if known.outline is None:
        raise InputError(f"the outline of `{name}` is a table of points; take it from shape_db.py of the dataset and give --outline FILE.")
    return shape_of_outline(known.outline), known.mass


def _read(file: Path) -> _Push:
    """One file. Raises BagError for another form, numbers that are not finite, or coordinates beyond the limits."""
    fields = _read_h5(file) if file.suffix == ".h5" else _read_json(file)
    arrays = {name: _rows(fields[name], f"{file}: {name}") for name in _FIELDS}
    recorded = min((float(rows[0, 0]) for rows in arrays.values() if len(rows)), default=0.0)
    for rows in arrays.values():
        rows[:, 0] -= recorded
    pose, tip, force = arrays.values()
    for rows in (pose, tip):
        check_coordinates(rows[:, 1:3], str(file), error=BagError)
    LIMITS.FORCE.check(float(np.abs(force[:, 1:3]).max(initial=0.0)), str(file), error=BagError)
    pose[:, 3] = np.unwrap(pose[:, 3])
    return _Push(pose, tip[:, :3], force[:, :3] * [1.0, -1.0, -1.0], recorded)


def _read_json(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(read_regular(file, LIMITS.TEXT_FILE.value))
    except (OSError, ValueError, RecursionError) as error:
        raise BagError(f"{file}: not a JSON file ({plain_text(str(error))[:100]}); download it again.") from None
    if not isinstance(content, dict) or any(name not in content for name in _FIELDS):
        raise _other_fields(file, content if isinstance(content, dict) else ())
    return content


def _other_fields(file: Path, names: Iterable[str]) -> BagError:
    got = ", ".join(plain_text(name) for name in list(names)[:5]) or "none of them"
    return BagError(f"{file}: has {got}, expected {', '.join(_FIELDS)}; give the raw files of the dataset.")


def _read_h5(file: Path) -> dict[str, Any]:
    need("mit")
    import h5py

    found: dict[str, Any] = {}
    try:
        with h5py.File(file, "r") as content:
            for name in _FIELDS:
                item = content.get(name)
                if not isinstance(item, h5py.Dataset):
                    raise _other_fields(file, content)
                # The size is only a claim: a few bytes can announce terabytes.
                LIMITS.TEXT_FILE.check(8 * float(np.prod(item.shape, dtype=np.float64)), f"{file}: {name}", error=BagError)
                found[name] = item[()]
    except (OSError, RuntimeError, ValueError, TypeError, KeyError) as error:
        raise BagError(f"{file}: not an HDF5 file ({plain_text(str(error))[:100]}); download it again.") from None
    return found


def _rows(values: Any, what: str) -> Float64Array:
    """Rows (time, three numbers) in order of time, each time once, shape (n, 4); n may be 0."""
    try:
        rows = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise BagError(f"{what}: not rows of numbers; download it again.") from None
    if rows.size == 0:
        return np.zeros((0, 4))
    if rows.ndim != 2 or rows.shape[1] != 4:
        raise BagError(f"{what} has shape {rows.shape}, expected (n, 4): time and three numbers; not a file of this dataset.")
    if not np.isfinite(rows).all():
        raise BagError(f"{what}: row {int(np.argmin(np.isfinite(rows).all(axis=1)))} is not finite; download it again.")
    return ascending(rows[np.argsort(rows[:, 0], kind="stable")])


def _unusable(push: _Push) -> str:
    """Why a push cannot be used; empty where it can. Frames less than 20 ms apart are compared for a jump: the tracker ran at 250 Hz."""
    if len(push.pose) < 2 or len(push.tip) < 2:
        return f"it has {len(push.pose)} object poses and {len(push.tip)} poses of the probe, expected at least 2 of each"
    end = max(rows[-1, 0] for rows in (push.pose, push.tip, push.force) if len(rows))
    if not end <= LIMITS.PUSH_SECONDS.value:
        return f"it lasts {end:.4g} s, expected at most {LIMITS.PUSH_SECONDS.value} s"
    step, turn = np.diff(push.pose[:, 0]), np.abs(np.diff(push.pose[:, 3]))
    if np.any((turn > _YAW_JUMP) & (step < 0.02)):
        return f"the tracker jumps by {np.degrees(turn[step < 0.02].max()):.0f} degrees between two frames"
    return ""


def _record(push: _Push, shape: ObjectShape, covariance: Float64Array, options: MitOptions) -> PushRecord:
    pose = push.pose[[0, -1]] if options.ends_only else push.pose
    return PushRecord(
        _OBJECT_ID,
        shape,
        PoseTrack(pose[:, 0], pose[:, 1:], np.broadcast_to(covariance, (len(pose), 3, 3))),
        PusherPath(push.tip[:, 0], push.tip[:, 1:], options.radius),
        WrenchTrack(push.force[:, 0], push.force[:, 1:]) if len(push.force) else None,
    )
