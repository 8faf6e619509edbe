"""Known objects as files: after a restart perception finds them again, with their ids, cells and object frames.

Without them a restarted perception traces an object anew, in another object frame, and the maps of the object do not fit any more.
"""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.checked_json import CheckedContent, Listed, Numbers, Points, Rows, read_checked
from push_ident.errors import InputError, ModelFileError, PushIdentError
from push_ident.files import write_whole
from push_ident.geometry.cut_cells import cut_at_outline
from push_ident.geometry.se2 import wrap_angle
from push_ident.perception.known_object import KnownObject, TracedObject
from push_ident.types import CellGrid, Float64Array, ObjectShape

_FORMAT: Final = "push_ident/object/1"
_SUFFIX: Final = ".object.json"
_POSE_SUFFIX: Final = ".pose.json"
_REMEDY: Final = "remove it to trace the object anew"
_MOVED: Final = (0.002, 0.02)
"""A pose that differs by more is written again [m, rad]: it only has to tell one half turn of the object from the other."""


class _Object(CheckedContent):
    format: str
    object_id: str
    outline: Points
    outline_std: Numbers | None = None
    cells: Points
    """Centres of their squares, which the outline cuts."""
    cell_size: float
    pose: tuple[float, float, float]
    top: Rows
    top_origin: tuple[float, float]
    top_resolution: float
    hollow: Listed[Listed[bool]] | None = None
    seen_from: Listed[Points] | Points | None = None
    """Positions of the cameras."""
    displaced: float = 0.0
    displaced_std: float = 0.0
    displaced_frame: tuple[float, float, float] = (0.0, 0.0, 0.0)
    frame_covariance: Rows | None = None
    keeps_heading: bool = True
    area: float


class ObjectMemory:
    """The objects in a folder.

    Args:
        folder: where they are kept; empty: nowhere.
    """

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder).expanduser() if folder else None
        self._written: dict[str, Float64Array] = {}

    def load(self) -> dict[str, KnownObject]:
        """All objects, by id. Raises ModelFileError: a file cannot be used."""
        if self._folder is None:
            return {}
        objects = [_read(path) for path in sorted(self._folder.glob(f"*{_SUFFIX}"))]
        return {object_id: KnownObject(traced, area, self._pose(object_id, traced.pose)) for object_id, traced, area in objects}

    def keep(self, object_id: str, known: KnownObject, *, anew: bool = False) -> None:
        """Write an object, unless it is there and not `anew`. Raises ModelFileError: it cannot be written."""
        if self._folder is None:
            return
        path = self._folder / f"{object_id}{_SUFFIX}"
        if path.exists() and not anew:
            return
        traced = known.traced
        content = _Object(
            format=_FORMAT,
            object_id=object_id,
            outline=traced.shape.outline.tolist(),
            outline_std=None if traced.shape.outline_std is None else traced.shape.outline_std.tolist(),
            cells=traced.shape.cells.squares.tolist(),
            cell_size=traced.shape.cells.size,
            pose=tuple(traced.pose.tolist()),
            top=traced.top.tolist(),
            top_origin=tuple(np.asarray(traced.top_origin).tolist()),
            top_resolution=float(traced.top_resolution),
            hollow=None if traced.hollow is None else traced.hollow.tolist(),
            seen_from=None if traced.camera_positions is None else [positions.tolist() for positions in traced.camera_positions],
            displaced=float(traced.displaced),
            displaced_std=float(traced.displaced_std),
            displaced_frame=traced.displaced_frame,
            frame_covariance=traced.frame_covariance.tolist(),
            keeps_heading=bool(traced.keeps_heading),
            area=float(known.area),
        )
        write_whole(path, content.model_dump_json(), "a known object", private=True, error=ModelFileError)

    def forget(self, object_id: str) -> None:
        """Remove an object that was given up. Raises ModelFileError: its files cannot be removed."""
        if self._folder is None:
            return
        self._written.pop(object_id, None)
        try:
            for suffix in (_SUFFIX, _POSE_SUFFIX):
                (self._folder / f"{object_id}{suffix}").unlink(missing_ok=True)
        except OSError as error:
            raise ModelFileError(f"{self._folder} still has the object {object_id}: {error.strerror}; {_REMEDY}.") from None

    def keep_pose(self, object_id: str, pose: Float64Array) -> None:
        """Write the latest pose of an object where it has moved; the file survives a kill, not a power cut."""
        last = self._written.get(object_id)
        if self._folder is None or (
            last is not None and np.hypot(*(pose - last)[:2]) < _MOVED[0] and abs(wrap_angle(pose[2] - last[2])) < _MOVED[1]
        ):
            return
        self._written[object_id] = np.array(pose)
        path = self._folder / f"{object_id}{_POSE_SUFFIX}"
        with suppress(PushIdentError):  # not durable: a slow disk must not hold up the next frame
            write_whole(path, json.dumps([float(value) for value in pose]), "the pose of an object", private=True, durable=False)

    def _pose(self, object_id: str, first: Float64Array) -> Float64Array:
        """The latest pose, that of the tracing where there is none."""
        assert self._folder is not None
        try:
            pose = np.array(json.loads((self._folder / f"{object_id}{_POSE_SUFFIX}").read_text(encoding="ascii")), dtype=np.float64)
        except (OSError, ValueError):
            return first
        return pose if pose.shape == (3,) and np.all(np.isfinite(pose)) else first


def _read(path: Path) -> tuple[str, TracedObject, float]:
    content = read_checked(path, _Object, "a known object", _REMEDY)
    if content.format != _FORMAT or not content.object_id[1:].isdigit() or path.name != content.object_id + _SUFFIX:
        raise ModelFileError(f"{path} has the format `{content.format}` and the id `{content.object_id}`, expected `{_FORMAT}`; {_REMEDY}.")
    try:
        std = None if content.outline_std is None else np.array(content.outline_std)
        shape = cut_at_outline(ObjectShape(CellGrid(np.array(content.cells), content.cell_size), np.array(content.outline), std))
        top = np.array(content.top, dtype=np.float32)
        hollow = None if content.hollow is None else np.array(content.hollow, dtype=bool)
    except (InputError, ValueError) as error:
        raise ModelFileError(f"{path} does not describe an object: {error}; {_REMEDY}.") from None
    if top.ndim != 2 or top.size == 0 or not content.top_resolution > 0:
        raise ModelFileError(f"{path} has heights of shape {top.shape}, expected two dimensions; {_REMEDY}.")
    if hollow is not None and hollow.shape != top.shape:
        raise ModelFileError(f"{path} has a hollow of shape {hollow.shape}, expected {top.shape} as its heights; {_REMEDY}.")
    for name in ("displaced", "displaced_std"):
        if (value := getattr(content, name)) < 0:
            raise ModelFileError(f"{path} has {name} = {value} m, expected 0 or more; {_REMEDY}.")
    frame_covariance = np.zeros((3, 3)) if content.frame_covariance is None else np.array(content.frame_covariance)
    if frame_covariance.shape != (3, 3) or np.any(np.linalg.eigvalsh(frame_covariance) < -1e-12):
        raise ModelFileError(f"{path} has a frame_covariance that is none of shape (3, 3); {_REMEDY}.")
    # Files of earlier versions have the positions of one rest, without the list of rests.
    rests = [np.array(positions, dtype=np.float64).reshape(-1, 2) for positions in content.seen_from or ()]
    is_flat = any(isinstance(positions, tuple) for positions in content.seen_from or ())
    camera_positions = ((np.vstack(rests),) if is_flat else tuple(rests)) if rests else None
    traced = TracedObject(
        shape,
        np.array(content.pose),
        top,
        np.array(content.top_origin),
        content.top_resolution,
        hollow,
        camera_positions,
        content.displaced,
        content.displaced_std,
        content.displaced_frame,
        frame_covariance,
        content.keeps_heading,
    )
    return content.object_id, traced, content.area
