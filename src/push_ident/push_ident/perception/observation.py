"""The result of perception for one frame."""

from __future__ import annotations

from dataclasses import dataclass, field

from push_ident.perception.frame.occupancy import TopDownGrid
from push_ident.perception.known_object import TrackStatus
from push_ident.perception.refusals import Refusal, Removal, summary_of
from push_ident.types import Float64Array, ObjectShape


@dataclass(frozen=True, slots=True)
class ObservedObject:
    """One known object in one frame."""

    object_id: str
    status: TrackStatus
    pose: Float64Array | None
    """(x, y, yaw) [m, m, rad], table frame; None unless TRACKED."""
    covariance: Float64Array | None
    """Shape (3, 3), table frame; None unless TRACKED."""


@dataclass(frozen=True, slots=True)
class Observation:
    """Result of one frame."""

    stamp: float
    """[s]"""
    objects: tuple[ObservedObject, ...]
    """All known objects that were tracked, lost or found again."""
    new_shapes: dict[str, ObjectShape]
    """Shapes of the objects registered with this frame, or remembered and found again, by id."""
    counts: dict[str, int]
    """Counts of each stage: `pixels`, `valid`, `tracked`, `lost`, and of the last search `table`, `robot`, `object_pixels`,
    `segments`, and refusals by their reason in small letters; `table_hidden` counts the checks of the plane that found too little of
    it."""
    refused: tuple[Refusal, ...]
    """What the last search found on the table that is no object, and why."""
    occupancy: TopDownGrid | None
    """None between two occupancy grids; they have a lower rate."""
    further_views: dict[str, str]
    """When an object was registered: per further camera the reason why its view was left out; empty where it was used."""
    restarted: bool = False
    """Whether time went back, so that everything known was dropped."""
    refined: dict[str, ObjectShape] = field(default_factory=dict)
    """Better shapes of known objects, by id: of several rests. The object frame stays."""
    not_refined: dict[str, str] = field(default_factory=dict)
    """Why the outline of an object, by id, stays as it is although a rest might have shown it better: what failed."""
    doubts: dict[str, str] = field(default_factory=dict)
    """Of objects registered with this frame, by id: why the tool may not touch them where their outlines are."""
    removed: tuple[Removal, ...] = ()
    """Objects that were given up with this frame, and why: they came apart. Their ids are not used again."""

    def why_no_pose(self) -> str:
        """Why no object has a pose; empty when one has."""
        if any(known.status is TrackStatus.TRACKED for known in self.objects):
            return ""
        if self.objects:
            return "; ".join(f"object {known.object_id}: {known.status.value}" for known in self.objects)
        if self.refused:
            return summary_of(self.refused)
        if n_pixels := self.counts.get("object_pixels", 0):
            return (
                f"{n_pixels} pixels show something on the table, but no connected patch of it has enough of them for an object; "
                "bring the camera nearer, or use a finer image"
            )
        return f"nothing on the table is higher than min_object_height ({self.counts['table']} pixels show the table)"
