"""The decision policy: every number is documented and hashed; what poses and outlines from a camera change in it, and their outliers."""

from __future__ import annotations

import ast
import inspect
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest

from helpers.diagnosis import frame_residuals
from helpers.objects import hammer_shape
from push_ident.diagnosis import policy as module
from push_ident.diagnosis.camera import OUTLINE_ERRORS, POSE_ERRORS, camera_settings, outlier_pushes
from push_ident.diagnosis.policy import CameraPolicy, DecisionPolicy, SelectionPolicy
from push_ident.diagnosis.settings import DiagnosisSettings


def test_errors_of_a_camera_join_the_base_model_once_and_an_outline_is_as_accurate_as_its_deviations_say() -> None:
    settings = camera_settings(DiagnosisSettings(base_effects=("wear", *POSE_ERRORS[:1])), hammer_shape())
    assert settings.base_effects[:2] == ("wear", POSE_ERRORS[0])
    assert sorted(settings.base_effects) == sorted({"wear", *OUTLINE_ERRORS, *POSE_ERRORS})
    traced = replace(hammer_shape(), outline_std=np.full(len(hammer_shape().outline), 1.5e-3))
    (name,) = OUTLINE_ERRORS
    assert settings.effect_std[name] == pytest.approx((4e-4,))
    assert camera_settings(DiagnosisSettings(), traced).effect_std[name] == pytest.approx((1.5e-3,))


def test_camera_raises_margins_and_noise_and_lowers_none() -> None:
    strict = DiagnosisSettings(policy=DecisionPolicy(selection=SelectionPolicy(discrepancy_rivals=50.0)))
    with_camera = camera_settings(strict, hammer_shape())
    selection = with_camera.policy.selection
    assert selection.discrepancy_rivals == 50.0 and selection.min_log_bayes_factor == pytest.approx(15.0, abs=0.1)
    assert with_camera.policy.for_camera() == with_camera.policy
    assert with_camera.noise.floor_position >= strict.noise.floor_position
    assert selection.log_prior_effect == SelectionPolicy().log_prior_effect


def test_pushes_that_disagree_with_all_others_are_outliers_unless_they_are_many() -> None:
    policy, noise = CameraPolicy(), np.random.default_rng(2).normal(size=(8, 30, 3))
    assert outlier_pushes(frame_residuals(noise), policy) == ()
    # So many pushes have a common cause.
    for pushes, outliers in (([2, 5], (2, 5)), ([2, 5, 6], ())):
        larger = noise.copy()
        larger[pushes] *= 3.0
        assert outlier_pushes(frame_residuals(larger), policy) == outliers


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
