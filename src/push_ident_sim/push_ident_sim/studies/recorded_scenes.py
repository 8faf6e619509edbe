"""Recorded pushes of others against a plain scene of MuJoCo, as one would write it: the outline, even, with the contacts of defaults."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.files import finite
from push_ident.simulators.gap import simulator_gap
from push_ident_sim.studies.common.measuring import mean_of
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import markdown_table, millimetres
from push_ident_sim.studies.recorded import draw_pushes, find_sets, prior_of
from push_ident_sim.studies.scenes import plain_scene

_N_PUSHES = 14
_FRICTION = 0.5
_UNKNOWN_RADIUS = 1e-3
"""Of a pusher that the recording does not describe [m]."""
_NUISANCES = ("outline_error",)
"""Fitted with all: the radius of the pusher, or the outline, is not known exactly."""


def _run(case: Case, settings: CaseSettings) -> Json:
    drawn = draw_pushes(find_sets(settings.recordings)[case.object_name], _N_PUSHES, np.random.default_rng([case.model]), with_forces=False)
    records, prior = drawn.records, prior_of(drawn)
    effects = [effect.name for effect in diagnose(records, DiagnosisSettings(prior=prior), proposes_push=False).effects]
    with tempfile.TemporaryDirectory() as folder:
        scene = plain_scene(Path(folder), records[0].shape.outline, max(records[0].pusher.radius, _UNKNOWN_RADIUS), _FRICTION)
        gap = simulator_gap(records, scene, prior, effects=effects, nuisances=_NUISANCES)
    before, corrected, model = (float(np.mean(errors)) for errors in (gap.errors[0], gap.corrected, gap.errors[-1]))
    way = float(np.mean(np.linalg.norm(gap.observed[1, :, :2] - gap.observed[0, :, :2], axis=1)))
    values = {"n": len(records), "way_m": way, "before_m": before, "corrected_m": corrected, "model_m": model, "effects": effects}
    return finite({**values, "causes": list(gap.causes)})


def _summarise(results: Sequence[CaseResult]) -> Json:
    sets: Json = {}
    for name in sorted({r.case.object_name for r in results}):
        cases = [r.values for r in results if r.case.object_name == name]
        sets[name] = {key: mean_of((v[key] for v in cases), 6) for key in ("n", "way_m", "before_m", "corrected_m", "model_m")}
        sets[name]["causes"] = sorted({cause for v in cases for cause in v["causes"]})
    return {"sets": sets}


def _tables(summary: Json) -> str:
    head = ["", "pushes", "way [mm]", "plain scene [mm]", "corrected [mm]", "model [mm]", "causes"]
    rows = []
    for name, row in summary["sets"].items():
        lengths = [millimetres(row[key], 1) for key in ("way_m", "before_m", "corrected_m", "model_m")]
        rows.append([name, f"{row['n']:.0f}", *lengths, ", ".join(row["causes"])])
    return markdown_table(head, rows)


def _answer(summary: Json) -> str:
    sets = summary["sets"].values()
    better = sum(row["corrected_m"] < row["before_m"] for row in sets)
    near = sum(row["corrected_m"] <= 1.2 * row["model_m"] for row in sets)
    return f"The corrected scene is nearer to {better} of {len(sets)} recordings, and within 1.2 times the error of the model in {near}."


STUDY = Experiment(
    name="recorded-scenes",
    title="How far is a plain MuJoCo scene from recorded pushes, and corrected?",
    question=(
        "For each set of recorded pushes (`--recordings DIR`, as of `recorded`): the object as one would write it in MuJoCo, its outline, "
        f"even, friction {_FRICTION} everywhere, contacts of defaults, and the same scene corrected by three quarters of the pushes, on "
        "the other quarter. The radius of the pusher or the outline is fitted with all; a pusher that the recording does not describe has "
        "1 mm in the scene, which can become no thinner than nothing. Mean error of the cells at the end."
    ),
    objects=(),
    find_objects=lambda folder: tuple(find_sets(folder)),
    variants=("plain",),
    stages=("geometry", "physics", "identification", "diagnosis", "bags", "offline", "pushing", "simulators"),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
)
