"""Recovery of maps: objects drawn from the prior, pushed as the recording was, and identified."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from push_ident.identification.fitting.fit import FitOptions
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import NoiseModel
from push_ident.identification.predicting.prediction import push_errors
from push_ident.identification.results.identifiability import Knowledge, Quantity, identifiability
from push_ident.identification.results.posterior import Estimate, ModelPosterior
from push_ident.identification.unknowns.mechanics import mechanics_at
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec, nuisance_effects
from push_ident.recovery.twins import twins_of
from push_ident.types import PushRecord

_TWO_SIDED_90: Final = 1.6449
"""Standard deviations within which a normal number lies with probability 0.9."""

_OF_MEDIAN: Final = 1.4826
"""Standard deviation of a normal error over the median of its size [1]."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """How well one quantity of known objects was identified; medians over them."""

    name: str
    unit: str
    """m: errors and deviations are lengths; else they are relative to the value [1]."""
    prior_std: float
    """Standard deviation before the pushes."""
    std: float
    """Stated after them."""
    error: float
    """Of the identified value."""
    n_within: int
    """Objects whose value lies within the stated 90 % interval."""
    knowledge: Knowledge
    """By the larger of the stated deviation and that of the errors."""


@dataclass(frozen=True, slots=True)
class MapTest:
    """Of one object drawn from the prior."""

    truth: tuple[Quantity, ...]
    found: tuple[Quantity, ...]
    end_error: float
    """Median cell error at the ends of the pushes under the identified model, noise of the poses included [m]."""
    end_error_before: float
    """The same under equal cells with nominal values [m]."""
    failure: str
    """Why nothing was identified; empty where something was."""


def try_maps(
    records: Sequence[PushRecord],
    prior: Prior,
    effects: Sequence[str],
    noise: NoiseModel,
    rng: np.random.Generator,
    options: FitOptions,
) -> MapTest:
    """Draw one object from the prior, push it as recorded, and identify it.

    `effects`: nuisances of the recording beside those of the shape and the prior. Raises InputError as `twins_of`.
    """
    shape, prior = records[0].shape, prior.with_camera_accuracy(record.poses.camera for record in records)
    prior = prior.with_force_offset(records)
    spec = UnknownsSpec.of(shape, prior, effects=tuple(dict.fromkeys((*effects, *nuisance_effects(shape, prior)))))
    z = rng.normal(size=spec.size)
    unknown = z[spec.slices["total_mass"]] if spec.blocks["total_mass"].size else rng.normal(size=1)
    mass = Estimate(prior.total_mass * float(np.exp(prior.total_mass_std * unknown[0])), 0.0)
    truth = identifiability(replace(ModelPosterior.of_prior(spec), z=z, total_mass=mass))
    twins = twins_of(records, mechanics_at(spec, z), noise, rng)
    result = identify(twins, prior, effects=effects, options=options)
    errors = push_errors(result, twins, range(len(twins)))
    ends, before = (float(np.nanmedian(values)) for values in (errors.identified, errors.uniform))
    failure = result.status.value if result.status.is_failure else ""
    return MapTest(truth.quantities, identifiability(result.posterior).quantities, ends, before, failure)


def recoveries_of(tests: Sequence[MapTest], before: ModelPosterior) -> tuple[Recovery, ...]:
    """Each named quantity over all objects; `before`: what is known without a push. None where nothing was identified."""
    done = [test for test in tests if not test.failure]
    rows = []
    for k, prior in enumerate(identifiability(before).quantities if done else ()):
        truth, found = [test.truth[k] for test in done], [test.found[k] for test in done]
        if prior.prior_std == 0.0:
            continue
        is_length = prior.unit == "m"
        error = [float(abs(f.value - t.value if is_length else np.log(f.value / t.value))) for t, f in zip(truth, found, strict=True)]
        stds = [f.std / (1.0 if is_length else f.value) for f in found]
        prior_std = prior.prior_std / (1.0 if is_length else prior.value)
        n_within = sum(bool(e <= _TWO_SIDED_90 * std) for e, std in zip(error, stds, strict=True))
        std, middle = float(np.median(stds)), float(np.median(error))
        known = Knowledge.of(max(std, _OF_MEDIAN * middle) / prior_std)
        rows.append(Recovery(prior.name, prior.unit, prior_std, std, middle, n_within, known))
    return tuple(rows)
