"""Whether a diagnosis names the right cause without knowing the truth: other engines, sealed truth, policy and code, one scoring run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.files import finite
from push_ident.geometry.cells import cell_error
from push_ident.identification.predicting.next_push import PlannedPush
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY, simulate
from push_ident.types import PusherPath, PushRecord
from push_ident_sim.engines.planar import PlanarWorld
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import OBJECT_NAMES, make_object
from push_ident_sim.recordings.truth import TruthSettings, make_pushes, true_model
from push_ident_sim.studies.blind.cases import CAMERAS, Truth, draw_truth, make_records, make_requested_record
from push_ident_sim.studies.blind.page import draw, tables
from push_ident_sim.studies.blind.scoring import score_case
from push_ident_sim.studies.blind.sealing import ENGINES, decision_hashes, seal_cases
from push_ident_sim.studies.blind.summary import summarise_cases
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment

__all__ = ["STUDY"]

CHOSEN: Final = "6-chosen"
"""Variant of as many pushes, most of which the diagnosis chose."""
_N_RANDOM: Final = 3
"""Random pushes before it chooses: the fewest that it takes."""
_N_PUSHES = {"14-pushes": 14, "8-pushes": 8, "6-pushes": 6, CHOSEN: 6, **dict.fromkeys(CAMERAS, 8)}
_N_MODELS = {**{name: 2 for name in CAMERAS if name != "camera"}, ENGINES: 2}
"""Ground truths of each object: there are many models of sensors."""
_EVERY = {"8-pushes": 6, "6-pushes": 3, CHOSEN: 3, "camera": 3}
"""Only every so manyth ground truth: fewer than of 14 pushes, and spread over a run, so that one that is stopped holds some of each."""
_N_COMPARED = 3
"""Pushes on which engines are compared."""


# --- one case


def _run(case: Case, settings: CaseSettings) -> Json:
    if case.variant == ENGINES:
        return _compare_engines(case)
    truth = draw_truth(case.object_name, case.model, sensor=CAMERAS.get(case.variant))
    make = _chosen_records if case.variant == CHOSEN else _random_records
    records = make(truth, case, settings)

    def make_push(push: PlannedPush, number: int) -> PushRecord | None:
        return make_requested_record(truth, case.object_name, case.model, push, number, settings.noise)

    def make_plain() -> list[PushRecord]:
        plain = replace(truth, effects=InjectedEffects(), outside=())
        return make_records(plain, case.object_name, case.model, _N_PUSHES[case.variant], settings.noise)

    thing = make_object(case.object_name, case.model)
    # Without any effect, other pushes would have been proposed.
    plain = None if case.variant == CHOSEN else make_plain
    values = score_case(records, truth, thing, DiagnosisSettings(), make_push=make_push, make_plain=plain)
    return {**finite(values), **decision_hashes()}


def _random_records(truth: Truth, case: Case, settings: CaseSettings) -> list[PushRecord]:
    return make_records(truth, case.object_name, case.model, _N_PUSHES[case.variant], settings.noise)


def _chosen_records(truth: Truth, case: Case, settings: CaseSettings) -> list[PushRecord]:
    """A few random pushes, then those that a diagnosis of all before proposes: to separate causes, or else to learn the maps.

    Where it proposes none, or the camera cannot make it, the next random one is made.
    """
    of_case = case.object_name, case.model
    n_pushes = _N_PUSHES[CHOSEN]
    random = make_records(truth, *of_case, n_pushes, settings.noise)
    records = random[:_N_RANDOM]
    while len(records) < n_pushes:
        found, number = diagnose(records, DiagnosisSettings()), len(records)
        push = found.first_push if found.next_push is None else found.next_push.push
        made = None if push is None else make_requested_record(truth, *of_case, push, number, settings.noise)
        records.append(random[number] if made is None else made)
    return records


def _compare_engines(case: Case) -> Json:
    """Cell errors [m] at the ends of the same pushes without any effect: the distance between the engines without effects."""
    thing = make_object(case.object_name, case.model)
    settings = TruthSettings(n_train=_N_COMPARED, n_test=0)
    radius = settings.pushes.pusher_radius
    model, planar = true_model(thing), PlanarWorld(thing, radius, time_step=settings.time_step)
    loaded = replace(model, friction=model.friction * planar.cell_loads() / (model.mass * GRAVITY))
    errors: dict[str, list[float]] = {"model_bullet": [], "model_planar": [], "model_planar_own_loads": [], "planar_bullet": []}
    for motion in make_pushes(thing, [case.model, OBJECT_NAMES.index(case.object_name), 6], settings):
        path = PusherPath(motion.time, motion.pusher, radius)
        other = planar.push(motion.pose[0], path).pose[-1]
        own, own_loads = (simulate(m, PushScenario(path, motion.pose[0], motion.time[-1:])).pose[-1] for m in (model, loaded))
        ends = {
            "model_bullet": (own, motion.pose[-1]),
            "model_planar": (own, other),
            "model_planar_own_loads": (own_loads, other),
            "planar_bullet": (other, motion.pose[-1]),
        }
        for name, (a, b) in ends.items():
            errors[name].append(cell_error(model.shape.cells, a, b))
    return dict(errors)


# --- all cases


def _summarise(results: Sequence[CaseResult]) -> Json:
    engines = [r.values for r in results if r.case.variant == ENGINES]
    scored = [r for r in results if r.case.variant != ENGINES]
    summary = summarise_cases(scored) if scored else {}
    if engines:
        summary["engines"] = {
            name: {
                "n": len(own),
                "median_m": float(np.median(own)),
                "q90_m": float(np.quantile(own, 0.9)),
                "largest_m": float(np.max(own)),
            }
            for name in engines[0]
            if (own := [v for values in engines for v in values[name]])
        }
    return summary


STUDY = Experiment(
    name="blind",
    place=130,
    title="Blind check of the diagnosis",
    question=(
        "Does a diagnosis name the right cause on pushes from other engines, when the truth is sealed? Pushes come from two engines "
        "that the diagnosis does not use: Bullet with injected effects, and a planar integrator with bristles, springs and a bed that "
        "tilts. Each case has no effect, one effect at sizes from undetectable to three times typical, two effects, or an effect "
        "outside the catalogue. Seeds below 1000 set the policy; those from 1000 on are scored once, after the hashes of truth and "
        "policy were written down. An effect is detectable where its true size brings 5 nat of log evidence on average, and clearly "
        "detectable where it does so nine times out of ten; one outside the catalogue is detectable where the same pushes without it "
        "differ by a noncentrality of 25. The noncentrality is that beside fitted maps and the hardest rival. The first name counts as "
        "right where it is the injected effect or its exact twin. S is the share of the gap on held-out pushes that the effect "
        "explains. Where a verdict leaves more than one effect, up to two requested pushes are made. `6-chosen`: three random pushes and "
        "three that the diagnosis proposes, one after the other; a table compares them with 14 random pushes of the same cases. "
        "`camera`: the same through rendered depth images and perception. `camera-NAME`: the same pushes as the first of those, through a "
        "sensor of that model, another unit for each ground truth; perception gets the pose and intrinsics that the unit publishes, not "
        "its own. Only a table of their own counts these cases; a named error of calibration, which every unit has, is neither right nor "
        "wrong there. `engines`: the distance between the engines without any effect."
    ),
    variants=("14-pushes", "8-pushes", "6-pushes", CHOSEN, *CAMERAS, ENGINES),
    fewer=_N_MODELS,
    every=_EVERY,
    needs_truth=False,
    stages=("geometry", "physics", "identification", "diagnosis", "pushing"),
    prepare=seal_cases,
    run=_run,
    summarise=_summarise,
    tables=tables,
    draw=draw,
)  # fmt: skip
