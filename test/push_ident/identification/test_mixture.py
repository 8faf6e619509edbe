"""Kinds of support that stay beside each other in a posterior."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.objects import random_records, square
from push_ident.errors import ModelFileError
from push_ident.identification.predicting.prediction import predict
from push_ident.identification.results.explanation import Explanation, PushEvidence
from push_ident.identification.results.identifiability import identifiability
from push_ident.identification.results.known_effects import KnownEffect, with_known_effects
from push_ident.identification.results.model_file import load_model, save_model
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.unknowns.mechanics import model_at, uniform_model
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.physics.scenario import PushScenario

SHAPE = square(5, 0.02)
RECORDS = random_records(uniform_model(SHAPE), 5, 3)


def mixture() -> ModelPosterior:
    """A whole base that is known well, and two feet, at even odds."""
    whole = ModelPosterior.of_prior(UnknownsSpec.of(SHAPE, Prior(), modes=np.ones((len(SHAPE.cells), 1)) / 2))
    known = replace(whole, covariance=1e-4 * whole.covariance)
    feet = replace(known, unknowns=replace(whole.unknowns, prior=Prior().on_feet(2)))
    feet = replace(ModelPosterior.of_prior(feet.unknowns), covariance=1e-4 * np.eye(feet.unknowns.size))
    z = np.zeros(feet.unknowns.size)
    z[feet.unknowns.slices["foot_positions"]] = [1.0, 0.5, -1.0, -0.5]
    return replace(known, alternatives=((0.5, replace(feet, z=z)),))


def test_mixture_has_the_mean_of_its_parts_and_what_they_differ() -> None:
    posterior = mixture()
    (_, whole), (_, feet) = posterior.parts
    limits = [part.model.mass * part.model.friction for part in (whole, feet)]
    assert posterior.model.mass * posterior.model.friction == pytest.approx(np.mean(limits, axis=0), rel=1e-9)
    assert posterior.model.total_mass == pytest.approx(whole.model.total_mass)
    apart = 0.5 * np.abs(limits[0] - limits[1])
    assert np.max(apart) > np.max(whole.mass_friction_std)
    inner = np.mean([part.mass_friction_std**2 for part in (whole, feet)], axis=0)
    assert posterior.mass_friction_std == pytest.approx(np.hypot(apart, np.sqrt(inner)), rel=1e-9)
    assert identifiability(posterior).quantities[0].std >= identifiability(whole).quantities[0].std / np.sqrt(2)


def test_draws_come_from_the_parts_by_their_weights_in_any_first_ones() -> None:
    posterior = mixture()
    drawn = posterior.drawn(np.zeros((40, posterior.most_unknowns)))
    for n in (4, 10, 40):
        assert abs(sum(part.prior.feet == 2 for part, _ in drawn[:n]) - n / 2) <= 1
    record = RECORDS[0]
    scenario = PushScenario(record.pusher, record.poses.pose[0], record.poses.time)
    both, whole = predict(posterior, scenario), predict(replace(posterior, alternatives=()), scenario)
    assert both.cell_error_std > whole.cell_error_std


def test_mixture_in_a_file(tmp_path: Path) -> None:
    posterior, file = mixture(), tmp_path / "model.json"
    save_model(file, posterior, object_id="1")
    _, read = load_model(file)
    assert [weight for weight, _ in read.parts] == [0.5, 0.5] and read.alternatives[0][1].prior.feet == 2
    assert read.model.mass * read.model.friction == pytest.approx(posterior.model.mass * posterior.model.friction)
    assert model_at(read.alternatives[0][1].unknowns, read.alternatives[0][1].z).friction == pytest.approx(
        posterior.alternatives[0][1].model.friction
    )
    file.write_text(file.read_text().replace('"weight": 0.5', '"weight": 1.5'))
    with pytest.raises(ModelFileError, match="sum 1 at most"):
        load_model(file)


def test_one_push_that_cannot_be_simulated_condemns_no_fit() -> None:
    good = PushEvidence(error=1e-3, motion=10e-3, noise=1e-3, overlap=-1e-3, remote_motion=0.0)
    failed = replace(good, error=np.inf)
    assert not Explanation((good,) * 9 + (failed,)).contradiction
    assert Explanation((failed,) * 3).contradiction


def test_effects_that_are_adopted_leave_no_kind_of_support_that_lacks_them(tmp_path: Path) -> None:
    changed, _ = with_known_effects(mixture(), [KnownEffect("table_tilt", np.array([0.01, 0.0]), np.array([0.002, 0.002]))])
    assert changed.effects.names == ("table_tilt",) and not changed.alternatives
    save_model(tmp_path / "model.json", changed, object_id="1")
    assert load_model(tmp_path / "model.json")[1].effects.names == ("table_tilt",)
