"""Push-T as gym-pusht has it: the block is identified from pushes in that game, then planned.

The game is unchanged, in metres: 1 mm for a pixel of the game. Chi et al., Diffusion Policy, RSS 2023; `gym-pusht` has its engine, block,
starts and gate: a start is won when 95 % of the goal is covered within 300 actions. An action is the place that a disc is led to by a
spring and a damper for 0.1 s. The engine forgets the velocity of the block in each of its steps, and knows no friction.

The disc follows an action u as its controller says, 100 (u - p) - 20 v, in steps of 10 ms; nothing holds it back. So position and velocity
after a tick are linear in those before it and in u. A line of given length and number of ticks is driven by the actions of least change,
sum of (u_k - u_{k-1})^2, with which it ends at rest at its end.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.outline import edge_normals, outline_of_cells, polygon_centroid, signed_distance
from push_ident.geometry.se2 import compose, transform_points, wrap_angle
from push_ident.identification.fitting.fit import FitOptions
from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.identification.results.posterior import prior_posterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.simulation import SimulationSettings
from push_ident.planning.belief import Belief
from push_ident.planning.goal import Goal
from push_ident.planning.library import Surroundings
from push_ident.planning.planner import GoalPlanner, PlanStatus
from push_ident.pushing.push import PushPlan2D, PushSettings
from push_ident.pushing.sampling import recentring_pushes, sample_push
from push_ident.types import CellGrid, Float64Array, ObjectShape, PoseTrack, PusherPath, PushRecord
from push_ident_sim.studies.common.measuring import failures, grouped, mean_of, share
from push_ident_sim.studies.common.pushed import IDENTIFIED, UNIFORM
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import causes_text, markdown_table, millimetres, number, share_text

_PIXEL: Final = 1e-3
"""[m]"""
_CELL: Final = 0.015
"""Edge of a cell of the block [m]."""
RADIUS: Final = 0.015
"""Of the disc [m]."""
TICK: Final = 0.1
"""Duration of an action [s]."""
TICKS: Final = 300
"""Actions of a start at most."""
_WALLS: Final = (0.007, 0.504)
"""Faces of the walls along both axes [m]."""
WORKSPACE: Final = (_WALLS[0] + RADIUS, _WALLS[1] - RADIUS) * 2
"""Of the middle of the disc (x_min, x_max, y_min, y_max) [m]."""


def _block() -> tuple[ObjectShape, Float64Array]:
    """The block, and the pose of its frame, which is at the centroid of the outline, in that of the game, which is at the top of the T."""
    bar = [(x, y) for x in np.arange(-3.5, 4.0) for y in (0.5, 1.5)]
    stem = [(x, y) for x in (-0.5, 0.5) for y in np.arange(2.5, 8.0)]
    centres = _CELL * np.array([*bar, *stem])
    middle = np.array(polygon_centroid(outline_of_cells(centres, _CELL)))
    shape = ObjectShape(CellGrid(centres - middle, _CELL), outline_of_cells(centres - middle, _CELL))
    return shape, np.append(middle, 0.0)


BLOCK, _FRAME = _block()
"""The T: a bar of 120 x 30 mm and a stem of 30 x 90 mm."""
GOAL: Float64Array = compose(np.array([0.256, 0.256, np.pi / 4]), _FRAME)
"""Pose of the block at the goal, shape (3,)."""


@dataclass(slots=True)
class Game:
    """One start after another, with poses of the block's frame and places of the disc in metres."""

    disc: Float64Array
    """Place of the disc [m], shape (2,)."""
    pose: Float64Array
    """Of the block, shape (3,)."""
    ticks: int
    """Actions since the start."""
    coverage: float
    """Share of the goal that is covered, at best since the start [1]."""
    is_won: bool
    _environment: Any

    @classmethod
    def new(cls) -> Game:
        """A game before its first start. Raises InputError where gym-pusht is not installed."""
        try:
            import gym_pusht  # noqa: F401 (registers the game)
            import gymnasium
        except ModuleNotFoundError as error:
            raise InputError(
                f"This needs the game, but {error.name} is not installed; run `pip install 'push_ident_sim[pusht]'`."
            ) from None
        environment = gymnasium.make("gym_pusht/PushT-v0", obs_type="state", max_episode_steps=TICKS)
        return cls(np.zeros(2), np.zeros(3), 0, 0.0, False, environment)

    def start(self, seed: int) -> None:
        """Begin a start of the game."""
        observation, _ = self._environment.reset(seed=seed)
        self.ticks, self.coverage, self.is_won = 0, 0.0, False
        self._read(observation)

    @property
    def is_over(self) -> bool:
        """Whether no action is left, or the start is won."""
        return self.is_won or self.ticks >= TICKS

    def act(self, target: Float64Array) -> None:
        """Lead the disc towards a place [m], shape (2,), for one tick; nothing where the start is over."""
        if self.is_over:
            return
        observation, _, _, _, info = self._environment.step((target / _PIXEL).astype(np.float32))
        self.ticks += 1
        self.coverage, self.is_won = max(self.coverage, float(info["coverage"])), bool(info["is_success"])
        self._read(observation)

    def _read(self, observation: Float64Array) -> None:
        self.disc = _PIXEL * np.array(observation[:2])
        pose = compose(np.append(_PIXEL * np.array(observation[2:4]), observation[4]), _FRAME)
        # The game gives the angle within one turn; poses of a push go on beyond it.
        self.pose = np.append(pose[:2], self.pose[2] + wrap_angle(pose[2] - self.pose[2]))

    def close(self) -> None:
        """Free the engine."""
        self._environment.close()


_STIFFNESS, _DAMPING, _STEP = 100.0, 20.0, 0.01
"""Of the controller [1/s^2, 1/s], and its time step [s]."""


def _tick() -> tuple[Float64Array, Float64Array]:
    """A and b of (p, v) after a tick = A (p, v) + b u."""
    one = np.array([[1.0, _STEP], [0.0, 1.0]]) @ np.array([[1.0, 0.0], [-_STIFFNESS * _STEP, 1.0 - _DAMPING * _STEP]])
    push = np.array([[1.0, _STEP], [0.0, 1.0]]) @ np.array([0.0, _STIFFNESS * _STEP])
    state, by_action = np.eye(2), np.zeros(2)
    for _ in range(round(TICK / _STEP)):
        state, by_action = one @ state, one @ by_action + push
    return state, by_action


@lru_cache
def _profile(n: int) -> Float64Array:
    """Actions of `n` ticks that move the disc by 1 from rest to rest, shape (n,)."""
    state, by_action = _tick()
    reach = np.array([np.linalg.matrix_power(state, n - 1 - k) @ by_action for k in range(n)]).T
    change = np.eye(n) - np.eye(n, k=-1)
    # At the end the last action is that of rest, too.
    weight = change.T @ change
    weight[-1, -1] += 1.0
    aim = np.zeros(n)
    aim[-1] = 1.0
    system = np.block([[weight, reach.T], [reach, np.zeros((2, 2))]])
    return np.asarray(np.linalg.solve(system, np.concatenate([aim, [1.0, 0.0]]))[:n])


def actions(start: Float64Array, end: Float64Array, speed: float) -> Float64Array:
    """Actions that lead a disc at rest along a line, to rest at its end, shape (n_ticks, 2) [m].

    `speed` is that of the mean, apart from two ticks to start and to stop [m/s].
    """
    n = int(np.ceil(float(np.linalg.norm(end - start)) / (speed * TICK))) + 2  # fewer than two more cannot end at rest
    return np.asarray(start + _profile(n)[:, None] * (end - start))


def way_around(outline: Float64Array, start: Float64Array, end: Float64Array) -> list[Float64Array] | None:
    """Corners of the shortest way of the disc from `start` to `end`, shape (2,), that does not touch the block; None where there is none.

    `outline` is that of the block, shape (n_vertices, 2). A disc that touches it leaves it first. The last corner is `end`.
    """
    gap = RADIUS + 0.004  # [m] more than the disc needs
    first = _away(outline, start, gap)
    corners = _corners(outline, gap)
    x_min, x_max, y_min, y_max = WORKSPACE
    inside = (corners[:, 0] >= x_min) & (corners[:, 0] <= x_max) & (corners[:, 1] >= y_min) & (corners[:, 1] <= y_max)
    nodes = np.vstack([first, end, corners[inside]])
    known, queue, best = {0: (0.0, -1)}, [(0.0, 0)], set[int]()
    while queue:
        cost, here = heapq.heappop(queue)
        if here in best:
            continue
        best.add(here)
        if here == 1:
            break
        for there in range(1, len(nodes)):
            length = cost + float(np.linalg.norm(nodes[there] - nodes[here]))
            if there not in best and length < known.get(there, (np.inf, -1))[0] and _is_clear(outline, nodes[here], nodes[there], gap):
                known[there] = length, here
                heapq.heappush(queue, (length, there))
    if 1 not in known:
        return None
    way, node = [], 1
    while node > 0:
        way.append(nodes[node])
        node = known[node][1]
    return ([first] if np.linalg.norm(first - start) > 1e-6 else []) + way[::-1]


def _away(outline: Float64Array, place: Float64Array, gap: float) -> Float64Array:
    """The nearest place with a gap to the block, within the workspace as far as possible."""
    place = place.copy()
    for _ in range(10):
        distance = float(signed_distance(place[None], outline)[0])
        if distance >= gap - 1e-6:
            break
        d = 1e-5
        slope = np.array([float(signed_distance((place + step)[None], outline)[0]) - distance for step in d * np.eye(2)]) / d
        place = place + (gap - distance) * slope / max(float(np.linalg.norm(slope)), 1e-9)
    x_min, x_max, y_min, y_max = WORKSPACE
    return np.clip(place, [x_min, y_min], [x_max, y_max])


def _corners(outline: Float64Array, gap: float) -> Float64Array:
    """Places beside each vertex with a gap to both of its edges, a little further out than the gap asks for."""
    normal = edge_normals(outline)
    before = np.roll(normal, 1, axis=0)
    middle = normal + before
    return np.asarray(outline + 1.02 * gap * middle / (1.0 + np.sum(normal * before, axis=1))[:, None])


def _is_clear(outline: Float64Array, start: Float64Array, end: Float64Array, gap: float) -> bool:
    """Whether the disc can drive along a line with the gap, or with that of its start where a wall leaves less there."""
    length = float(np.linalg.norm(end - start))
    places = start + np.linspace(0.0, 1.0, max(2, int(np.ceil(length / 0.004)) + 1))[:, None] * (end - start)
    distance = signed_distance(places, outline)
    return bool(np.all(distance >= min(gap, float(distance[0])) - 1e-4))


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


@dataclass(frozen=True, slots=True)
class Knowledge:
    """What a planner knows of the block."""

    belief: Belief
    law: str
    """One of `LAWS`."""
    errors_m: dict[str, float]
    """Mean cell error on held-out pushes by the law of friction [m]; empty where nothing was learned."""


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
        drive(game, actions(game.disc, corner, 0.4))  # [m/s], where the disc pushes nothing
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
    while len(records) < 12:
        _begin(game, int(rng.integers(2**31)))
        for _ in range(3):  # pushes of one start
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


def _begin(game: Game, seed: int) -> None:
    game.start(seed)
    drive(game, np.tile(game.disc, (2, 1)))  # bodies that were put into one another come apart


def play(game: Game, seed: int, known: Knowledge, planner: GoalPlanner) -> Json:
    """One start, until it is won or over; its `end`: WON, TIME where the actions were used up, or how planning ended."""
    _begin(game, seed)
    end, pushes, level, failed = "TIME", 0, 0, list[PushPlan2D]()
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
            end = "NO_WAY" if failed else goal_push.status.name
            break
        if push(game, plan) is None:
            failed.append(plan)
            continue
        failed.clear()
        pushes += 1
    end = "WON" if game.is_won else end
    return {"won": game.is_won, "coverage": round(game.coverage, 4), "ticks": game.ticks, "pushes": pushes, "end": end}


def _to_the_middle(game: Game, failed: Sequence[PushPlan2D]) -> PushPlan2D | None:
    """A push to the middle that did not fail yet; None where there is none."""
    around = Surroundings(failed=failed)
    return next((push for push in recentring_pushes(BLOCK, game.pose, SETTINGS) if not around.has_failed(push)), None)


def _run(case: Case, settings: CaseSettings) -> Json:
    game = Game.new()
    try:
        nothing = Knowledge(Belief.of(prior_posterior(BLOCK)), "dry", {})  # equal cells on a table with dry friction
        known = learn(game, case.model * 1000 + 7) if case.variant == IDENTIFIED else nothing
        planner = GoalPlanner(BLOCK, SETTINGS)
        first = 100_000 + case.model * settings.goals  # starts of the game below this seed are for tuning
        starts = [{"seed": seed} | play(game, seed, known, planner) for seed in range(first, first + settings.goals)]
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
        "0.1 s; a diffusion policy that sees images wins 63.8 % of 500 (model card of lerobot/diffusion_pusht; another input, so a "
        "reference and no win). Outline and pose are known; maps, friction of the "
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
