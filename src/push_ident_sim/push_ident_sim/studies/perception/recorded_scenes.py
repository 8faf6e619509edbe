"""Recorded table-top scenes with labels: which of the labelled objects perception finds, and how well their masks agree from above.

A scene is an organised point cloud (PCD) with fields label, x, y, z, as in the Object Segmentation Database (Richtsfeld et al.,
"Segmentation of unknown objects in indoor environments", 2012): label 0 is nothing, 1 the table, others are objects. Labels that share
their tens are surfaces of one object (40 the inside of a bowl, 41 its outside).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.errors import InputError
from push_ident.offline.depth_images import read_cloud
from push_ident.perception.calibration import camera_over_table, table_extent
from push_ident.perception.depth import points_in_table
from push_ident.perception.labels import label_pixels
from push_ident.perception.segments import Segment, find_segments
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import BoolArray, DepthFrame
from push_ident_sim.studies.common.base import Json

__all__ = ["Scene", "find_objects", "picture_of", "read_scene", "scene_files"]

_TABLE_LABEL: Final = 1
_SURFACES: Final = 10
_TALLEST: Final = 0.5
"""Largest height of objects in these scenes [m]; they contain no robot."""
_AROUND: Final = 0.3
"""Margin around the table that is searched [m]."""
_CELL: Final = 0.005
"""Edge of a cell of the masks in the view from above [m]: pixels are up to 3 mm apart."""
_FOUND: Final = 0.5
"""Overlap from which an object counts as found."""


@dataclass(frozen=True, slots=True)
class Scene:
    """One recording."""

    frame: DepthFrame
    label: NDArray[np.int64]
    """Shape (height, width)."""


def scene_files(folder: Path) -> list[Path]:
    """All PCD files in a folder and its subfolders, by name."""
    return sorted(folder.rglob("*.pcd"))


def read_scene(path: Path) -> Scene:
    """Read an organised cloud; the camera matrix follows from the points themselves.

    Raises:
        InputError: It cannot be read, or is no labelled, organised cloud.
    """
    cloud = read_cloud(path)
    if cloud.label is None:
        raise InputError(f"{path} is a cloud without labels, expected a field `label`.")
    return Scene(cloud.frame, cloud.label)


def find_objects(scene: Scene) -> tuple[Json, list[Segment]]:
    """Segments over the plane of the table, and how each labelled object fits its best one.

    Returns:
        `objects`: per label (its tens) `label, iou` and `found`, `n_segments`, `table_noise_m`; and the segments.
    """
    frame = scene.frame
    camera, noise, _ = camera_over_table(frame)
    low, high = table_extent(frame, camera, noise)
    settings = PerceptionSettings(workspace_low=low, workspace_high=high, max_object_height=_TALLEST)
    points = points_in_table(frame, camera)
    segments, counts = find_segments(frame, points, label_pixels(points, (), settings), settings)
    reach = np.array([*np.subtract(low, _AROUND), *np.add(high, _AROUND)])
    masks = [_from_above(points[s.rows, s.columns][s.mask], reach) for s in segments]
    rows = []
    for number in sorted({int(value) // _SURFACES for value in np.unique(scene.label) if value > _TABLE_LABEL}):
        own = (scene.label // _SURFACES == number) & (scene.label > _TABLE_LABEL) & np.isfinite(frame.depth)
        mask = _from_above(points[own], reach)
        iou = max((float(np.sum(mask & other) / np.sum(mask | other)) for other in masks), default=0.0)
        rows.append({"label": number * _SURFACES, "iou": round(iou, 4), "found": iou >= _FOUND})
    return {"objects": rows, "n_segments": counts["segments"], "table_noise_m": round(noise, 6)}, segments


def picture_of(scene: Scene, segments: list[Segment]) -> NDArray[np.uint8]:
    """The labels of the scene and the segments found, side by side, over its depth in grey; RGB."""
    palette = np.random.default_rng(5).integers(70, 255, (64, 3)).astype(np.uint8)
    near, far = np.nanquantile(scene.frame.depth, [0.01, 0.99])
    grey = np.nan_to_num(np.clip(255 - 200 * (scene.frame.depth - near) / (far - near), 0, 255)).astype(np.uint8)
    labels, found = np.stack([grey] * 3, axis=-1), np.stack([grey] * 3, axis=-1)
    for place, value in enumerate(v for v in np.unique(scene.label) if v > _TABLE_LABEL):
        labels[scene.label == value] = palette[place]
    for place, segment in enumerate(segments):
        found[segment.rows, segment.columns][segment.mask] = palette[place % len(palette)]
    return np.hstack([labels, found])


def _from_above(points: NDArray[np.float32], reach: NDArray[np.float64]) -> BoolArray:
    """Cells that the points cover, single gaps closed."""
    columns, rows = (int(n) for n in np.ceil((reach[2:] - reach[:2]) / _CELL))
    index = np.floor((points[:, :2] - reach[:2]) / _CELL).astype(np.int64)
    inside = np.all((index >= 0) & (index < (columns, rows)), axis=1)
    mask = np.zeros((rows, columns), dtype=np.uint8)
    mask[index[inside, 1], index[inside, 0]] = 1
    return np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0)
