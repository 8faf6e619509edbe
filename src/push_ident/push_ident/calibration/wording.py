"""The check of a calibration in plain sentences, as JSON, and as a parameter file."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from push_ident.calibration.check import CalibrationCheck, NextPush, Outcome, Quantity, Verdict
from push_ident.geometry.se3 import quaternion_of_pose
from push_ident.limits import plain_text
from push_ident.survey.parameter_file import HEADING_STD, POSITION_STD, pose_lines
from push_ident.types import Float64Array

_WORDS: Final = {
    "camera_x": "camera along x",
    "camera_y": "camera along y",
    "camera_heading": "camera about z",
    "surface": "outline and radius",
    "clock": "clock of the poses",
}
_SCALES: Final = {"m": (1e3, "mm"), "rad": (1e3, "mrad"), "s": (1e3, "ms")}
"""Units for people."""
HEADINGS: Final = ("quantity", "from contacts", "as configured", "probability", "")
"""Of the columns of `rows_of`."""


def _size(quantity: Quantity, value: float, std: float | None = None) -> str:
    factor, unit = _SCALES[quantity.unit]
    return f"{factor * value:.1f} {unit}" if std is None else f"{factor * value:.1f} ± {factor * std:.1f} {unit}"


def rows_of(check: CalibrationCheck) -> list[tuple[str, ...]]:
    """A row for each quantity: name, estimate and configured value with their deviations, probability, outcome."""
    rows: list[tuple[str, ...]] = []
    for q in check.quantities:
        configured = _size(q, 0.0, q.stated_std) if q.stated_std else "0"
        shown = (_size(q, q.estimate, q.std), configured, f"{q.probability:.2g}") if _is_seen(q) else ("–", configured, "–")
        rows.append((_WORDS[q.name], *shown, q.outcome.value))
    return rows


def _is_seen(quantity: Quantity) -> bool:
    """Whether the contacts show it at all: a number ten times less exact than needed says nothing."""
    return quantity.std < 10.0 * quantity.needed_std


def sentences_of(check: CalibrationCheck) -> list[str]:
    """The verdict and what follows from it."""
    said = [_verdict_text(check)]
    of = {quantity.name: quantity for quantity in check.quantities}
    if _is_seen(of["camera_x"]) and _is_seen(of["camera_y"]) and not check.warnings:
        said.append(_displacement_text(check))
    if (q := of["surface"]).outcome is Outcome.DIFFERS:
        side = "outside" if q.estimate > 0 else "inside"
        said.append(
            f"The tool touches {_size(q, abs(q.estimate), q.std)} {side} of outline and radius: measure the diameter of the tool and a "
            "length of the object, pushes show only their sum."
        )
    if (clock := of.get("clock")) is not None and clock.outcome is Outcome.DIFFERS:
        order = "late" if clock.estimate > 0 else "early"
        said.append(f"Poses are stamped {_size(clock, abs(clock.estimate), clock.std)} {order}: compare the clocks of camera and arm.")
    if unknown := [_WORDS[q.name] for q in check.quantities if q.outcome is Outcome.UNKNOWN]:
        said.append(f"Not shown as exactly as it is stated or needed: {', '.join(unknown)}.")
    if check.next_push is not None:
        said.append(next_text(check.next_push, check))
    return said


def _displacement_text(check: CalibrationCheck) -> str:
    by = check.unknowns[:2]
    size = float(np.linalg.norm(by))
    along = by / max(size, 1e-9)
    std = float(np.sqrt(along @ check.covariance[:2, :2] @ along))
    return (
        f"Where the pushes were, at ({check.centre[0]:.2f}, {check.centre[1]:.2f}) m, the camera shows things {1e3 * size:.1f} ± "
        f"{1e3 * std:.1f} mm from where the tool meets them, towards ({along[0]:.2f}, {along[1]:.2f}). Pushes show where camera and tool "
        "stand relative to each other, not which of them is displaced."
    )


def _verdict_text(check: CalibrationCheck) -> str:
    pushes = f"{len(check.contacts)} of {check.n_pushes} pushes show contacts"
    differing = [_WORDS[q.name] for q in check.quantities if q.outcome is Outcome.DIFFERS]
    return {
        Verdict.AGREES: f"The calibration agrees with the contacts, within what is stated of it ({pushes}).",
        Verdict.DIFFERS: f"The calibration is wrong: {', '.join(differing)} ({pushes}).",
        Verdict.NOT_ENOUGH: f"The contacts do not show yet whether the calibration is right ({pushes}).",
    }[check.verdict]


def next_text(push: NextPush, check: CalibrationCheck) -> str:
    """What to push next, and what it would show."""
    quantity = next(q for q in check.quantities if q.name == push.name)
    return (
        f"Push next with the tool moving towards ({push.towards[0]:.1f}, {push.towards[1]:.1f}), the object near ({push.place[0]:.2f}, "
        f"{push.place[1]:.2f}) m, at {1e3 * push.speed:.0f} mm/s: {_WORDS[push.name]} would be known to {_size(quantity, push.std_after)} "
        f"instead of {_size(quantity, push.std)}."
    )


def calibration_json(check: CalibrationCheck, camera_in_table: Float64Array | None) -> dict[str, Any]:
    """The result as JSON; `camera_in_table`: the pose that was in use, shape (4, 4), where it is known."""
    push = check.next_push
    correction = None
    if check.verdict is not Verdict.NOT_ENOUGH and camera_in_table is not None:
        pose, accuracy = check.corrected(camera_in_table)
        correction = {
            "position_m": pose[:3, 3].tolist(),
            "quaternion": list(quaternion_of_pose(pose)),
            "position_std_m": accuracy.position,
            "heading_std": accuracy.heading,
        }
    return {
        "verdict": check.verdict.value,
        "quantities": [
            {
                "name": q.name,
                "unit": q.unit,
                "estimate": q.estimate,
                "std": q.std,
                "stated_std": q.stated_std or None,
                "deviations": q.deviations,
                "probability": q.probability,
                "outcome": q.outcome.name.lower(),
            }
            for q in check.quantities
        ],
        "centre_m": check.centre.tolist(),
        "together": {"estimate": check.unknowns.tolist(), "covariance": check.covariance.tolist()},
        "corrected_camera": correction,
        "n_pushes": check.n_pushes,
        "n_with_contact": len(check.contacts),
        "next_push": None
        if push is None
        else {
            "towards": push.towards.tolist(),
            "place_m": push.place.tolist(),
            "speed": push.speed,
            "shows": push.name,
            "std": push.std,
            "std_after": push.std_after,
        },
        "sentences": sentences_of(check),
        "warnings": list(check.warnings),
    }


def camera_file(check: CalibrationCheck, camera_in_table: Float64Array, source: str) -> str:
    """A parameter file of perception_node with the camera where the contacts and its calibration together place it."""
    pose, accuracy = check.corrected(camera_in_table)
    lines = [
        "extrinsics: parameters",
        *pose_lines(pose),
        f"{POSITION_STD}: {accuracy.position:.6f}",
        f"{HEADING_STD}: {accuracy.heading:.6f}",
    ]
    head = (
        f"# Made by `push-ident check-calibration` from {len(check.contacts)} pushes of {plain_text(source)}. Lengths in metres.\n"
        "# Things lie then where the tool meets them. Height and tilt are those of the calibration before.\n"
        "/**/perception_node:\n  ros__parameters:\n"
    )
    return head + "".join(f"    {line}\n" for line in lines)
