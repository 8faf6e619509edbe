"""Errors and times of perception: shapes and poses on the simulated camera, recorded scenes, and the delay of the node."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from push_ident.errors import InputError
from push_ident_sim.cell.sensors import SENSORS
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, markdown_table, millimetres, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped
from push_ident_sim.studies.common.seeing import see_pushes
from push_ident_sim.studies.perception.latency import measure_latency
from push_ident_sim.studies.perception.recorded_scenes import find_objects, picture_of, read_scene, scene_files

__all__ = ["STUDY"]

_VIEWS: Final[dict[str, dict[str, Any]]] = {"clear": {}, "hidden": {"hidden": 0.4}, "arm": {"with_arm": True}}
"""What occludes the object, by variant."""
_LABELS: Final = {"clear": "", "hidden": "40 % hidden, ", "arm": "behind the arm, "}
_SENSOR_MODELS: Final = 3
"""Ground truths of each object with each model of a sensor: there are many of them."""
_NOMINAL: Final = 0.9
_REGION: Final = 6.2514
"""90 % quantile of chi-squared with three degrees of freedom."""
_KINDS: Final = {"rest": "at rest", "moving": "moving"}
"""Kinds of frames."""
_POSE_HEAD: Final = ("position, RMS [mm]", "yaw, RMS [deg]", f"in the {_NOMINAL:.0%} region", "not tracked")
_LEVELS: Final = {0.1: 0.5844, 0.25: 1.2125, 0.5: 2.3660, 0.75: 4.1083, 0.9: 6.2514, 0.95: 7.8147, 0.99: 11.3449}
"""Quantiles of chi-squared with three degrees of freedom."""
_OUTLINES: Final = {
    "outline_m": "outline, one view, RMS [mm]",
    "placed_m": "the same, placed",
    "refined_m": "after the pushes",
    "refined_placed_m": "the same, placed",
    "table_m": "place of the object by the extrinsics, RMS [mm]",
}
"""Errors of outlines, and of the table frame that the camera sees, and how the table calls them."""
_PICTURE_WIDTH: Final = 800
_FOUND: Final = 0.5
"""Overlap from which the shape of an object counts as right."""


def _run(case: Case, settings: CaseSettings) -> Json:
    if case.variant == "latency":
        return measure_latency(case.object_name, case.model)
    if case.variant == "recorded":
        return _recorded(settings.recordings)
    if case.variant in SENSORS:
        return see_pushes(case.object_name, case.model, sensor=case.variant)
    return see_pushes(case.object_name, case.model, **_VIEWS[case.variant])


def _recorded(folder: Path) -> Json:
    files = scene_files(folder)
    if not files:
        raise InputError(f"There are no recorded scenes (*.pcd) in {folder}; give their folder with --recordings.")
    scenes = {}
    for path in files:
        scene = read_scene(path)
        found, segments = find_objects(scene)
        scenes[path.stem] = found | {"picture": _encoded(picture_of(scene, segments))}
    return {"scenes": scenes}


def _encoded(picture: np.ndarray) -> str:  # type: ignore[type-arg]
    """As a small JPEG in text, since pictures are made from the summary."""
    height = round(picture.shape[0] * _PICTURE_WIDTH / picture.shape[1])
    small = cv2.resize(picture, (_PICTURE_WIDTH, height), interpolation=cv2.INTER_AREA)
    return base64.b64encode(cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()).decode("ascii")


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_variant = grouped(results, "variant")
    rendered = [result for variant in _VIEWS for result in by_variant.get(variant, [])]
    summary: Json = {"objects": {}, "coverage": {}}
    for name, own in [*grouped(rendered, "object_name").items(), *([("all", rendered)] if rendered else [])]:
        summary["objects"][name] = _row(own)
    for variant in _VIEWS:
        for kind in _KINDS:
            squared = [q for r in by_variant.get(variant, []) for q in r.values["kinds"][kind]["squared"]]
            if squared:
                summary["coverage"][f"{variant}, {kind}"] = {
                    str(level): round(float(np.mean(np.array(squared) < bound)), 4) for level, bound in _LEVELS.items()
                }
    if sensors := {name: _sensor_row(by_variant[name]) for name in SENSORS if by_variant.get(name)}:
        summary["sensors"] = sensors
    for variant in ("latency", "recorded"):
        if by_variant.get(variant):
            summary[variant] = by_variant[variant][0].values
    return summary


def _row(results: Sequence[CaseResult]) -> Json:
    row: Json = {"cases": len(results)}
    for key, pick in (("outline_m", _root_mean_square), ("outline_95_m", max), ("grid_iou", min), ("occupancy_iou", min)):
        row[key] = round(float(pick([r.values[key] for r in results])), 6)
    row["grid_iou_mean"] = round(float(np.mean([r.values["grid_iou"] for r in results])), 4)
    for variant in _VIEWS:
        for kind in _KINDS:
            frames = [r.values["kinds"][kind] for r in results if r.case.variant == variant]
            if any(f["squared"] for f in frames):
                row[f"{variant}_{kind}"] = _pose_row(frames) | {
                    "hidden": round(float(np.mean([share for f in frames for share in f["hidden"]])), 4),
                    "most_hidden": round(max(share for f in frames for share in f["hidden"]), 4),
                }
    return row


def _pose_row(frames: Sequence[Json]) -> Json:
    """Errors of the poses of one kind of frames, one entry a case."""
    errors = {key: [v for f in frames for v in f[key]] for key in ("position_m", "yaw", "squared")}
    return {
        "position_m": round(_root_mean_square(errors["position_m"]), 6),
        "worst_m": round(max(errors["position_m"]), 6),
        "yaw": round(_root_mean_square(errors["yaw"]), 6),
        "in_region": round(float(np.mean(np.array(errors["squared"]) < _REGION)), 4),
        "frames": len(errors["squared"]),
        "not_tracked": sum(f["not_tracked"] for f in frames),
    }


def _sensor_row(results: Sequence[CaseResult]) -> Json:
    row: Json = {"cases": len(results)}
    picks: dict[str, Callable[[Sequence[float]], Any]] = {key: _root_mean_square for key in _OUTLINES if key in results[0].values}
    picks |= {"outline_95_m": max, "grid_iou": np.mean}
    for key, pick in picks.items():
        row[key] = round(float(pick([r.values[key] for r in results])), 6)
    for kind in _KINDS:
        frames = [r.values["kinds"][kind] for r in results]
        if any(f["squared"] for f in frames):
            row[kind] = _pose_row(frames)
    return row


def _root_mean_square(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _view_tables(summary: Json) -> list[str]:
    """Errors of outlines and of poses on rendered views."""
    parts = []
    if summary["objects"]:
        head = ["shape", "cases", "outline, RMS [mm]", "95 % of it within, worst case [mm]", "grid IoU", "its worst"]
        rows = [
            [
                name,
                str(r["cases"]),
                millimetres(r["outline_m"]),
                millimetres(r["outline_95_m"]),
                f"{r['grid_iou_mean']:.3f}",
                f"{r['grid_iou']:.3f}",
            ]
            for name, r in summary["objects"].items()
        ]
        parts.append(markdown_table(head, rows))
        head = ["pose", "frames", "occluded, mean", "largest", "position, RMS [mm]", "worst [mm]", "yaw, RMS [deg]"]
        head += [f"in the {_NOMINAL:.0%} region", "not tracked"]
        rows = [
            [
                f"{name}, {_LABELS[variant]}{label}",
                str(r[key]["frames"]),
                f"{r[key]['hidden']:.0%}",
                f"{r[key]['most_hidden']:.0%}",
                millimetres(r[key]["position_m"]),
                millimetres(r[key]["worst_m"]),
                f"{np.degrees(r[key]['yaw']):.2f}",
                f"{r[key]['in_region']:.0%}",
                str(r[key]["not_tracked"]),
            ]
            for name, r in summary["objects"].items()
            for variant in _VIEWS
            for kind, label in _KINDS.items()
            if (key := f"{variant}_{kind}") in r
        ]
        parts.append(markdown_table(head, rows))
    return parts


def _sensor_table(summary: Json) -> str:
    """Errors of outlines and of poses by the model of the sensor."""
    head = ["sensor", "cases", *_OUTLINES.values(), "95 % of one view within, worst case [mm]", "grid IoU"]
    head += [f"{what}, {label}" for label in _KINDS.values() for what in _POSE_HEAD]
    rows = []
    for name, row in summary["sensors"].items():
        cells = [name, str(row["cases"]), *(millimetres(row.get(key)) for key in _OUTLINES)]
        cells += [millimetres(row["outline_95_m"]), f"{row['grid_iou']:.3f}"]
        for kind in _KINDS:
            if poses := row.get(kind):
                cells += [millimetres(poses["position_m"]), f"{np.degrees(poses['yaw']):.2f}", f"{poses['in_region']:.0%}"]
                cells.append(f"{poses['not_tracked']} of {poses['frames'] + poses['not_tracked']}")
            else:
                cells += ["–"] * len(_POSE_HEAD)
        rows.append(cells)
    return markdown_table(head, rows)


def _scene_table(summary: Json) -> str:
    scenes = summary["recorded"]["scenes"]
    rows = [
        [
            name,
            str(len(scene["objects"])),
            str(sum(o["found"] for o in scene["objects"])),
            str(scene["n_segments"]),
            f"{np.mean([o['iou'] for o in scene['objects']]):.3f}" if scene["objects"] else "–",
            f"{min(o['iou'] for o in scene['objects']):.3f}" if scene["objects"] else "–",
            f"{sum(o.get('shape_iou', 0.0) >= _FOUND for o in scene['objects'])}",
            f"{scene.get('n_wrong_shapes', 0)}",
        ]
        for name, scene in scenes.items()
    ]
    return markdown_table(["recorded scene", "objects", "found", "segments", "mean IoU", "worst IoU", "shapes right", "shapes wrong"], rows)


def _latency_table(summary: Json) -> str:
    own = summary["latency"]
    rows = [
        ["median [ms]", f"{1e3 * own['median_s']:.1f}"],
        ["99th percentile [ms]", f"{1e3 * own['p99_s']:.1f}"],
        ["worst [ms]", f"{1e3 * own['worst_s']:.1f}"],
        ["processor time of a pose [ms]", f"{1e3 * own['cpu_per_frame_s']:.1f}"],
        ["frames, poses", f"{own['n_frames']}, {own['n_poses']}"],
        ["load of the machine", f"{own['load']:.1f}"],
    ]
    return markdown_table(["from image to pose, between processes", ""], rows)


def _tables(summary: Json) -> str:
    parts = _view_tables(summary)
    if "sensors" in summary:
        parts.append(_sensor_table(summary))
    if "recorded" in summary:
        parts.append(_scene_table(summary))
    if "latency" in summary:
        parts.append(_latency_table(summary))
    return "\n\n".join(parts)


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    pictures = {}
    if summary["coverage"]:
        figure, (ax,) = new_figure(1, width=5.2, height=4.6)
        ax.plot([0, 1], [0, 1], color="black", linestyle=":", linewidth=1)
        for (label, shares), colour in zip(summary["coverage"].items(), COLOURS.values(), strict=False):
            ax.plot([float(level) for level in shares], list(shares.values()), "o-", color=colour, markersize=4, label=label)
        ax.set_xlabel("probability of the region")
        ax.set_ylabel("share of true poses within it")
        ax.legend(fontsize=8, frameon=False)
        ax.grid(alpha=0.3)
        save(figure, folder / "perception.png")
        pictures["perception.png"] = (
            "Whether the stated covariance of poses is right: above the dotted line it is too large, below too small."
        )
    scenes = summary.get("recorded", {}).get("scenes", {})
    if scenes:
        figure, axes = new_figure(1, len(scenes), width=6.4, height=2.7)
        for ax, (name, scene) in zip(axes, scenes.items(), strict=True):
            code = np.frombuffer(base64.b64decode(scene["picture"]), np.uint8)
            ax.imshow(cv2.imdecode(code, cv2.IMREAD_COLOR)[..., ::-1])
            ax.set_axis_off()
            overlaps = ", ".join(f"{o['iou']:.2f}" for o in scene["objects"])
            ax.set_title(f"{name}: IoU from above {overlaps}", fontsize=9)
        save(figure, folder / "perception-scenes.png")
        pictures["perception-scenes.png"] = (
            "Recorded scenes: labels of their authors (left) and segments found here (right); colours do not correspond."
        )
    return pictures


STUDY = Experiment(
    name="perception",
    place=100,
    title="Errors and times of perception",
    question=(
        "An object is placed anywhere in any heading, segmented from ten frames at rest, then moved three times by 5 to 10 cm and up to "
        "40 degrees in half a second, with a rest of 20 frames after each, in which its outline may get better. Depth comes from the "
        "simulated camera with its noise (30 Hz, 640 x 480). In a third of the cases 40 % of the object's pixels are occluded, from "
        "another side in each frame. In another third the arm is in the picture: its fist touches the outline on the side it pushes "
        "from, moves with the object, and waits for 0.13 s before and after; pushes out of its reach are drawn again; perception knows "
        "its joint positions, without error. The outline is compared with the true one, where it is and placed as well as a rigid "
        "motion can, its cells as the overlap of the areas (IoU). Position errors count both axes together; the object frame is that of "
        "the first detection. With each model of a sensor, the same in full view: the camera stands where the sensor sees the "
        "workspace, each case has another unit, and perception gets the pose and intrinsics that the unit publishes, not its own. "
        "Errors are then those in the table frame that the camera sees; by how much the extrinsics displace an object is a column. The "
        "recorded scenes come from a Kinect, with labels by others; an object counts as found from an IoU of 0.5 with its best segment, "
        "both in the view from above. Delays are measured between processes, the node on one core."
    ),
    variants=(*_VIEWS, *SENSORS, "recorded", "latency"),
    fewer=dict.fromkeys(SENSORS, _SENSOR_MODELS),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "perception", "nodes"),
    once=("recorded", "latency"),
)
