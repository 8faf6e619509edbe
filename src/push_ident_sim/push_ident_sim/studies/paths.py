"""How closely objects are pushed along paths, and how soon they are back after someone has displaced them.

They are pushed in Bullet as a goal of the cell would be: with the tool steered, or by straight pushes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Final

import numpy as np

from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.planning.curved_planner import CurvedPush
from push_ident.planning.path_follower import FollowStatus, PathFollower
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_planner import PathPlanner, PathPush, PathStatus
from push_ident.planning.path_steps import PathSteps, may_steer_after
from push_ident.types import Float64Array
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.studies.common.measuring import failures, grouped, mean_of, root_mean_square, share
from push_ident_sim.studies.common.objects import plate_in_bullet, random_object
from push_ident_sim.studies.common.pushed import IDENTIFIED, REST, TRUTH, PushedObject
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import causes_text, markdown_table, number, share_text

SPEED: Final = 0.05
"""Of the tool [m/s]."""
PATHS: Final = ("line", "ahead", "circle", "eight")
HALF_WIDTH: Final = 0.06
"""Of the corridor along a path [m]: the default of `goal_pushing_node`."""
_LINE, _RADIUS = 0.25, 0.08
"""Length of the lines, and radius of the circle and of both loops of the eight [m]."""
_MOST_CONTACTS: Final = 60
_ANGLES: Final = np.linspace(0.0, 2 * np.pi, 200)
_PERIOD: Final = 1.0 / 30.0
"""Of the camera [s]."""
_EVERY: Final = 4
"""Only every so many poses of the engine are measured."""
_ASIDE, _TURN = 0.040, 0.117
"""Of a displacement [m], [rad]."""


def named_path(name: str, speed: float = SPEED) -> PathGoal:
    """One of `PATHS`, at a speed [m/s]: the line with one heading beside it, all others with the heading along the path."""
    if name in ("line", "ahead"):
        yaw = 0.5 if name == "line" else 0.0
        return PathGoal(np.array([[-_LINE / 2, 0.0, yaw], [_LINE / 2, 0.0, yaw]]), speed)
    circle = np.column_stack([_RADIUS * np.sin(_ANGLES), _RADIUS * (1.0 - np.cos(_ANGLES)), _ANGLES])
    if name == "circle":
        return PathGoal(circle - [0.0, _RADIUS, 0.0], speed)
    # To the left around one loop, then to the right around the other: the heading is the same at the crossing.
    return PathGoal(np.vstack([circle, (circle * [1.0, -1.0, -1.0])[1:]]), speed)


@dataclass(slots=True)
class Displacement:
    """Someone displaces the object half-way, in a steered push or before a straight one."""

    at: float = np.inf
    """When, since the beginning, rests included [s]."""
    back: float = np.inf
    """When it was back on the path for the first time [s]."""
    pending: bool = True


@dataclass(slots=True)
class PathOutcome:
    """What became of one path."""

    name: str
    speed: float = SPEED
    """Along the path [m/s]."""
    end: str = ""
    """The status of planning, or MAX_CONTACTS."""
    contacts: int = 0
    time_s: float = 0.0
    """Of the pushes with their rests."""
    rms_m: float | None = None
    """Root mean square of the true distance from the path, over the length that was followed."""
    rms_rad: float | None = None
    followed: float = 0.0
    """Share of the path [1]."""
    correction_s: float | None = None
    """99 % quantile of the time of a correction by the wall clock; None where none was made."""
    back_s: float | None = None
    """Time from a displacement until the object was back."""


@dataclass(slots=True)
class _Run:
    pushed: PushedObject
    path: PathGoal
    outcome: PathOutcome
    displacement: Displacement | None = None
    done: float = 0.0
    """Length of the path that is behind the object [m]."""
    poses: list[Float64Array] = field(default_factory=list)
    """True ones, push by push."""
    corrections: list[float] = field(default_factory=list)
    """Time of each correction [s]."""


def follow_by_straight_pushes(pushed: PushedObject, planner: PathPlanner, name: str) -> Json:
    """Push an object, put at the start of a path, along it without corrections."""
    run = _Run(pushed, named_path(name), PathOutcome(name))
    pushed.pose = run.path.poses[0].copy()
    while True:
        plan = planner.plan(pushed.belief, pushed.observe()[0], run.path, run.done)
        run.done = plan.done
        if plan.plan is None or run.outcome.contacts >= _MOST_CONTACTS:
            break
        _end_contact(run, pushed.push(plan.plan))
    return _measured(run, plan.status.name if plan.plan is None else "MAX_CONTACTS")


def follow_steered(pushed: PushedObject, planner: PathSteps, name: str, speed: float, displacement: Displacement | None = None) -> Json:
    """Push an object, put at the start of a path, along it as a goal of the cell is pursued."""
    path = replace(named_path(name, speed), position=0.003, yaw=float(np.radians(2.0)))
    run, steers = _Run(pushed, path, PathOutcome(name, speed), displacement), True
    pushed.pose = path.poses[0].copy()
    while True:
        plan = planner.plan(pushed.belief, pushed.observe()[0], path, run.done, steers=steers)
        run.done = plan.done
        if plan.contact is None or run.outcome.contacts >= _MOST_CONTACTS:
            break
        if plan.straight is not None:
            _push_straight(run, plan.straight)
        else:
            assert plan.steered is not None and plan.follower is not None
            _push_steered(run, plan.steered, plan.follower(_PERIOD))
        steers = may_steer_after(plan, plan.done, run.done)
    return _measured(run, plan.status.name if plan.contact is None else "MAX_CONTACTS")


def _push_steered(run: _Run, plan: CurvedPush, follower: PathFollower) -> None:
    pushed, path, displacement = run.pushed, run.path, run.displacement
    assert plan.time is not None and plan.tool is not None
    pose, covariance = pushed.observe()
    follower.begin(plan.time, plan.tool, pose, covariance, run.done, plan.expected_error)
    pushed.touch(plan.tool[0])
    now = np.ceil(plan.time[1] / _PERIOD) * _PERIOD
    pushed.lead(plan.time, plan.tool, now)
    last = now + 4.0 * path.length / path.speed  # no contact takes longer
    while now < last:
        frame = pushed.frame()
        begun = time.perf_counter()
        correction = follower.correct(now, *frame)
        run.corrections.append(time.perf_counter() - begun)
        run.done = correction.done
        if correction.status is not FollowStatus.GOING:
            break
        now += _PERIOD
        pushed.lead(correction.time, correction.tool, now)
        is_due = displacement is not None and displacement.pending and run.done > 0.5 * path.length
        beside = _pose_beside(run, correction.tool[1]) if is_due else None
        if displacement is not None and beside is not None:
            displacement.pending, displacement.at = False, run.outcome.time_s + REST + now
            pushed.displace(beside)
        else:
            _note_return(run, now, pushed.pose)
    _end_contact(run, pushed.let_go())


def _push_straight(run: _Run, plan: PathPush) -> None:
    pushed, displacement = run.pushed, run.displacement
    assert plan.plan is not None
    if displacement is not None and displacement.pending and run.done > 0.5 * run.path.length:
        # Between two contacts: the tool is away.
        beside = _pose_beside(run, None)
        assert beside is not None, "no tool is in the way"
        displacement.pending, displacement.at = False, run.outcome.time_s
        pushed.pose = beside
        return
    motion = pushed.push(plan.plan)
    for now, pose in zip(motion.time[::_EVERY], motion.pose[::_EVERY], strict=True):
        _note_return(run, float(now), pose)
    _end_contact(run, motion)


def _end_contact(run: _Run, motion: TrueMotion) -> None:
    run.poses.append(motion.pose[::_EVERY])
    run.outcome.contacts += 1
    run.outcome.time_s += run.pushed.duration(motion)


def _note_return(run: _Run, now: float, pose: Float64Array) -> None:
    displacement = run.displacement
    if displacement is None or displacement.pending or np.isfinite(displacement.back):
        return
    _, error = run.path.error(pose, run.done, 0.1)
    if np.all(error < np.array([0.005, np.radians(4.0)])):  # [m, rad]
        displacement.back = run.outcome.time_s + REST + now


def _pose_beside(run: _Run, tool: Float64Array | None) -> Float64Array | None:
    """To the side of the path; None while the tool, if it is down, is in the way on both sides."""
    pushed, direction = run.pushed, float(run.path.direction(run.done))
    for side in (1.0, -1.0):
        along = direction + side * np.pi / 2
        pose = pushed.pose + np.array([_ASIDE * np.cos(along), _ASIDE * np.sin(along), side * _TURN])
        if tool is None:
            return pose
        gap = signed_distance(tool[None], transform_points(pose, pushed.truth.shape.outline))[0] - pushed.settings.pusher_radius
        if gap > 1e-3:
            return pose
    return None


def _measured(run: _Run, end: str) -> Json:
    """The outcome, with errors weighted by the length of path that they last."""
    outcome, places, errors = run.outcome, [0.0], []
    outcome.end = end
    if run.corrections:
        outcome.correction_s = float(np.quantile(run.corrections, 0.99))
    if run.displacement is not None and np.isfinite(run.displacement.back):
        outcome.back_s = run.displacement.back - run.displacement.at
    for pose in np.concatenate(run.poses) if run.poses else ():
        place, error = run.path.error(pose, places[-1], 0.02)  # [m] between two poses of the engine: many times what it does
        places.append(max(places[-1], float(place)))
        errors.append(error)
    moved = np.diff(places)
    if moved.sum() > 0:
        outcome.rms_m, outcome.rms_rad = (float(v) for v in np.sqrt(moved @ np.array(errors) ** 2 / moved.sum()))
    outcome.followed = places[-1] / run.path.length
    return {key: round(value, 5) if isinstance(value, float) else value for key, value in asdict(outcome).items()}


_STRAIGHT, _DISPLACED = "straight", "displaced"
"""By straight pushes that are not corrected; displaced half-way. Both know as much as identified."""
_SPEEDS: Final = (0.05, 0.1, 0.2)
"""Along the path, of displaced objects [m/s]."""
_DISPLACED_ON: Final = ("ahead", "circle")
_AIM: Final = 3.0
"""Time in which a displaced object should be back [s]."""


def _run(case: Case, settings: CaseSettings) -> Json:
    sim_object = plate_in_bullet(random_object(np.random.default_rng(case.model)))
    kind = TRUTH if case.variant == TRUTH else IDENTIFIED
    pushed = PushedObject(sim_object, kind, np.random.default_rng([case.model, 6 if case.variant == _DISPLACED else 5]))
    try:
        if case.variant == _STRAIGHT:
            straight = PathPlanner(pushed.truth.shape, pushed.settings, SPEED)
            return {"paths": [follow_by_straight_pushes(pushed, straight, name) for name in PATHS]}
        planner = PathSteps(pushed.truth.shape, pushed.settings, HALF_WIDTH)
        if case.variant == _DISPLACED:
            return {"paths": [follow_steered(pushed, planner, name, v, Displacement()) for name in _DISPLACED_ON for v in _SPEEDS]}
        return {"paths": [follow_steered(pushed, planner, name, SPEED) for name in PATHS]}
    finally:
        pushed.close()


def _summarise(results: Sequence[CaseResult]) -> Json:
    runs = {kind: [run for r in cases for run in r.values["paths"]] for kind, cases in grouped(results, "variant").items()}
    displaced = runs.pop(_DISPLACED, [])
    return {
        "kinds": {kind: {name: _row([run for run in own if run["name"] == name]) for name in PATHS} for kind, own in runs.items()},
        "displaced": {str(v): _back_row([run for run in displaced if run["speed"] == v]) for v in _SPEEDS} if displaced else {},
    }


def _row(runs: Sequence[Json]) -> Json:
    return {
        "followed": share(run["end"] == PathStatus.ARRIVED.name for run in runs),
        "causes": failures((run["end"] for run in runs), PathStatus.ARRIVED.name),
        # Over paths of one length: the root of the mean square.
        "rms_m": root_mean_square((run["rms_m"] for run in runs), 5),
        "rms_rad": root_mean_square((run["rms_rad"] for run in runs), 5),
        "contacts": mean_of(run["contacts"] for run in runs),
        "time_s": mean_of(run["time_s"] for run in runs),
        "correction_p99_s": max((run["correction_s"] for run in runs if run["correction_s"] is not None), default=None),
    }


def _back_row(runs: Sequence[Json]) -> Json:
    times = sorted(run["back_s"] for run in runs if run["back_s"] is not None)
    return {
        "in_time": share(run["back_s"] is not None and run["back_s"] <= _AIM for run in runs),
        "median_s": round(float(np.median(times)), 3) if times else None,
        "longest_s": times[-1] if times else None,
        "causes": failures((run["end"] for run in runs), PathStatus.ARRIVED.name),
    }


def _tables(summary: Json) -> str:
    kinds = summary["kinds"]
    rows = [[name, *(_path_text(paths[name]) for paths in kinds.values())] for name in PATHS]
    late = [row["correction_p99_s"] for paths in kinds.values() for row in paths.values() if row["correction_p99_s"] is not None]
    tables = [markdown_table(["path: followed to its end; RMS; contacts; time", *kinds], rows)]
    if late:
        tables.append(f"99 % of the corrections of a run were decided within {1e3 * max(late):.0f} ms by the wall clock.")
    if summary["displaced"]:
        rows = [
            [
                f"{1e3 * float(speed):.0f} mm/s",
                share_text(row["in_time"]),
                number(row["median_s"], "{:.1f} s"),
                number(row["longest_s"], "{:.1f} s"),
                causes_text(row["causes"]),
            ]
            for speed, row in summary["displaced"].items()
        ]
        head = ["displaced, speed", f"back within {_AIM:.0f} s (95 % interval)", "median", "longest", "failures after it"]
        tables.append(markdown_table(head, rows))
    return "\n\n".join(tables)


def _path_text(row: Json) -> str:
    """Such as `4/4; 2.5 mm, 1.6°; 9.8; 18 s`, with the ends of runs that failed."""
    rms = number(row["rms_m"], "{:.1f} mm", 1e3) + ", " + number(row["rms_rad"], "{:.1f}°", float(np.degrees(1.0)))
    followed = f"{row['followed']['successes']}/{row['followed']['n']}" + "".join(f", {n} {end}" for end, n in row["causes"].items())
    return "; ".join([followed, rms, number(row["contacts"], "{:.1f}"), number(row["time_s"], "{:.0f} s")])


def _answer(summary: Json) -> str:
    answers = []
    if row := summary["kinds"].get(IDENTIFIED):
        errors = [path["rms_m"] for path in row.values() if path["rms_m"] is not None]
        answers.append(f"Identified: RMS {1e3 * min(errors):.1f} to {1e3 * max(errors):.1f} mm from the path")
    if rows := summary["displaced"].values():
        back, n = (sum(row["in_time"][key] for row in rows) for key in ("successes", "n"))
        answers.append(f"displaced by 40 mm, back within {_AIM:.0f} s in {back} of {n} runs")
    return "; ".join(answers) + "."


STUDY = Experiment(
    name="paths",
    title="How closely are objects pushed along paths?",
    question=(
        "Objects as in `goals` are pushed along a line of 25 cm with a heading of 0.5 rad to it, the same line with the heading "
        "along it (ahead), a circle of 8 cm radius and an eight of two such circles, at "
        f"{1e3 * SPEED:.0f} mm/s. Where a contact can hold the object on the path, the tool is steered at each of 30 frames a "
        "second; else a straight push is made. Frames have the noise of the camera and an error that lasts as long as the "
        "contact. RMS: of the true pose from the nearest point of the path. Knowledge as in `goals`; straight: as identified, by "
        "straight pushes alone; displaced: half-way, by 40 mm to the side and 0.117 rad, and back within 5 mm and 4 degrees."
    ),
    objects=("uneven",),
    variants=(IDENTIFIED, TRUTH, _STRAIGHT, _DISPLACED),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    stages=("geometry", "physics", "identification", "pushing", "planning"),
)
