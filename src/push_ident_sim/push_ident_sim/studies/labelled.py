"""Labelled depth frames of others: is what perception takes in one whole thing, where it is, and what becomes of the rest?"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.errors import InputError
from push_ident.extras import need
from push_ident.files import finite
from push_ident.geometry.se2 import transform_points, wrap_angle
from push_ident.offline.depth_images import DepthImages
from push_ident.perception.frame.view import points_in_table
from push_ident.perception.pipeline import Perception
from push_ident.perception.refusals import Reason
from push_ident.perception.search.segments import nearer_than_border, with_shadow
from push_ident.perception.settings import PerceptionSettings
from push_ident.survey.survey import survey_frames
from push_ident.types import BoolArray, DepthFrame, Float64Array
from push_ident_sim.studies.common.measuring import mean_of, share
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import markdown_table, number, share_text

_N_FRAMES: Final = 44
"""Each frame is seen so many times, 1.5 s at 30 Hz: poses of what rests must not move."""
_FOUND: Final = 0.5
"""Least intersection over union, from above, of the convex hulls of an outline and of a labelled thing."""
_MOVED: Final = (0.01, np.radians(10.0))
"""A pose that differs by more from the first one, in the same frame, is wrong [m, rad]."""
_BESIDE: Final = 4
"""Distance at which things are side by side in the image [px]."""
_SHADOW: Final = 25
"""Width up to which a shadow may lie between a thing and what hides it [px]: 5 cm at 1 m, of a thing 0.4 m high."""
_STEP: Final = 0.02
"""What is nearer to the camera by more hides what is beside it [m]."""
_FOOT: Final = 0.15
"""Of the height of a thing that stands on the table its lowest points are at most so much [1]: few of a tall one are near its foot."""
_SUPPORTED: Final = 0.25
"""Of its lower border, or of its footprint, lies so much over another thing on which a thing stands [1]. What lies on its round side has no
points near the table either."""
_HIDDEN: Final = 0.04
"""Least fraction of its surroundings that hides a thing which counts as partly hidden."""
_LEAST: Final = (100, 0.012)
"""Points and height [m] of a labelled thing that counts: parts of the table are labelled, too."""
_OF_A_THING: Final = 10
"""Labels of each thing, and of the table, one for each of its parts."""
_CELL: Final = 0.002
"""Of the grid in which overlaps are counted [m]."""


@dataclass(frozen=True, slots=True)
class Labelled:
    """One labelled thing."""

    hull: Float64Array
    """Convex hull of its points from above [m], shape (n, 2), table frame."""
    low: float
    high: float
    """Heights of its lowest and highest points [m]."""
    hidden: bool
    """Whether something nearer is beside it, or the border of the image or of the workspace."""
    above_others: float
    """Fraction of its lower border in the image below which other things are seen."""


def _read(path: Path) -> tuple[DepthFrame, NDArray[np.int64]]:
    """The depth, and the number of the thing that each pixel shows, 0 for none: labels 30 and 31 are parts of the same thing, as the inside
    and the outside of a bowl are; those below 10 are of the table.

    Raises InputError for a cloud that is not organised, or has no labels.
    """
    need("pcd")
    import open3d

    frame = next(DepthImages(path).frames())
    cloud = open3d.t.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
    if "label" not in cloud.point:
        raise InputError(f"{path} has no field `label`, expected the number of the part that each point belongs to.")
    return frame, cloud.point["label"].numpy().reshape(frame.depth.shape).astype(np.int64) // _OF_A_THING


def labelled_things(frame: DepthFrame, labels: NDArray[np.int64], camera: Float64Array, settings: PerceptionSettings) -> list[Labelled]:
    """What the labels of a frame say is on the table; `camera`: optical frame in the table frame, shape (4, 4)."""
    points, things = points_in_table(frame, camera), []
    low, high = np.array(settings.workspace_low), np.array(settings.workspace_high)
    for label in np.unique(labels[labels > 0]):
        mask = (labels == label) & np.isfinite(points[..., 2])
        inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0  # points at an edge lie between two things
        surface = points[inner].astype(np.float64)
        if len(surface) < _LEAST[0] or np.quantile(surface[:, 2], 0.98) < _LEAST[1]:
            continue
        inside = np.all((surface[:, :2] > low) & (surface[:, :2] < high))
        at_border = mask[:_BESIDE].any() or mask[-_BESIDE:].any() or mask[:, :_BESIDE].any() or mask[:, -_BESIDE:].any()
        hidden = bool(at_border or not inside or _is_hidden(frame.depth, mask, (labels > 0) & (labels != label)))
        lowest, highest = np.quantile(surface[:, 2], [0.02, 0.98])
        below = labels[_BESIDE:][mask[:-_BESIDE] & ~mask[_BESIDE:]]  # the table is below each image
        above_others = float(np.mean((below > 0) & (below != label))) if len(below) else 0.0
        things.append(Labelled(_hull(surface[:, :2]), float(lowest), float(highest), hidden, above_others))
    return things


def _is_hidden(depth: NDArray[np.float32], mask: BoolArray, others: BoolArray) -> bool:
    """Whether other things beside the pixels of a thing are nearer to the camera than its border is."""
    # A shadow, in which nothing is measured, may lie between.
    grown = with_shadow(mask, ~np.isfinite(depth), _SHADOW)
    surroundings = (cv2.dilate(grown.astype(np.uint8), np.ones((2 * _BESIDE + 1,) * 2, np.uint8)) > 0) & ~grown
    hiding = surroundings & others & nearer_than_border(depth, mask, _STEP)
    return bool(np.count_nonzero(hiding) > _HIDDEN * np.count_nonzero(surroundings))


def _stands_on_another(thing: Labelled, things: Sequence[Labelled]) -> bool:
    """Whether it ends above the table and other things are seen below a quarter of it, or a quarter of its footprint lies over that of
    another thing and it begins where that ends."""
    return (thing.low > max(_STEP, _FOOT * thing.high) and thing.above_others > _SUPPORTED) or any(
        _rests_on(thing, other) for other in things
    )


def _rests_on(thing: Labelled, other: Labelled) -> bool:
    """Whether a quarter of the footprint of a thing lies over that of another one, and it begins where that ends."""
    area = cv2.contourArea(thing.hull.astype(np.float32))
    return other is not thing and thing.low > max(_STEP, 0.6 * other.high) and _common(thing.hull, other.hull)[0] > _SUPPORTED * area


def _carries(thing: Labelled, things: Sequence[Labelled]) -> bool:
    """Whether another thing rests on it."""
    return any(_rests_on(other, thing) for other in things)


def _is_reason_true(reason: Reason, thing: Labelled, things: Sequence[Labelled]) -> bool | None:
    """Whether a reason for not taking in a thing is true by its labels; None where labels do not tell."""
    carries = _carries(thing, things)
    if reason is Reason.STACKED:
        return carries or _stands_on_another(thing, things)
    if reason is Reason.BEHIND_ANOTHER:
        return carries or thing.hidden
    return thing.hidden if reason in (Reason.AT_IMAGE_BORDER, Reason.AT_WORKSPACE_BORDER) else None


def _hull(points: Float64Array) -> Float64Array:
    return np.asarray(cv2.convexHull(points.astype(np.float32).reshape(-1, 1, 2))[:, 0], dtype=np.float64)


def _common(a: Float64Array, b: Float64Array) -> tuple[float, float]:
    """Areas of the intersection and of the union of two polygons [m^2]."""
    both = np.vstack([a, b])
    low = both.min(axis=0)
    size = np.ceil((both.max(axis=0) - low) / _CELL).astype(int) + 1
    masks = []
    for polygon in (a, b):
        mask = np.zeros((size[1], size[0]), np.uint8)
        cv2.fillPoly(mask, [np.rint((polygon - low) / _CELL).astype(np.int32)], 1)
        masks.append(mask > 0)
    return float(np.count_nonzero(masks[0] & masks[1])) * _CELL**2, float(np.count_nonzero(masks[0] | masks[1])) * _CELL**2


def _overlap(a: Float64Array, b: Float64Array) -> float:
    common, union = _common(a, b)
    return common / union


def _run(case: Case, settings: CaseSettings) -> Json:
    frame, labels = _read(find_frames(settings.recordings)[case.object_name])
    survey = survey_frames([frame])
    things = labelled_things(frame, labels, survey.camera_in_table, survey.settings)
    perception, first = Perception(survey.camera_in_table, survey.settings, occupancy=False), dict[str, Float64Array]()
    for i in range(_N_FRAMES):
        observation = perception.observe(replace(frame, stamp=i / 30))
        first |= {name: perception.first_pose(name) for name in observation.new_shapes}
    tracked = {known.object_id: known.pose for known in observation.objects if known.pose is not None}
    outlines = {name: _hull(transform_points(pose, perception.known(name).traced.shape.outline)) for name, pose in tracked.items()}
    faults, right = [], set[int]()
    for name, outline in outlines.items():
        overlaps = [_overlap(outline, thing.hull) for thing in things]
        best = int(np.argmax(overlaps)) if overlaps else -1
        shift = tracked[name] - first[name]
        if best < 0 or overlaps[best] < _FOUND:
            faults.append("outline" if best >= 0 and overlaps[best] > 0.1 else "nothing there")
        elif _stands_on_another(things[best], things):
            faults.append("on another")
        elif things[best].hidden:
            faults.append("partly hidden")
        elif np.hypot(*shift[:2]) > _MOVED[0] or abs(float(wrap_angle(shift[2]))) > _MOVED[1]:
            faults.append("elsewhere")
        else:
            right.add(best)
    whole = [i for i, one in enumerate(things) if not (one.hidden or _stands_on_another(one, things) or _carries(one, things))]
    reasons: dict[int, Reason] = {}
    best_overlaps = []
    for i, thing in enumerate(things):
        overlaps = [_overlap(refusal.outline, thing.hull) for refusal in observation.refused]
        if overlaps and max(overlaps) > 0.0:
            reasons[i] = observation.refused[int(np.argmax(overlaps))].reason
        best_overlaps.append(max([*overlaps, *(_overlap(outline, thing.hull) for outline in outlines.values()), 0.0]))
    judged = [_is_reason_true(reason, things[i], things) for i, reason in reasons.items() if i not in right]
    return finite(
        {
            "things": len(things),
            "whole": len(whole),
            "found": len([i for i in whole if i in right]),
            "refused": len([i for i in whole if i not in right and i in reasons]),
            "unsaid": len([i for i in range(len(things)) if i not in right and i not in reasons]),
            "reasons": {str(verdict): judged.count(verdict) for verdict in (True, False, None)},
            "overlaps": [round(overlap, 3) for overlap in best_overlaps],
            "tracked": len(tracked),
            "right": len(right),
            "faults": dict(Counter(faults)),
        }
    )


def find_frames(folder: Path) -> dict[str, Path]:
    """Labelled clouds in a folder and the folders in it, by the name of the file. Raises InputError where there is none."""
    files = {path.stem: path for path in sorted(folder.rglob("*.pcd"))}
    if not files:
        raise InputError(f"{folder}: no labelled frame in it; expected organised clouds `*.pcd` with a field `label`.")
    return files


def _row(cases: Sequence[Json]) -> Json:
    faults = sum((Counter(v["faults"]) for v in cases), Counter[str]())
    total = {key: sum(v[key] for v in cases) for key in ("things", "whole", "found", "refused", "unsaid", "tracked", "right")}
    reasons = sum((Counter(v["reasons"]) for v in cases), Counter[str]())
    yes, no = reasons["True"], reasons["False"]
    return {
        **total,
        "frames": len(cases),
        "not_judged": reasons["None"],
        "seen": share([overlap >= _FOUND for v in cases for overlap in v["overlaps"]]),
        "overlap": mean_of(overlap for v in cases for overlap in v["overlaps"] if overlap >= _FOUND),
        "true_reasons": share([i < yes for i in range(yes + no)]),
        "right_or_true": share([i < total["right"] + yes for i in range(total["right"] + yes + no + total["unsaid"])]),
        "wrong": share([i >= total["right"] for i in range(total["tracked"])]),
        "of_whole": share([i < total["found"] for i in range(total["whole"])]),
        "faults": dict(faults),
    }


def _summarise(results: Sequence[CaseResult]) -> Json:
    groups = sorted({_group(r.case.object_name) for r in results})
    return {"sets": {name: _row([r.values for r in results if _group(r.case.object_name) == name]) for name in groups}}


def _group(name: str) -> str:
    """The letters with which the name of a frame begins."""
    match = re.match(r"[^\W\d_]+", name)
    return match.group() if match else name


def _tables(summary: Json) -> str:
    head = ["", "frames", "labelled", "whole", "whole: found", "whole: refused", "all: neither", "reasons true", "not judged"]
    head += ["all but those: found or truly refused", "all: overlap of half", "mean of these", "tracked", "of these wrong", "faults"]
    rows = []
    for name, row in summary["sets"].items():
        faults = ", ".join(f"{n} {fault}" for fault, n in row["faults"].items()) or "–"
        refused, unsaid, not_judged, tracked = (number(row[key], "{:.0f}") for key in ("refused", "unsaid", "not_judged", "tracked"))
        cells = [str(row["frames"]), str(row["things"]), str(row["whole"]), share_text(row["of_whole"]), refused, unsaid]
        cells += [share_text(row["true_reasons"]), not_judged, share_text(row["right_or_true"]), share_text(row["seen"])]
        rows.append([name, *cells, number(row["overlap"], "{:.2f}"), tracked, share_text(row["wrong"]), faults])
    return markdown_table(head, rows)


def _answer(summary: Json) -> str:
    return "; ".join(
        f"{name}: {row['wrong']['successes']} of {row['tracked']} tracked objects are wrong, {row['found']} of {row['whole']} whole found"
        for name, row in summary["sets"].items()
    )


STUDY = Experiment(
    name="labelled",
    title="Is what perception takes in a whole thing, where it is?",
    question=(
        f"Organised clouds with labels (`--recordings DIR`), each seen {_N_FRAMES} times, without a number given. Whole: nothing "
        "nearer is beside it or on it, it stands on the table, and inside image and workspace. Found: tracked at the end, and its "
        "outline overlaps with the footprint of the labelled thing by half (intersection over union of the convex hulls). Wrong: an "
        "outline of no labelled thing, of one that is partly hidden or stands on another, or a pose more than 10 mm or 10 degrees "
        "from the first one though nothing moved. Reasons of refusals are true where labels agree: hidden, stacked, or at a border; "
        "others are not judged. Overlap: with what is tracked or the hull of what is refused. Labels and hulls are of what the "
        "camera sees; labels 30 and 31 are parts of one thing. Groups are the letters with which names begin."
    ),
    objects=(),
    find_objects=lambda folder: tuple(find_frames(folder)),
    variants=("at-rest",),
    stages=("geometry", "perception", "offline", "survey"),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
)  # fmt: skip
