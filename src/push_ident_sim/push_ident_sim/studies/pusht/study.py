"""Push-T as gym-pusht has it: the block is identified from pushes in that game, then planned."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from push_ident.geometry.se2 import transform_points
from push_ident.planning.planner import GoalPlanner
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped
from push_ident_sim.studies.common.pushed import IDENTIFIED, UNIFORM
from push_ident_sim.studies.common.reaching import causes_in_words, failures, mean_of, share, share_in_words
from push_ident_sim.studies.pusht.game import BLOCK, GOAL, TICKS, Game
from push_ident_sim.studies.pusht.player import LAWS, SETTINGS, learn, nothing_known, play

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["STUDY"]

_FIRST_START: Final = 100_000
"""Seed of the first start in the game: those below are for tuning."""
_LEARNING: Final = 7
"""Second seed of the pushes that the block is identified from."""
_PICTURES: Final = 10


def _run(case: Case, settings: CaseSettings) -> Json:
    game = Game.new()
    try:
        known = learn(game, case.model * 1000 + _LEARNING) if case.variant == IDENTIFIED else nothing_known()
        planner = GoalPlanner(BLOCK, SETTINGS)
        first = _FIRST_START + case.model * settings.goals
        starts = [(seed, play(game, seed, known, planner)) for seed in range(first, first + settings.goals)]
    finally:
        game.close()
    return {
        "law": known.law,
        "errors_m": known.errors_m,
        "starts": [
            {
                "seed": seed,
                "won": own.is_won,
                "coverage": round(own.coverage, 4),
                "ticks": own.ticks,
                "pushes": own.pushes,
                "end": own.end,
                "poses": own.poses,
            }
            for seed, own in starts
        ],
    }


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_kind = grouped(results, "variant")
    main = by_kind.get(IDENTIFIED, results)
    starts = [run for r in main for run in r.values["starts"]]
    lost = sorted((run for run in starts if not run["won"]), key=lambda run: float(run["coverage"]))
    slow = sorted((run for run in starts if run["won"]), key=lambda run: -int(run["ticks"]))
    half = _PICTURES // 2
    return {
        "kinds": {kind: _row(own) for kind, own in by_kind.items()},
        "laws": {name: sum(r.values["law"] == name for r in main) for name in LAWS},
        "errors_m": {name: mean_of([r.values["errors_m"].get(name) for r in main], 6) for name in LAWS},
        "runs": (lost[:half] + slow)[:_PICTURES],
    }


def _row(results: Sequence[CaseResult]) -> Json:
    runs = [run for r in results for run in r.values["starts"]]
    won = [run for run in runs if run["won"]]
    return {
        "success": share(run["won"] for run in runs),
        "coverage": mean_of([run["coverage"] for run in runs]),
        "ticks": mean_of([run["ticks"] for run in won]),
        "pushes": mean_of([run["pushes"] for run in won]),
        "causes": failures((run["end"] for run in runs), "WON"),
        "seeds": [min(run["seed"] for run in runs), max(run["seed"] for run in runs)],
    }


def _tables(summary: Json) -> str:
    rows = [
        [
            kind,
            "{} to {}".format(*row["seeds"]),
            f"{100 * row['success']['share']:.1f} %, {share_in_words(row['success'])}",
            f"{row['coverage']:.3f}",
            *("" if row[key] is None else f"{row[key]:.{digits}f}" for key, digits in (("ticks", 0), ("pushes", 1))),
            causes_in_words(row["causes"]),
        ]
        for kind, row in summary["kinds"].items()
    ]
    head = ["", "seeds of the game", "won (95 % interval)", "best coverage", "actions", "pushes", "others ended by"]
    laws = [
        [name, "–" if error is None else f"{1e3 * error:.2f} mm", f"{summary['laws'][name]} times"]
        for name, error in summary["errors_m"].items()
    ]
    text = markdown_table(head, rows)
    return (
        text if not any(summary["laws"].values()) else text + "\n\n" + markdown_table(["law of friction", "held-out error", "chosen"], laws)
    )


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, panels = new_figure(5, 2, width=2.2, height=2.4)
    for ax in panels:
        ax.set_axis_off()
    for ax, run in zip(panels, summary["runs"], strict=False):
        _draw_run(ax, run)
    save(figure, folder / "pusht.png")
    text = "Starts of the identified model: lost ones first, then those that took longest. Filled: the goal; outlines after each push."
    return {"pusht.png": text}


def _draw_run(ax: Axes, run: Json) -> None:
    ax.fill(*transform_points(GOAL, BLOCK.outline).T, color="0.88")
    for k, pose in enumerate(run["poses"]):
        outline = transform_points(np.array(pose), BLOCK.outline)
        last = k == len(run["poses"]) - 1
        colour, width = (COLOURS["gauss_newton"], 1.5) if last else ("0.6", 0.7)
        ax.plot(*np.vstack([outline, outline[:1]]).T, color=colour, linewidth=width)
    ax.set_xlim(0.0, 0.512)
    ax.set_ylim(0.0, 0.512)
    ax.set_aspect("equal")
    ax.set_title(f"{run['seed']}: {run['pushes']} pushes, {run['ticks']} actions\n{100 * run['coverage']:.0f} %", fontsize=7)


STUDY = Experiment(
    name="pusht",
    place=69,
    title="Push-T",
    question=(
        "The game Push-T of gym-pusht, unchanged: its engine, its block, its observations of the state, its starts. A start is won "
        f"when the block covers 95 % of the goal within {TICKS} actions of 0.1 s; a diffusion policy that learned from people and sees "
        "images wins 63.8 % of 500 (model card of lerobot/diffusion_pusht; another input, so a reference and no win). The block is "
        "identified from twelve random pushes of other starts: its outline is known, its maps, the friction of the disc and the law "
        "of the table's friction are not. Two laws are fitted to eight of the pushes, dry friction and one that grows with speed; "
        "that which predicts the other four better is taken. Then pushes are planned as for any object and turned into actions, which "
        "lead the disc, whose controller is known, around the block and along straight lines. Where it has no way to a push, such as "
        "between block and wall, another contact is planned, until all were tried. Identified anew for each group of starts; uniform: "
        "nothing is known, dry friction."
    ),
    objects=("T",),
    variants=(IDENTIFIED, UNIFORM),
    fewer={UNIFORM: 4},
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    counts_goals=True,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
    headline=("kinds",),
)
