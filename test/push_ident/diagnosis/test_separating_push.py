"""The push that would resolve a tie, and the check that needs no push."""

from __future__ import annotations

import numpy as np

from helpers.diagnosis import simulated_pushes, stub_fit
from push_ident.diagnosis.fits import fit_base, fit_effects
from push_ident.diagnosis.next_push import NO_EFFECT, competing_explanations, separating_push
from push_ident.diagnosis.policy import NextPushPolicy, SelectionPolicy
from push_ident.diagnosis.selection import Candidate, Selection, Step
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.pushing.push import PushSettings


def test_no_push_distinguishes_an_error_of_the_tool_from_one_of_the_camera() -> None:
    """The object lies where it is reported, and with an error of the camera elsewhere: exact twins then predict the same of every push."""
    base = fit_base(simulated_pushes(3, 1, {"tool_offset": [0.003, 0.001]}), DiagnosisSettings())
    fits = {name: fit_effects(base, (name,)) for name in ("tool_offset", "camera_translation")}
    limits, policy = PushSettings(workspace=(-1.0, 1.0, -1.0, 1.0)), NextPushPolicy()
    twins = separating_push(fits, np.zeros(3), limits, policy)
    other = separating_push({"nothing": base, "tool_offset": fits["tool_offset"]}, np.zeros(3), limits, policy)
    assert twins is None and other is not None and other.mahalanobis2 > 9.0 and other.resolves
    three = separating_push({"nothing": base, **fits}, np.zeros(3), limits, policy)
    assert three is not None and "nothing" in three.between and three.mahalanobis2 > 9.0 and not three.resolves


def test_explanations_compete_with_no_effect_with_rivals_or_with_absence() -> None:
    def names(found: tuple[str, ...], **log_bayes_factors: float) -> list[str]:
        candidates = tuple(Candidate(name, stub_fit(name), value) for name, value in log_bayes_factors.items())
        selection = Selection(stub_fit(), stub_fit(*found), (Step(stub_fit(), None, (), candidates),))
        return list(competing_explanations(selection, SelectionPolicy()))

    assert names((), wear=2.0, tether=1.0, restitution=0.5) == [NO_EFFECT, "wear", "tether"]
    assert names(("wear",), wear=50.0, tether=48.0) == ["wear", "tether"]
    assert names(("wear",), wear=50.0, tether=10.0) == ["without wear", "wear"]
    # No push distinguishes exact twins.
    assert names(("tool_offset",), tool_offset=50.0, camera_translation=50.0) == ["without tool_offset", "tool_offset"]
