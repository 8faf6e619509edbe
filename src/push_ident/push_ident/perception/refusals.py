"""Why something on the table is not taken in as an object."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

from push_ident.types import Float64Array


class Reason(Enum):
    """Kind of a refusal; the value says what the image shows and what to do about it."""

    AT_IMAGE_BORDER = "cut by the border of the image; move it into view"
    AT_WORKSPACE_BORDER = "reaches over the border of the workspace; move it inside, or enlarge workspace_low and workspace_high"
    BESIDE_ROBOT = "touches the robot, or something higher than max_object_height, in the image; move the robot away"
    BESIDE_UNMEASURED = "the camera measures nothing beside it; move camera, light or object, or make it less dark and glossy"
    BEHIND_ANOTHER = "partly hidden behind another one; move the nearer one out of the way"
    TOUCHING = "several things that touch: a part of it moved against the rest; move them apart"
    STACKED = "stacked or leaning: a thing that rests on another one; put each on the table itself"
    TOUCHES_KNOWN = "touches a known object, so where it ends cannot be seen; move them apart"
    TOO_SMALL = "smaller than min_object_area"
    TOO_LOW = "no higher than the noise of the table at its distance: it may be none; move it nearer to the camera"
    NOT_AT_REST = "not at rest yet"
    NO_SHAPE = "its shape cannot be traced"


@dataclass(frozen=True, slots=True)
class Refusal:
    """One segment that is no object, and why."""

    reason: Reason
    why: str
    """For people: the reason, with numbers where there are any."""
    outline: Float64Array
    """Convex outline of its points [m], shape (n, 2), table frame."""
    height: float
    """Of its highest points above the table [m]."""


@dataclass(frozen=True, slots=True)
class Removal:
    """An object that was given up, because it never was one thing."""

    object_id: str
    reason: Reason


def summary_of(refusals: Iterable[Refusal]) -> str:
    """One line for people: how many segments were refused for each reason, most frequent first."""
    counts = Counter(refusal.why for refusal in refusals)
    return "; ".join(f"{n} {'segment' if n == 1 else 'segments'}: {why}" for why, n in counts.most_common())
