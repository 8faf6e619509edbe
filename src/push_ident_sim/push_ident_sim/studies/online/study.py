"""How fast an object is learned online from depth images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.identification.predicting.next_push import Criterion
from push_ident.identification.push_study import CurveOptions, choose_at_random, choose_by, learning_curve
from push_ident_sim.objects import OBJECT_NAMES, make_object
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, log_millimetres, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.filmed import PUSHES, FilmedObject
from push_ident_sim.studies.common.measuring import grouped, micrometres

__all__ = ["STUDY"]

_RANDOM, _CHOSEN = "random", "chosen"
_N_PUSHES: Final = 8
_SHOWN: Final = (1, 2, 4, 8)
_N_TEST: Final = 12
_AIM: Final = 0.003
"""After four pushes [m]."""


def _run(case: Case, settings: CaseSettings) -> Json:
    own = [case.model, OBJECT_NAMES.index(case.object_name)]
    thing = make_object(case.object_name, case.model)
    # Noise, test pushes and the first push are the same for both policies.
    filmed = FilmedObject(thing, [*own, 5])
    try:
        test = filmed.test_pushes(_N_TEST, np.random.default_rng([*own, 6]))
        policy = choose_at_random if case.variant == _RANDOM else choose_by(Criterion.ERROR, PUSHES)
        rng = np.random.default_rng([*own, 7])
        options = CurveOptions(n_pushes=_N_PUSHES, n_candidates=60)
        errors = learning_curve(filmed, policy, test, rng, push_settings=PUSHES, options=options)
    finally:
        filmed.close()
    return {"errors_m": micrometres(errors)}


def _summarise(results: Sequence[CaseResult]) -> Json:
    summary: Json = {"pushes": list(range(1, _N_PUSHES + 1)), "curves": {}}
    for variant, own in grouped(results, "variant").items():
        rows = {"all": own, **grouped(own, "object_name")}
        summary["curves"][variant] = {name: _curve([r.values["errors_m"] for r in cases]) for name, cases in rows.items()}
    return summary


def _curve(errors: Sequence[Sequence[float]]) -> Json:
    values = np.array(errors, dtype=np.float64)
    spread = np.nanstd(values, axis=0, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.full(values.shape[1], np.nan)
    return {"n": len(values), "mean_m": micrometres(np.nanmean(values, axis=0)), "standard_error_m": micrometres(spread)}


def _tables(summary: Json) -> str:
    head = ["mean cell error on held-out pushes [mm]", "cases", *(f"after {n}" for n in _SHOWN)]
    rows = [
        [f"{variant}, {name}", str(curve["n"]), *(_cell(curve, n - 1) for n in _SHOWN)]
        for variant, curves in summary["curves"].items()
        for name, curve in curves.items()
    ]
    return markdown_table(head, rows)


def _cell(curve: Json, i: int) -> str:
    mean, error = curve["mean_m"][i], curve["standard_error_m"][i]
    return f"{1e3 * mean:.2f}" + (f" ± {1e3 * error:.2f}" if error is not None and np.isfinite(error) else "")


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (axes,) = new_figure(1, width=6.0, height=4.2)
    for (name, curves), colour in zip(summary["curves"].items(), (COLOURS["uniform"], COLOURS["gauss_newton"]), strict=False):
        curve = curves["all"]
        bars = [1e3 * (error or 0.0) for error in curve["standard_error_m"]]
        axes.errorbar(summary["pushes"], 1e3 * np.array(curve["mean_m"]), bars, label=name, color=colour, marker="o", capsize=3)
    axes.axhline(1e3 * _AIM, color=COLOURS["truth"], lw=1.0, ls=":")
    axes.set_xlabel("pushes learned from")
    axes.set_xticks(summary["pushes"])
    log_millimetres(axes, "mean cell error on held-out pushes [mm]", low=0.5, high=20.0)
    label_below(axes, 2)
    save(figure, folder / "online.png")
    return {"online.png": "Error on held-out pushes by the number of pushes; bars are standard errors, dotted: 3 mm."}


STUDY = Experiment(
    name="online",
    place=70,
    title="Learning an object online from depth images",
    question=(
        "How many pushes does it take to learn an object when shape and poses come from depth images (30 Hz, 640 x 480, the noise of a "
        "real camera)? Perception segments it at rest. Then it is pushed eight times from where it lies, and put back by hand when it "
        "nears the edge; each push is learned as the node does it. `random`: any safe push. `chosen`: after the first, the one of 60 "
        f"safe pushes with the smallest expected error. The errors are those on {_N_TEST} other random pushes, the same for both, whose "
        "true motion is known."
    ),
    variants=(_RANDOM, _CHOSEN),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "perception", "physics", "identification"),
)
