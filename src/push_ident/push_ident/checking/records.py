"""What is wrong with recorded pushes, found without a model of the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.checking.contact import Contact, contact_of, contact_tolerance_of, contact_warnings
from push_ident.checking.forces import check_forces
from push_ident.checking.overlap import Overlap, Streams, overlap_of
from push_ident.pages.tables import html_table
from push_ident.types import Float64Array, PushRecord

_APART: Final = 60.0
"""Between the last time of one push and the first of the next where pushes are compared together [s]: longer than any clock is searched."""


@dataclass(frozen=True, slots=True)
class RecordCheck:
    """Whether poses, path of the pusher and forces of pushes agree with each other."""

    records: tuple[PushRecord, ...]
    """The pushes; forces that cannot be those of the pusher, or that no contact confirms, are left out, offsets of the sensor taken off."""
    overlap: Overlap | None
    """Pusher and object while the object moves; None for a pusher that is no cylinder."""
    notes: tuple[str, ...] = ()
    """What was corrected."""
    warnings: tuple[str, ...] = ()
    """What is wrong with the pushes: results of them are wrong, too."""

    def __repr__(self) -> str:
        return f"RecordCheck({len(self.records)} pushes {'agree' if self.agrees else 'contradict themselves'}{self._list()})"

    def _repr_html_(self) -> str:
        """For notebooks."""
        rows = [(text,) for text in (*self.warnings, *self.notes)]
        return html_table(f"{len(self.records)} pushes {'agree' if self.agrees else 'contradict themselves'}", ("finding",), rows)

    @property
    def agrees(self) -> bool:
        """Whether nothing is wrong as far as contacts, clocks and forces show it."""
        return not self.warnings

    def _list(self) -> str:
        return "".join(f"; {text.rstrip('.')}" for text in (*self.warnings, *self.notes))


def check_records(records: Sequence[PushRecord], *, tare: bool = True) -> RecordCheck:
    """Check pushes of one object, at least one.

    Pusher and object have to meet where the object moves, to within the accuracy of their poses; then forces have to point into the
    object, and to be zero without contact. A fit can hide such an error in its maps. `tare`: take offsets of the force sensor off.
    """
    if any(not record.pusher.shape.is_cylinder for record in records):
        return RecordCheck(tuple(records), None)
    tolerance = contact_tolerance_of(records)
    overlap = overlap_of(one_stream(records, tolerance))
    # Of end poses no frame shows the motion: the pusher must at least come to where the object stood.
    by_ends = {number: _contact(record, tolerance) for number, record in enumerate(records) if number not in overlap.push}
    warnings = contact_warnings({number: contact for number, contact in by_ends.items() if contact.moved}, tolerance)
    if not overlap.fits:
        causes = "; or ".join(cause.finding for cause in overlap.causes)
        why = f"probably {causes}" if causes else "no single mistake explains it"
        # Where the contacts are wrong, nothing shows whether the forces are right.
        poses_only = tuple(replace(record, wrench=None) for record in records)
        return RecordCheck(poses_only, overlap, warnings=(*warnings, f"{overlap.finding()} in the median; {why}."))
    forces = check_forces(records, tare=tare)
    return RecordCheck(forces.records, overlap, forces.notes, (*warnings, *forces.warnings))


def _contact(record: PushRecord, tolerance: float) -> Contact:
    poses, pusher = record.poses, record.pusher
    path = np.column_stack([pusher.time, pusher.position])
    return contact_of(poses.time, poses.pose, path, shape=record.shape, radius=pusher.radius, tolerance=tolerance)


def one_stream(records: Sequence[PushRecord], tolerance: float) -> Streams:
    """The pushes one after the other, each on a time of its own."""
    poses: list[Float64Array] = []
    runs: list[Float64Array] = []
    start = 0.0
    for record in records:
        first = min(record.poses.time[0], record.pusher.time[0])
        shift = start - first
        poses.append(np.column_stack([record.poses.time + shift, record.poses.pose]))
        runs.append(np.column_stack([record.pusher.time + shift, record.pusher.position, np.zeros(len(record.pusher.time))]))
        start = max(poses[-1][-1, 0], runs[-1][-1, 0]) + _APART
    return Streams(np.vstack(poses), runs, records[0].shape, records[0].pusher.radius, tolerance, units=frozenset())
