"""What a diagnosis is worth: objects are pushed to goals in a world with one effect, by models without it, with what was diagnosed, and
with the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.diagnosis_json import to_json
from push_ident.diagnosis.usable_effects import usable_effects
from push_ident.errors import InputError
from push_ident.physics.effects import EFFECTS
from push_ident.types import Float64Array, PushRecord
from push_ident_sim.injected import INJECTED, InjectedEffects
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped
from push_ident_sim.studies.common.plate import plate_in_bullet
from push_ident_sim.studies.common.pushed import IDENTIFIED, TRUTH, PushedObject
from push_ident_sim.studies.common.random_objects import random_object
from push_ident_sim.studies.common.reaching import share, share_in_words
from push_ident_sim.studies.goals.run import LEVELS, random_goal, reach

__all__ = ["STUDY", "won_back"]

_EFFECTS: Final = ("table_tilt", "table_anisotropy", "pusher_lag", "tool_offset")
_KINDS = UNDIAGNOSED, DIAGNOSED, TRUE = ("undiagnosed", "diagnosed", "truth")
_EXPLORING: Final = 6
"""Random pushes before the first goal, from which the effect is diagnosed."""
_LAST: Final = tuple(LEVELS)[-1]
_MEASURES: Final = {"pushes": "pushes", "error_m": "error of the expected ends"}
_RESAMPLED: Final = 2000
"""Bootstrap samples of the objects, for intervals of 95 %."""


def _run(case: Case, settings: CaseSettings) -> Json:
    rng = np.random.default_rng([case.model, 1])
    goals = [random_goal(rng) for _ in range(settings.goals)]
    thing, noise = plate_in_bullet(random_object(np.random.default_rng(case.model))), np.random.default_rng([case.model, 2])
    effects = _injected(case.object_name, np.random.default_rng([case.model, 3]))
    kind, names = (TRUTH if case.variant == TRUE else IDENTIFIED), (_found if case.variant == DIAGNOSED else None)
    pushed = PushedObject(thing, kind, noise, effects=effects, exploring=_EXPLORING, names_effects=names)
    try:
        outcomes = [reach(pushed, goal) for goal in goals]
    finally:
        pushed.close()
    return {
        "reached": [outcome.reached for outcome in outcomes],
        "pushes": [outcome.pushes[_LAST] for outcome in outcomes],
        "error_m": [round(error, 6) for outcome in outcomes for error in outcome.errors],
        "named": list(pushed.named),
        "injected": {name: list(values) for name, values in effects.as_dict().items()},
    }


def _injected(name: str, rng: np.random.Generator) -> InjectedEffects:
    """An effect in its typical size, in any direction of the table where it has one."""
    size, turn = INJECTED[name].parameters[0].typical, rng.uniform(-np.pi, np.pi)
    has_direction = len(INJECTED[name].parameters) == 2
    return InjectedEffects.of({name: [size * np.cos(turn), size * np.sin(turn)] if has_direction else size})


def _found(records: list[PushRecord]) -> tuple[str, ...]:
    """Names of the effects that a diagnosis finds and that join a model by its own rule, as in the nodes."""
    try:
        return tuple(effect.name for effect in usable_effects(to_json(diagnose(records))).effects)
    except InputError:
        return ()


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_effect = {name: grouped(own, "variant") for name, own in grouped(results, "object_name").items()}
    return {
        "effects": {name: {kind: _row(own) for kind, own in kinds.items()} for name, kinds in by_effect.items()},
        "named": {name: _named(name, kinds.get(DIAGNOSED, [])) for name, kinds in by_effect.items()},
        "won_back": {name: _shares(kinds) for name, kinds in by_effect.items() if set(kinds) == set(_KINDS)},
    }


def _row(results: Sequence[CaseResult]) -> Json:
    goals = [goal for r in results for goal in r.values["reached"]]
    return {
        "success": {level: share(goal[level] for goal in goals) for level in LEVELS},
        "pushes": round(float(np.mean(np.concatenate([r.values["pushes"] for r in results]))), 3),
        "error_m": round(float(np.mean(np.concatenate([r.values["error_m"] for r in results]))), 6),
    }


def _named(name: str, results: Sequence[CaseResult]) -> Json:
    """How often the diagnosis found the effect or one that no push can tell from it, and how often others."""
    right = {name, *EFFECTS[name].exact_twins}
    found = [set(r.values["named"]) for r in results]
    return {"cases": len(found), "right": sum(bool(own & right) for own in found), "others": sum(bool(own - right) for own in found)}


def _shares(kinds: dict[str, list[CaseResult]]) -> Json:
    """Of each measure, the share of the loss that the diagnosis wins back, over objects that all kinds of model pushed."""
    by_model = {kind: {r.case.model: r.values for r in own} for kind, own in kinds.items()}
    common = sorted(set.intersection(*(set(own) for own in by_model.values())))
    return {key: won_back(*(np.array([np.mean(by_model[kind][m][key]) for m in common]) for kind in _KINDS)) for key in _MEASURES}


def won_back(undiagnosed: Float64Array, diagnosed: Float64Array, truth: Float64Array) -> Json:
    """Share of what a model without the effect loses against the truth, which the diagnosed model does not lose.

    Args:
        undiagnosed: a measure of cost with each object, shape (n_objects,).
        diagnosed: the same with the effect that was found.
        truth: the same with the true model.

    Returns:
        `lost`, the mean difference of the first from the last; and `share` with its bootstrap interval (`low`, `high`) over the objects:
        None where nothing is lost, no interval where there is one object.
    """
    lost, won = undiagnosed - truth, undiagnosed - diagnosed
    drawn = np.random.default_rng(0).integers(0, len(lost), (_RESAMPLED, len(lost)))
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = won[drawn].mean(axis=1) / lost[drawn].mean(axis=1)
    found: Json = {"lost": round(float(lost.mean()), 6), "share": None, "low": None, "high": None}
    if lost.mean() > 0:
        low, high = np.quantile(np.where(lost[drawn].mean(axis=1) > 0, shares, np.inf), [0.025, 0.975])
        found["share"] = round(float(won.mean() / lost.mean()), 4)
        known = len(lost) > 1
        found |= {key: round(float(value), 4) if known and np.isfinite(value) else None for key, value in (("low", low), ("high", high))}
    return found


def _tables(summary: Json) -> str:
    head = ["", *(f"reached, {level.replace('_', ', ')}" for level in LEVELS), "pushes", "error of the expected ends"]
    rows = [
        [
            f"{name}, {kind}",
            *(share_in_words(row["success"][level]) for level in LEVELS),
            f"{row['pushes']:.2f}",
            f"{1e3 * row['error_m']:.2f} mm",
        ]
        for name, kinds in summary["effects"].items()
        for kind, row in kinds.items()
    ]
    won = [
        [
            name,
            "{right} of {cases}, others in {others}".format(**summary["named"][name]),
            *(_share_text(own[key], factor, unit) for key, factor, unit in (("pushes", 1.0, ""), ("error_m", 1e3, " mm"))),
        ]
        for name, own in summary["won_back"].items()
    ]
    titles = ["", "named rightly", *(f"{what}: lost, of it won back" for what in _MEASURES.values())]
    return markdown_table(head, rows) + "\n\n" + markdown_table(titles, won)


def _share_text(row: Json, factor: float, unit: str) -> str:
    text = f"{factor * row['lost']:.2f}{unit}"
    if row["share"] is None:
        return f"{text}, –"
    text += f", {100 * row['share']:.0f} %"
    if row["low"] is None and row["high"] is None:
        return text
    low, high = ("?" if row[key] is None else f"{100 * row[key]:.0f}" for key in ("low", "high"))
    return f"{text} ({low} to {high} %)"


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, panels = new_figure(2, width=4.6, height=3.6)
    scales = {"pushes": (1.0, "pushes a goal"), "error_m": (1e3, "error of the expected ends [mm]")}
    names, colours = list(summary["effects"]), ("uniform", "gauss_newton", "truth")
    for ax, (key, (factor, label)) in zip(panels, scales.items(), strict=True):
        for k, kind in enumerate(_KINDS):
            values = [factor * summary["effects"][name].get(kind, {}).get(key, np.nan) for name in names]
            ax.bar(np.arange(len(names)) + 0.27 * (k - 1), values, width=0.25, color=COLOURS[colours[k]], label=kind)
        ax.set_xticks(range(len(names)), [name.replace("_", "\n") for name in names], fontsize=8)
        ax.set_ylabel(label)
        label_below(ax, 3)
    save(figure, folder / "effects.png")
    text = "Pushes until the last tolerance is met, and errors of the expected ends of all pushes, by what the model knows of the effect."
    return {"effects.png": text}


STUDY = Experiment(
    name="effects",
    place=69,
    title="What a diagnosis is worth",
    question=(
        "Objects of random shape and uneven maps are pushed in Bullet from one random goal to the next, as in `goals`, in a world "
        "with one effect of typical size (a slope of 0.02 rad, friction that differs by 15 % along the grain, a lag of 20 ms, a tool "
        "that is 2 mm beside its place), in any direction of the table. Six random pushes come first. The undiagnosed model is "
        "identified from them and from up to four more without any effect. For the diagnosed one, a diagnosis of the six names "
        "effects; those that are certain enough by its own rule, as for the nodes, are then fitted with the maps and act in all that is "
        "planned. The true model knows maps and effect. At most "
        "20 pushes a goal, all tolerances together. Lost is what the undiagnosed model needs or errs more than the true one; in "
        "brackets the interval of 95 % from a bootstrap over the objects. After a lag the tool comes to rest where it was sent, so "
        "that ends of pushes lose nothing by it but what it does to the maps."
    ),
    objects=_EFFECTS,
    variants=_KINDS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    counts_goals=True,
    stages=("geometry", "physics", "identification", "pushing", "planning", "diagnosis"),
    headline=("won_back",),
)
