"""An object that perception follows: how it is known, and where it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from push_ident.perception.refinement import Refined
from push_ident.perception.shape import TracedObject
from push_ident.perception.tracking import PoseFit, Template, TrackStatus
from push_ident.types import Float64Array

__all__ = ["TrackedObject"]

_MAX_AGE: Final = 0.2
"""Poses further apart in time do not estimate a velocity [s]."""


@dataclass(slots=True)
class TrackedObject:
    """A registered object and its latest pose."""

    traced: TracedObject
    """How it was traced when it was registered, or later from several rests."""
    template: Template
    area: float
    """Area of its segment [m^2]."""
    first_pose: Float64Array
    pose: Float64Array
    stamp: float
    velocity: Float64Array = field(default_factory=lambda: np.zeros(3))
    status: TrackStatus = TrackStatus.TRACKED
    checked: float = -math.inf
    """When it was last looked for missing parts [s]."""
    announced: bool = True
    """Whether its shape has been reported; that of a remembered object is when it is found again."""

    @property
    def is_tracked(self) -> bool:
        """Whether its latest pose is one."""
        return self.status is TrackStatus.TRACKED

    @property
    def placed(self) -> tuple[Template, Float64Array]:
        """What tracks it, and its latest pose."""
        return self.template, self.pose

    def predicted(self, stamp: float) -> Float64Array:
        """Pose at constant velocity."""
        age = stamp - self.stamp
        return self.pose + self.velocity * age if 0 < age < _MAX_AGE else self.pose

    def accept(self, fit: PoseFit, stamp: float) -> None:
        """Update status, pose and velocity with a fit."""
        self.status = fit.status
        if not fit.can_start_next:
            self.velocity = np.zeros(3)
            return
        age = stamp - self.stamp
        self.velocity = (fit.pose - self.pose) / age if 0 < age < _MAX_AGE else np.zeros(3)
        self.pose, self.stamp = fit.pose, stamp

    def adopt(self, better: Refined, template: Template) -> None:
        """Follow the object by a better outline from now on."""
        self.traced, self.template, self.area = better.traced, template, better.area
