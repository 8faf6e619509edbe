"""The decision policy: every number is documented and hashed; what poses and outlines from a camera change in it, and their outliers."""

from __future__ import annotations

import ast
import inspect
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest

from helpers.diagnosis import NOISE, simulated_pushes
from push_ident.diagnosis import policy as module
from push_ident.diagnosis.camera import OUTLINE_ERRORS, camera_settings
from push_ident.diagnosis.policy import DecisionPolicy
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.physics.effects import CAMERA_ERRORS


def test_errors_of_a_camera_join_the_base_model_once_and_an_outline_is_as_accurate_as_its_deviations_say() -> None:
    (record,) = simulated_pushes(1, seed=0)
    settings = camera_settings(DiagnosisSettings(base_effects=("wear", "camera_rotation")), [record])
    assert settings.base_effects[:2] == ("wear", "camera_rotation")
    assert sorted(settings.base_effects) == sorted({"wear", *CAMERA_ERRORS})
    traced = replace(record, shape=replace(record.shape, outline_std=np.full(len(record.shape.outline), 1.5e-3)))
    (name,) = OUTLINE_ERRORS
    assert settings.effect_std[name] == pytest.approx((4e-4,))
    assert camera_settings(DiagnosisSettings(), [traced]).effect_std[name] == pytest.approx((1.5e-3,))


def test_errors_that_frames_of_a_camera_share_are_those_that_their_scatter_does_not_show() -> None:
    records = simulated_pushes(4, seed=0)
    assert camera_settings(DiagnosisSettings(), records).noise.floor_position < 4e-4
    # Frames that state twice the deviation by which they scatter.
    claimed = [replace(record, poses=replace(record.poses, covariance=4.0 * record.poses.covariance)) for record in records]
    noise = camera_settings(DiagnosisSettings(), claimed).noise
    assert (noise.floor_position, noise.floor_yaw) == pytest.approx((np.sqrt(3.0) * NOISE[0], np.sqrt(3.0) * NOISE[2]), rel=0.1)


def test_hash_depends_on_every_number() -> None:
    policy = DecisionPolicy()
    hashes = {policy.sha256}
    for section in fields(policy):
        own = getattr(policy, section.name)
        for field in fields(own):
            value = getattr(own, field.name)
            other = {**value, "": 9.0} if isinstance(value, dict) else (*value[:-1], 9.0) if isinstance(value, tuple) else value + 1
            hashes.add(replace(policy, **{section.name: replace(own, **{field.name: other})}).sha256)
    assert len(hashes) == 1 + sum(len(fields(getattr(policy, section.name))) for section in fields(policy)) > 50
    assert DecisionPolicy().sha256 == policy.sha256


def test_every_number_is_documented() -> None:
    """A field is followed by a string that gives its meaning and its source."""
    classes = [
        node for node in ast.parse(inspect.getsource(module)).body if isinstance(node, ast.ClassDef) and node.name != "DecisionPolicy"
    ]
    for statement, after in (pair for node in classes for pair in pairwise([*node.body, ast.Pass()])):
        if isinstance(statement, ast.AnnAssign):
            assert isinstance(after, ast.Expr) and len(ast.unparse(after)) > 20, ast.unparse(statement)
