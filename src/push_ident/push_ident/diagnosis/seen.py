"""What is known of poses and outlines that a camera told: errors of sensing within its accuracy belong to the base model."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.diagnosis.fits import EffectFit
from push_ident.diagnosis.residuals import Frames
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.identification.observation import NoiseModel
from push_ident.physics.effects import CAMERA_ERRORS, EFFECTS

__all__ = ["SEEN_OUTLINE", "as_seen", "is_off", "odd_pushes", "with_camera_in_question"]

SEEN_OUTLINE: Final = next(name for name in CAMERA_ERRORS if EFFECTS[name].moves_outline)
"""Effect that belongs to the base model where a camera traced the outline."""
_CAMERA: Final = tuple(name for name in CAMERA_ERRORS if not EFFECTS[name].moves_outline)
"""Effects that belong to the base model within the accuracy of a camera, whose error changes with place and view."""
_POSE_STD: Final = (7e-4, 6e-3)
"""Of a pose of such an object, shared by all frames of a rest [m, rad]."""
_GROWTH: Final = (0.012, 0.12)
"""Discrepancy per way gone: the edge that the pusher meets is off by its own amount at every place [1, rad/m]."""
_MOVING_FRAMES: Final = 10
"""Kept of a motion at most: neighbouring frames share an error that depends on the pose, so that more of them tell nothing new."""
_SEEN: Final = 15.0
"""Gain of log evidence from which an effect counts as seen [nat]: what is left of the camera's errors gained up to 11 where nothing was."""
_SURE: Final = 25.0
"""And from which it is named without its runners-up."""
_UNKNOWN: Final = 30.0
"""And from which a smooth wrench does."""
_APART: Final = 10.0
"""Differences below this tell no effects apart [nat]."""
_ODD: Final = 2.5
"""Mean square of the residuals of one push, over that of a model that is right, from which it goes its own way."""
_MOST_ODD: Final = 0.25
"""Share of the pushes that may: more of them have something in common."""
_OFF: Final = 2.5
"""Deviations from which a camera is not as accurate as it should be."""


def as_seen(settings: DiagnosisSettings) -> DiagnosisSettings:
    """Settings for poses and outlines that a camera told: its errors belong to the base model."""
    accuracy = {name: tuple(p.camera_std or p.scale for p in EFFECTS[name].parameters) for name in CAMERA_ERRORS}
    own = [name for name in CAMERA_ERRORS if name not in settings.base_effects]
    asked = settings.thresholds
    thresholds = replace(
        asked,
        seen=max(asked.seen, _SEEN),
        sure=max(asked.sure, _SURE),
        unknown=max(asked.unknown, _UNKNOWN),
        apart=max(asked.apart, _APART),
    )
    base = (*settings.base_effects, *own)
    return replace(
        settings, base_effects=base, effect_std=settings.effect_std | accuracy, noise=_noise(settings.noise), thresholds=thresholds
    )


def is_off(fit: EffectFit, asked: DiagnosisSettings) -> bool:
    """Whether the errors of the camera, beside all effects that were found, are larger than its accuracy explains.

    Args:
        fit: under settings by `as_seen`.
        asked: the settings before that: what they have in the base stays there.
    """
    values = fit.z[fit.parameters.effect_slice]
    own = [name for name in _CAMERA if name in fit.names and name not in asked.base_effects]
    return any(bool(np.any(np.abs(values[fit.effects.slice_of(name)]) > _OFF)) for name in own)


def odd_pushes(frames: Frames) -> tuple[int, ...]:
    """Pushes that go their own way whatever explains the others: the pusher met an edge that is not where the camera traced it.

    Args:
        frames: what is left beside all that was found.

    Returns:
        Their numbers; none where they are more than a few.
    """
    misfit = {int(push): frames.misfit_of(frames.push == push) for push in np.unique(frames.push)}
    odd = tuple(push for push, own in misfit.items() if own > _ODD)
    return odd if len(odd) <= _MOST_ODD * len(misfit) else ()


def with_camera_in_question(settings: DiagnosisSettings, asked: DiagnosisSettings) -> DiagnosisSettings:
    """The same settings with the errors of the camera as effects that may be found; `asked` as in `is_off`."""
    kept = tuple(name for name in settings.base_effects if name not in _CAMERA or name in asked.base_effects)
    effect_std = {name: std for name, std in settings.effect_std.items() if name not in _CAMERA or name in asked.effect_std}
    return replace(settings, base_effects=kept, effect_std=effect_std)


def _noise(noise: NoiseModel) -> NoiseModel:
    """Noise of poses that a camera tells: their error depends on place and view, and no mean over frames takes it away."""
    return replace(
        noise,
        floor_position=max(noise.floor_position, _POSE_STD[0]),
        floor_yaw=max(noise.floor_yaw, _POSE_STD[1]),
        fit_discrepancy_position=max(noise.fit_discrepancy_position, _GROWTH[0]),
        fit_discrepancy_yaw=max(noise.fit_discrepancy_yaw, _GROWTH[1]),
        max_moving_frames=min(noise.max_moving_frames, _MOVING_FRAMES),
    )
