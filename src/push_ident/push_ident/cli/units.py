"""Numbers with units on the command line, such as `50mm` or `90deg`: the one place that reads them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import typer

from push_ident.errors import InputError
from push_ident.limits import LIMITS, plain_text

if TYPE_CHECKING:
    from push_ident.types import Float64Array

_KINDS: Final[Mapping[str, Mapping[str, float]]] = {
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "angle": {"rad": 1.0, "deg": math.pi / 180.0, "°": math.pi / 180.0},
    "speed": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "number of pixels": {"px": 1.0},
    "number": {"": 1.0},
}
"""In SI units, by the names of the units."""
_MOST_BARE: Final = {"rad": (2.0 * math.pi, "radians", "deg"), "m": (float(LIMITS.EXTENT.value), "metres", "mm")}
"""By unit: the largest number that is believed without a unit, the name of the unit, and the one that is probably meant beyond."""


def in_unit(unit: str, least: float = -math.inf, most: float = math.inf) -> Callable[[str | float], float]:
    """Parser of an option whose value is in `unit`, and so is a number that comes without one; from `least` to `most`."""

    def parse(text: str | float) -> float:
        try:
            value = read_number(str(text), unit)
        except ValueError as error:
            raise typer.BadParameter(f"{error}.") from None
        if not least <= value <= most:
            expected = f"{least:g} {unit} or more" if most == math.inf else f"{least:g} to {most:g} {unit}"
            raise typer.BadParameter(f"{value:g} {unit} is given, expected {expected}.")
        return value

    return parse


def parse_floats(text: str, units: Sequence[str], option: str, expected: str) -> Float64Array:
    """Finite numbers divided by commas, one for each of `units`, in which they are given back, shape (n_units,).

    Raises InputError, with what is expected, for another form.
    """
    import numpy as np  # `push-ident --help` needs none

    parts, why = text.split(","), ""
    try:
        if len(parts) == len(units):
            return np.array([read_number(part, unit) for part, unit in zip(parts, units, strict=True)])
    except ValueError as error:
        why = f"; {error}"
    raise InputError(f"{option} is {plain_text(text)!r}, expected {expected}{why}.")


def read_number(text: str, unit: str) -> float:
    """A finite number with or without a unit, in `unit`.

    Raises ValueError for anything else, and for a bare number that is probably in degrees or millimetres: an arm shall not move by a guess.
    """
    kind, units = next((kind, units) for kind, units in _KINDS.items() if unit in units)
    text = text.strip()
    given = max((name for name in units if text.endswith(name)), key=len, default="")
    try:
        value = float(text.removesuffix(given))
    except ValueError:
        value = math.nan
    shown = plain_text(text)
    if not math.isfinite(value):
        raise ValueError(f"{shown or 'nothing'} is given, expected a finite {kind} in {unit}, or with its unit: {', '.join(units)}")
    most, name, other = _MOST_BARE.get(unit, (math.inf, "", ""))
    if not given and abs(value) > most:
        reading = f"{shown}{other} is {value * units[other]:.4g} {unit}"
        raise ValueError(f"{shown} is given, expected {name}: {reading}; write {shown}{other} or {shown}{unit}")
    return value if given in ("", unit) else value * units[given] / units[unit]
