"""Poses and outlines from a camera: errors of sensing within its accuracy belong to the base model.

An effect is a camera error where its parameters have a `camera_std`, the accuracy of a calibrated camera. Those of the outline stay in the
base model. Those of the poses return to the effects that may be found where they come out larger than the accuracy explains: the camera
itself is then in question.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.diagnosis.earlier import EarlierFits
from push_ident.diagnosis.policy import CameraPolicy
from push_ident.diagnosis.residuals import FrameResiduals, standardized_residuals
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.state import DiagnosisState
from push_ident.physics.effects import CAMERA_ERRORS, EFFECTS
from push_ident.types import ObjectShape

OUTLINE_ERRORS: Final = tuple(name for name in CAMERA_ERRORS if EFFECTS[name].moves_outline)
"""Camera errors that displace the outline."""
POSE_ERRORS: Final = tuple(name for name in CAMERA_ERRORS if not EFFECTS[name].moves_outline)
"""Camera errors of the measured poses."""


def camera_settings(settings: DiagnosisSettings, shape: ObjectShape) -> DiagnosisSettings:
    """Settings for poses and outlines from a camera: its errors belong to the base model, noise and margins are larger.

    The outline is as accurate as its own deviations say; without them, as that of a calibrated camera.
    """
    noise, policy = settings.noise, settings.policy.camera
    camera_errors = [name for name in CAMERA_ERRORS if name not in settings.base_effects]
    accuracy = {name: tuple(p.camera_std or p.scale for p in EFFECTS[name].parameters) for name in CAMERA_ERRORS}
    if shape.outline_error is not None:
        accuracy |= {name: (shape.outline_error,) for name in OUTLINE_ERRORS}
    return replace(
        settings,
        base_effects=(*settings.base_effects, *camera_errors),
        effect_std=settings.effect_std | accuracy,
        # Errors of a perceived pose depend on place and view, so that no mean over frames removes them. These numbers hold the errors of
        # the outline push by push as well; that of the whole outline is an effect of the base model.
        noise=replace(
            noise,
            floor_position=max(noise.floor_position, policy.floor_position),
            floor_yaw=max(noise.floor_yaw, policy.floor_yaw),
            fit_discrepancy_position=max(noise.fit_discrepancy_position, policy.fit_discrepancy_position),
            fit_discrepancy_yaw=max(noise.fit_discrepancy_yaw, policy.fit_discrepancy_yaw),
            max_moving_frames=min(noise.max_moving_frames, policy.max_moving_frames),
            outline_errors=False,
            discrepancy_modes=0,
        ),
        policy=settings.policy.for_camera(),
    )


def camera_is_in_question(state: DiagnosisState) -> bool:
    """Whether the errors of the camera, beside all effects that were found, are larger than its accuracy explains.

    What the requested settings have in the base model stays there.
    """
    if not state.from_camera or state.selection is None:
        return False
    fit, requested = state.selection.fit, state.requested
    pose_errors = [name for name in POSE_ERRORS if name in fit.names and name not in requested.base_effects]
    limit = requested.policy.camera.max_deviations
    return any(bool(np.any(np.abs(fit.effect_unknowns[fit.fitted_effects.slice_of(name)]) > limit)) for name in pose_errors)


def question_camera(state: DiagnosisState) -> DiagnosisState:
    """The state with the camera's errors of the poses among the effects that may be found."""
    settings, requested = state.settings, state.requested
    kept = tuple(name for name in settings.base_effects if name not in POSE_ERRORS or name in requested.base_effects)
    effect_std = {name: std for name, std in settings.effect_std.items() if name not in POSE_ERRORS or name in requested.effect_std}
    return replace(state, settings=replace(settings, base_effects=kept, effect_std=effect_std))


def outlier_pushes(residuals: FrameResiduals, policy: CameraPolicy) -> tuple[int, ...]:
    """Numbers of the pushes that disagree with all others, beside all effects that were found; none where they are more than a few.

    The pusher met an edge that is not where the camera traced it.
    """
    ratios = {int(push): residuals.residual_ratio_of(residuals.push == push) for push in np.unique(residuals.push)}
    outliers = tuple(push for push, ratio in ratios.items() if ratio > policy.outlier_residual_ratio)
    return outliers if len(outliers) <= policy.max_outlier_share * len(ratios) else ()


def set_outliers_aside(state: DiagnosisState) -> DiagnosisState:
    """The state without the outlier pushes of its selection; the same state where there is none."""
    if not state.from_camera or state.selection is None:
        return state
    policy = state.settings.policy
    outliers = outlier_pushes(standardized_residuals(state.selection.fit, policy.residuals), policy.camera)
    if not outliers:
        return state
    return replace(
        state,
        records=tuple(record for push, record in enumerate(state.records) if push not in outliers),
        outliers=tuple(state.source_of(push) for push in outliers),
        earlier=EarlierFits(),
    )
