"""Whether numbers from outside can be the posterior of an object."""

from __future__ import annotations

from dataclasses import astuple
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.results.result import WarmStart
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.quadratic import Quadratic
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.limits import LIMITS, plain_text
from push_ident.types import Float64Array

_MATRIX_ROUNDING: Final = 1e-9
"""Error of a matrix that rounding explains, relative to its largest entry [-]: condition numbers are below 1e7."""
_MODE_ROUNDING: Final = 1e-6
"""By which the variance of a cell of a unit map may exceed 1 [-]."""
_MOST_LOG: Final = 700.0
"""Logarithm of a ratio with its standard deviation [-]: e^709 is the largest number. Right pushes leave 5, some that contradict each other
left 150."""
_MOST_DEVIATION: Final = 10.0
"""Standard deviation of a logarithm in a prior [-]: a factor of 22,000 either way says nothing."""
_MAP_PRIOR: Final = (1e-4, 100.0)
"""What pushes can make of each number of a prior of maps [-]; pushes that contradict each other made 0.05 to 8."""
_MOST_START: Final = 100.0
"""Unknown at which a solve may start, in units of its prior [-]: fits reach 40, and from some 200 on the maps may be no number."""
_LEAST_VARIANCE: Final = 1e-15
"""Of an unknown, whose prior variance is 1 [-]: below it rounding decides. Frozen unknowns have 1e-8."""
_LEAST_MASS: Final = 1e-6
"""[kg]: a grain of foam as small as the smallest object."""
_LENGTHS: Final = (1e-3, 1e3)
"""Correlation length of the maps over the size of the object [-]: below a cell, and the same everywhere."""
_MOST_NOISE_FACTOR: Final = 1e5
"""On the stated noise of poses [-]: it makes 100 m of 1 mm."""
_LOGS: Final = (
    "total_mass_std", "friction_std", "pusher_friction_std", "mass_map_std", "pressure_map_std", "friction_map_std",
)  # fmt: skip


def check_prior(prior: Prior) -> Prior:
    """The same prior; raises InputError where one of its numbers is beyond what `Prior` leaves open for a search."""
    for name in _LOGS:
        if getattr(prior, name) > _MOST_DEVIATION:
            raise InputError(f"Prior.{name} is {getattr(prior, name):.3g}, expected at most {_MOST_DEVIATION:g}, as of a logarithm.")
    if not _LENGTHS[0] <= prior.correlation_length <= _LENGTHS[1]:
        raise InputError(f"Prior.correlation_length is {prior.correlation_length:.3g}, expected {_LENGTHS[0]:g} to {_LENGTHS[1]:g}.")
    if prior.total_mass < _LEAST_MASS:
        raise InputError(f"Prior.total_mass is {prior.total_mass:.3g} kg, expected at least {_LEAST_MASS:g} kg.")
    return prior


def check_start(start: WarmStart) -> WarmStart:
    """The same start of a solve; raises InputError where no fit can have ended there."""
    largest = float(np.max(np.abs(start.x), initial=0.0))
    if not largest <= _MOST_START:
        raise InputError(f"The start `{plain_text(start.name)}` has the unknown {largest:.3g}, expected at most {_MOST_START:g}.")
    if start.prior is not None and not all(_MAP_PRIOR[0] <= value <= _MAP_PRIOR[1] for value in astuple(start.prior)):
        low, high = _MAP_PRIOR
        raise InputError(f"The start `{plain_text(start.name)}` has {start.prior}, expected {low:g} to {high:g} for each.")
    return start


def check_posterior(posterior: ModelPosterior) -> ModelPosterior:
    """The same posterior; raises InputError where one of its numbers can be none of an object."""
    unknowns, covariance, n = posterior.unknowns, posterior.covariance, posterior.unknowns.size
    if posterior.z.shape != (n,) or covariance.shape != (n, n):
        raise InputError(f"`z` has {len(posterior.z)} unknowns, `covariance` {covariance.shape}, expected {n} and {(n, n)} as its cells.")
    variance = np.diag(covariance)
    if not np.min(variance) >= _LEAST_VARIANCE:
        raise InputError(f"`covariance` has the variance {np.min(variance):.3g}, expected at least {_LEAST_VARIANCE:g}.")
    _check_logs(unknowns, np.abs(posterior.z) + np.sqrt(variance), "z")
    _check_positive(covariance, "covariance")
    row = float(np.max(np.sum(unknowns.modes**2, axis=1)))
    if not row <= 1.0 + _MODE_ROUNDING:
        raise InputError(f"`modes` give a cell the variance {row:.3g}, expected at most 1, that of a unit map.")
    factor = posterior.pose_noise_factor
    if factor is not None and not 0 < factor <= _MOST_NOISE_FACTOR:
        raise InputError(f"`pose_noise_factor` is {factor:.3g}, expected a number from 0 to {_MOST_NOISE_FACTOR:g}.")
    _check_masses(posterior)
    return posterior


def _check_logs(unknowns: UnknownsSpec, z: Float64Array, name: str) -> None:
    """Raise InputError for unknowns, shape (n_unknowns,), whose quantities are no number."""
    log = np.concatenate([block.std for block in unknowns.blocks.values()]) * np.abs(z)
    if not np.max(log) <= _MOST_LOG:
        raise InputError(f"`{name}` changes a logarithm by {np.max(log):.3g} with its deviation, expected at most {_MOST_LOG:g}.")


def check_information(cost: Quadratic, unknowns: UnknownsSpec) -> None:
    """Raise InputError where the cost of pushes and the unit normal prior together are no distribution of these unknowns."""
    precision = cost.hessian + np.eye(unknowns.size)
    _check_positive(precision, "hessian")
    if not np.max(np.diag(precision)) <= 1.0 / _LEAST_VARIANCE:
        raise InputError(f"`hessian` has the entry {np.max(np.diag(precision)):.3g}, expected at most {1.0 / _LEAST_VARIANCE:g}.")
    _check_logs(unknowns, cost.point, "point")
    try:
        least = np.linalg.solve(precision, cost.hessian @ cost.point - cost.gradient)
    except np.linalg.LinAlgError:
        raise InputError("`hessian` and the prior leave an unknown open, expected a positive definite sum.") from None
    _check_logs(unknowns, np.asarray(least, dtype=np.float64), "gradient")


def _check_positive(matrix: Float64Array, name: str) -> None:
    largest = float(np.max(np.abs(matrix)))
    if np.max(np.abs(matrix - matrix.T)) > _MATRIX_ROUNDING * largest:
        raise InputError(f"`{name}` is not symmetric, expected equal entries on both sides of its diagonal.")
    try:
        np.linalg.cholesky(matrix + _MATRIX_ROUNDING * largest * np.eye(len(matrix)))
    except np.linalg.LinAlgError:
        least = float(np.linalg.eigvalsh(matrix)[0])
        raise InputError(f"`{name}` has the eigenvalue {least:.3g}, expected none below 0.") from None


def _check_masses(posterior: ModelPosterior) -> None:
    total = posterior.total_mass
    if not (total.value >= _LEAST_MASS and 0 <= total.std <= _MOST_LOG * total.value):
        raise InputError(f"The total mass is {total.value:.3g} ± {total.std:.3g} kg, expected {_LEAST_MASS:g} kg or more and a deviation.")
    LIMITS.MASS.check(total.value, "Total mass", remedy="Give it in kilograms.")
    model = posterior.model
    LIMITS.FRICTION.check(float(model.mass @ model.friction) / model.total_mass, "Support, mean over the object")
    LIMITS.FRICTION.check(model.pusher_friction, "Pusher")
