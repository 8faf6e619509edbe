"""Recorded pushes of others: diagnosed set by set, and held against what their authors measured of the friction."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.files import finite
from push_ident.identification.unknowns.prior import Prior
from push_ident.types import PusherPath
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped
from push_ident_sim.studies.recorded.page import draw, tables
from push_ident_sim.studies.recorded.sets import Drawn, draw_pushes, find_sets, known_of

__all__ = ["LAWS", "STUDY"]

LAWS: Final = ("speed_dependent_friction", "position_dependent_friction", "table_anisotropy", "wear")
"""Effects of the catalogue for friction that depends on speed, place, direction and use."""
_VARIANTS: Final[dict[str, tuple[int, bool, bool]]] = {
    "14-pushes": (14, False, True),
    "14-poses": (14, False, False),
    "30-ends": (30, True, False),
}
"""Number of pushes, whether only their ends are known, and whether measured forces are used."""


def _run(case: Case, settings: CaseSettings) -> Json:
    n, ends_only, with_forces = _VARIANTS[case.variant]
    found = find_sets(settings.recordings)[case.object_name]
    # All variants draw the same pushes, as far as they take as many.
    drawn = draw_pushes(found, n, np.random.default_rng([case.model]), ends_only=ends_only, with_forces=with_forces)
    prior = Prior() if drawn.mass is None else Prior(total_mass=drawn.mass, total_mass_std=0.0)
    start = time.process_time()
    diagnosis = diagnose(drawn.records, DiagnosisSettings(prior=prior))
    seconds = time.process_time() - start
    return finite(
        {**_of_pushes(drawn), **_outcome(diagnosis), "seconds": seconds, "known": known_of(settings.recordings, case.object_name)}
    )


def _of_pushes(drawn: Drawn) -> Json:
    speeds = [_speed(record.pusher) for record in drawn.records]
    travel = [float(np.linalg.norm(r.poses.pose[-1, :2] - r.poses.pose[0, :2])) for r in drawn.records]
    return {
        "n_pushes": len(drawn.records),
        "n_all": drawn.n_all,
        "forces": any(record.wrench is not None for record in drawn.records),
        "mass_kg": drawn.mass,
        "speed_mps": [min(speeds), max(speeds)],
        "travel_m": float(np.median(travel)),
        "notes": list(drawn.notes),
    }


def _speed(path: PusherPath) -> float:
    """Of the pusher while it drives [m/s]: the speed in the middle of its way."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path.position, axis=0), axis=1))])
    first, last = (float(path.time[np.searchsorted(way, share * way[-1])]) for share in (0.25, 0.75))
    return float(0.5 * way[-1] / max(last - first, np.finfo(float).eps))


def _outcome(found: Diagnosis) -> Json:
    return {
        "verdict": found.verdict.value,
        "sentence": found.sentence,
        "failed_gates": [{"found": gate.found, "remedy": gate.remedy} for gate in found.gates if not gate.passed],
        "effects": [{"name": e.name, "parameters": e.parameters, "std": e.std, "evidence": e.log_bayes_factor} for e in found.effects],
        "confusable": list(found.confusion_set),
        "probabilities": {} if found.probabilities is None else {
            **found.probabilities.effects, "something_else": found.probabilities.something_else, "nothing": found.probabilities.nothing
        },
        "gap": None if found.gap is None else {
            "before_m": float(np.mean(found.gap.before)),
            "after_m": float(np.mean(found.gap.after)),
            "noise_m": float(np.mean(found.gap.noise)),
        },
        "friction": _friction(found),
        "laws": {name: _law(found, name) for name in LAWS},
    }  # fmt: skip


def _friction(found: Diagnosis) -> float | None:
    """Mean support friction coefficient of the fitted model, by the loads of the cells; None where the diagnosis abstains."""
    if found.fit is None:
        return None
    model = found.fit.posterior.model
    return float(model.mass @ model.friction / model.mass.sum())


def _law(found: Diagnosis, name: str) -> Json:
    """What these pushes say of one law: its evidence in the first step, and the smallest size that they would have shown."""
    if found.selection is None or not found.selection.steps:
        return {}
    first = found.selection.steps[0]
    refitted = {c.name: c.log_bayes_factor for c in first.candidates}
    score = next((s for s in first.scores if s.name == name), None)
    if score is None:
        return {}
    return {"evidence": refitted.get(name, score.expected_log_bayes_factor), "smallest": score.smallest_detectable}


# --- all cases


def _summarise(results: Sequence[CaseResult]) -> Json:
    sets = {name: grouped(own, "variant") for name, own in grouped(results, "object_name").items()}
    return {
        "laws": list(LAWS),
        "sets": {name: {variant: _row(own) for variant, own in variants.items()} for name, variants in sets.items()},
        "known": {name: next(iter(variants.values()))[0].values["known"] for name, variants in sets.items()},
    }


def _row(results: Sequence[CaseResult]) -> Json:
    values = [result.values for result in results]
    gaps = [v["gap"] for v in values if v["gap"] is not None]
    named = Counter(effect["name"] for v in values for effect in v["effects"])
    frictions = [v["friction"] for v in values if v["friction"] is not None]
    return {
        "draws": len(values),
        "pushes": [min(v["n_pushes"] for v in values), max(v["n_pushes"] for v in values), max(v["n_all"] for v in values)],
        "forces": any(v["forces"] for v in values),
        "speed_mps": [min(v["speed_mps"][0] for v in values), max(v["speed_mps"][1] for v in values)],
        "travel_m": float(np.median([v["travel_m"] for v in values])),
        "verdicts": dict(Counter(v["verdict"] for v in values)),
        "named": dict(named),
        "open": dict(Counter(name for v in values for name in v["confusable"])),
        "failed_gates": [gate["found"] for v in values for gate in v["failed_gates"]],
        "sentences": [v["sentence"] for v in values],
        "gap": {key: float(np.mean([gap[key] for gap in gaps])) for key in ("before_m", "after_m", "noise_m")} if gaps else None,
        "friction": [float(np.mean(frictions)), float(np.min(frictions)), float(np.max(frictions))] if frictions else None,
        "laws": {name: _law_row(values, name) for name in LAWS},
        "sizes": {name: _sizes(values, name) for name in named},
        "probabilities": _mean_probabilities(values),
        "seconds": float(np.median([v["seconds"] for v in values])),
    }


def _law_row(values: Sequence[Json], name: str) -> Json:
    own = [v["laws"].get(name) or {} for v in values]
    evidence = [law["evidence"] for law in own if law.get("evidence") is not None]
    smallest = [np.inf if law["smallest"] is None else law["smallest"] for law in own if law]
    middle = float(np.median(smallest)) if smallest else np.inf
    return {
        "named": sum(any(effect["name"] == name for effect in v["effects"]) for v in values),
        "open": sum(name in v["confusable"] for v in values),
        "evidence": float(np.median(evidence)) if evidence else None,
        "smallest": middle if np.isfinite(middle) else None,
        "probability": _mean_probabilities(values).get(name),
    }


def _mean_probabilities(values: Sequence[Json]) -> dict[str, float]:
    stated = [v["probabilities"] for v in values if v["probabilities"]]
    names = dict.fromkeys(name for own in stated for name in own)
    return {name: float(np.mean([own.get(name, 0.0) for own in stated])) for name in names}


def _sizes(values: Sequence[Json], name: str) -> list[dict[str, Any]]:
    """Sizes of an effect in the draws in which it was named."""
    return [{"parameters": e["parameters"], "std": e["std"]} for v in values for e in v["effects"] if e["name"] == name]


def _find(folder: Path) -> tuple[str, ...]:
    return tuple(find_sets(folder))


STUDY = Experiment(
    name="recorded",
    place=132,
    title="Recordings of others",
    question=(
        "What does a diagnosis find in pushes that others recorded, on surfaces whose friction they measured? The recordings are those "
        "of `--recordings DIR`, set by set: one object on one surface. Each seed is a random draw of the pushes of a set, in the order "
        "in which they were made; `14-pushes` with measured forces, where there are any, `14-poses` the same pushes without them, "
        "`30-ends` 30 pushes known by their poses before and after only. A published mass counts as given. What the authors measured "
        "stands in `known.json` beside their recordings. The smallest size is that of the first parameter of a law from which these "
        "pushes would have shown it on average; a dash: no sensible size. Nothing of the decisions was set on these recordings."
    ),
    objects=(),
    find=_find,
    variants=tuple(_VARIANTS),
    needs_truth=False,
    stages=("geometry", "physics", "identification", "diagnosis", "bags", "offline", "pushing"),
    run=_run,
    summarise=_summarise,
    tables=tables,
    draw=draw,
)
