"""What is known of poses and outlines that a camera told: errors of sensing within its accuracy belong to the base model."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.diagnosis.fits import EffectFit
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.identification.observation import NoiseModel

__all__ = ["SEEN_OUTLINE", "as_seen", "is_off", "with_camera_in_question"]

SEEN_OUTLINE: Final = "outline_error"
"""Effect that belongs to the base model where a camera traced the outline."""
_CAMERA: Final = ("camera_translation", "camera_rotation", "camera_scale")
"""Effects that belong to the base model within the accuracy of a camera, whose error changes with place and view."""
_OUTLINE_STD: Final = 4e-4
"""Of a traced outline [m]; the perception of this suite is off by 0.32 mm root mean square."""
_CAMERA_SHARE: Final = 0.25
"""Accuracy of a calibrated camera as a share of the prior of its effects: 0.5 mm, 2.5 mrad, 0.5 %. Over the 0.1 m that an object is pushed
about, the perception of this suite was off by 0.3 mm and 3.5 mrad."""
_POSE_STD: Final = (5e-4, 4e-3)
"""Of a pose of such an object, shared by all frames of a rest [m, rad]."""
_MOVING_FRAMES: Final = 10
"""Kept of a motion at most: neighbouring frames share an error that depends on the pose, so that more of them tell nothing new."""
_SEEN: Final = 10.0
"""Gain of log evidence from which an effect counts as seen [nat]: what is left of the camera's errors gained up to 7 without any effect."""
_OFF: Final = 2.5
"""Deviations from which a camera is not as accurate as it should be."""


def as_seen(settings: DiagnosisSettings) -> DiagnosisSettings:
    """Settings for poses and outlines that a camera told: its errors belong to the base model."""
    prior = replace(settings.prior, outline_std=_OUTLINE_STD, camera_share=_CAMERA_SHARE)
    own = [name for name in (SEEN_OUTLINE, *_CAMERA) if name not in settings.base_effects]
    thresholds = replace(settings.thresholds, seen=max(settings.thresholds.seen, _SEEN))
    base = (*settings.base_effects, *own)
    return replace(settings, base_effects=base, prior=prior, noise=_noise(settings.noise), thresholds=thresholds)


def is_off(fit: EffectFit, asked: DiagnosisSettings) -> bool:
    """Whether the errors of the camera, beside all effects that were found, are larger than its accuracy explains.

    Args:
        fit: under settings by `as_seen`.
        asked: the settings before that: what they have in the base stays there.
    """
    values = fit.z[fit.parameters.effect_slice]
    own = [name for name in _CAMERA if name in fit.names and name not in asked.base_effects]
    return any(bool(np.any(np.abs(values[fit.effects.slice_of(name)]) > _OFF)) for name in own)


def with_camera_in_question(settings: DiagnosisSettings, asked: DiagnosisSettings) -> DiagnosisSettings:
    """The same settings with the errors of the camera as effects that may be found; `asked` as in `is_off`."""
    kept = tuple(name for name in settings.base_effects if name not in _CAMERA or name in asked.base_effects)
    return replace(settings, base_effects=kept, prior=replace(settings.prior, camera_share=asked.prior.camera_share))


def _noise(noise: NoiseModel) -> NoiseModel:
    """Noise of poses that a camera tells: their error depends on place and view, and no mean over frames takes it away."""
    floor_position = max(noise.floor_position, _POSE_STD[0])
    return replace(
        noise,
        floor_position=floor_position,
        floor_yaw=max(noise.floor_yaw, _POSE_STD[1]),
        max_moving_frames=min(noise.max_moving_frames, _MOVING_FRAMES),
    )
