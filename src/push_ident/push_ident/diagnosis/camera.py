"""Poses and outlines from a camera: errors of sensing within its accuracy belong to the base model.

An effect is a camera error where its parameters have a `camera_std`, the accuracy of a calibrated camera. They return to the effects that
may be found where they come out larger than the accuracy explains, or the pushes depart from the model by more than is
usual: the camera itself is then in question.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.state import DiagnosisState
from push_ident.identification.observing.observation import errors_shared_by_frames
from push_ident.physics.effects import CAMERA_ERRORS, EFFECTS
from push_ident.types import PushRecord

OUTLINE_ERRORS: Final = tuple(name for name in CAMERA_ERRORS if EFFECTS[name].moves_outline)
"""Camera errors that displace the outline."""


def camera_settings(settings: DiagnosisSettings, records: Sequence[PushRecord]) -> DiagnosisSettings:
    """Settings for poses and outlines from a camera: its errors belong to the base model, those that frames share to the noise.

    The outline is as accurate as its own deviations say; without them, as that of a calibrated camera.
    """
    noise, policy, shape = settings.noise, settings.policy.camera, records[0].shape
    camera_errors = [name for name in CAMERA_ERRORS if name not in settings.base_effects]
    accuracy = {name: tuple(p.camera_std or p.scale for p in EFFECTS[name].parameters) for name in camera_errors}
    if shape.outline_error is not None:
        accuracy |= {name: (shape.outline_error,) for name in OUTLINE_ERRORS if name in camera_errors}
    # Errors of a perceived pose depend on place and view, so that no mean over frames removes them.
    x, y, yaw = errors_shared_by_frames(records)
    return replace(
        settings,
        base_effects=(*settings.base_effects, *camera_errors),
        effect_std=settings.effect_std | accuracy,
        noise=replace(
            noise,
            floor_position=max(noise.floor_position, x, y),
            floor_yaw=max(noise.floor_yaw, yaw),
            max_moving_frames=min(noise.max_moving_frames, policy.max_moving_frames),
        ),
    )


def camera_is_in_question(state: DiagnosisState) -> bool:
    """Whether the errors of the camera, beside all effects that were found, are larger than its accuracy explains, or so much departs from
    the model that they may have become its discrepancy.

    What the requested settings have in the base model stays there.
    """
    if not state.from_camera or state.selection is None or not _returned_by_questioning(state):
        return False
    fit, policy = state.selection.fit, state.requested.policy
    errors = [fit.effect_unknowns[fit.fitted_effects.slice_of(n)] for n in _returned_by_questioning(state) if n in fit.names]
    is_large = any(bool(np.any(np.abs(error) > policy.camera.max_deviations)) for error in errors)
    return is_large or fit.has_discrepancy_above(policy.selection.usual_discrepancy)


def question_camera(state: DiagnosisState) -> DiagnosisState:
    """The state with the camera's errors among the effects that may be found."""
    settings, returned = state.settings, _returned_by_questioning(state)
    kept = tuple(name for name in settings.base_effects if name not in returned)
    # Of the size of an effect, not of the camera's accuracy.
    effect_std = settings.effect_std | {name: tuple(p.scale for p in EFFECTS[name].parameters) for name in returned}
    return replace(state, settings=replace(settings, base_effects=kept, effect_std=effect_std))


def _returned_by_questioning(state: DiagnosisState) -> list[str]:
    """Errors of the camera in the base model, but for those that were requested there."""
    requested = state.requested
    return [n for n in CAMERA_ERRORS if n in state.settings.base_effects and n not in (*requested.base_effects, *requested.effect_std)]
