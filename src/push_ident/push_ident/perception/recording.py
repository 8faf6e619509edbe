"""Perception of a whole depth recording."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import FrameError, PerceptionError
from push_ident.perception.frame.robot import RobotPart
from push_ident.perception.known_object import TrackStatus
from push_ident.perception.pipeline import Perception
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import CameraAccuracy, DepthFrame, Float64Array, ObjectShape, PoseTrack


def observe_offline(
    frames: Iterable[DepthFrame],
    camera_in_table: ArrayLike,
    *,
    robot_at: Callable[[float], Sequence[RobotPart]] | None = None,
    settings: PerceptionSettings | None = None,
) -> dict[str, tuple[ObjectShape, PoseTrack]]:
    """Shapes and tracks of all objects in a depth recording.

    The frames at rest from which an object was registered get poses as well. Frames in which it was lost are missing in its track.

    Args:
        frames: In the order of their stamps.
        robot_at: Parts of the robot at a time [s].

    Returns:
        The last shape and the track by id, without those that came apart.

    Raises PerceptionError: No object has two poses; the text gives the stage that failed.
    """
    perception = Perception(camera_in_table, settings, occupancy=False)
    parts_at = robot_at or (lambda stamp: ())
    recent: deque[DepthFrame] = deque(maxlen=perception.settings.rest_frames)
    shapes: dict[str, ObjectShape] = {}
    tracks: dict[str, list[tuple[float, Float64Array, Float64Array]]] = {}
    n_frames, why, given_up = 0, "there are no frames", ""
    for frame in frames:
        n_frames += 1
        try:
            observation = perception.observe(frame, parts_at(frame.stamp))
        except (FrameError, PerceptionError) as error:
            why = str(error)
            continue
        if observation.restarted:
            raise PerceptionError(f"Time goes back at {frame.stamp:.3f} s in the recording; cut it there and process the parts separately.")
        recent.append(frame)
        for removal in observation.removed:
            # Its track is that of several things.
            tracks.pop(removal.object_id)
            given_up = f"object {removal.object_id} is {removal.reason.value}"
        for name, shape in observation.new_shapes.items():
            shapes[name] = shape
            fits = [(earlier.stamp, perception.fit(name, earlier, parts_at(earlier.stamp))) for earlier in recent]
            tracks[name] = [(stamp, fit.pose, fit.covariance) for stamp, fit in fits if fit.status is TrackStatus.TRACKED]
        shapes |= observation.refined
        for known in observation.objects:
            if known.pose is not None and known.covariance is not None:
                tracks[known.object_id].append((observation.stamp, known.pose, known.covariance))
        why = observation.why_no_pose()
    shapes |= perception.finish()
    accuracy = perception.settings.camera_accuracy
    result = {name: (shapes[name], _pose_track(track, accuracy)) for name, track in tracks.items() if len(track) >= 2}
    if not result:
        raise PerceptionError(
            f"No object was found in {n_frames} depth frames: {given_up or why or 'each has a pose in fewer than two frames'}."
        )
    return result


def _pose_track(track: Sequence[tuple[float, Float64Array, Float64Array]], accuracy: CameraAccuracy) -> PoseTrack:
    time, pose, covariance = (np.array(column) for column in zip(*track, strict=True))
    return PoseTrack(time, pose, covariance, accuracy)
