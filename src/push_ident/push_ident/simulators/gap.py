"""The gap of somebody else's simulator, in parts that add up.

Each push is repeated in the simulator and compared with its recorded end. What the simulator gets wrong is divided by correcting one thing
after the other, always by a fit of the object and all effects that has not seen the push:

    gap = (as it is - with right object)                     its mass and friction
        + (that - with precise contact)                      its pusher friction, contact parameters and time step
        + (that - with an effect), for each effect           what the scene or the data lack
        + (that - the model of this package, same object)    what its engine does otherwise
        + (that - with an effect), for each effect           what no scene or data can have, by the model
        + the error of that model                            noise, maps, other causes: the account of a diagnosis

The parts are differences of mean cell errors on the same pushes [m]; a part is negative where a correction makes the simulator worse.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.cells import cell_error
from push_ident.identification.fitting.fit import FitOptions
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import observe_push
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.results.result import Identification
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.effect_values import EffectValues, changed_friction, effect_values
from push_ident.physics.effects import EFFECTS
from push_ident.simulators.measured import Measured, inexpressible, of_the_data
from push_ident.simulators.protocol import CONTACT, OBJECT, CorrectableSimulator, PushSimulator
from push_ident.threads import map_in_threads
from push_ident.types import Float64Array, PushRecord

ENGINE: Final = "what the engine does otherwise"
UNDIVIDED: Final = "mass and friction of the object, contact, and what the engine does otherwise"
MODEL: Final = "noise, and what the model lacks"
_WITH_OBJECT: Final = "with right object"
_PRECISE: Final = "with precise contact"
_MODEL: Final = "the model"
_STANDARD_ERRORS: Final = 2.0
"""By which a part exceeds zero where it is certain, as of a gap on held-out pushes [1]: about 95 %, two-sided."""
_NEGLIGIBLE: Final = 1e-4
"""No surface of a cell is known better [m]."""
_FOLDS: Final = 4
"""Parts of the pushes that are held out in turn: each fit has three of four pushes."""


@dataclass(frozen=True, slots=True)
class SimulatorGap:
    """Errors of a simulator on recorded pushes."""

    name: str
    """Of the simulator."""
    stages: tuple[str, ...]
    """What was corrected, one after the other; the first is the simulator as it is, the last the model of this package."""
    errors: Float64Array
    """Cell error at the end of each push [m], shape (n_stages, n_pushes)."""
    parts: tuple[str, ...]
    """Names of the differences from one stage to the next; the last is what remains."""
    observed: Float64Array
    """Recorded poses of the object before and after each push (x, y, yaw), table frame, shape (2, n_pushes, 3)."""
    ends: Float64Array
    """Where each push ends in the simulator as it is, and with all that it can have corrected, shape (2, n_pushes, 3)."""
    words: Mapping[str, str] = field(default_factory=dict)
    """What the users of the simulator call what was corrected, by the name of the part."""
    left_out: tuple[str, ...] = ()
    """Effects among them that neither the scene nor corrected data can have: all fits have them, and their part is what the model gains by
    them."""

    @property
    def sizes(self) -> Float64Array:
        """Mean of each part over the pushes [m], shape (n_parts,); they add up to the gap."""
        means = self.errors.mean(axis=1)
        return np.append(means[:-1] - means[1:], means[-1])

    @property
    def stds(self) -> Float64Array:
        """Standard error of each part from push to push [m], shape (n_parts,)."""
        rows = np.vstack([self.errors[:-1] - self.errors[1:], self.errors[-1:]])
        return np.asarray(rows.std(axis=1, ddof=1) / np.sqrt(rows.shape[1]))

    @property
    def corrected(self) -> Float64Array:
        """Errors of the simulator with all that it can have corrected [m], shape (n_pushes,)."""
        return np.asarray(self.errors[-2 - len(self.left_out)])

    @property
    def excess(self) -> tuple[float, float]:
        """By how much the simulator misses the ends further than the model of this package, and its standard error [m]."""
        more = self.errors[0] - self.errors[-1]
        return float(more.mean()), float(more.std(ddof=1) / np.sqrt(len(more)))

    @property
    def causes(self) -> tuple[str, ...]:
        """Parts that certainly make it larger, the largest first; none where the simulator certainly does no worse than the model."""
        excess, std = self.excess
        if not excess > max(_STANDARD_ERRORS * std, _NEGLIGIBLE):
            return ()
        parts = sorted(zip(self.sizes[:-1], self.stds[:-1], self.parts[:-1], strict=True), reverse=True)
        return tuple(name for size, std, name in parts if size > max(_STANDARD_ERRORS * std, _NEGLIGIBLE))

    def lines(self) -> list[str]:
        """For people: the gap and its parts."""
        width = max(map(len, self.parts))
        total = f"{self.name} misses the ends of {self.errors.shape[1]} pushes by {1e3 * float(self.errors[0].mean()):.1f} mm in the mean:"
        rows = zip(self.parts, self.sizes, self.stds, strict=True)
        lines = [total, *(f"  {name:<{width}}  {1e3 * size:6.1f} ± {1e3 * std:.1f} mm" for name, size, std in rows)]
        causes = [f"{name} ({self.words[name]})" if name in self.words else name for name in self.causes]
        lines.append(f"causes, the largest first: {'; '.join(causes)}" if causes else "no cause is certain")
        return [*lines, *(f"  {name} is in no scene: its part is what the model gains by it" for name in self.left_out)]

    def as_json(self) -> dict[str, object]:
        """Plain numbers in SI units."""
        keys = ("name", "mean", "std")
        parts = [
            dict(zip(keys, (name, float(m), float(s)), strict=True)) for name, m, s in zip(self.parts, self.sizes, self.stds, strict=True)
        ]
        stages = [{"name": name, "errors": row.tolist()} for name, row in zip(self.stages, self.errors, strict=True)]
        return {"simulator": self.name, "causes": list(self.causes), "parts": parts, "stages": stages, "in_no_scene": list(self.left_out)}


def check_number_of_pushes(records: Sequence[PushRecord]) -> None:
    """Raise InputError where they are too few for `simulator_gap`."""
    if len(records) < _FOLDS:
        raise InputError(f"There are {len(records)} pushes, expected {_FOLDS} or more: each is compared with fits that did not see it.")


def simulator_gap(
    records: Sequence[PushRecord],
    simulator: PushSimulator,
    prior: Prior | None = None,
    *,
    effects: Sequence[str] = (),
    nuisances: Sequence[str] = (),
    options: FitOptions | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> SimulatorGap:
    """Repeat recorded pushes in a simulator, and divide its error.

    Args:
        records: pushes of one object, at least 4.
        simulator: whose gap it is. One that is no `CorrectableSimulator` has the parts of object, contact and engine as one.
        prior: of the object.
        effects: names of causes, of a diagnosis, that are added one after the other.
        nuisances: names of effects that all fits have, as of `LoadedPushes.nuisances`; they are corrected with the object.
        options: of the fits.
        on_progress: called with what is under way.

    Raises:
        InputError: fewer than 4 pushes, fits that explain nothing, or a simulator that fails.
    """
    check_number_of_pushes(records)
    report = on_progress or (lambda text: None)
    left_out = inexpressible(effect_values(tuple(name for name in effects if name not in nuisances)))
    in_scene = [name for name in effects if name not in (*nuisances, *left_out)]
    report(f"repeating {len(records)} pushes in {simulator.name}")
    corrected = isinstance(simulator, CorrectableSimulator)
    stages = (*((_WITH_OBJECT, _PRECISE) if corrected else ()), *(f"with {name}" for name in in_scene))
    stages = (*stages, _MODEL, *(f"{_MODEL} with {name}" for name in left_out))
    errors, ends = np.full((1 + len(stages), len(records)), np.nan), np.full((2, len(records), 3), np.nan)
    errors[0], ends[0] = _errors(simulator, records)

    def identified(fold: int) -> Identification:
        train = [record for k, record in enumerate(records) if k % _FOLDS != fold]
        names = (*nuisances, *left_out, *in_scene)
        report(f"identifying {' and '.join(('the object', *names))} from {len(train)} pushes")
        return _identified(train, prior, names, options)

    def repeat(fold_and_fit: tuple[int, Identification]) -> None:
        fold, fit = fold_and_fit
        held_out = list(range(fold, len(records), _FOLDS))
        tests = [records[k] for k in held_out]
        for row, scene in enumerate(_corrected_one_after_the_other(simulator, fit, in_scene), start=1):
            report(f"repeating the other {len(tests)} pushes in {simulator.name} {stages[row - 1]}")
            errors[row, held_out], ends[1, held_out] = _errors(scene, tests)
        for n in range(len(left_out) + 1):
            acting = _without(fit.posterior.effects, left_out[n:])
            errors[len(stages) - len(left_out) + n, held_out] = held_out_errors(fit.model, tests, effects=acting)

    fits = enumerate(map_in_threads(identified, range(_FOLDS)))
    at_once = isinstance(simulator, CorrectableSimulator) and simulator.in_threads
    list(map_in_threads(repeat, list(fits)) if at_once else map(repeat, fits))
    parts = (*((OBJECT, CONTACT) if corrected else ()), *in_scene, ENGINE if corrected else UNDIVIDED, *left_out, MODEL)
    observed = np.stack([observe_push(record).pose[[0, -1]] for record in records], axis=1)
    return SimulatorGap(simulator.name, ("as it is", *stages), errors, parts, observed, ends, _words(simulator, parts), left_out)


def _without(effects: EffectValues, names: Sequence[str]) -> EffectValues:
    """The effects but for those of some names."""
    return effect_values({name: effects.values[effects.slice_of(name)] for name in effects.names if name not in names})


def _words(simulator: PushSimulator, parts: Sequence[str]) -> dict[str, str]:
    """What the users of a simulator call the parts of its gap."""
    known = simulator.words if isinstance(simulator, CorrectableSimulator) else {}
    words = {name: known[name] for name in parts if name in known}
    effects = effect_values(tuple(name for name in parts if name in EFFECTS))
    of_data = of_the_data(effects)
    for effect in effects.effects:
        if effect.export is not None and effect.export.value in known:
            words[effect.name] = known[effect.export.value]
        elif effect.name in of_data:
            words[effect.name] = "in the data: path of the tool, stamps, poses or radius of the pusher"
    return words


def _identified(records: Sequence[PushRecord], prior: Prior | None, effects: Sequence[str], options: FitOptions | None) -> Identification:
    result = identify(records, prior, effects=effects, options=options)
    if result.status.is_failure:
        raise InputError(f"{len(records)} of the pushes identify no object: {result.status.value}.")
    return result


def _corrected_one_after_the_other(simulator: PushSimulator, fit: Identification, effects: Sequence[str]) -> Iterator[PushSimulator]:
    """The simulator with the object of a fit, with precise contact, and with one effect more each."""
    if isinstance(simulator, CorrectableSimulator):
        others = _without(fit.posterior.effects, effects)
        yield Measured(simulator.with_object(fit.model, others), others)
        yield corrected_by(simulator, fit, effects)
    for n in range(1, len(effects) + 1):
        yield corrected_by(simulator, fit, effects[n:])


def corrected_by(simulator: PushSimulator, fit: Identification, without: Sequence[str] = ()) -> PushSimulator:
    """The simulator with the object of a fit, precise contact, and those of its effects that scene or data can have, `without` some."""
    effects = _without(fit.posterior.effects, without)
    if isinstance(simulator, CorrectableSimulator):
        friction = changed_friction(effects, fit.model.pusher_friction)[0]
        return Measured(simulator.with_object(fit.model, effects).with_precise_contact(friction), effects)
    return Measured(simulator, effects)


def _errors(simulator: PushSimulator, records: Sequence[PushRecord]) -> tuple[Float64Array, Float64Array]:
    """Cell error at the end of each push [m], shape (n_records,), and the end, shape (n_records, 3)."""
    errors, ends = [], []
    for record in records:
        observed = observe_push(record)
        simulator = replace(simulator, order=record.order) if isinstance(simulator, Measured) else simulator
        ends.append(simulator.simulate(observed.pose[0], record.pusher, observed.time[-1:])[-1])
        errors.append(cell_error(record.shape.cells, ends[-1], observed.pose[-1]))
    return np.array(errors), np.array(ends)
