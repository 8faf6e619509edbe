"""What the endurance study concludes from its samples and from two maps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.identification.results.posterior import ModelPosterior, prior_posterior
from push_ident.types import CellGrid, ObjectShape
from push_ident_sim.studies.endurance.comparison import compare_maps
from push_ident_sim.studies.endurance.meters import growth


def life(number: int, hours: float, level: float, per_hour: float, noise: float = 0.0) -> list[dict[str, float]]:
    rng = np.random.default_rng(number)
    ages = np.arange(0.0, 3600.0 * hours, 5.0)
    values = level + per_hour * ages / 3600.0 + noise * rng.standard_normal(len(ages)) + 500.0 * (ages < 50.0)
    return [{"life": number, "age_s": age, "memory_mb": value} for age, value in zip(ages, values, strict=True)]


def test_growth_is_that_within_lives_whatever_their_levels() -> None:
    found = growth([*life(1, 0.3, 100.0, 12.0), *life(2, 0.3, 300.0, 12.0)], "memory_mb")
    assert found is not None
    assert found["per_hour"] == pytest.approx(12.0, abs=0.01)


def test_flat_memory_shows_no_growth_beyond_its_noise() -> None:
    found = growth(life(3, 1.0, 100.0, 0.0, noise=2.0), "memory_mb")
    assert found is not None
    assert abs(found["per_hour"]) < 3.0 * found["std"] < 6.0


def test_lives_too_short_to_judge_have_no_growth() -> None:
    assert growth([*life(1, 0.02, 100.0, 0.0), *life(2, 0.02, 100.0, 0.0)], "memory_mb") is None


def plate(size: float = 0.01) -> ObjectShape:
    x, y = np.meshgrid(np.arange(8) * size, np.arange(5) * size)
    centres = np.stack([x.ravel(), y.ravel()], axis=1) - [3.5 * size, 2.0 * size]
    outline = np.array([[-4, -2.5], [4, -2.5], [4, 2.5], [-4, 2.5]]) * size
    return ObjectShape(CellGrid(centres, size), outline)


def learned(rng: np.random.Generator, std: float) -> ModelPosterior:
    """A posterior whose mean is off by its own standard deviation, of a truth at zero."""
    prior = prior_posterior(plate())
    n = prior.unknowns.size
    return replace(prior, z=std * rng.standard_normal(n), covariance=std**2 * np.eye(n))


def test_two_maps_of_one_truth_differ_by_what_they_state() -> None:
    rng = np.random.default_rng(0)
    found = [compare_maps(learned(rng, 0.1), learned(rng, 0.1)) for _ in range(20)]
    assert np.mean([m["mahalanobis2"] / m["n_pinned"] for m in found]) == pytest.approx(1.0, abs=0.15)
    assert np.mean([m["within_2_std"] for m in found]) == pytest.approx(0.95, abs=0.04)


def test_map_of_another_object_differs_by_more_than_both_state() -> None:
    rng = np.random.default_rng(0)
    one, other = learned(rng, 0.1), learned(rng, 0.1)
    found = compare_maps(one, replace(other, z=other.z + rng.standard_normal(len(other.z))))
    assert found["mahalanobis2"] > 10.0 * found["n_pinned"]


def test_objects_of_other_cells_are_not_compared() -> None:
    one = prior_posterior(plate())
    with pytest.raises(InputError, match="one object"):
        compare_maps(one, prior_posterior(plate(size=0.03)))
