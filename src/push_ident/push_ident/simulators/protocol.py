"""What a simulator of somebody else has to offer to be compared with recorded pushes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol, runtime_checkable

import numpy as np

from push_ident.errors import InputError
from push_ident.physics.effect_values import EffectValues
from push_ident.types import Float64Array, ObjectModel, PusherPath


@runtime_checkable
class PushSimulator(Protocol):
    """Pushes one object on a table."""

    @property
    def name(self) -> str:
        """For people."""

    def simulate(self, first_pose: Float64Array, tool_path: PusherPath, times: Float64Array) -> Float64Array:
        """Poses of the object while the tool follows a path.

        Args:
            first_pose: of the object at rest at the first time of the path (x, y, yaw), table frame, shape (3,).
            tool_path: of the pusher, table frame.
            times: at which poses are wanted, on the clock of the path [s], shape (n,).

        Returns:
            (x, y, yaw), table frame, shape (n, 3); yaw may have any number of turns.
        """


OBJECT: Final = "mass and friction of the object"
CONTACT: Final = "pusher friction, contact and time step"


@runtime_checkable
class CorrectableSimulator(PushSimulator, Protocol):
    """One whose scene can be corrected by what was identified."""

    def with_object(self, model: ObjectModel, effects: EffectValues | None = None) -> CorrectableSimulator:
        """The same scene with the identified mass and support friction of each cell, and the effects on friction and gravity that it can
        express; the pusher keeps its friction."""

    def with_precise_contact(self, pusher_friction: float) -> CorrectableSimulator:
        """The same scene with a friction coefficient of the pusher, and the time step and the contact parameters at which its engine is
        near rigid contact with Coulomb friction."""

    @property
    def in_threads(self) -> bool:
        """Whether pushes may be simulated at once, each in a thread."""

    @property
    def words(self) -> Mapping[str, str]:
        """What its users call what is corrected: of `OBJECT`, `CONTACT`, and the value of each `ExportAs` that it can have."""

    @property
    def contact_settings(self) -> str:
        """For people: what the engine has to be set to for gravity and contact of this scene."""

    def write(self, path: Path) -> list[Path]:
        """Write the scene with its changes; the files written."""


@dataclass(frozen=True, slots=True)
class FunctionSimulator:
    """A Python function as a simulator: `function(first_pose, tool_path, times)` of `PushSimulator.simulate`."""

    function: Callable[[Float64Array, PusherPath, Float64Array], Float64Array]

    @property
    def name(self) -> str:
        """Of the function."""
        return getattr(self.function, "__name__", "the simulator")

    def simulate(self, first_pose: Float64Array, tool_path: PusherPath, times: Float64Array) -> Float64Array:
        """As of `PushSimulator`. Raises InputError for a result of another shape, or numbers that are not finite."""
        poses = np.asarray(self.function(first_pose, tool_path, times), dtype=np.float64)
        if poses.shape != (len(times), 3) or not np.all(np.isfinite(poses)):
            raise InputError(
                f"{self.name} returned an array of shape {poses.shape}, expected finite poses (x, y, yaw) of shape ({len(times)}, 3), one "
                "for each time."
            )
        return poses
