"""Whether a diagnosis names the right cause without knowing the truth: other engines, sealed truth, policy and code, one scoring run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.files import finite
from push_ident.geometry.cells import cell_error
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.types import PusherPath, PushRecord
from push_ident_sim.engines.planar import PlanarWorld
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import OBJECT_NAMES, make_object
from push_ident_sim.recordings.truth import TruthSettings, make_pushes, true_model
from push_ident_sim.studies.blind.cases import (
    CAMERA,
    ENGINES,
    NULLS,
    Truth,
    decision_hashes,
    draw_truth,
    make_records,
    n_pushes_of_null,
    seal_cases,
)
from push_ident_sim.studies.blind.scoring import score_case
from push_ident_sim.studies.blind.summary import MOST_PUSHES, answer, summarise_cases, tables
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json

_N_PUSHES: Final = {MOST_PUSHES: 14, CAMERA: 8}


# --- one case


def _run(case: Case, settings: CaseSettings) -> Json:
    if case.variant == ENGINES:
        return _compare_engines(case)
    of_case = (case.object_name, case.model)
    n_pushes = n_pushes_of_null(*of_case) if case.variant == NULLS else _N_PUSHES[case.variant]
    truth = draw_truth(*of_case, case.variant)
    records = make_records(truth, *of_case, n_pushes, settings.noise)

    def make_plain() -> list[PushRecord]:
        plain: Truth = replace(truth, effects=InjectedEffects(), outside=())
        return make_records(plain, *of_case, n_pushes, settings.noise)

    values = score_case(records, truth, make_object(*of_case), DiagnosisSettings(), make_plain=make_plain)
    return {**finite(values), **decision_hashes()}


def _compare_engines(case: Case) -> Json:
    """Cell errors [m] at the ends of the same pushes without any effect: the distance between the engines without effects."""
    sim_object = make_object(case.object_name, case.model)
    settings = TruthSettings(n_train=3, n_test=0)
    radius = settings.pushes.pusher_radius
    model, planar = true_model(sim_object), PlanarWorld(sim_object, radius, time_step=settings.time_step)
    errors: dict[str, list[float]] = {"model and Bullet": [], "model and planar engine": [], "planar engine and Bullet": []}
    for motion in make_pushes(sim_object, [case.model, OBJECT_NAMES.index(case.object_name), 6], settings):
        path = PusherPath(motion.time, motion.pusher, radius)
        of_model = simulate(model, PushScenario(path, motion.pose[0], motion.time[-1:])).pose[-1]
        of_planar, of_bullet = planar.push(motion.pose[0], path).pose[-1], motion.pose[-1]
        ends = ((of_model, of_bullet), (of_model, of_planar), (of_planar, of_bullet))
        for name, (a, b) in zip(errors, ends, strict=True):
            errors[name].append(cell_error(model.shape.cells, a, b))
    return dict(errors)


# --- all cases


def _summarise(results: Sequence[CaseResult]) -> Json:
    engines = [r.values for r in results if r.case.variant == ENGINES]
    scored = [r for r in results if r.case.variant != ENGINES]
    summary = summarise_cases(scored) if scored else {}
    if engines:
        distances = {name: [v for values in engines for v in values[name]] for name in engines[0]}
        summary["engines"] = {
            name: {"n": len(values), "median_m": float(np.median(values)), "q90_m": float(np.quantile(values, 0.9))}
            for name, values in distances.items()
        }
    return summary


STUDY = Experiment(
    name="blind",
    title="Does a diagnosis name the right cause?",
    question=(
        "Each case has no effect, one at sizes from undetectable to three times typical, two, one by a law that the catalogue does not "
        "hold (foreign), or one whose mechanism it does not hold (outside). `nulls`: none, 6 to 20 pushes. Seeds from "
        "1000 on are scored once, after the hashes were written down. An effect is detectable where its true size brings 5 nat of log "
        "evidence on average (odds of 150 to 1), clearly detectable where it does so nine times out of ten; a foreign or outside one "
        "is visible where the same pushes without it differ by a noncentrality of 25. Exact twins count as right. S is the share of the"
        " gap on held-out pushes that the effect explains. "
        "`camera`: 8 pushes through rendered depth images "
        "and perception; effects that cannot be filmed are left out."
    ),
    variants=(MOST_PUSHES, CAMERA, NULLS, ENGINES),
    most_models={ENGINES: 2},
    every={CAMERA: 3},
    # Perception counts for the camera, pushing for the paths of the pushes.
    stages=("geometry", "perception", "physics", "identification", "diagnosis", "pushing"),
    prepare=seal_cases,
    run=_run,
    summarise=_summarise,
    tables=tables,
    answer=answer,
)
