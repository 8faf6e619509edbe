"""What is simulated beside the model: who pushes, where the object lies, when its pose is reported."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from push_ident.errors import InputError
from push_ident.types import Float64Array, PusherPath


@dataclass(frozen=True, slots=True)
class PushScenario:
    """One push of an object at rest.

    Raises:
        InputError: a pose or times that are not finite or have another shape, or times that descend.
    """

    pusher: PusherPath
    """Path of the pusher. Before its first and after its last sample the pusher stands still."""
    pose_object_in_table: Float64Array
    """First pose (x, y, yaw), the true one also where effects change reported poses, shape (3,)."""
    time: Float64Array
    """When to report the pose [s], on the clock of `pusher`, in ascending order, shape (n_frames,)."""
    order: float = 0.0
    """Number of pushes made before this one."""
    force_time: Float64Array = field(default_factory=lambda: np.zeros(0))
    """When to report the impulse of the pusher [s], in ascending order, shape (n_forces,); of none by default."""

    @property
    def duration(self) -> float:
        """From the first sample of the pusher to `end` [s]."""
        return self.end - float(self.pusher.time[0])

    @property
    def end(self) -> float:
        """When the pusher is at rest and everything is reported [s]."""
        return max(float(self.time[-1]), float(self.pusher.time[-1]), float(self.force_time[-1]) if len(self.force_time) else -np.inf)

    def __post_init__(self) -> None:
        pose, time = np.array(self.pose_object_in_table, dtype=np.float64), np.array(self.time, dtype=np.float64)
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise InputError(f"The first pose is {pose}, expected three finite numbers (x, y, yaw).")
        if time.ndim != 1 or len(time) == 0 or not np.isfinite(time).all() or (time[1:] < time[:-1]).any():
            raise InputError("The times to report must be finite and ascend; sort them first.")
        force_time = np.array(self.force_time, dtype=np.float64)
        if force_time.ndim != 1 or not np.isfinite(force_time).all() or (force_time[1:] < force_time[:-1]).any():
            raise InputError("The times at which to report impulses must be finite and ascend; sort them first.")
        for name, array in (("pose_object_in_table", pose), ("time", time), ("force_time", force_time)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)
