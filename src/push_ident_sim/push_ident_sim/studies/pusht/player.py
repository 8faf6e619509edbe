"""What is known of the block, from pushes in the game, and starts that are played with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np

from push_ident.errors import PlanningError
from push_ident.geometry.se2 import transform_points
from push_ident.identification.fitting.fit import FitOptions
from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.results.posterior import prior_posterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.simulation import SimulationSettings
from push_ident.planning.belief import Belief
from push_ident.planning.feasible import Surroundings
from push_ident.planning.goal import Goal
from push_ident.planning.planner import GoalPlanner, PlanStatus
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.pushing.sampling import recentring_pushes, sample_push
from push_ident.types import Float64Array, PoseTrack, PusherPath, PushRecord
from push_ident_sim.studies.common.study import Json
from push_ident_sim.studies.pusht.disc import actions, way_around
from push_ident_sim.studies.pusht.game import BLOCK, GOAL, RADIUS, TICK, WORKSPACE, Game

__all__ = ["LAWS", "SETTINGS", "Knowledge", "Played", "learn", "nothing_known", "play", "record_of"]

SETTINGS: Final = PushSettings(
    workspace=WORKSPACE,
    pusher_radius=RADIUS,
    clearance=0.012,
    lowering_gap=0.005,
    distance_range=(0.03, 0.08),
    speed_range=(0.15, 0.15),
    cone=float(np.radians(40.0)),
    edge_margin=0.02,
)
_WAY_SPEED: Final = 0.4
"""Of the disc where it pushes nothing [m/s]."""
_LEARNED: Final = 12
"""Pushes from which the block is identified."""
_A_START: Final = 3
"""Of them, pushes of one start."""
_HELD_OUT: Final = 4
"""Of them, pushes that judge the laws of friction before all of them count."""
LAWS: Final = {"dry": SimulationSettings(), "viscous": SimulationSettings(quasi_static=True, smoothing_speed=1.0)}
"""Laws of the table's friction: one that does not depend on speed; and one that grows with it, as below a smoothing speed far above those
of the block, without inertia."""
_PRIOR: Final = Prior(pusher_friction=0.1, pusher_friction_std=1.5)
"""The friction of the disc may be anything."""
_EXACT: Final = np.array([3e-4, 3e-4, 3e-3])
"""Standard deviations of a pose [m, m, rad]: the game states it exactly, and lets bodies overlap by some tenths of a millimetre."""
_TOLERANCES: Final = ((0.0025, 0.03), (0.0015, 0.02), (0.0008, 0.012))
"""Of position [m] and yaw [rad], one after the other until the game is won: 2.6 mm or 3.6 degrees alone leave 5 % of the goal bare."""
_AT_START: Final = 2
"""Ticks that the disc waits at a start: bodies that were put into one another come apart."""


@dataclass(frozen=True, slots=True)
class Knowledge:
    """What a planner knows of the block."""

    belief: Belief
    law: str
    """One of `LAWS`."""
    errors_m: dict[str, float]
    """Mean cell error on held-out pushes by the law of friction [m]; empty where nothing was learned."""


@dataclass(slots=True)
class Played:
    """What became of a start."""

    won: bool = False
    coverage: float = 0.0
    """At best [1]."""
    ticks: int = 0
    pushes: int = 0
    end: str = "TIME"
    """WON; TIME where the actions were used up; else how planning ended."""

    def values(self) -> Json:
        """For JSON."""
        return asdict(self) | {"coverage": round(self.coverage, 4)}


def drive(game: Game, targets: Float64Array) -> list[tuple[Float64Array, Float64Array]]:
    """Act, and give the place of the disc and the pose of the block after each tick."""
    states = []
    for target in targets:
        game.act(target)
        states.append((game.disc, game.pose))
    return states


def push(game: Game, plan: PushPlan2D) -> PushRecord | None:
    """Go around the block and push it; None where there is no way."""
    begin = plan.tool_start(SETTINGS.clearance)
    way = way_around(transform_points(game.pose, BLOCK.outline), game.disc, begin)
    if way is None:
        return None
    for corner in way:
        drive(game, actions(game.disc, corner, _WAY_SPEED))
    before = [(game.disc, game.pose)]
    return record_of(before + drive(game, actions(game.disc, plan.tool_end, plan.speed)))


def record_of(states: Sequence[tuple[Float64Array, Float64Array]]) -> PushRecord:
    """Places of the disc and poses of the block, tick by tick, as a push; both are at rest at the start and at the end."""
    at_rest = [states[0], *states, states[-1]]
    time = np.linspace(0.0, TICK * (len(at_rest) - 1), len(at_rest))
    poses = np.array([pose for _, pose in at_rest])
    track = PoseTrack(time, poses, np.broadcast_to(np.diag(_EXACT**2), (len(time), 3, 3)))
    return PushRecord("o1", BLOCK, track, PusherPath(time, np.array([disc for disc, _ in at_rest]), RADIUS))


def learn(game: Game, seed: int) -> Knowledge:
    """Identify the block from random pushes of several starts, under the law of friction that predicts held-out pushes best."""
    rng, records = np.random.default_rng(seed), list[PushRecord]()
    while len(records) < _LEARNED:
        _begin(game, int(rng.integers(2**31)))
        for _ in range(_A_START):
            try:
                record = push(game, sample_push(BLOCK, game.pose, rng, SETTINGS))
            except PlanningError:
                break
            if record is None or game.is_over:
                break
            records.append(record)
    errors = {name: float(np.mean(_errors(records, law))) for name, law in LAWS.items()}
    best = min(errors, key=errors.__getitem__)
    result = identify(records, _PRIOR, options=FitOptions(numerics=LAWS[best]))
    return Knowledge(Belief.of(result.posterior, LAWS[best]), best, errors)


def _errors(records: Sequence[PushRecord], law: SimulationSettings) -> Float64Array:
    fit = identify(records[:-_HELD_OUT], _PRIOR, options=FitOptions(numerics=law))
    return held_out_errors(fit.model, records[-_HELD_OUT:], settings=law)


def nothing_known() -> Knowledge:
    """Equal cells on a table with dry friction."""
    return Knowledge(Belief.of(prior_posterior(BLOCK)), "dry", {})


def _begin(game: Game, seed: int) -> None:
    game.start(seed)
    drive(game, np.tile(game.disc, (_AT_START, 1)))


def play(game: Game, seed: int, known: Knowledge, planner: GoalPlanner) -> Played:
    """One start, until it is won or over."""
    _begin(game, seed)
    played, level, failed = Played(), 0, list[PushPlan2D]()
    while not game.is_over:
        goal_push = planner.plan(known.belief, game.pose, np.diag(_EXACT**2) * 0.1, Goal(GOAL, *_TOLERANCES[level]), failed=failed)
        plan = goal_push.plan
        if goal_push.status is PlanStatus.ARRIVED and level + 1 < len(_TOLERANCES):
            level += 1
            continue
        if plan is None:
            # Where no push leads on, one to the middle may: an object in a corner has few places to be pushed at.
            plan = _to_the_middle(game, failed)
        if plan is None:
            # The disc has no way to any contact that is left.
            played.end = "NO_WAY" if failed else goal_push.status.name
            break
        if push(game, plan) is None:
            failed.append(plan)
            continue
        failed.clear()
        played.pushes += 1
    played.won, played.coverage, played.ticks = game.is_won, game.coverage, game.ticks
    if game.is_won:
        played.end = "WON"
    return played


def _to_the_middle(game: Game, failed: Sequence[PushPlan2D]) -> PushPlan2D | None:
    """A push to the middle that did not fail yet; None where there is none."""
    around = Surroundings(failed=failed)
    return next((push for push in recentring_pushes(BLOCK, game.pose, SETTINGS) if not around.has_failed(push)), None)
