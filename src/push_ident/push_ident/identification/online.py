"""Identification that goes on while pushes come in."""

from __future__ import annotations

from push_ident.identification.identify import identify, prior_posterior
from push_ident.identification.observation import NoiseModel
from push_ident.identification.parameters import Prior
from push_ident.identification.result import Identification, ModelPosterior
from push_ident.identification.solvers.gauss_newton import MAX_ITERATIONS
from push_ident.physics.simulation import SimulationSettings
from push_ident.types import ObjectShape, PushRecord

__all__ = ["OnlineIdentifier"]


class OnlineIdentifier:
    """Estimate of one object that improves with every push and already during one.

    Each update starts from the last estimate, so that a few iterations are enough while a push is under way.
    """

    def __init__(
        self,
        shape: ObjectShape,
        prior: Prior | None = None,
        *,
        noise: NoiseModel | None = None,
        settings: SimulationSettings | None = None,
    ) -> None:
        self._prior = prior or Prior()
        self._noise = noise
        self._settings = settings
        self._records: list[PushRecord] = []
        self.result: Identification | None = None
        self.posterior: ModelPosterior = prior_posterior(shape, self._prior)

    @property
    def n_pushes(self) -> int:
        """Finished pushes that the estimate rests on."""
        return len(self._records)

    def add(self, record: PushRecord) -> Identification:
        """Take in a finished push and polish the estimate."""
        self._records.append(record)
        return self._solve(self._records)

    def peek(self, partial: PushRecord, *, max_iterations: int = 4) -> Identification:
        """Estimate with the push under way, as far as it has come; the push is not kept."""
        return self._solve([*self._records, partial], max_iterations)

    def adopt(self, posterior: ModelPosterior) -> None:
        """Take over a model from elsewhere as the current estimate; pushes seen so far are forgotten."""
        self._records.clear()
        self.result, self.posterior = None, posterior

    def _solve(self, records: list[PushRecord], max_iterations: int = MAX_ITERATIONS) -> Identification:
        result = identify(
            records,
            self._prior,
            noise=self._noise,
            settings=self._settings,
            max_iterations=max_iterations,
            warm_start=self.result,
        )
        self.result, self.posterior = result, result.posterior
        return result
