"""Effects of a diagnosis that are certain enough to be part of the model of an object, from its JSON.

The rule is that of the verdict: a name is left open where another cause has a probability above `SelectionPolicy.max_probability_of_error`,
since a wrong name would then cost more than none. Exact twins count as one: with each of them the same pushes have the same outcome.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from push_ident.checked_json import Listed, parse_checked, read_checked
from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.errors import InputError
from push_ident.identification.results.known_effects import KnownEffect
from push_ident.limits import LIMITS, plain_text
from push_ident.physics.effect import Mechanism, OnPusherFriction
from push_ident.physics.effects import EFFECTS

_NAMING: Final = ("named", "one_of", "several")
"""Verdicts that name what acts; `diagnosis.verdict.Verdict`."""
_NOTHING: Final = "no_gap"
_REMEDY: Final = "`push-ident diagnose BAG --json FILE` writes one"


class _Effect(BaseModel):
    model_config = ConfigDict(allow_inf_nan=False)

    name: str
    parameters: dict[str, float]
    std: dict[str, float]


class _Gap(BaseModel):
    before_per_push_m: Listed[float | None]


class _Content(BaseModel):
    """What counts here of a diagnosis as JSON."""

    verdict: str
    effects: Listed[_Effect]
    probabilities: dict[str, float] | None
    gap: _Gap


@dataclass(frozen=True, slots=True)
class UsableEffects:
    """What a diagnosis says of a model."""

    effects: tuple[KnownEffect, ...]
    """Those that act; none where nothing is missing from the base model, or only what is an unknown of every model."""
    base: frozenset[str]
    """Effects of its base model, of which it says nothing."""
    n_pushes: int
    """That were diagnosed."""


def usable_effects_of_file(path: Path) -> UsableEffects:
    """As `usable_effects`. Raises ModelFileError where the file is missing, too large or no diagnosis."""
    return _usable(read_checked(path, _Content, "a diagnosis", _REMEDY))


def usable_effects_of_text(text: str, what: str) -> UsableEffects:
    """As `usable_effects`, of JSON; `what` names where it comes from."""
    LIMITS.TEXT_FILE.check(len(text), what)
    return _usable(parse_checked(text, _Content, f"{what} is not a diagnosis", _REMEDY, error=InputError))


def usable_effects(content: Mapping[str, Any]) -> UsableEffects:
    """The effects of a diagnosis as JSON (`diagnosis_json.to_json`).

    Raises:
        InputError: no diagnosis, one that leaves open what acts, or effects that are none.
    """
    try:
        return _usable(_Content.model_validate(content))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "all of it"
        raise InputError(f"This is not a diagnosis: {where}: {first['msg']}; {_REMEDY}.") from None


def _usable(content: _Content) -> UsableEffects:
    verdict, probabilities = content.verdict, content.probabilities
    if probabilities is None or verdict not in (*_NAMING, _NOTHING):
        raise InputError(f"The verdict of the diagnosis is `{plain_text(verdict)}`: it names nothing to be used; the model stays as it is.")
    named = content.effects if verdict in _NAMING else []
    effects = [_known(effect) for effect in named]
    for effect in effects:
        _check_certain(effect.name, probabilities)
    # What every identification has as an unknown, or poses do not show, changes no plan.
    planned = [e for e in effects if not (isinstance(EFFECTS[e.name].acts, OnPusherFriction) or EFFECTS[e.name].needs_forces)]
    return UsableEffects(
        tuple(planned),
        frozenset(name for name in EFFECTS if name not in probabilities),
        max(1, len(content.gap.before_per_push_m)),
    )


def _known(effect: _Effect) -> KnownEffect:
    if effect.name in {mechanism.value for mechanism in Mechanism}:
        raise InputError(f"The diagnosis names `{effect.name}` by a free law, which no model holds: the model stays as it is.")
    if effect.name not in EFFECTS:
        raise InputError(f"The diagnosis names `{plain_text(effect.name)}`, which is no effect of this version: {', '.join(EFFECTS)}.")
    names = [parameter.name for parameter in EFFECTS[effect.name].parameters]
    if set(effect.parameters) != set(names) or set(effect.std) != set(names):
        raise InputError(
            f"The diagnosis gives {effect.name} the parameters {plain_text(', '.join(effect.parameters))}, expected {', '.join(names)}, "
            "each with its standard deviation."
        )
    value, std = (np.array([numbers[name] for name in names]) for numbers in (effect.parameters, effect.std))
    return KnownEffect(effect.name, value, std)


def _check_certain(name: str, probabilities: Mapping[str, float]) -> None:
    """Raise InputError where another cause is too probable."""
    certain = sum(probabilities.get(twin, 0.0) for twin in (name, *EFFECTS[name].exact_twins))
    needed = 1.0 - SelectionPolicy().max_probability_of_error
    if not certain >= needed:
        raise InputError(
            f"The diagnosis names {name} with a probability of {certain:.2f}, expected {needed:.2f} at least: the model stays as it is. "
            "Make the push that the diagnosis proposes, and diagnose again."
        )
