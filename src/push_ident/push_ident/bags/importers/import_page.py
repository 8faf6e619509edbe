"""The page of an import: do pusher and object meet, what was imported, the checks in words, and what to do next."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident import __version__
from push_ident.bags.importers.report import ImportReport
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import BagContents, ObjectTrack, read_bag
from push_ident.checking.forces import check_forces
from push_ident.checking.overlap import Overlap
from push_ident.checking.records import RecordCheck
from push_ident.errors import BagError
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.pages.outline_chart import Placed, outline_panel
from push_ident.pages.page import write_page
from push_ident.pages.time_chart import Line, time_chart
from push_ident.types import Float64Array, PusherShape, PushRecord

_MOST_ROWS: Final = 60
"""Pushes in the table; of more, those that miss most."""
_CIRCLE: Final = np.linspace(0.0, 2.0 * np.pi, 41)[:-1]
_Centre = Callable[[int], Float64Array]


@dataclass(frozen=True, slots=True)
class _ReadBack:
    """The new bag as all other commands read it."""

    object_id: str
    track: ObjectTrack
    contents: BagContents
    pushes: list[PushRecord]


@dataclass(frozen=True, slots=True)
class _Check:
    """One check: what was found, what is expected."""

    name: str
    found: str
    expected: str
    good: bool


def write_import_page(path: Path, report: ImportReport, source: str) -> None:
    """Write the page of a bag that was imported from `source`.

    The bag is read again, as other commands read it: the page shows what is in it, not what was meant to be. Raises InputError where the
    page cannot be written.
    """
    back, problem = _read_back(report)
    checks = _checks(report, back, problem)
    is_good = all(check.good for check in checks) and not report.warnings
    verdict = _verdict(report)
    write_page(
        path,
        __package__,
        "import.html.j2",
        _context(report.overlap)
        | {
            "title": f"Import of {report.bag.name}: {verdict}",
            "headline": f"{_count(report.n_pushes, 'push')} of {source} {'is' if report.n_pushes == 1 else 'are'} now in {report.bag}.",
            "wrong": list(report.warnings),
            "checks": checks,
            "rows": _rows(report, back),
            "n_pushes": report.n_pushes,
            "facts": _facts(report, back),
            "notes": list(report.notes),
            "steps": _steps(report, back, is_good),
        },
    )


def write_refusal_page(path: Path, overlap: Overlap, reason: str) -> None:
    """Write the page of a recording in which the pusher never comes near the object, so that there is no bag. Raises InputError."""
    write_page(
        path,
        __package__,
        "import.html.j2",
        _context(overlap)
        | {
            "title": "Import: pusher and object do not meet",
            "headline": "No bag was written: nothing in this recording is a push of this object.",
            "wrong": [reason, *([] if overlap.causes or not len(overlap.distance) else [overlap.explanation()])],
            "checks": [],
            "rows": [],
            "n_pushes": 0,
            "facts": [
                ("object", f"{_size(overlap.shape.outline)}, {len(overlap.shape.cells)} cells"),
                ("pusher", _pusher(PusherShape(overlap.radius))),
                ("accepted distance of pusher and outline", f"{1e3 * overlap.tolerance:.1f} mm"),
            ],
            "notes": [],
            "steps": [*_mend(overlap), ("Then import again.", "")],
        },
    )


def force_warnings(bag: Path) -> tuple[str, ...]:
    """Why the forces of a bag that was imported cannot be those of the pusher; empty where they can, or where it has none."""
    try:
        contents = read_bag(bag)
        pushes = split_pushes(contents, next(iter(contents.objects)))
    except BagError:  # the page says so
        return ()
    return check_forces(pushes).warnings


def write_check_page(path: Path, checked: RecordCheck) -> None:
    """Write the page of pushes that were checked as they are in memory. Raises InputError where it cannot be written."""
    overlap, facts = checked.overlap, []
    if overlap is not None:
        facts = [
            ("object", f"{_size(overlap.shape.outline)}, {len(overlap.shape.cells)} cells"),
            ("pusher", _pusher(PusherShape(overlap.radius))),
            ("accepted distance of pusher and outline", f"{1e3 * overlap.tolerance:.1f} mm"),
        ]
    step = "Nothing is wrong as far as these pushes show it." if checked.agrees else "Mend it where they are recorded or read."
    content = {
        "title": f"{_count(len(checked.records), 'push')}: {'they agree' if checked.agrees else 'they contradict themselves'}",
        "headline": "Contacts, clocks and forces of pushes, checked against each other.",
        "explanation": "" if overlap is None else f"{overlap.finding()}.",
        "wrong": list(checked.warnings),
        "checks": [],
        "rows": [],
        "n_pushes": len(checked.records),
        "facts_title": "What was checked",
        "facts": facts,
        "notes": list(checked.notes),
        "steps": [(step, "")],
    }
    write_page(path, __package__, "import.html.j2", _context(overlap) | content)


def _context(overlap: Overlap | None) -> dict[str, Any]:
    figures = _overlap_figures(overlap) if overlap is not None and len(overlap.push) else []
    return {
        "figures": figures,
        "explanation": "" if overlap is None else overlap.explanation(),
        "most_rows": _MOST_ROWS,
        "version": f"push_ident {__version__}, Python {platform.python_version()}",
    }


def _verdict(report: ImportReport) -> str:
    overlap, warned = report.overlap, " in most frames, with warnings" if report.warnings else ""
    if overlap is None:
        return "look at the warnings" if report.warnings else "no warning"
    if not len(overlap.push):
        return "no frame shows the object in motion"
    return f"pusher and object meet{warned}" if overlap.fits else "pusher and object do not meet"


def _read_back(report: ImportReport) -> tuple[_ReadBack | None, str]:
    try:
        contents = read_bag(report.bag)
        object_id, track = next(iter(contents.objects.items()))
        return _ReadBack(object_id, track, contents, split_pushes(contents, object_id)), ""
    except BagError as error:
        return None, str(error)


def _checks(report: ImportReport, back: _ReadBack | None, problem: str) -> list[_Check]:
    n, tolerance = report.n_pushes, 1e3 * report.tolerance
    expected = f"within ± {tolerance:.1f} mm"
    found = [_Check("the bag can be read", problem or f"{_count(n, 'push')} written", f"{_count(n, 'push')} read", back is not None)]
    if back is not None:
        found = [_Check("the bag can be read", f"{_count(len(back.pushes), 'push')} read", f"{n} written", len(back.pushes) == n)]
        moved = sum(_way(push) > report.tolerance for push in back.pushes)
        found.append(_Check("every push moves the object", f"{moved} of {len(back.pushes)}", "all", moved == len(back.pushes)))
    distance = 1e3 * report.contact_distance[np.isfinite(report.contact_distance)]
    if len(distance):
        text = f"{np.mean(distance):.1f} ± {np.std(distance):.1f} mm, farthest {distance[np.argmax(np.abs(distance))]:.1f} mm"
        found.append(_Check("pusher on the outline at first contact", text, expected, bool(np.all(np.abs(distance) <= tolerance))))
    overlap = report.overlap
    if overlap is not None and len(overlap.distance):
        share = float(np.mean(np.abs(overlap.distance) <= overlap.tolerance))
        text = f"{1e3 * overlap.miss:.1f} mm in the median, {100 * share:.0f} % of the frames within"
        found.append(_Check("pusher on the outline while the object moves", text, expected, overlap.fits))
    # With six pushes maps predict new ones to about the noise (docs: what makes data useful).
    found.append(_Check("enough pushes for maps", str(n), "6 or more, from different sides", n >= 6))
    return found


def _rows(report: ImportReport, back: _ReadBack | None) -> list[dict[str, str]]:
    """What each push is, of more than `_MOST_ROWS` those that miss most."""
    pushes = {} if back is None else {int(push.source.rpartition(" ")[2]) - 1: push for push in back.pushes}
    overlap = report.overlap
    median = {}  # distance of pusher and outline while the object moves [m]
    if overlap is not None:
        median = {int(push): float(np.median(overlap.distance[overlap.push == push])) for push in np.unique(overlap.push)}
    missed = [np.nanmax(np.abs([0.0, report.contact_distance[k], median.get(k, np.nan)])) for k in range(report.n_pushes)]
    shown = sorted(np.argsort(missed, kind="stable")[-_MOST_ROWS:].tolist())
    return [
        {
            "number": str(k + 1),
            "time": "–" if k not in pushes else f"{pushes[k].pusher.time[-1] - pushes[k].pusher.time[0]:.1f} s",
            "way": "left out" if k not in pushes else f"{1e3 * _path(pushes[k]):.0f} mm",
            "turn": "–" if k not in pushes else f"{np.degrees(pushes[k].poses.pose[-1, 2] - pushes[k].poses.pose[0, 2]):.0f}°",
            "first": _millimetres(float(report.contact_distance[k])),
            "median": _millimetres(median.get(k, float("nan"))),
            "verdict": "misses" if missed[k] > report.tolerance else "meets" if missed[k] > 0 else "not shown",
        }
        for k in shown
    ]


def _facts(report: ImportReport, back: _ReadBack | None) -> list[tuple[str, str]]:
    facts = [("bag", str(report.bag))]
    if back is not None:
        track, contents = back.track, back.contents
        if track.shape is not None:
            facts.append(("object", f"{back.object_id}: {_size(track.shape.outline)}, {len(track.shape.cells)} cells"))
        facts.append(("pusher", _pusher(contents.pusher_shape)))
        facts.append(("poses", f"{len(track.time)} in {track.time[-1] - track.time[0]:.0f} s, {_rate(track.time)}"))
        std = np.sqrt(np.median(track.covariance, axis=0).diagonal())
        facts.append(("standard deviation of a pose", f"{1e3 * std[0]:.2f} mm and {np.degrees(std[2]):.2f}°"))
        n_forces = 0 if contents.wrench is None else len(contents.wrench.time)
        facts.append(("force", f"{n_forces} samples" if n_forces else "none: pushes alone do not show the total mass; weigh the object"))
    if report.mass is not None:
        facts.append(("published mass", f"{report.mass:g} kg"))
    if report.centre_of_mass is not None:
        facts.append(("published centre of mass", _point(report.centre_of_mass)))
    if len(report.supports):
        facts.append(("published supports", ", ".join(_point(point) for point in report.supports)))
    if report.surface:
        facts.append(("surface of the table", report.surface))
    return facts


def _steps(report: ImportReport, back: _ReadBack | None, is_good: bool) -> list[tuple[str, str]]:
    """Sentences, each with the command that it asks for, or none; a third of the pushes is held out to measure the error of predictions."""
    bag, name = shlex.quote(str(report.bag)), shlex.quote(f"out/{report.bag.stem}")
    if report.warnings or back is None:
        first = [("Look at the pushes and files that the warnings name.", "")]
        if report.overlap is not None and not report.overlap.fits:
            first = _mend(report.overlap)
        return [*first, ("Then import again under another --out, since a bag is not overwritten, and leave this bag aside.", "")]
    steps = [("The picture and the checks show nothing wrong." if is_good else "Look at the checks above first.", "")]
    weighed = "" if report.mass is None else f" --total-mass {report.mass:g}"
    n = len(back.pushes)
    train = f" --train 0-{n - max(1, n // 3) - 1}" if n > 3 else ""
    steps.append(("Identify the maps; pushes that are not in --train (it counts from 0) measure the error of predictions:" if train else
                  "Identify the maps:", f"push-ident identify {bag}{train}{weighed} --out {name}_maps"))  # fmt: skip
    if n >= 8:  # a diagnosis can tell effects from each other (docs: what makes data useful)
        steps.append(("Ask what the model lacks for these pushes:", f"push-ident diagnose {bag} --out {name}_diagnosis"))
    else:
        steps.append(("For a diagnosis record 8 to 14 pushes from different sides.", ""))
    return steps


def _mend(overlap: Overlap) -> list[tuple[str, str]]:
    """The likely mistakes, the first one first."""
    if not overlap.causes:
        return [("Check frames, units, the pusher's radius and the clocks of both recordings; no single mistake explains the miss.", "")]
    words = ["Most likely", *["Or"] * len(overlap.causes)]
    return [(f"{word}: {cause.text}.", "") for word, cause in zip(words, overlap.causes, strict=False)]


def _way(push: PushRecord) -> float:
    """Farthest that a point of the outline may have moved between the ends of a push [m]."""
    first, last = push.poses.pose[[0, -1]]
    lever = float(np.linalg.norm(push.shape.outline, axis=1).max())
    return _path(push) + lever * abs(float(last[2] - first[2]))


def _path(push: PushRecord) -> float:
    """Distance of the object frame between the ends of a push [m]."""
    first, last = push.poses.pose[[0, -1]]
    return float(np.linalg.norm(last[:2] - first[:2]))


def _size(outline: Float64Array) -> str:
    width, height = 1e3 * np.ptp(outline, axis=0)
    return f"{width:.0f} x {height:.0f} mm"


def _pusher(shape: PusherShape | None) -> str:
    if shape is None or (shape.is_cylinder and not shape.radius):
        return "a point"
    radius = f"radius {1e3 * shape.radius:.1f} mm"
    if shape.fingers is not None:
        return f"two fingers of {radius}, {1e3 * float(np.linalg.norm(shape.fingers[1] - shape.fingers[0])):.1f} mm apart"
    return radius if shape.polygon is None else f"a prism of {len(shape.polygon)} corners, rounded by {radius}"


def _rate(time: Float64Array) -> str:
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    return f"{1.0 / step:.0f} a second" if 0 < step < 1.0 else "before and after each push only"


def _point(point: Sequence[float] | Float64Array) -> str:
    return f"({1e3 * float(point[0]):.1f}, {1e3 * float(point[1]):.1f}) mm"


def _millimetres(metres: float) -> str:
    return f"{round(1e3 * metres, 1) + 0.0:.1f} mm" if np.isfinite(metres) else "–"  # no -0.0


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 'es'}"


def _overlap_figures(overlap: Overlap, most: int = 12) -> list[tuple[str, str]]:
    """Caption and drawing of the first pushes in the table frame, in the object frame, and over time. There is one frame at least.

    `most`: pushes that are drawn; with more, circles and outlines cover each other.
    """
    pushes = np.unique(overlap.push)[:most]
    n = len(np.unique(overlap.push))
    some = "" if n == len(pushes) else f" (the first {len(pushes)} of {n} pushes)"
    captions = (
        f"As the object begins to move, on the table: each circle, the pusher, should touch its outline{some}",
        f"The same in the object frame: the circles should lie against the outline, outside of it{some}",
        f"While the object moves, the distance of pusher and outline should stay in the green band{some}",
    )
    drawings = (
        _on_table(captions[0], overlap, pushes),
        _in_object_frame(captions[1], overlap, pushes),
        _over_time(captions[2], overlap, pushes),
    )
    return list(zip(captions, drawings, strict=True))


def _on_table(title: str, overlap: Overlap, pushes: Float64Array) -> str:
    placed = []
    for push in pushes:
        k = _first(overlap, push)
        text = f"object as push {push + 1:.0f} begins to move it"
        placed.append(Placed(transform_points(overlap.pose[k], overlap.shape.outline), "outline", text))
    for push in pushes:
        path = overlap.pusher[overlap.push == push]
        placed.append(Placed(path, "trace", f"path of the pusher while push {push + 1:.0f} moves the object", closed=False))
    return _panel(title, placed, overlap, pushes, lambda k: overlap.pusher[k])


def _in_object_frame(title: str, overlap: Overlap, pushes: Float64Array) -> str:
    def centre(k: int) -> Float64Array:
        return transform_points(inverse(overlap.pose[k]), overlap.pusher[k : k + 1])[0]

    return _panel(title, [Placed(overlap.shape.outline, "outline", "outline of the object")], overlap, pushes, centre)


def _panel(title: str, placed: list[Placed], overlap: Overlap, pushes: Float64Array, centre: _Centre) -> str:
    """What is placed already, and a circle for each push where `centre` has the pusher in a frame; one that is a point is seen as well."""
    first = [_first(overlap, push) for push in pushes]
    centres = np.array([centre(k) for k in first])
    every = np.vstack([*(one.corners for one in placed), centres - overlap.radius, centres + overlap.radius])
    frame = np.array([every.min(axis=0), every.max(axis=0)])
    radius = max(overlap.radius, 0.006 * float(np.max(frame[1] - frame[0])))
    circle = radius * np.column_stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
    for push, k, middle in zip(pushes, first, centres, strict=True):
        style = "meets" if abs(overlap.distance[k]) <= overlap.tolerance else "missed"
        text = f"pusher of push {push + 1:.0f}: {1e3 * overlap.distance[k]:.1f} mm from the outline"
        placed.append(Placed(middle + circle, style, text, label=f"{push + 1:.0f}"))
    return outline_panel(title, placed, frame)


def _over_time(title: str, overlap: Overlap, pushes: Float64Array) -> str:
    lines = []
    for push in pushes:
        of_push = overlap.push == push
        distance = 1e3 * overlap.distance[of_push]
        style = "trace" if abs(np.median(distance)) <= 1e3 * overlap.tolerance else "missed"
        lines.append(Line(overlap.time[of_push], distance, style, f"push {push + 1:.0f}: {np.median(distance):.1f} mm in the median"))
    return time_chart(
        title,
        lines,
        x_axis="since the object began to move [s]",
        y_axis="pusher to outline [mm], negative: inside",
        band=1e3 * overlap.tolerance,
    )


def _first(overlap: Overlap, push: float) -> int:
    """The first frame in which a push moves the object: one far before the next, by twice the median step, is noise."""
    of_push = np.flatnonzero(overlap.push == push)
    step = np.diff(overlap.time[of_push])
    return int(of_push[np.argmax(step <= 2.0 * np.median(step))]) if len(step) else int(of_push[0])
