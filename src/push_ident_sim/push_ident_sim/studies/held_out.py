"""Recorded pushes of which only the ends are known: how far a few of them go on the others, and whether they ever do harm."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.predicting.scoring import score_push
from push_ident.identification.unknowns.load import feet_load
from push_ident.identification.unknowns.prior import Prior
from push_ident.offline.loading import load_pushes
from push_ident.types import Float64Array, ObjectModel, ObjectShape, PushRecord
from push_ident_sim.studies.common.measuring import ends_of, grouped, mean_of, micrometres, solve_values
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import markdown_table, millimetres, number
from push_ident_sim.studies.recorded import RecordedSet, find_sets

_PUSHES: Final = {"2-pushes": 2, "5-pushes": 5, "10-pushes": 10}
_N_TEST: Final = 25
"""Pushes that are predicted, at most: half of a set of fifty."""
_FRICTIONS: Final = np.arange(0.1, 0.85, 0.05)
"""Of the pusher, of which the best on the predicted pushes is taken [-]: a bound that nobody can know beforehand."""
_IMPOSSIBLE: Final = 0.03
"""Error of equal cells from which a recorded push counts as broken off or mixed up [m]: the pushes are 20 mm long."""
_BEYOND: Final = 3.0
"""Expected errors from which a prediction counts as wrong [1]."""


def _load(recorded: RecordedSet) -> tuple[list[PushRecord], Float64Array | None]:
    """Pushes with their ends only, and the supports of the object where they are known [m], shape (n, 2)."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        report = None if recorded.read is None else recorded.read(recorded.paths, bag)
        loaded = load_pushes([recorded.paths[0] if report is None else bag]).records
    supports = None if report is None or not len(report.supports) else report.supports
    return [replace(ends_of(record), wrench=None) for record in loaded], supports


def _run(case: Case, settings: CaseSettings) -> Json:
    records, supports = _load(find_sets(settings.recordings)[case.object_name])
    n_train = _PUSHES[case.variant]
    order = np.random.default_rng([7, case.model]).permutation(len(records))
    test = [records[i] for i in order[:_N_TEST]]
    train = [records[i] for i in order[_N_TEST : _N_TEST + n_train]]
    if len(train) < n_train:
        raise InputError(f"{case.object_name} has {len(records)} pushes, expected {_N_TEST + n_train} and more.")
    result = identify(train, budget=settings.budget)
    uniform = held_out_errors(result.uniform, test)
    test = [record for record, error in zip(test, uniform, strict=True) if error < _IMPOSSIBLE]
    models = {"identified": result.model, "scalar": result.scalar, "uniform": result.uniform}
    errors = {name: held_out_errors(model, test) for name, model in models.items()}
    if supports is not None:
        known = [held_out_errors(on_supports(test[0].shape, supports, mu), test) for mu in (Prior().pusher_friction, *_FRICTIONS)]
        errors |= {"supports": known[0], "best": min(known[1:], key=lambda values: float(np.nanmean(values)))}
    scores = [score_push(result.posterior, record, 1) for record in test]
    return solve_values(result) | {
        "errors_m": {name: micrometres(values) for name, values in errors.items()},
        "within_90": [score.within_90 for score in scores],
        "beyond": [bool(score.cell_error > _BEYOND * score.expected_cell_error) for score in scores],
    }


def on_supports(shape: ObjectShape, supports: Float64Array, pusher_friction: float) -> ObjectModel:
    """An even object on points, which bear what statics gives them."""
    prior, cells = Prior(), shape.cells
    weight = cells.areas / cells.areas.sum()
    feet = feet_load(weight, cells.centres, supports, 0.6 * cells.size, np.zeros(len(supports)))
    return ObjectModel(shape, prior.total_mass * weight, prior.friction * feet.load / weight, pusher_friction)


def _summarise(results: Sequence[CaseResult]) -> Json:
    groups = grouped(results, "object_name") | {"all": list(results)}
    return {"sets": {name: {variant: _row(cases, variant) for variant in _PUSHES} for name, cases in groups.items()}}


def _row(results: Sequence[CaseResult], variant: str) -> Json:
    cases = [result.values for result in results if result.case.variant == variant]

    def pooled(name: str) -> float | None:
        return mean_of((error for values in cases for error in values["errors_m"].get(name, [])), 6)

    def share(name: str) -> float | None:
        return mean_of((float(value) for values in cases for value in values[name]), 4)

    times = [values["time_s"] for values in cases]
    return {
        **{f"{name}_m": pooled(name) for name in ("identified", "scalar", "uniform", "supports", "best")},
        **{name: share(name) for name in ("within_90", "beyond")},
        "median_s": float(np.median(times)) if times else None,
        "solves": len(cases),
    }


def _tables(summary: Json) -> str:
    def of(name: str, key: str, text: Callable[[float | None], str] = millimetres) -> str:
        return " / ".join(text(summary["sets"][name][variant][key]) for variant in _PUSHES)

    def percent(value: float | None) -> str:
        return "–" if value is None else f"{100 * value:.0f}"

    return markdown_table(
        [
            "set, mean cell error [mm]",
            "equal cells",
            "fitted equal cells, 2 / 5 / 10 pushes",
            "identified, 2 / 5 / 10",
            "known supports, nominal; best pusher friction",
            "90 % regions hold, 2 / 5 / 10 [%]",
            "beyond 3 expected [%]",
            "median solve [s]",
        ],
        [
            [
                name,
                millimetres(rows["10-pushes"]["uniform_m"]),
                of(name, "scalar_m"),
                of(name, "identified_m"),
                "; ".join(millimetres(rows["10-pushes"][key]) for key in ("supports_m", "best_m")),
                of(name, "within_90", percent),
                of(name, "beyond", percent),
                of(name, "median_s", lambda value: number(value, "{:.1f}")),
            ]
            for name, rows in summary["sets"].items()
        ],
    )


def harmed(summary: Json, variant: str, allowed: float = 0.02) -> list[str]:
    """Names of the sets that are predicted worse than by nominal equal cells, by more than a share `allowed`."""
    rows = {name: sets[variant] for name, sets in summary["sets"].items() if name != "all"}
    return [name for name, row in rows.items() if row["solves"] and row["identified_m"] > (1.0 + allowed) * row["uniform_m"]]


def _answer(summary: Json) -> str:
    row, n = summary["sets"]["all"], len(summary["sets"]) - 1
    errors = " / ".join(millimetres(row[variant]["identified_m"]) for variant in _PUSHES)
    counts = " / ".join(str(len(harmed(summary, variant))) for variant in _PUSHES)
    return (
        f"From 2 / 5 / 10 pushes known by their ends {errors} mm on the others "
        f"(equal cells {millimetres(row['10-pushes']['uniform_m'])} mm); "
        f"{counts} of {n} sets are predicted worse than by equal cells, by 2 % and more."
    )


STUDY = Experiment(
    name="held-out",
    title="Do a few recorded pushes ever do harm?",
    question=(
        "Sets of recorded pushes, of which only the pose before and after each is used, without forces: identified from 2, 5 and 10 "
        f"pushes, {_N_TEST} others predicted from their first poses. Each seed is another draw. Equal cells have nominal friction, or "
        "fitted frictions. Where the supports are known, an object on them is predicted as well, with the nominal pusher friction and "
        "with the one that is best on the predicted pushes, which nobody can know."
    ),
    objects=(),
    variants=tuple(_PUSHES),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    find_objects=lambda folder: tuple(find_sets(folder)),
)
