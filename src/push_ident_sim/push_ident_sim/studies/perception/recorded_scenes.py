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
from push_ident.geometry.se2 import transform_points
from push_ident.offline.depth_images import read_cloud
from push_ident.perception.calibration import camera_over_table, table_extent
from push_ident.perception.known_object import Segment, TrackStatus
from push_ident.perception.pipeline import Perception
from push_ident.perception.search.hollows import cover_hollows
from push_ident.perception.search.segments import find_segments
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import BoolArray, DepthFrame, Float64Array
from push_ident_sim.studies.common.base import Json

__all__ = ["Scene", "find_objects", "picture_of", "read_scene", "scene_files"]

_SURFACES: Final = 10
"""Labels from here on are objects; lower ones are the table and its parts."""
_FRAME_PERIOD: Final = 0.3
"""Between two copies of the one frame of a scene [s]: longer than between two searches."""
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
    """What perception with its defaults makes of a scene, and how each labelled object fits its best segment and shape.

    Returns:
        `objects`: per label (its tens) `label`, `iou` and `found` of the best segment, and `shape_iou` of the best shape (0 without);
        `n_segments`, `table_noise_m`, `n_shapes` taken in and `n_wrong_shapes`, those that are followed and fit no object; and the
        segments.
    """
    frame = scene.frame
    camera, noise, _ = camera_over_table(frame)
    low, high = table_extent(frame, camera, noise)
    settings = PerceptionSettings(workspace_low=low, workspace_high=high)
    perception = Perception(camera, settings)
    shapes, followed = _taken_in(perception, frame)
    covered = cover_hollows(perception.view(frame)).view
    points = covered.points
    segments, counts = find_segments(covered)
    reach = np.array([*np.subtract(low, _AROUND), *np.add(high, _AROUND)])
    masks = [_from_above(segment.points_in(points), reach) for segment in segments]
    areas = {name: _inside(outline, reach) for name, outline in shapes.items()}
    rows, best_of = [], dict.fromkeys(shapes, 0.0)
    for number in sorted({int(value) // _SURFACES for value in np.unique(scene.label) if value >= _SURFACES}):
        mask = _from_above(points[(scene.label // _SURFACES == number) & np.isfinite(frame.depth)], reach)
        iou = max((_overlap(mask, other) for other in masks), default=0.0)
        overlaps = {name: _overlap(mask, area) for name, area in areas.items()}
        best_of = {name: max(best_of[name], overlap) for name, overlap in overlaps.items()}
        shape_iou = max(overlaps.values(), default=0.0)
        rows.append({"label": number * _SURFACES, "iou": round(iou, 4), "found": iou >= _FOUND, "shape_iou": round(shape_iou, 4)})
    summary = {"objects": rows, "n_segments": counts["segments"], "table_noise_m": round(noise, 6), "n_shapes": len(shapes)}
    return summary | {"n_wrong_shapes": sum(best < _FOUND and name in followed for name, best in best_of.items())}, segments


def _taken_in(perception: Perception, frame: DepthFrame) -> tuple[dict[str, Float64Array], set[str]]:
    """Outlines [m], shape (n, 2), table frame, of the objects that perception makes of a frame at rest, and which of them it follows."""
    outlines: dict[str, Float64Array] = {}
    followed: set[str] = set()
    for i in range(perception.settings.rest_frames + 2):
        observation = perception.observe(DepthFrame(_FRAME_PERIOD * i, frame.depth, frame.intrinsics, frame.frame_id))
        outlines |= {name: transform_points(perception.first_pose(name), shape.outline) for name, shape in observation.new_shapes.items()}
        followed = {known.object_id for known in observation.objects if known.status is TrackStatus.TRACKED}
    return outlines, followed


def _overlap(mask: BoolArray, other: BoolArray) -> float:
    return float(np.sum(mask & other) / np.sum(mask | other))


def _inside(outline: Float64Array, reach: NDArray[np.float64]) -> BoolArray:
    """Cells whose middle lies inside an outline [m], shape (n, 2)."""
    columns, rows = (int(n) for n in np.ceil((reach[2:] - reach[:2]) / _CELL))
    mask = np.zeros((rows, columns), dtype=np.uint8)
    cv2.fillPoly(mask, [np.rint(((outline - reach[:2]) / _CELL - 0.5) * 16).astype(np.int32)], 1, shift=4)
    return np.asarray(mask > 0)


def picture_of(scene: Scene, segments: list[Segment]) -> NDArray[np.uint8]:
    """The labels of the scene and the segments found, side by side, over its depth in grey; RGB."""
    palette = np.random.default_rng(5).integers(70, 255, (64, 3)).astype(np.uint8)
    near, far = np.nanquantile(scene.frame.depth, [0.01, 0.99])
    grey = np.nan_to_num(np.clip(255 - 200 * (scene.frame.depth - near) / (far - near), 0, 255)).astype(np.uint8)
    labels, found = np.stack([grey] * 3, axis=-1), np.stack([grey] * 3, axis=-1)
    for place, value in enumerate(v for v in np.unique(scene.label) if v >= _SURFACES):
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
