"""Whether choosing the next push by its expected gain is better than pushing at random."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from push_ident.identification.predicting.next_push import Criterion, PlannedPush
from push_ident.identification.push_study import CurveOptions, Policy, choose_at_random, choose_by, learning_curve
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array, ObjectShape, PusherPath, PushRecord
from push_ident_sim.engines.bullet.push_world import PushWorld
from push_ident_sim.objects import OBJECT_NAMES, SimObject
from push_ident_sim.recordings.truth import CameraNoise, load_truth, observe_motion, true_model
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, log_millimetres, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped, micrometres

__all__ = ["STUDY"]

_N_PUSHES = 5
_RANDOM, _CHOSEN = "random", "least-error"


class _BulletObject:
    """An object of the simulated cell, pushed in Bullet, observed with noise, and put back to the middle after each push."""

    def __init__(self, thing: SimObject, radius: float, noise: CameraNoise, rng: np.random.Generator) -> None:
        self.shape: ObjectShape = true_model(thing).shape
        self.pose: Float64Array = np.zeros(3)
        self._world, self._radius, self._noise, self._rng = PushWorld(thing, radius), radius, noise, rng

    def execute(self, push: PlannedPush) -> PushRecord:
        path = push.pusher
        moves = np.flatnonzero(np.linalg.norm(np.diff(path.position, axis=0), axis=1) > 0)
        driven = slice(moves[0], moves[-1] + 2)
        motion = self._world.push(push.pose_object_in_table, PusherPath(path.time[driven], path.position[driven], path.radius))
        return PushRecord("o1", self.shape, *observe_motion(motion, self._radius, self._noise, self._rng))

    def close(self) -> None:
        self._world.close()


def _policy(variant: str, pushes: PushSettings) -> Policy:
    return choose_at_random if variant == _RANDOM else choose_by(Criterion.ERROR, pushes)


def _run(case: Case, settings: CaseSettings) -> Json:
    _, test, thing = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, settings.noise)
    pushes, own = settings.truth.pushes, OBJECT_NAMES.index(case.object_name)
    # The same noise and the same first push for both policies.
    pushed = _BulletObject(thing, pushes.pusher_radius, settings.noise, np.random.default_rng([case.model, own, 3]))
    try:
        rng = np.random.default_rng([case.model, own, 4])
        errors = learning_curve(
            pushed, _policy(case.variant, pushes), test, rng, push_settings=pushes, options=CurveOptions(n_pushes=_N_PUSHES)
        )
    finally:
        pushed.close()
    return {"errors_m": micrometres(errors)}


def _curves(results: Sequence[CaseResult]) -> dict[tuple[str, int], Float64Array]:
    return {r.case.truth: np.array(r.values["errors_m"], dtype=np.float64) for r in results}


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_variant = {variant: _curves(own) for variant, own in grouped(results, "variant").items()}
    summary: Json = {"pushes": list(range(1, _N_PUSHES + 1)), "curves": {}}
    for variant, curves in by_variant.items():
        values = np.array(list(curves.values()))
        summary["curves"][variant] = {"mean_m": micrometres(np.nanmean(values, axis=0)), "standard_error_m": _standard_error(values)}
    if _RANDOM in by_variant and _CHOSEN in by_variant:
        both = [t for t in by_variant[_RANDOM] if t in by_variant[_CHOSEN]]
        gain = np.array([by_variant[_RANDOM][t] - by_variant[_CHOSEN][t] for t in both])
        summary["gain"] = {"mean_m": micrometres(np.nanmean(gain, axis=0)), "standard_error_m": _standard_error(gain)}
    return summary


def _standard_error(values: Float64Array) -> list[float | None]:
    return micrometres(np.nanstd(values, axis=0, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else [None] * _N_PUSHES


def _row(name: str, curve: Json) -> list[str]:
    pairs = zip(curve["mean_m"], curve["standard_error_m"], strict=True)
    return [name, *(f"{1e3 * mean:.2f}" + (f" ± {1e3 * error:.2f}" if error is not None else "") for mean, error in pairs)]


def _tables(summary: Json) -> str:
    head = ["mean cell error on held-out pushes [mm]", *(f"{n} push{'es' if n > 1 else ''}" for n in summary["pushes"])]
    rows = [_row(name, curve) for name, curve in summary["curves"].items()]
    if "gain" in summary:
        rows.append(_row("gain on the same object", summary["gain"]))
    return markdown_table(head, rows)


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (axes,) = new_figure(1, width=6.0, height=4.2)
    for (name, curve), colour in zip(summary["curves"].items(), (COLOURS["uniform"], COLOURS["gauss_newton"]), strict=False):
        bars = [1e3 * (error or 0.0) for error in curve["standard_error_m"]]
        axes.errorbar(summary["pushes"], 1e3 * np.array(curve["mean_m"]), bars, label=name, color=colour, marker="o", capsize=3)
    axes.set_xlabel("pushes learned from")
    axes.set_xticks(summary["pushes"])
    log_millimetres(axes, "mean cell error on held-out pushes [mm]", low=0.5, high=20.0)
    label_below(axes, 2)
    save(figure, folder / "next-push.png")
    return {"next-push.png": "Error on held-out pushes with every push after the first chosen, and random; bars are standard errors."}


STUDY = Experiment(
    name="next-push",
    place=60,
    title="Choosing the next push",
    question=(
        "Does it pay to choose pushes? The first push is random and the same for both policies. Every further one is either random or, "
        "among 100 safe candidates, the one with the smallest expected error of predictions of other pushes. The object is put back "
        "after each push."
    ),
    variants=(_RANDOM, _CHOSEN),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
)
