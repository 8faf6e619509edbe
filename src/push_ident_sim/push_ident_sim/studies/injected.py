"""Known causes put into recordings of others: does a diagnosis name them beside all that real pushes hold anyway?

Errors of sensing, of the tool and of the geometry can be put into a recording exactly: its poses, stamps, path and radius are changed as if
the cell had reported them so. What the recording holds before is diagnosed, too, with the same pushes: a cause named in both was there.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.diagnosis_json import to_json
from push_ident.diagnosis.fits import fit_effects
from push_ident.diagnosis.held_out import measure_gap
from push_ident.diagnosis.odds import SOMETHING_ELSE, mechanism_of
from push_ident.diagnosis.policy import ValidationPolicy
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.files import finite
from push_ident.physics.effects import EFFECTS
from push_ident_sim.injected.into_recordings import CHANGES, Values, values_of, with_causes
from push_ident_sim.recordings.recording import seal
from push_ident_sim.studies.blind.cases import decision_hashes
from push_ident_sim.studies.blind.scoring import account_holds
from push_ident_sim.studies.common.measuring import mean_of
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import causes_text, markdown_table, millimetres, number
from push_ident_sim.studies.recorded import draw_pushes, find_sets, prior_of

_N_PUSHES: Final = 14
"""Drawn from a recording at most, as many as of a case of the blind check."""
_SIZES: Final = (1e-3, 2e-3, 4e-3, 8e-3)
"""By which a cause displaces the contact, root mean square over the pushes [m]."""
_COUNTS: Final = {"as-recorded": 0, "single": 1, "pair": 2, "against-half": 0, "single-against-half": 1, "pair-against-half": 2}
"""Causes that a variant puts in."""
_AGAINST: Final = "against-half"
"""End of the names of variants whose reference are the other half of the pushes, as they were recorded."""


def draw_causes(case: Case) -> dict[str, tuple[float, float]]:
    """Which causes a case has, by the seed of the case: by how much each displaces the contact [m], one size for all, and its direction
    [rad]."""
    n_causes = _COUNTS[case.variant]
    rng = np.random.default_rng([case.model, *case.object_name.encode(), n_causes])
    size = float(rng.choice(_SIZES)) * float(np.exp(0.2 * rng.normal()))
    return {str(name): (size, float(rng.uniform(-np.pi, np.pi))) for name in rng.permutation(list(CHANGES))[:n_causes]}


def _run(case: Case, settings: CaseSettings) -> Json:
    drawn = draw_pushes(find_sets(settings.recordings)[case.object_name], _N_PUSHES, np.random.default_rng([case.model]), with_forces=False)
    of_diagnosis = DiagnosisSettings(prior=prior_of(drawn))
    causes = {name: values_of(name, *of_case, drawn.records) for name, of_case in draw_causes(case).items()}
    records, reference = (drawn.records[1::2], drawn.records[::2]) if case.variant.endswith(_AGAINST) else (drawn.records, [])
    start = time.process_time()
    diagnosis = diagnose(with_causes(records, causes), of_diagnosis, against=reference)
    values: Json = {"n": len(records), "causes": causes, "seconds": time.process_time() - start, **_outcome(diagnosis)}
    if causes:
        values["before"] = _outcome(diagnose(records, of_diagnosis, against=reference))
        values["gain"] = _gain(diagnosis, causes)
    return finite(values)


def _outcome(diagnosis: Diagnosis) -> Json:
    probabilities, gap = diagnosis.probabilities, diagnosis.gap
    return {
        "verdict": diagnosis.verdict.value,
        "named": {e["name"]: list(e["parameters"].values()) for e in to_json(diagnosis)["effects"]},
        "confusable": list(diagnosis.confusion_set),
        "account_holds": account_holds(diagnosis),
        "something_else": None if probabilities is None else probabilities.something_else,
        "gap": None if gap is None else {f"{key}_m": float(np.mean(getattr(gap, key))) for key in ("before", "after", "noise")},
    }


def _gain(diagnosis: Diagnosis, causes: Mapping[str, Values]) -> Json | None:
    """What the true causes gain on held-out pushes when the model is given them; None where nothing was fitted."""
    if diagnosis.selection is None:
        return None
    base = diagnosis.selection.base
    added = [name for name in causes if name not in base.names]
    start = [v / p.scale for name in added for v, p in zip(causes[name], EFFECTS[name].parameters, strict=True)]
    fit = fit_effects(base, (*base.names, *added), np.r_[base.effect_unknowns, start])
    gap = measure_gap(base, fit, ValidationPolicy())
    gain = gap.log_density_gain
    error = float(np.std(gain, ddof=1) / np.sqrt(len(gain)))
    return {
        "log_density": float(np.mean(gain)), "standard_error": error,
        "before_m": float(np.mean(gap.before)), "after_m": float(np.mean(gap.after)),
        "sizes": {name: fit.effects.values[fit.effects.slice_of(name)].tolist() for name in added},
    }  # fmt: skip


def is_detectable(values: Json) -> bool:
    """Whether the causes, given to the model, predict held-out pushes better by more than twice the standard error of that gain."""
    gain = values["gain"]
    return gain is not None and bool(gain["log_density"] > 2.0 * gain["standard_error"])


def is_same(name: str, other: str) -> bool:
    """Whether two causes, effects or mechanisms with a free law, are the same to these sensors, by whatever law."""
    return mechanism_of(name) == mechanism_of(other) or (name in EFFECTS and other in EFFECTS[name].exact_twins)


# --- all cases


def _summarise(results: Sequence[CaseResult]) -> Json:
    summary: Json = {"variants": {}, "causes": {}}
    for variant in _COUNTS:
        of_variant = [r.values for r in results if r.case.variant == variant]
        if of_variant:
            summary["variants"][variant] = _row(of_variant)
    for name in CHANGES:
        single = [r.values for r in results if r.case.variant.startswith("single") and name in r.values["causes"]]
        if single:
            summary["causes"][name] = _row(single)
    return summary


def _row(cases: Sequence[Json]) -> Json:
    row = {
        "n": len(cases),
        "verdicts": dict(Counter(v["verdict"] for v in cases)),
        "something_else": mean_of(v["something_else"] for v in cases),
        "account_holds": [sum(v["account_holds"] is True for v in cases), sum(v["account_holds"] is not None for v in cases)],
        "gap": {key: mean_of((v["gap"][key] for v in cases if v["gap"]), 6) for key in ("before_m", "after_m", "noise_m")},
        "seconds": float(np.median([v["seconds"] for v in cases])),
    }
    injected = [v for v in cases if v["causes"]]
    if injected:
        detected = [v for v in injected if is_detectable(v)]
        row |= {
            "detectable": len(detected),
            "all_named": sum(all(_named_as(c, v) for c in v["causes"]) for v in detected),
            "one_named": sum(any(_named_as(c, v) for c in v["causes"]) for v in detected),
            "left_open": sum(not all(_named_as(c, v) for c in v["causes"]) and all(_possible(c, v) for c in v["causes"]) for v in detected),
            "wrong": sum(bool(_wrong(v)) for v in injected),
            "size_errors": [error for v in detected for error in _size_errors(v)],
        }
    return row


def _named_as(cause: str, values: Json) -> str | None:
    return next((name for name in values["named"] if is_same(cause, name)), None)


def _possible(cause: str, values: Json) -> bool:
    return any(is_same(cause, name) for name in (*values["named"], *values["confusable"]) if name != SOMETHING_ELSE)


def _wrong(values: Json) -> list[str]:
    """Names that are neither true nor given to the recording as it was, nor left open to what is true."""
    if all(_possible(cause, values) for cause in values["causes"]):
        return []
    expected = (*values["causes"], *values["before"]["named"], *values["before"]["confusable"])
    return [name for name in values["named"] if not any(is_same(name, other) for other in expected if other != SOMETHING_ELSE)]


def _size_errors(values: Json) -> list[float]:
    """Relative errors of the sizes of causes that were named, beyond what the recording had of them."""
    errors = []
    for cause, true in values["causes"].items():
        name = _named_as(cause, values)
        if name in EFFECTS:
            # Exact twins have the same values.
            before = next((np.array(v) for n, v in values["before"]["named"].items() if is_same(cause, n)), np.zeros(len(true)))
            errors.append(float(np.linalg.norm(np.array(values["named"][name]) - before - true) / np.linalg.norm(true)))
    return errors


def _tables(summary: Json) -> str:
    head = ["", "cases", "verdicts", "detectable", "all named", "one of them", "left open", "named wrongly", "size wrong by (median)"]
    head += ["account holds the error", "something else", "held-out error, after it, noise [mm]", "processor [s]"]
    parts = []
    for rows in (summary["variants"], summary["causes"]):
        if rows:
            parts.append(markdown_table(head, [_cells(name, row) for name, row in rows.items()]))
    return "\n\n".join(parts)


def _cells(name: str, row: Json) -> list[str]:
    counts = [str(row[key]) if key in row else "–" for key in ("detectable", "all_named", "one_named", "left_open", "wrong")]
    errors, (n_held, n) = row.get("size_errors"), row["account_holds"]
    return [
        name, str(row["n"]), causes_text(row["verdicts"]), *counts, f"{100 * float(np.median(errors)):.0f} %" if errors else "–",
        f"{n_held} of {n}", number(row["something_else"], "{:.2f}"), ", ".join(millimetres(value, 1) for value in row["gap"].values()),
        f"{row['seconds']:.0f}",
    ]  # fmt: skip


def _answer(summary: Json) -> str:
    row = summary["variants"].get("single")
    if row is None:
        return "No cause was put into a recording."
    return (
        f"Of {row['detectable']} detectable causes in real recordings {row['all_named']} were named; {row['wrong']} of {row['n']} wrongly."
    )


def _seal(cases: Sequence[Case], folder: Path) -> Json:
    truths = {case.key: {name: list(drawn) for name, drawn in draw_causes(case).items()} for case in cases}
    return {"n_cases": len(cases), "truth_sha256": seal({"cases": truths}), **decision_hashes()}


STUDY = Experiment(
    name="injected",
    title="Does it name known causes in real recordings?",
    question=(
        "Errors of camera, clock, tool and geometry are put into recordings of others (`--recordings DIR`, as of `recorded`), so that they "
        "displace the contact by 1 to 8 mm, singly and in pairs; each seed is a draw of pushes and causes. Against half: the other half "
        "of the pushes, as recorded, is the reference of `--against`. Detectable: the model that is given "
        "the true causes predicts held-out pushes better by more than twice the standard error of that gain. Exact twins count as right. "
        "Left open: true, but only one of several. Wrong: neither true, nor left open to it, nor given to the same pushes as they were "
        "recorded."
    ),
    objects=(),
    find_objects=lambda folder: tuple(find_sets(folder)),
    variants=tuple(_COUNTS),
    stages=("geometry", "physics", "identification", "diagnosis", "bags", "offline", "pushing"),
    prepare=_seal,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
)
