"""Figures of the blind check, each with an interval that holds at 90 %."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from push_ident.diagnosis.odds import SOMETHING_ELSE
from push_ident.physics.effects import CAUSES, EFFECTS
from push_ident_sim.cell.sensors import PLAIN
from push_ident_sim.studies.blind.scoring import twins_of
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.experiment import CaseResult

__all__ = ["Judged", "figures", "interval", "judge", "summarise_cases"]

_Z90 = 1.6449
_NINE_OF_TEN = 1.2816
"""A normal deviate is larger than minus this nine times out of ten."""
_DETECTABLE = 5.0
"""An effect is detectable where its true size increases the log evidence by this on average [nat]; odds of 150 to 1."""
_PLAIN = 25.0
"""Noncentrality from which a confusion is rare."""
_SIZED = (
    "outline_error", "pusher_lag", "pusher_speed_scale", "pose_latency", "tool_offset", "camera_translation", "camera_rotation",
    "camera_scale", "pusher_friction", "table_anisotropy", "base_anisotropy",
)  # fmt: skip
"""Effects whose law is the same in the engines and in the model."""
_OF_A_UNIT = ("camera_translation", "camera_rotation", "camera_scale")
"""Errors of calibration that every unit of a model of a sensor has."""
_MOST_PUSHES = "14-pushes"
_N_BOOTSTRAP = 2000
_SURE = 0.9
"""Probability from which a cause counts as said."""
_PROBABILITIES = (0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0 + 1e-9)
"""Ranges in which what is said is held against the truth."""


@dataclass(frozen=True, slots=True)
class Judged:
    """A diagnosis against the truth; exact twins count as one."""

    engine: str
    kind: str
    pushes: str
    truth: tuple[str, ...]
    verdict: str
    named: tuple[str, ...]
    """Effects that were added, in their order."""
    set: frozenset[str]
    """The named effects and the confusion set."""
    noncentrality: float
    """Of the weakest true effect, beside its hardest rival; by slopes at null, and of a single one by fits of both as well."""
    detectable: bool
    """Every true effect is detectable on average."""
    clearly_detectable: bool
    """Each is detectable nine times out of ten."""
    values: Json
    sensor: str = PLAIN
    """Model of the sensor, where the engine is a camera."""
    of_the_unit: tuple[str, ...] = ()
    """Effects that were named and are those of a sensor's calibration, which nobody injected; taken out of `named`."""
    ground_truth: tuple[str, int] = ("", 0)
    """Object and seed."""

    @property
    def right(self) -> bool:
        """The first named effect was injected."""
        return bool(self.named) and self.named[0] in self.truth

    @property
    def wrong(self) -> bool:
        """Named with confidence, and not injected."""
        return self.verdict in ("named", "several") and any(name not in self.truth for name in self.named)


def _one_of_twins(name: str) -> str:
    return min((name, *twins_of(name)))


def judge(result: CaseResult) -> Judged:
    """Compare a case's outcome with its truth."""
    values = result.values
    truth = values["truth"]
    names = tuple(map(_one_of_twins, truth["names"])) if truth["kind"] in ("single", "pair") else ()
    named = tuple(_one_of_twins(effect["name"]) for effect in values["effects"])
    sensor, verdict = truth.get("sensor", PLAIN), values["verdict"]
    own = {_one_of_twins(name) for name in _OF_A_UNIT} - set(names) if sensor != PLAIN else set()
    of_the_unit, named = tuple(name for name in named if name in own), tuple(name for name in named if name not in own)
    if of_the_unit and not named:
        verdict = "no_gap"
    detectability = values.get("detectability", {}).values()
    return Judged(
        engine=truth["engine"],
        kind=truth["kind"],
        pushes=result.case.variant,
        truth=names,
        verdict=verdict,
        named=named,
        set=frozenset((*named, *map(_one_of_twins, values["confusable"]))),
        noncentrality=_noncentrality(values),
        detectable=bool(detectability) and all((d["gain"] or 0.0) >= _DETECTABLE for d in detectability),
        clearly_detectable=bool(detectability) and all(_in_nine_of_ten(d) >= _DETECTABLE for d in detectability),
        values=values,
        sensor=sensor,
        of_the_unit=of_the_unit,
        ground_truth=result.case.truth,
    )


def _noncentrality(values: Json) -> float:
    hardest = min((t["hardest"] or 0.0 for t in values.get("detectability", {}).values()), default=0.0)
    separation = values.get("oracle", {}).get("apart")
    return float(hardest if separation is None else min(hardest, separation))


def _in_nine_of_ten(detectability: Json) -> float:
    """Log evidence [nat] that a true size exceeds nine times out of ten.

    The square root of twice the log likelihood ratio is normal with unit variance.
    """
    root = float(np.sqrt(detectability["alone"] or 0.0))
    return (detectability["gain"] or 0.0) - 0.5 * (root**2 - max(0.0, root - _NINE_OF_TEN) ** 2)


def interval(hits: int, n: int) -> Json:
    """A share with Wilson's interval at 90 %."""
    if n == 0:
        return {"share": None, "n": 0, "low": None, "high": None}
    share, z2 = hits / n, _Z90**2
    middle = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = _Z90 / (1 + z2 / n) * np.sqrt(share * (1 - share) / n + z2 / (4 * n * n))
    return {"share": share, "n": n, "low": float(max(0.0, middle - half)), "high": float(min(1.0, middle + half))}


def _share(cases: Iterable[Judged], holds: Callable[[Judged], Any]) -> Json:
    found = [bool(holds(case)) for case in cases]
    return interval(sum(found), len(found))


def _statistic(values: Sequence[Any], of: Callable[..., Any] = np.median) -> Json:
    """A median or mean over the rows of `values` with its bootstrap interval at 90 %."""
    if not len(values):
        return {"value": None, "n": 0, "low": None, "high": None}
    rows, rng = np.array(values, dtype=np.float64), np.random.default_rng(0)
    drawn = [of(rows[i], axis=0) for i in rng.integers(len(rows), size=(_N_BOOTSTRAP, len(rows)))]
    low, high = np.quantile(drawn, [0.05, 0.95])
    return {"value": float(of(rows, axis=0)), "n": len(rows), "low": float(low), "high": float(high)}


def figures(cases: Sequence[Judged]) -> Json:
    """All figures of one group of cases."""
    nulls, singles, pairs, outside = ([c for c in cases if c.kind == kind] for kind in ("null", "single", "pair", "outside"))
    detected = [c for c in singles if c.detectable]
    plain = [c for c in detected if c.noncentrality >= _PLAIN]
    below = [c for c in singles if not c.detectable]
    both_detectable = [c for c in pairs if c.detectable]
    clearly = [c for c in singles if c.clearly_detectable]
    # A case in which the base model is not trustworthy counts as visible.
    visible = [c for c in outside if c.values.get("visibility") is None or c.values["visibility"] >= _PLAIN]
    shrunk = [c for c in (*detected, *both_detectable) if None not in (c.values["gap"]["shrink"], c.values["oracle"]["gap"]["shrink"])]
    shrinks = [(c.values["gap"]["shrink"], c.values["oracle"]["gap"]["shrink"]) for c in shrunk]
    sized = [s for c in detected if c.right for s in _size_errors(c)]
    ties = [c for c in detected if "asked" in c.values]
    tuned = [c.values["baselines"]["tuned_gap"]["shrink"] for c in shrunk]
    return {
        "false_alarms": _share(nulls, lambda c: c.verdict not in ("no_gap", "not_trustworthy")),
        "nulls_not_trusted": _share(nulls, lambda c: c.verdict == "not_trustworthy"),
        "top1_detectable": _share(detected, lambda c: c.right),
        "top1_surely": _share(clearly, lambda c: c.right),
        "top1_plain": _share(plain, lambda c: c.right),
        "wrong_names": _share(singles, lambda c: c.wrong),
        "wrong_names_detectable": _share(detected, lambda c: c.wrong),
        "in_set": _share([c for c in detected if c.set], lambda c: c.truth[0] in c.set),
        "set_size": _statistic([len(c.set) for c in detected if c.set], np.mean),
        "ties_settled": _share(ties, _settled_rightly),
        "ties_settled_as_expected": _share([c for c in ties if c.values["asked"].get("expected", False)], _settled_rightly),
        "ties_beyond_pushes": _share(ties, lambda c: c.values["asked"]["n"] == 0),
        "ties_asked": _statistic([c.values["asked"]["n"] for c in ties], np.mean),
        "silent_undetectable": _share(below, lambda c: c.verdict == "no_gap"),
        "wrong_undetectable": _share(below, lambda c: c.wrong),
        "pairs_both": _share(both_detectable, lambda c: set(c.truth) <= set(c.named)),
        "pairs_one": _share(both_detectable, lambda c: set(c.truth) & set(c.named)),
        "unknown_flagged": _share(visible, lambda c: c.verdict in ("unknown", "not_trustworthy")),
        "unknown_misnamed": _share(outside, lambda c: c.verdict in ("named", "several")),
        **_calibration(_counted(cases)),
        "outside_invisible": interval(len(outside) - len(visible), len(outside)),
        "shrink": _statistic([own for own, _ in shrinks]),
        "shrink_oracle": _statistic([oracle for _, oracle in shrinks]),
        "shrink_of_oracle": _statistic([own / oracle for own, oracle in shrinks if oracle > 0.1]),
        "shrink_tuned": _statistic([t for t in tuned if t is not None]),
        "size_error": _statistic([error for error, _ in sized]),
        "sizes_within_tenth": interval(sum(error <= 0.1 for error, _ in sized), len(sized)),
        "size_intervals": interval(sum(held for _, inside in sized for held in inside), sum(len(inside) for _, inside in sized)),
        "baseline_evidence": _share(detected, lambda c: _baseline(c, "evidence") in c.truth),
        "baseline_training_fit": _share(detected, lambda c: _baseline(c, "training_fit") in c.truth),
        "baseline_largest_residual": _share(detected, lambda c: _baseline(c, "largest_residual") in c.truth),
        "baseline_random": {"share": 1.0 / len(CAUSES), "n": len(detected), "low": None, "high": None},
        "seconds": _statistic([c.values["seconds"] for c in cases]),
    }


def _counted(cases: Sequence[Judged]) -> list[Judged]:
    """Cases whose probabilities are held against the truth: without causes that are there and cannot be seen."""
    return [
        c
        for c in cases
        if c.kind == "null"
        or (c.kind in ("single", "pair") and c.detectable)
        or (c.kind == "outside" and (c.values.get("visibility") is None or c.values["visibility"] >= _PLAIN))
    ]


def _said(cases: Sequence[Judged]) -> list[tuple[float, bool]]:
    """Probabilities of all causes (effects, something else, nothing), and whether each is there. Exact twins share theirs. Cases without a
    verdict, or from before probabilities were published, say nothing."""
    said: list[tuple[float, bool]] = []
    for case in cases:
        true = {"null": {"nothing"}, "outside": {SOMETHING_ELSE}}.get(case.kind, set(case.truth))
        probabilities: Counter[str] = Counter()
        for name, value in (case.values.get("probabilities") or {}).items():
            probabilities[_one_of_twins(name)] += value
        said += [(min(value, 1.0), name in true) for name, value in probabilities.items()]
    return said


def _calibration(cases: Sequence[Judged]) -> Json:
    """Of causes that are said with a high probability: the share that is right, and the mean of what was said."""
    said = [(value, right) for value, right in _said(cases) if value >= _SURE]
    return {
        "said_surely": interval(sum(right for _, right in said), len(said)),
        "said_surely_mean": _statistic([value for value, _ in said], np.mean),
    }


def _by_probability(cases: Sequence[Judged]) -> list[Json]:
    """The same for every range of probabilities."""
    said, rows = _said(_counted(cases)), []
    for low, high in pairwise(_PROBABILITIES):
        own = [(value, right) for value, right in said if low <= value < high]
        mean = float(np.mean([value for value, _ in own])) if own else None
        rows.append({"from": low, "to": high, "said": mean, "right": interval(sum(right for _, right in own), len(own))})
    return rows


def _settled_rightly(case: Judged) -> bool:
    """Whether only the true effect remained after the requested pushes."""
    asked = case.values["asked"]
    return asked["settled"] and [_one_of_twins(name) for name in asked["named"]] == list(case.truth)


def _baseline(case: Judged, name: str) -> str:
    return _one_of_twins(case.values["baselines"][name] or "")


def _size_errors(case: Judged) -> list[tuple[float, list[bool]]]:
    """Relative error of an effect that was rightly named, and whether each parameter lies in its interval at 90 %; none where the law of
    the world is not that of the model."""
    effect = case.values["effects"][0]
    name = effect["name"]
    if name not in _SIZED or name not in case.values["true_parameters"]:
        return []
    shown = [i for i, p in enumerate(EFFECTS[name].parameters) if not p.shape]
    true = np.array(case.values["true_parameters"][name])[shown]
    found, std = (np.array(list(effect[key].values()))[shown] for key in ("parameters", "std"))
    error = float(np.linalg.norm(found - true) / np.linalg.norm(true))
    return [(error, [bool(v) for v in np.abs(found - true) <= _Z90 * std])]


def summarise_cases(results: Sequence[CaseResult]) -> Json:
    """Figures by engine and by number of pushes, the confusion matrix, the smallest detectable sizes, and every case in a line.

    Cases through a model of a sensor have figures of their own and count nowhere else.
    """
    judged = [judge(result) for result in results]
    cases = [case for case in judged if case.sensor == PLAIN]
    by_sensor: dict[str, list[Judged]] = {}
    for case in judged:
        if case.sensor != PLAIN:
            by_sensor.setdefault(case.sensor, []).append(case)
    groups: dict[str, list[Judged]] = {"all": cases}
    for case in cases:
        # The camera is an engine and a variant.
        for name in {case.pushes, case.engine}:
            groups.setdefault(name, []).append(case)
    return {
        "figures": {name: figures(own) for name, own in groups.items()},
        "sensors": {
            name: {"n": len(own), "of_the_unit": _share(own, lambda c: c.of_the_unit), **figures(own)} for name, own in by_sensor.items()
        },
        "by_noncentrality": _by_noncentrality(cases),
        "by_probability": _by_probability(cases),
        "same_cases": _same_cases(cases),
        "confusion": _confusion(cases),
        "smallest": _smallest(cases),
        "cases": [
            {
                "case": result.case.key,
                "truth": "+".join(result.values["truth"]["names"]) or "nothing",
                "size": result.values["truth"]["size"],
                "engine": case.engine,
                "kind": case.kind,
                "detectable": case.detectable,
                "noncentrality": case.noncentrality,
                "verdict": case.verdict,
                "named": list(case.named),
                "confusable": result.values["confusable"],
            }
            for result, case in zip(results, judged, strict=True)
        ],
    }


def _by_noncentrality(cases: Sequence[Judged]) -> list[Json]:
    edges = (0.0, 9.0, 25.0, 100.0, 400.0, np.inf)
    rows = []
    for low, high in pairwise(edges):
        own = [c for c in cases if c.kind == "single" and c.truth and low <= c.noncentrality < high and "detectability" in c.values]
        rows.append(
            {
                "from": low,
                "top1": _share(own, lambda c: c.right),
                "in_set": _share(own, lambda c: set(c.truth) & c.set),
                "wrong": _share(own, lambda c: c.wrong),
                "silent": _share(own, lambda c: c.verdict == "no_gap"),
            }
        )
    return rows


def _same_cases(cases: Sequence[Judged]) -> Json:
    """Other numbers of pushes against the largest, in cases that both have: single effects count where the largest number detects them.

    Cases through a camera have other noise and are left out.
    """
    by_pushes: dict[str, dict[tuple[str, int], Judged]] = {}
    for case in cases:
        if case.engine != "camera":
            by_pushes.setdefault(case.pushes, {})[case.ground_truth] = case
    table: Json = {}
    for pushes, own in by_pushes.items():
        most = by_pushes.get(_MOST_PUSHES, {})
        both = [key for key in own if key in most]
        if pushes == _MOST_PUSHES or not both:
            continue
        for name, of in ((_MOST_PUSHES, most), (pushes, own)):
            table.setdefault(pushes, {})[name] = {
                "top1": _share([of[key] for key in both if most[key].kind == "single" and most[key].detectable], lambda c: c.right),
                "one_of_pair": _share([of[key] for key in both if of[key].kind == "pair"], lambda c: set(c.truth) & set(c.named)),
                "false_alarms": _share([of[key] for key in both if of[key].kind == "null"], lambda c: c.verdict != "no_gap"),
                "wrong": _share([of[key] for key in both if of[key].kind != "outside"], lambda c: c.wrong),
            }
    return table


def _confusion(cases: Sequence[Judged]) -> Json:
    """How often each truth got each name; truths of one detectable effect, nulls, and effects outside the catalogue."""
    counts: dict[str, Counter[str]] = {}
    for case in cases:
        if case.kind == "pair" or (case.kind == "single" and not case.detectable):
            continue
        truth = case.truth[0] if case.truth else ("outside" if case.kind == "outside" else "nothing")
        answer = case.named[0] if case.named else {"no_gap": "nothing"}.get(case.verdict, case.verdict)
        counts.setdefault(truth, Counter())[answer] += 1
    return {truth: dict(own) for truth, own in sorted(counts.items())}


def _smallest(cases: Sequence[Judged]) -> Json:
    """Median over the nulls of the smallest detectable size of each effect, by number of pushes; None where it is infinite."""
    table: Json = {}
    for pushes in sorted({c.pushes for c in cases}):
        smallest = [c.values["steps"][0]["smallest"] for c in cases if c.kind == "null" and c.pushes == pushes and c.values["steps"]]
        table[pushes] = {}
        for name in CAUSES:
            middle = float(np.median([own.get(name, np.inf) for own in smallest])) if smallest else np.inf
            table[pushes][name] = middle if np.isfinite(middle) else None
    return table
