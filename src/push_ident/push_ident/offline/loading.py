"""The pushes of one object from one or more bags; poses are tracked in depth images where a bag has none."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, overload

import numpy as np

from push_ident.bags.pushes import pushes_by_object, split_pushes
from push_ident.bags.read_options import ReadOptions
from push_ident.bags.reader import BagContents, ObjectTrack, read_bag
from push_ident.errors import BagError, PerceptionError
from push_ident.identification.observing.observation import observe_push, pusher_gaps
from push_ident.identification.predicting.possible_poses import check_poses, why_no_object_ends_there
from push_ident.identification.results.posterior import prior_posterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.pages.tables import html_table
from push_ident.physics.effect import OnContact
from push_ident.physics.effects import EFFECTS
from push_ident.types import Float64Array, PushRecord

if TYPE_CHECKING:
    from push_ident.perception.frame.robot import Cylinder

_CONTACT: Final = tuple(effect.name for effect in EFFECTS.values() if effect.acts == OnContact("offset"))
"""Effects of the surface that the pusher touches: an error of the outline, or of the pusher's radius."""


@dataclass(frozen=True, slots=True)
class LoadedPushes(Sequence[PushRecord]):
    """The pushes of one object: a sequence of records; a slice is as many pushes of the same object."""

    object_id: str
    records: list[PushRecord]
    """In order of bags and time."""
    notes: list[str]
    """Data that was missing, dropped or assumed; one line each."""
    nuisances: tuple[str, ...] = ()
    """Names of effects that stand for what the bags do not give: the radius of the pusher, or an outline."""
    camera_in_table: Float64Array | None = None
    """Pose of the depth camera of the first bag that has it, or the one that was given, homogeneous, shape (4, 4)."""

    def __len__(self) -> int:
        return len(self.records)

    @overload
    def __getitem__(self, index: int) -> PushRecord: ...

    @overload
    def __getitem__(self, index: slice) -> LoadedPushes: ...

    def __getitem__(self, index: int | slice) -> PushRecord | LoadedPushes:
        if isinstance(index, slice):
            return replace(self, records=self.records[index])
        return self.records[index]

    def __repr__(self) -> str:
        cells = f", {len(self.records[0].shape.cells)} cells" if self.records else ""
        return f"LoadedPushes({len(self)} pushes of object {self.object_id!r}{cells}, {len(self.notes)} notes)"

    def _repr_html_(self) -> str:
        """For notebooks: a row for each push."""
        rows = [
            (
                record.source or str(number),
                f"{1e3 * float(np.linalg.norm(record.poses.pose[-1, :2] - record.poses.pose[0, :2])):.0f} mm",
                f"{math.degrees(float(record.poses.pose[-1, 2] - record.poses.pose[0, 2])):.0f}°",
                f"{record.pusher.time[-1] - record.pusher.time[0]:.1f} s",
                str(len(record.poses.time)),
            )
            for number, record in enumerate(self.records, 1)
        ]
        heads = ("push", "object moved", "turned", "time", "poses")
        return html_table(f"{len(self)} pushes of object {self.object_id}", heads, rows, note=" ".join(self.notes))


def load_pushes(
    paths: Sequence[Path],
    *,
    object_id: str = "",
    camera_in_table: Float64Array | None = None,
    options: ReadOptions | None = None,
    possible_with: Prior | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> LoadedPushes:
    """Read the pushes of one object from bags of the contract.

    Args:
        paths: bags. Where one has no object poses, they are tracked in its depth images.
        object_id: the object; empty: the only one, or the one with the most pushes.
        camera_in_table: extrinsics for depth bags without them, homogeneous, shape (4, 4).
        options: topics with other names than those of the contract, and the unit of depth images.
        possible_with: prior of the object: poses and pushes that are impossible under it are left out. None: keep all, as for a
            diagnosis.
        on_progress: called with a line of text for each step.

    Raises:
        BagError: a bag cannot be read, lacks what is needed, or has another object than the others.
    """
    records: list[PushRecord] = []
    notes: list[str] = []
    is_contact_measured = True
    camera = None
    for path in paths:
        contents = read_bag(path, options)
        camera = contents.camera_in_table if camera is None else camera
        if not contents.has_poses:
            if on_progress:
                on_progress(f"{path.name}: no object poses; tracking the object in {contents.n_depth} depth images")
            contents = track_from_depth(contents, camera_in_table)
        chosen = object_id or most_pushed(contents)
        object_id = object_id or chosen
        pushes = split_pushes(contents, chosen)
        notes += [f"{path.name}: {note}" for note in contents.notes]
        if contents.pusher_radius is None:
            radius = touching_radius(pushes)
            notes.append(f"{path.name}: a radius of {1e3 * radius:.1f} mm is assumed: that near the pusher came to the outline (median).")
            pushes = [replace(push, pusher=replace(push.pusher, radius=radius)) for push in pushes]
        if possible_with is not None:
            pushes, left_out = _possible(pushes, possible_with)
            notes += left_out
        records += pushes
        is_contact_measured &= contents.pusher_radius is not None and contents.objects[chosen].has_outline
    records = [replace(record, order=order) for order, record in enumerate(records)]
    first = records[0]
    for record in records:
        if not np.array_equal(record.shape.cells.centres, first.shape.cells.centres):
            raise BagError(
                f"{record.source} has {len(record.shape.cells)} other cells than {first.source}; "
                "only bags with the same cells of one object can be identified together, such as those of one run."
            )
    return LoadedPushes(object_id, records, notes, () if is_contact_measured else _CONTACT, camera_in_table if camera is None else camera)


def _possible(pushes: list[PushRecord], prior: Prior) -> tuple[list[PushRecord], list[str]]:
    """The pushes without poses that no push can have made, and notes of what is left out."""
    possible, notes, refused = [], [], []
    any_object = prior_posterior(pushes[0].shape, prior)
    for push in pushes:
        checked = check_poses(push)
        is_touched = not checked.why and observe_push(checked.record).touched
        if why := checked.why or (why_no_object_ends_there(checked.record, any_object, prior) if is_touched else ""):
            refused.append(f"{push.source}: no push can have made its poses: {why}")
            continue
        possible.append(checked.record)
        notes += [f"{push.source}: {checked.note}"] if checked.note else []
    # Above one half, frames, units or clocks are wrong rather than single poses: the fit then names the cause.
    if len(refused) > 0.5 * len(pushes):
        cause = "look at frames, units and clocks of poses and pusher"
        return pushes, [f"{len(refused)} of {len(pushes)} pushes are impossible but not left out; {cause}. The first is {refused[0]}"]
    return possible, notes + [f"left out is {text}" for text in refused]


def touching_radius(records: Sequence[PushRecord]) -> float:
    """Radius at which the pusher would just touch the object where it came nearest to the outline [m], the median over the pushes, >= 0.

    The object moved, so the pusher touched it. Errors of the poses make this too small by about their standard deviation.
    """
    return max(0.0, float(np.median([np.min(pusher_gaps(record)) + record.pusher.radius for record in records])))


def track_from_depth(contents: BagContents, camera_in_table: Float64Array | None = None) -> BagContents:
    """The same bag with objects detected and tracked in its depth images."""
    # Bags of poses need none of this, and it takes half a second to import.
    from push_ident.perception.frame.depth_unit import wrong_unit
    from push_ident.perception.frame.robot import Cylinder
    from push_ident.perception.recording import observe_offline
    from push_ident.perception.settings import PerceptionSettings

    camera = contents.camera_in_table if contents.camera_in_table is not None else camera_in_table
    if camera is None:
        raise BagError(
            f"{contents.path}: depth images without the pose of the camera; record /tf_static (`table` -> camera), or give "
            "`push-ident identify`, `predict` or `diagnose` its pose with --camera FILE."
        )
    pusher, radius = contents.pusher, contents.pusher_radius or 0.0
    max_age = 0.1  # [s] between a depth image and the pose that places the pusher in it

    def robot_at(stamp: float) -> list[Cylinder]:
        """The pusher, if its position is known at that time."""
        after = int(np.searchsorted(pusher.time, stamp))
        if np.min(np.abs(pusher.time[max(after - 1, 0) : after + 1] - stamp)) > max_age:
            return []
        x, y = (float(np.interp(stamp, pusher.time, pusher.value[:, axis])) for axis in (0, 1))
        return [Cylinder(x=x, y=y, radius=radius)]

    settings = PerceptionSettings()
    accuracy = contents.camera_accuracy or settings.camera_accuracy
    settings = replace(settings, camera_accuracy=accuracy)
    try:
        tracked = observe_offline(contents.depth_frames(), camera, robot_at=robot_at, settings=settings)
    except PerceptionError as error:
        if (wrong := wrong_unit(next(contents.depth_frames()), camera)) is None:
            raise PerceptionError(f"{contents.path}: {error}") from None
        remedy = (
            "`push-ident identify`, `predict`, `selftest`, `diagnose`, `check-calibration`, `fleet` and `replay` take it as "
            f"--depth-unit {wrong.unit:g}"
        )
        raise PerceptionError(f"{contents.path}: {wrong}; {remedy}.") from None
    objects = {
        object_id: ObjectTrack(shape=shape, time=track.time, pose=track.pose, covariance=track.covariance)
        for object_id, (shape, track) in tracked.items()
    }
    if not objects:
        raise BagError(f"{contents.path}: no object was found in its {contents.n_depth} depth images; check the pose of the camera.")
    return replace(contents, objects=objects, camera_accuracy=accuracy)


def most_pushed(contents: BagContents) -> str:
    """The only object, or the one that the most pushes touch. Raises BagError where none of several has poses and usable cells."""
    if len(contents.objects) == 1:
        return next(iter(contents.objects))
    touched = {}
    for object_id, records in pushes_by_object(contents).items():
        if records:
            # About 100 pushes show which object is touched.
            some = records[:: 1 + len(records) // 100]
            touched[object_id] = float(np.mean([observe_push(record).touched for record in some])) * len(records)
    if not touched:
        reasons = " ".join(note for note in contents.notes if note.startswith("object "))
        raise BagError(
            f"{contents.path}: none of the objects {', '.join(contents.objects)} has cells, poses and a usable push. {reasons}".rstrip()
        )
    return max(touched, key=lambda key: touched[key])
