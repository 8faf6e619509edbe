"""All faults, in the order of their numbers."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from typing import Final

from push_ident_sim.faults import entries
from push_ident_sim.faults.fault import Fault

__all__ = ["FAULTS"]


def _discover() -> tuple[Fault, ...]:
    found: list[Fault] = []
    for module in iter_modules(entries.__path__, f"{entries.__name__}."):
        found += import_module(module.name).FAULTS
    numbers = [fault.number for fault in found]
    assert len(set(numbers)) == len(numbers), f"two faults have one number: {sorted(numbers)}"
    return tuple(sorted(found, key=lambda fault: fault.number))


FAULTS: Final = _discover()
"""Every `FAULTS` of the files in `entries`."""
