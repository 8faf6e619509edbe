"""The outcome of an identification."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from push_ident.checking.records import RecordCheck
from push_ident.identification.results.explanation import Explanation
from push_ident.identification.results.identifiability import before_text, identifiability, value_text
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.unknowns.prior import MapPrior
from push_ident.pages.tables import html_table
from push_ident.types import Float64Array, ObjectModel, SolveStatus, short_repr

_DEVIATIONS: Final = 3.0
"""Standard deviations by which a misfit exceeds 1 where it is said: by chance in 0.1 % of fits to independent frames."""
_QUANTILE_STD: Final = 1.03
"""Relative standard deviation of the quantile of 0.8 of chi squared with 3 degrees of freedom, times the root of the number of frames."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """The best model at one moment of the solve, with the work done until then."""

    __repr__ = short_repr

    n_simulations: int
    """Pushes simulated until then."""
    time_s: float
    cost: float
    model: ObjectModel


@dataclass(frozen=True, slots=True)
class WarmStart:
    """Where a fit ended."""

    __repr__ = short_repr

    name: str
    """Of the start that led there, for a solver with several."""
    x: Float64Array
    """Unknowns of the object and first poses, in the units of the caller's prior."""
    prior: MapPrior | None = None
    """Of the maps; None for a solver that sets none."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """One prior that the pushes were explained with."""

    __repr__ = short_repr

    name: str
    log_evidence: float
    """With the prior odds of this prior [nat], up to a constant of the pushes."""
    maps: MapPrior | None
    """What the pushes made of the prior of the maps; None: no maps."""
    probability: float
    """Among the candidates, by evidence [-]: its weight in the mixture."""
    on_feet: ModelPosterior | None = None
    """Of a prior with feet, see `supports`; None: the whole base bears the load."""


@dataclass(frozen=True, slots=True)
class Identification:
    """Result of `identify`."""

    def __repr__(self) -> str:
        x, y = 1e3 * self.model.centre_of_friction
        return (
            f"Identification({self.status.name.lower()}, {len(self.model.mass)} cells, centre of friction ({x:.1f}, {y:.1f}) mm, "
            f"{self.method}: {self.n_simulations} simulations in {self.time_s:.2f} s)"
        )

    def _repr_html_(self) -> str:
        """For notebooks: how the solve ended, and the named quantities with their standard deviations before and after the pushes."""
        known = identifiability(self.posterior)
        rows = [(q.name, value_text(q), before_text(q), q.knowledge.value.partition(":")[0]) for q in known.quantities]
        wrong = "".join(f"{warning} " for warning in self.warnings)
        return html_table(
            f"{len(self.model.mass)} cells, {self.method}: {self.status.value}",
            ("quantity", "value", "before the pushes", "identifiability"),
            rows,
            note=f"{wrong}Of {len(known.combinations)} combinations of the cells, {known.n_pinned} are pinned down and {known.n_open} "
            f"hardly constrained. {self.n_simulations} simulations in {self.time_s:.2f} s.",
        )

    method: str
    status: SolveStatus
    posterior: ModelPosterior
    scalar: ObjectModel
    """Equal cells with the friction scale and the pusher friction fitted to the same pushes."""
    uniform: ObjectModel
    """Equal cells with nominal values."""
    cost: float
    """Half the robust sum of squared residuals plus half the squared unknowns."""
    reduced_chi2: float
    """Squared residual per degree of freedom: about 1 where the model fits to within the noise; NaN where the solver has no posterior."""
    n_simulations: int
    time_s: float
    """Of the solve [s]."""
    warm_starts: tuple[WarmStart, ...]
    """Where the fits of the solver ended: starts for the same solver, the same pushes and more."""
    history: tuple[Checkpoint, ...] = ()
    """Every improvement during the solve, the oldest first."""
    candidates: tuple[Candidate, ...] = ()
    """Priors that were compared."""
    explanation: Explanation = field(default_factory=Explanation)
    """How well the fit explains its training pushes, also where `posterior` is the prior because it does not."""
    checked: RecordCheck = field(default_factory=lambda: RecordCheck((), None))
    """The pushes of the fit, and whether they agree with each other."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What was corrected in the pushes, and whether the fit leaves more of them than noise does."""
        n_frames = max(1, sum(len(record.poses.time) for record in self.checked.records))
        if not self.reduced_chi2 > 1.0 + _DEVIATIONS * _QUANTILE_STD / np.sqrt(n_frames):
            return self.checked.notes
        misfit = (
            f"the squared residuals are {self.reduced_chi2:.2g} times those of noise: the pushes hold something that the model lacks, as "
            "an impact, a delay or another outline; standard deviations are widened by it, and `push-ident diagnose` looks for its cause"
        )
        return (*self.checked.notes, misfit)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is wrong with the pushes, whatever the status says: contacts, clocks or forces that contradict each other (`checking/`)."""
        return self.checked.warnings

    @property
    def model(self) -> ObjectModel:
        """The mean model of the posterior."""
        return self.posterior.model
