"""Push-T as gym-pusht has it: the block is identified from pushes in that game, then planned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from push_ident.planning.planner import GoalPlanner
from push_ident_sim.studies.common.measuring import failures, grouped, mean_of, share
from push_ident_sim.studies.common.pushed import IDENTIFIED, UNIFORM
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import causes_text, markdown_table, millimetres, number, share_text
from push_ident_sim.studies.pusht.game import BLOCK, TICKS, Game
from push_ident_sim.studies.pusht.player import LAWS, SETTINGS, learn, nothing_known, play

__all__ = ["STUDY"]

_FIRST_START: Final = 100_000
"""Seed of the first start in the game: those below are for tuning."""
_LEARNING: Final = 7
"""Second seed of the pushes that the block is identified from."""


def _run(case: Case, settings: CaseSettings) -> Json:
    game = Game.new()
    try:
        known = learn(game, case.model * 1000 + _LEARNING) if case.variant == IDENTIFIED else nothing_known()
        planner = GoalPlanner(BLOCK, SETTINGS)
        first = _FIRST_START + case.model * settings.goals
        starts = [{"seed": seed} | play(game, seed, known, planner).values() for seed in range(first, first + settings.goals)]
    finally:
        game.close()
    return {"law": known.law, "errors_m": known.errors_m, "starts": starts}


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_kind = grouped(results, "variant")
    main = by_kind.get(IDENTIFIED, results)
    return {
        "kinds": {kind: _row([run for r in cases for run in r.values["starts"]]) for kind, cases in by_kind.items()},
        "laws": {name: sum(r.values["law"] == name for r in main) for name in LAWS},
        "errors_m": {name: mean_of((r.values["errors_m"].get(name) for r in main), 6) for name in LAWS},
    }


def _row(runs: Sequence[Json]) -> Json:
    won = [run for run in runs if run["won"]]
    return {
        "success": share(run["won"] for run in runs),
        "coverage": mean_of(run["coverage"] for run in runs),
        "ticks": mean_of(run["ticks"] for run in won),
        "pushes": mean_of(run["pushes"] for run in won),
        "causes": failures((run["end"] for run in runs), "WON"),
        "seeds": [min(run["seed"] for run in runs), max(run["seed"] for run in runs)],
    }


def _tables(summary: Json) -> str:
    rows = [
        [
            kind,
            "{} to {}".format(*row["seeds"]),
            share_text(row["success"]),
            f"{row['coverage']:.3f}",
            number(row["ticks"], "{:.0f}"),
            number(row["pushes"], "{:.1f}"),
            causes_text(row["causes"]),
        ]
        for kind, row in summary["kinds"].items()
    ]
    head = ["what is known", "seeds of the game", "won (95 % interval)", "best coverage", "actions", "pushes", "others ended by"]
    laws = ", ".join(
        f"{name} {millimetres(error)} mm ({summary['laws'][name]} times chosen)" for name, error in summary["errors_m"].items()
    )
    return markdown_table(head, rows) + (
        f"\n\nError on held-out pushes by the law of friction: {laws}." if any(summary["laws"].values()) else ""
    )


def _answer(summary: Json) -> str:
    row = summary["kinds"].get(IDENTIFIED) or next(iter(summary["kinds"].values()))
    return f"Identified: {row['success']['successes']} of {row['success']['n']} starts won, in {number(row['pushes'], '{:.1f}')} pushes."


STUDY = Experiment(
    name="pusht",
    title="Does it play Push-T?",
    question=(
        f"The game Push-T of gym-pusht, unchanged. A start is won when the block covers 95 % of the goal within {TICKS} actions of "
        "0.1 s; a diffusion policy that learned from people and sees images wins 63.8 % of 500 (model card of "
        "lerobot/diffusion_pusht; another input, so a reference and no win). Outline and pose are known; maps, friction of the "
        "disc and law of the table's friction are identified from twelve random pushes of other starts. The law is that which "
        "predicts held-out pushes better. uniform: nothing is known, dry friction. The game: `pip install --no-deps -r "
        "requirements/pusht.txt`."
    ),
    objects=("T",),
    variants=(IDENTIFIED, UNIFORM),
    most_models={UNIFORM: 4},
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    counts_goals=True,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
    headline=("kinds",),
)
