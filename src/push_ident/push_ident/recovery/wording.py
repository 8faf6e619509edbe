"""A self-test in plain sentences, and as JSON."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Final

import numpy as np
from scipy.stats import binom

from push_ident.diagnosis.wording import detectable_size
from push_ident.identification.results.identifiability import Knowledge
from push_ident.physics.effects import EFFECTS
from push_ident.recovery.effects import Proof
from push_ident.recovery.maps import Recovery
from push_ident.recovery.run import SelfTest

OUTCOMES = {
    "named": "it was named",
    "left open": "it was left open among causes that these pushes cannot distinguish",
    "by its mechanism": "its mechanism was named, not its law",
    "not named": "it was not named",
}
"""Of `Proof.outcome`."""
_MAX_P_VALUE: Final = 0.01
"""Probability that right intervals hold the truth so rarely, below which they count as too narrow [1]; judgement."""


def size_text(recovery: Recovery, value: float) -> str:
    """A deviation or an error: `2.1 mm`, or a relative one, `12 %`."""
    return f"{1e3 * value:.1f} mm" if recovery.unit == "m" else f"{100.0 * value:.0f} %"


def quantity_rows(test: SelfTest) -> list[tuple[str, ...]]:
    """Of a table: name, deviation before the pushes and stated after them, error, share within the intervals, identifiability."""
    n, rows = sum(not one.failure for one in test.tests), []
    for q in test.quantities:
        sizes = [size_text(q, value) for value in (q.prior_std, q.std, q.error)]
        rows.append((q.name, *sizes, f"{q.n_within} of {n}", q.knowledge.value.partition(":")[0]))
    return rows


def effect_rows(test: SelfTest) -> list[tuple[str, ...]]:
    """Of a table: name, smallest detectable and usual size."""
    return [(e.name, *(detectable_size(e.name, size) or "none" for size in (e.smallest, e.typical))) for e in test.effects]


def can_tell(test: SelfTest) -> list[str]:
    """What the pushes tell, a sentence each."""
    told = [
        f"{q.name[0].upper()}{q.name[1:]}: to {size_text(q, q.error)} (median error; stated {size_text(q, q.std)}, before the pushes "
        f"{size_text(q, q.prior_std)})."
        for q in test.quantities
        if q.knowledge in (Knowledge.PINNED, Knowledge.NARROWED)
    ]
    visible = [f"{e.name} from {detectable_size(e.name, e.smallest)}" for e in test.effects if e.is_visible]
    return [*told, f"Effects that would be detected at a usual size, on average: {', '.join(visible)}."] if visible else told


def cannot_tell(test: SelfTest) -> list[str]:
    """What they do not tell, and where their stated intervals cannot be relied on."""
    told = [
        f"{q.name[0].upper()}{q.name[1:]}: hardly (median error {size_text(q, q.error)}, before the pushes {size_text(q, q.prior_std)})."
        for q in test.quantities
        if q.knowledge is Knowledge.OPEN
    ]
    n = sum(not one.failure for one in test.tests)
    if wrong := [q.name for q in test.quantities if binom.cdf(q.n_within, n, 0.9) < _MAX_P_VALUE]:
        told.append(f"The stated intervals of {', '.join(wrong)} are too narrow: they held the truth less often than at 90 %.")
    hidden = [e.name for e in test.effects if not e.is_visible]
    if hidden:
        told.append(f"Effects that would remain hidden at a usual size: {', '.join(hidden)}. No name does not mean that they are absent.")
    return told + [f"{p.name} at {detectable_size(p.name, p.size)}: {OUTCOMES[p.outcome]}." for p in test.proofs if p.outcome != "named"]


def would_help(test: SelfTest) -> list[str]:
    """What to do about that."""
    open_ones = {q.name for q in test.quantities if q.knowledge is Knowledge.OPEN}
    steps = []
    if any(q.unit == "kg" and q.name in open_ones for q in test.quantities):
        steps.append("Weigh the object and give its mass, or record the forces of the pusher: poses do not show the mass.")
    if len(open_ones) > bool(steps) or any(q.knowledge is Knowledge.NARROWED for q in test.quantities):
        steps.append("More pushes, at other places and in other directions, that turn the object both ways.")
    return steps + [f"For {e.name}, at the cell: {EFFECTS[e.name].check}" for e in test.effects if not e.is_visible]


def proof_text(proof: Proof) -> str:
    """Size, outcome and verdict of one injection."""
    named = f" (first name: {', '.join(proof.named)})" if proof.named else ""
    return f"{proof.name} {detectable_size(proof.name, proof.size)}: {OUTCOMES[proof.outcome]}{named}"


def selftest_json(test: SelfTest) -> dict[str, Any]:
    """All numbers in SI units, deviations of quantities without a length relative to the value, and the sentences."""
    done = [one for one in test.tests if not one.failure]
    return {
        "n_pushes": test.n_pushes,
        "options": asdict(test.options),
        "discrepancy": test.discrepancy,
        "quantities": [{**asdict(q), "knowledge": q.knowledge.name.lower()} for q in test.quantities],
        "n_objects": len(done),
        "failures": [one.failure for one in test.tests if one.failure],
        "end_error_m": float(np.median([one.end_error for one in done])) if done else None,
        "end_error_before_m": float(np.median([one.end_error_before for one in done])) if done else None,
        "effects": [{**asdict(e), "visible": e.is_visible, "unit": EFFECTS[e.name].parameters[0].unit} for e in test.effects],
        "proofs": [asdict(p) for p in test.proofs],
        "can_tell": can_tell(test),
        "cannot_tell": cannot_tell(test),
        "would_help": would_help(test),
        "left_out": list(test.left_out),
        "seconds": test.seconds,
    }
