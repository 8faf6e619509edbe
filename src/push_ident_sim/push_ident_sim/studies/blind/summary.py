"""Figures of the blind check, each with an interval that holds at 90 %, and their tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np

from push_ident.diagnosis.odds import SOMETHING_ELSE
from push_ident.physics.effects import EFFECTS
from push_ident_sim.studies.blind.scoring import twins_of
from push_ident_sim.studies.common.study import CaseResult, Json
from push_ident_sim.studies.common.tables import markdown_table, number

MOST_PUSHES: Final = "14-pushes"
_Z90: Final = 1.6449
"""Standard normal quantile: between minus this and this lie 90 %."""
_DETECTABLE: Final = 5.0
"""An effect is detectable where its true size increases the log evidence by this on average [nat]; odds of 150 to 1."""
_VISIBLE: Final = 25.0
"""Noncentrality from which an effect outside the catalogue is visible [1]."""
_SIZED: Final = (
    "outline_error", "pusher_lag", "pusher_speed_scale", "pose_latency", "tool_offset", "camera_translation", "camera_rotation",
    "camera_scale", "pusher_friction", "table_anisotropy", "base_anisotropy",
)  # fmt: skip
"""Effects whose law is the same in the engines and in the model."""
_SURE: Final = 0.9
"""Probability from which a cause counts as stated [1]."""
_PROBABILITIES: Final = (0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0 + 1e-9)
"""Ranges in which stated probabilities are compared with the truth."""


@dataclass(frozen=True, slots=True)
class Judged:
    """A diagnosis against the truth; exact twins count as one."""

    engine: str
    kind: str
    pushes: str
    """The variant."""
    ground_truth: tuple[str, int]
    """Object and seed."""
    truth: tuple[str, ...]
    verdict: str
    named: tuple[str, ...]
    """Effects that were added, in their order."""
    mechanism: str
    """Of the first of them; "" where none was."""
    true_mechanisms: frozenset[str]
    set: frozenset[str]
    """The named effects and the confusion set."""
    detectable: bool
    """Every true effect is detectable on average."""
    clearly_detectable: bool
    """Each is detectable nine times out of ten."""
    values: Json

    @property
    def right(self) -> bool:
        """The first named effect was injected."""
        return bool(self.named) and self.named[0] in self.truth

    @property
    def right_mechanism(self) -> bool:
        """The mechanism of the first named effect was injected."""
        return self.mechanism in self.true_mechanisms

    @property
    def wrong(self) -> bool:
        """Named with confidence, and not injected."""
        return self.verdict in ("named", "several") and any(name not in self.truth for name in self.named)


def _one_of_twins(name: str) -> str:
    return min((name, *twins_of(name)))


def _mechanism_of(name: str) -> str:
    return EFFECTS[name].mechanism if name in EFFECTS else name


def _true_mechanisms(truth: Json) -> list[str]:
    """Those of the injected effects, one of each pair of twins; none where the catalogue holds none of them."""
    of_kind = {"foreign": [truth["mechanism"]], "outside": []}
    return of_kind.get(truth["kind"], [_mechanism_of(_one_of_twins(name)) for name in truth["names"]])


def judge(result: CaseResult) -> Judged:
    """Compare a case's outcome with its truth."""
    values = result.values
    truth = values["truth"]
    named = tuple(_one_of_twins(effect["name"]) for effect in values["effects"])
    detectability = values.get("detectability", {}).values()
    return Judged(
        engine=truth["engine"],
        kind=truth["kind"],
        pushes=result.case.variant,
        ground_truth=result.case.truth,
        truth=tuple(map(_one_of_twins, truth["names"])) if truth["kind"] in ("single", "pair") else (),
        verdict=values["verdict"],
        named=named,
        mechanism=_mechanism_of(named[0]) if named else "",
        true_mechanisms=frozenset(_true_mechanisms(truth)),
        set=frozenset((*named, *map(_one_of_twins, values["confusable"]))),
        detectable=bool(detectability) and all((d["gain"] or 0.0) >= _DETECTABLE for d in detectability),
        clearly_detectable=bool(detectability) and all((d["certain_gain"] or 0.0) >= _DETECTABLE for d in detectability),
        values=values,
    )


def interval(hits: int, n: int) -> Json:
    """A share with Wilson's interval at 90 %."""
    if n == 0:
        return {"share": None, "n": 0, "low": None, "high": None}
    share, z2 = hits / n, _Z90**2
    middle = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = _Z90 / (1 + z2 / n) * np.sqrt(share * (1 - share) / n + z2 / (4 * n * n))
    return {"share": share, "n": n, "low": float(max(0.0, middle - half)), "high": float(min(1.0, middle + half))}


def _share(cases: Iterable[Judged], holds: Callable[[Judged], Any]) -> Json:
    outcomes = [bool(holds(case)) for case in cases]
    return interval(sum(outcomes), len(outcomes))


def _statistic(values: Sequence[Any], of: Callable[..., Any] = np.median) -> Json:
    """A median or mean over the rows of `values` with its bootstrap interval at 90 %."""
    if not len(values):
        return {"value": None, "n": 0, "low": None, "high": None}
    rows, rng = np.array(values, dtype=np.float64), np.random.default_rng(0)
    drawn = [of(rows[i], axis=0) for i in rng.integers(len(rows), size=(2000, len(rows)))]
    low, high = np.quantile(drawn, [0.05, 0.95])
    return {"value": float(of(rows, axis=0)), "n": len(rows), "low": float(low), "high": float(high)}


def figures(cases: Sequence[Judged]) -> Json:
    """All figures of one group of cases."""
    kinds = ("null", "single", "pair", "foreign", "outside")
    nulls, singles, pairs, foreign, outside = ([c for c in cases if c.kind == kind] for kind in kinds)
    detected = [c for c in singles if c.detectable]
    below = [c for c in singles if not c.detectable]
    both_detectable = [c for c in pairs if c.detectable]
    visible = [c for c in outside if _is_visible(c)]
    shrinks = [c.values["gap"]["shrink"] for c in (*detected, *both_detectable)]
    sized = [held for c in detected if c.right for held in _sizes_held(c)]
    stated = [right for value, right in _stated(_counted(cases)) if value >= _SURE]
    return {
        "false_alarms": _share(nulls, lambda c: c.verdict not in ("no_gap", "not_trustworthy")),
        "top1_detectable": _share(detected, lambda c: c.right),
        "top1_surely": _share([c for c in singles if c.clearly_detectable], lambda c: c.right),
        "mechanism_detectable": _share(detected, lambda c: c.right_mechanism),
        "mechanism_foreign": _share([c for c in foreign if _is_visible(c)], lambda c: c.right_mechanism),
        "wrong_foreign": _share(foreign, lambda c: c.verdict in ("named", "several") and not c.right_mechanism),
        "wrong_names": _share(singles, lambda c: c.wrong),
        "in_set": _share([c for c in detected if c.set], lambda c: c.truth[0] in c.set),
        "set_size": _statistic([len(c.set) for c in detected if c.set], np.mean),
        "silent_undetectable": _share(below, lambda c: c.verdict == "no_gap"),
        "pairs_both": _share(both_detectable, lambda c: set(c.truth) <= set(c.named)),
        "pairs_one": _share(both_detectable, lambda c: set(c.truth) & set(c.named)),
        "unknown_flagged": _share(visible, lambda c: c.verdict in ("unknown", "not_trustworthy")),
        "unknown_misnamed": _share(outside, lambda c: c.verdict in ("named", "several")),
        "stated_surely": interval(sum(stated), len(stated)),
        "shrink": _statistic([share for share in shrinks if share is not None]),
        "size_intervals": interval(sum(sized), len(sized)),
        "account": _share([c for c in (*nulls, *singles, *pairs) if _explained(c)], lambda c: c.values["account_holds"]),
        "seconds": _statistic([c.values["seconds"] for c in cases]),
    }


def _explained(case: Judged) -> bool:
    """Whether exactly what acts is named, so that the account is to hold the whole error."""
    return case.values.get("account_holds") is not None and set(case.truth) == set(case.named)


def _is_visible(case: Judged) -> bool:
    """Of a case whose law the catalogue does not hold; one in which the base model is not trustworthy counts as visible."""
    visibility = case.values.get("visibility")
    return visibility is None or visibility >= _VISIBLE


def _counted(cases: Sequence[Judged]) -> list[Judged]:
    """Cases whose probabilities are compared with the truth: without causes that are there and cannot be noticed."""
    shown = {"single": lambda c: c.detectable, "pair": lambda c: c.detectable, "foreign": _is_visible, "outside": _is_visible}
    return [c for c in cases if c.kind == "null" or shown[c.kind](c)]


def _stated(cases: Sequence[Judged]) -> list[tuple[float, bool]]:
    """Probabilities of all causes (effects, something else, nothing), and whether each is there. Exact twins share theirs. Cases without a
    verdict state nothing."""
    stated: list[tuple[float, bool]] = []
    for case in cases:
        laws = {name for name in EFFECTS if EFFECTS[name].mechanism in case.true_mechanisms}
        true = {"null": {"nothing"}, "outside": {SOMETHING_ELSE}, "foreign": laws}.get(case.kind, set(case.truth))
        probabilities: Counter[str] = Counter()
        for name, value in (case.values.get("probabilities") or {}).items():
            probabilities[_one_of_twins(name)] += value
        stated += [(min(value, 1.0), name in true) for name, value in probabilities.items()]
    return stated


def _by_probability(cases: Sequence[Judged]) -> list[Json]:
    stated, rows = _stated(_counted(cases)), []
    for low, high in pairwise(_PROBABILITIES):
        within = [(value, right) for value, right in stated if low <= value < high]
        mean = float(np.mean([value for value, _ in within])) if within else None
        rows.append({"from": low, "to": high, "stated": mean, "right": interval(sum(right for _, right in within), len(within))})
    return rows


def _sizes_held(case: Judged) -> list[bool]:
    """Whether each parameter of an effect that was rightly named lies in its interval at 90 %; none where the law of the world is not that
    of the model."""
    effect = case.values["effects"][0]
    name = effect["name"]
    if name not in _SIZED or name not in case.values["true_parameters"]:
        return []
    shown = [i for i, p in enumerate(EFFECTS[name].parameters) if not p.shape]
    true = np.array(case.values["true_parameters"][name])[shown]
    estimate, std = (np.array(list(effect[key].values()))[shown] for key in ("parameters", "std"))
    return [bool(v) for v in np.abs(estimate - true) <= _Z90 * std]


def summarise_cases(results: Sequence[CaseResult]) -> Json:
    """Figures by variant, the calibration of stated probabilities, what was named instead of the truth, and every case in a line."""
    cases = [judge(result) for result in results]
    groups: dict[str, list[Judged]] = {}
    for case in cases:
        groups.setdefault(case.pushes, []).append(case)
    return {
        "figures": {name: figures(group) for name, group in groups.items()},
        "by_probability": _by_probability(cases),
        "confusion": _confusion(cases),
        "cases": [
            {
                "case": result.case.key,
                "truth": "+".join(result.values["truth"]["names"]) or "nothing",
                "size": result.values["truth"]["size"],
                "engine": case.engine,
                "kind": case.kind,
                "detectable": case.detectable,
                "verdict": case.verdict,
                "named": list(case.named),
                "confusable": result.values["confusable"],
            }
            for result, case in zip(results, cases, strict=True)
        ],
    }


def _confusion(cases: Sequence[Judged]) -> Json:
    """How often each truth got each name; truths of one detectable effect, nulls, and effects outside the catalogue."""
    counts: dict[str, Counter[str]] = {}
    for case in cases:
        if case.kind == "pair" or (case.kind == "single" and not case.detectable):
            continue
        other = {"null": "nothing", "foreign": " or ".join(f"foreign {name}" for name in case.true_mechanisms)}
        truth = case.truth[0] if case.truth else other.get(case.kind, case.kind)
        named = case.mechanism if case.kind == "foreign" else "".join(case.named[:1])
        answer = named if case.named else {"no_gap": "nothing"}.get(case.verdict, case.verdict)
        counts.setdefault(truth, Counter())[answer] += 1
    return {truth: dict(answers) for truth, answers in sorted(counts.items())}


_ROWS: Final = {
    "false_alarms": ("false alarms on nulls", "<= 1 %"),
    "top1_detectable": ("first name right, detectable sizes", ">= 90 %"),
    "top1_surely": ("first name right, clearly detectable sizes", ">= 90 %"),
    "mechanism_detectable": ("first mechanism right, detectable sizes", ">= 97 %"),
    "mechanism_foreign": ("foreign law, visible: first mechanism right", ">= 97 %"),
    "wrong_foreign": ("foreign law: another mechanism named with confidence", "<= 1 %"),
    "wrong_names": ("named with confidence and wrong, all sizes", "<= 1 %"),
    "in_set": ("truth in the confusion set", ">= 95 %"),
    "set_size": ("size of the confusion set", "<= 1.3"),
    "silent_undetectable": ("undetectable sizes: no gap", ""),
    "pairs_both": ("two effects: both named", ">= 90 %"),
    "pairs_one": ("two effects: one named", ">= 95 %"),
    "unknown_flagged": ("outside the catalogue, visible: reported as unknown", ">= 90 %"),
    "unknown_misnamed": ("outside the catalogue: named with confidence", "<= 3 %"),
    "stated_surely": ("causes stated with a probability of at least 90 %: right", ""),
    "shrink": ("S, median", ">= 0.85"),
    "size_intervals": ("90 % intervals of sizes that contain the truth", "85-95 %"),
    "account": ("nothing, or all of it, to be named: account holds the held-out error", "85-95 %"),
    "seconds": ("processor seconds a case, median", ""),
}
"""Figure: its words and its target."""


def _figure(figure: Json) -> str:
    if "share" in figure and figure["share"] is not None:
        return f"{round(figure['share'] * figure['n'])}/{figure['n']} ({100 * figure['low']:.0f}-{100 * figure['high']:.0f}%)"
    return number(figure.get("value"), "{:.2f}")


def tables(summary: Json) -> str:
    """Markdown of a summary."""
    parts = []
    if sealed := summary.get("sealed"):
        hashes = ", ".join(f"{what} `{sealed[f'{what}_sha256'][:12]}`" for what in ("truth", "policy", "code"))
        parts.append(f"Set: {sealed['phase']}, {sealed['n_cases']} cases; SHA-256 {hashes}. Intervals hold at 90 %.")
    if by_variant := summary.get("figures"):
        rows = [[text, aim, *(_figure(group[key]) for group in by_variant.values())] for key, (text, aim) in _ROWS.items()]
        parts.append(markdown_table(["figure", "target", *by_variant], rows))
        rows = [
            [f"{row['from']:.2f} to {min(row['to'], 1.0):.2f}", number(row["stated"], "{:.2f}"), _figure(row["right"])]
            for row in summary["by_probability"]
        ]
        parts.append(markdown_table(["stated probability of a cause", "mean", "right"], rows))
        parts.append(f"Not named rightly (truth: answer): {_confusions(summary['confusion'])}.")
    if engines := summary.get("engines"):
        errors = "; ".join(f"{name} {1e3 * row['median_m']:.2f} ({1e3 * row['q90_m']:.2f})" for name, row in engines.items())
        parts.append(f"Cell error between engines without effects, median (90 %) [mm]: {errors}.")
    return "\n\n".join(parts)


def _confusions(confusion: Json) -> str:
    """What was answered instead of the truth, such as `pose_latency: pusher_lag 3`."""
    right = {"nothing": ("nothing", "not_trustworthy"), "outside": ("unknown", "not_trustworthy")}
    wrong = {
        truth: ", ".join(
            f"{answer} {n}" for answer, n in answers.items() if answer not in right.get(truth, (truth.removeprefix("foreign "),))
        )
        for truth, answers in confusion.items()
    }
    return "; ".join(f"{truth}: {answers}" for truth, answers in wrong.items() if answers) or "none"


def answer(summary: Json) -> str:
    """The answer in a sentence."""
    by_variant = summary["figures"]
    figures = by_variant.get(MOST_PUSHES) or next(iter(by_variant.values()))
    first, alarms, wrong = (figures[key] for key in ("top1_detectable", "false_alarms", "wrong_names"))
    hits = {key: round((row["share"] or 0.0) * row["n"]) for key, row in (("first", first), ("alarms", alarms), ("wrong", wrong))}
    return (
        f"Of detectable single effects {hits['first']} of {first['n']} are named first; {hits['alarms']} false alarms in {alarms['n']} "
        f"null cases; {hits['wrong']} of {wrong['n']} named wrongly with confidence."
    )
