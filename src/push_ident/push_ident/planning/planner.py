"""The next push towards a goal.

A library of pushes (`library.py`) holds the motion of the object by each stroke of each length, for the mean model and for models of the
posterior. The value of a push is the expected number of pushes from it on:

    J(a) = 1 + mean over models of (1 - s) (1 + (1 - p) r)        s: whether the object is at the goal after a under that model
                                                                  p: chance that the best push from there ends at the goal
                                                                  r: pushes after that one, from the distance that it leaves

All strokes and lengths are judged by the mean model, the best by all models, and the best of these in the table frame, without those that
leave the workspace or touch something else first. A tool with two contacts may also carry the object to the goal (`carrying.py`); that
is judged as the others are. Contact, direction and length of a push that may be the last one are then improved
by the exact derivative, and its expectation is taken over more models and the uncertainty of the pose.

r may promise too much where things stand around the object: then every push that leads out seems worse than one that hardly moves it. So
J of the push that was chosen is remembered, and r is no less at poses within the tolerances of that one (real-time heuristic search, LRTA*:
Korf, Artificial Intelligence 42, 1990): an object that comes back to where it was is pushed another way.

Diagnosed effects are part of the models. Where they make a motion depend on the place, the library is made anew where the object
lies.

At an edge of the table these last simulations know which cells have left it. A push whose chance p_f to bring the
centre of mass nearer to the border of its support than the margin is more than `EdgeHold.limit` is not proposed, unless the object is no
less at risk at its present pose; below that it costs p_f times `PlannerOptions.fall_cost` pushes. Models under which the object would have
fallen there are left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import islice
from typing import Final

import numpy as np
from scipy.spatial import KDTree
from scipy.special import ndtr

from push_ident.errors import PlanningError
from push_ident.geometry.distance_field import RESOLUTION
from push_ident.geometry.se2 import compose, inverse, rotation, transform_points, wrap_angle
from push_ident.physics.batch import BatchModel, BatchPush
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings
from push_ident.planning.belief import Belief
from push_ident.planning.carrying import carrying_pushes, carrying_turns
from push_ident.planning.edge_goal import held_target
from push_ident.planning.goal import CERTAIN, EdgeHold, Goal
from push_ident.planning.keep_out import KeepOut, WayRound
from push_ident.planning.library import Library, Strokes, Surroundings, is_possible, moved, path_of, placed, simulated, strokes
from push_ident.planning.obstacle import DEVIATIONS, RISK
from push_ident.planning.stable import StableTurns
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.pushing.tool_path import ToolPath
from push_ident.types import BoolArray, Float64Array, ObjectShape, PusherPath, SolveStatus


@dataclass(frozen=True, slots=True)
class PlannerOptions:
    """Size of the search, and the costs of `GoalPlanner`."""

    screened: int = 400
    """Pushes that are best under the mean model, and are then judged by all models of the library."""
    judged: int = 12
    """Feasible ones of these that are judged in the table frame."""
    n_models: int = 8
    """Models in the library beside the mean."""
    finalists: int = 6
    """Candidates that are judged by the final models; the first `n_models` of these choose them."""
    n_final_models: int = 32
    """Models that the expectation of a push is taken from."""
    neighbours: int = 4
    """Second pushes that are compared for each first one."""
    push_travel: float = 0.1
    """Distance that a further push is expected to cover [m]."""
    near: float = 5.0
    """Error up to which a push may be the last one and is refined [tolerances]: the spacing of the strokes is that coarse."""
    fall_cost: float = 20.0
    """Pushes that a fall counts as: as many as are made for a goal at most."""
    frames: int = 8
    """Poses along a push at which the margin of an overhanging object is computed, and its distance from obstacles."""
    frame_travel: float = 0.02
    """Travel between two of them in a push that carries the object [m]: as in the longest straight one."""
    surer: tuple[float, ...] = (1.0, 0.1, 0.01, 1e-4)
    """Largest chances of a touch, by the library, of the pushes that are judged, one after another until one is found that touches nothing
    [`RISK`]."""


_OPTIONS: Final = PlannerOptions()


class PlanStatus(Enum):
    """How planning ended."""

    PUSH = "a push is proposed"
    ARRIVED = "the object is at the goal"
    UNSURE = "the pose is not known well enough for the tolerance: observe longer, or allow more"
    UNHELD = (
        "with what is known, each push might bring the centre of mass too near to the border of its support: push the object a few times "
        "more on the table, or allow less overhang"
    )
    BLOCKED = "no way leads to the goal between the things that must not be touched: move them away, or choose another goal"
    UNTOUCHED = (
        "each push might bring object or tool onto something that must not be touched: move it away, or push the object a few times more, "
        "so that it is known better"
    )
    UNREACHABLE = "no push within the workspace brings the object nearer: move it to the middle, or choose a nearer goal"


@dataclass(frozen=True, slots=True)
class GoalPush:
    """The next push, or why there is none."""

    status: PlanStatus
    chance: float
    """Of being at the goal: now where the object has arrived, after the push where one is proposed [1]."""
    plan: PushPlan2D | None = None
    end: Float64Array = field(default_factory=lambda: np.full(3, np.nan))
    """Expected pose after the push, shape (3,), table frame."""
    ends: Float64Array = field(default_factory=lambda: np.empty((0, 3)))
    """Poses after it under models that may be true, shape (n_models, 3), table frame."""
    risk: float = 0.0
    """Chance that the object is not held by the margin during the push [1]; 0 away from edges."""
    touch: float = 0.0
    """Chance that it enters the outline of an obstacle during the push [1]; 0 without any."""
    pushes: float = float("inf")
    """That are expected from this one on."""
    path: ToolPath | None = None
    """Of a tool with two contacts that carries the object, of which `plan` is the beginning, table frame; None: the push is straight."""


class GoalPlanner:
    """Plans pushes of one object; simulations are kept until the belief changes. `settings`: limits of pushes and the pusher."""

    def __init__(self, shape: ObjectShape, settings: PushSettings) -> None:
        self._shape, self._settings = shape, settings
        self._strokes = strokes(shape, settings)
        self._belief: Belief | None = None
        self._library: Library | None = None
        self._turns: list[StableTurns] | None = None
        self._judges: list[BatchModel] = []
        self._towards: Float64Array | None = None
        self._passed: list[tuple[Float64Array, float]] = []
        """Poses from which pushes to the goal `_towards` were planned, table frame of the arm, and the J of each push [1]."""

    def _library_of(self, belief: Belief, pose: Float64Array) -> Library:
        if belief is not self._belief:
            self._belief, self._library, self._turns = belief, None, None
            self._judges = belief.models(_OPTIONS.n_final_models, np.random.default_rng(1))
        if self._library is None or not self._library.holds_at(belief, pose):
            self._library = Library.of(belief, self._strokes, self._settings, pose, _OPTIONS.n_models, np.random.default_rng(0))
        return self._library

    def plan(
        self,
        belief: Belief,
        pose: Float64Array,
        covariance: Float64Array,
        goal: Goal,
        obstacles: Sequence[Float64Array] = (),
        failed: Sequence[PushPlan2D] = (),
        hold: EdgeHold | None = None,
    ) -> GoalPush:
        """The next push of an object at a pose in the table frame, shape (3,), of a covariance, shape (3, 3).

        `obstacles`: outlines that must not be touched, with their clearance, table frame [m], each of shape (n_vertices, 2); `failed`:
        pushes from this pose that did not move the object, or could not be made; `hold`: an edge of the table near the goal, and by how
        much the object must be held there.
        """
        hold_in_arm = None if hold is None else hold.in_frame(belief.camera)
        in_arm = _in_arm_frame(belief.camera, pose, covariance, goal)
        outlines = [transform_points(inverse(belief.camera), outline) for outline in obstacles]
        push = self._plan(belief, *in_arm, Surroundings(outlines, failed, hold_in_arm))
        if push.plan is None:
            return push
        return replace(push, end=compose(belief.camera, push.end), ends=compose(belief.camera, push.ends))

    def random_push(
        self, belief: Belief, pose: Float64Array, covariance: Float64Array, obstacles: Sequence[Float64Array], seed: int
    ) -> PushPlan2D:
        """A random push by which neither tool nor object touches an obstacle, with the lengths of random pushes; arguments as of `plan`.

        Raises:
            PlanningError: UNREACHABLE where there is none.
        """
        in_arm, covariance, goal = _in_arm_frame(belief.camera, pose, covariance, Goal(pose))
        around = Surroundings([transform_points(inverse(belief.camera), outline) for outline in obstacles])
        library = self._library_of(belief, in_arm)
        keep_out = KeepOut(self._shape, around.obstacles, self._settings) if obstacles else None
        task = _Task(belief, in_arm, covariance, goal, goal, around, keep_out, _FurtherPushes(library, goal, None, ()))
        low, high = self._settings.distance_range
        usable = (self._touch_of_strokes(library, task) <= RISK) & (library.lengths >= low) & (library.lengths <= high)
        models = self._displaced_judges(in_arm, covariance)
        for index in np.random.default_rng(seed).permutation(np.flatnonzero(usable))[: _OPTIONS.screened]:
            number, k = divmod(int(index), len(library.lengths))
            plan = placed(library.strokes, number, in_arm, float(library.lengths[k]), self._settings.speed_range[0])
            if not is_possible(self._shape, self._settings, plan, in_arm, library.motion[0, number, k], around):
                continue
            if task.touch(self._poses(task, models, [(library.strokes.picked(number), plan.distance)]))[0] <= RISK:
                return plan
        raise PlanningError(
            PushCode.UNREACHABLE, "no random push keeps object and tool clear of what must not be touched; make room for it."
        )

    def _plan(self, belief: Belief, pose: Float64Array, covariance: Float64Array, goal: Goal, around: Surroundings) -> GoalPush:
        """As `plan`, all of it in the table frame of the arm."""
        chance = goal.chance(pose, covariance)
        if chance >= CERTAIN and (around.hold is None or held_target(goal, around.hold, belief).is_reached(pose, covariance)):
            return GoalPush(PlanStatus.ARRIVED, chance)
        if goal.chance(goal.pose, covariance) < CERTAIN:
            return GoalPush(PlanStatus.UNSURE, chance)
        if len(self._strokes) == 0:
            return GoalPush(PlanStatus.UNREACHABLE, chance)
        library = self._library_of(belief, pose)
        keep_out = KeepOut(self._shape, around.obstacles, self._settings) if around.obstacles else None
        way = None
        if keep_out is not None:
            room = _room_of(library, goal, _OPTIONS.push_travel)
            way = WayRound.to(goal, keep_out, self._shape, self._settings, room)
            if way is None or not np.isfinite(way.extra(pose)):
                return GoalPush(PlanStatus.BLOCKED, chance)
        wanted = Goal(compose(inverse(pose), goal.pose), goal.position, goal.yaw)
        if self._towards is None or not np.array_equal(goal.pose, self._towards):
            self._towards, self._passed = goal.pose, []
        further = _FurtherPushes(library, goal, way, self._passed)
        task = _Task(belief, pose, covariance, goal, wanted, around, keep_out, further)
        answer = GoalPush(PlanStatus.UNREACHABLE, chance)
        for candidates in self._candidates(library, task):
            answer = self._best(task, candidates)
            if answer.plan is not None or keep_out is None:
                break
        carrying = self._carrying(task) if self._settings.span and around.hold is None else None
        chosen = answer if carrying is None or carrying.pushes > answer.pushes else carrying
        if chosen.plan is not None:
            self._passed.append((pose, chosen.pushes))
        return chosen

    def _carrying(self, task: _Task) -> GoalPush | None:
        """A push with both ends of the tool that carries the object to the goal, by more models and with the uncertainty of the pose; the
        shortest that touches nothing, None without one."""
        if self._turns is None:
            self._turns = carrying_turns(self._shape, self._judges, self._settings)
        models, goal = self._displaced_judges(task.pose, task.covariance), task.goal
        possible = carrying_pushes(self._shape, self._turns, self._settings, task.pose, goal.pose, task.around)
        for push in islice(possible, _OPTIONS.judged):
            tool, path = self._settings.tool, push.path
            driven = PusherPath(path.time, path.position, tool.radius, tool.polygon, path.yaw, tool.fingers)
            frames = np.linspace(float(path.time[1]), float(path.time[-1]), 1 + math.ceil(push.length / _OPTIONS.frame_travel))[1:]
            poses = simulated(task.belief, models, [BatchPush(driven, task.pose, frames)])
            before = compose(task.pose, np.array([model.displacement for model in models]))[:, None, None]
            touch = float(task.touch(np.concatenate([before, poses], axis=2))[0])
            ends = poses[:, :, -1]
            value = float(_value(task.further, ends, goal, ends)[0])
            if touch <= RISK and np.isfinite(value):
                chance = float(np.mean(np.asarray(goal.relative_error(ends[:, 0])) <= 1.0))
                return GoalPush(PlanStatus.PUSH, chance, push.plan, ends[0, 0], ends[:, 0], touch=touch, pushes=value, path=push.path)
        return None

    def _candidates(self, library: Library, task: _Task) -> Iterator[list[_Candidate]]:
        """The best feasible pushes, and what refinement makes of them; then those among ever surer ones. At least one each time."""
        touch = self._touch_of_strokes(library, task)
        for limit in _OPTIONS.surer if task.keep_out is not None else (1.0,):
            if candidates := self._best_feasible(library, task, touch <= limit * RISK):
                yield candidates

    def _best_feasible(self, library: Library, task: _Task, clear: BoolArray) -> list[_Candidate]:
        pose, around, strokes_of = task.pose, task.around, library.strokes
        risks = _EdgeRisk(around.hold, self._shape, library.centres, pose)
        beside = replace(around, obstacles=())  # tool and object have been compared with them
        candidates: list[_Candidate] = []
        motions: list[Float64Array] = []
        for number, k in _ranked(library, task, clear):
            plan = placed(strokes_of, number, pose, float(library.lengths[k]), self._settings.speed_range[0])
            motion = library.motion[0, number, k]
            every = library.motion[:, number, k]
            if is_possible(self._shape, self._settings, plan, pose, motion, beside) and risks.allows(every, around.n_poses):
                candidates.append((strokes_of, number, float(library.lengths[k])))
                motions.append(motion)
            if len(candidates) == _OPTIONS.judged:
                break
        return self._with_refined(task, candidates, motions)

    def _with_refined(self, task: _Task, candidates: list[_Candidate], motions: list[Float64Array]) -> list[_Candidate]:
        """Candidates, and those that may be the last push once more with its end at the goal."""
        added: list[_Candidate] = []
        for (group, number, length), motion in zip(candidates, motions, strict=True):
            if task.wanted.relative_error(motion) > _OPTIONS.near:
                continue
            better = refine(task.belief, group.picked(number), length, task.wanted, self._settings, task.pose)
            if better is not None:
                plan = placed(better.stroke, 0, task.pose, better.length, self._settings.speed_range[0])
                if is_possible(self._shape, self._settings, plan, task.pose, better.motion, task.around):
                    added.append((better.stroke, 0, better.length))
        return candidates + added

    def _touch_of_strokes(self, library: Library, task: _Task) -> Float64Array:
        """Chance that a stroke of a length brings the object onto an obstacle, by the mean model and the spread of all, 1 where the tool
        touches one, shape (n_strokes, n_lengths)."""
        keep_out, strokes_of, pose = task.keep_out, library.strokes, task.pose
        if keep_out is None:
            return np.zeros(library.motion.shape[1:3])
        clearance, span, heading = self._settings.clearance, self._settings.span, strokes_of.heading()
        # The rear end of a tool with two contacts follows the front one, and begins where both are lowered.
        rear = np.linspace(-clearance - span, -clearance, 1 + int(np.ceil(span / library.lengths[0])))
        along = np.concatenate([rear, np.linspace(-clearance, 0.0, 1 + int(clearance / library.lengths[0]))[1:], library.lengths])
        tool = transform_points(pose, (strokes_of.tool[:, None] + along[:, None] * heading[:, None]).reshape(-1, 2))
        tool = tool.reshape(len(strokes_of), len(along), 2)
        clear = keep_out.is_tool_clear(tool[:, : len(rear)], tool)[:, -len(library.lengths) :]
        gaps, now = keep_out.gaps(compose(pose, library.motion[0])), float(keep_out.gaps(pose))
        variance = library.variance + np.where((gaps < now - RESOLUTION)[..., None], np.diag(task.covariance), 0.0)
        std = np.sqrt(np.max(variance[..., :2], axis=-1) + keep_out.lever**2 * variance[..., 2])
        # The error of the pose moves a push that leads away, or along, no nearer.
        touch = ndtr(-(gaps - min(now, 0.0)) / np.hypot(std, 0.5 * RESOLUTION))
        return np.where(clear, np.maximum.accumulate(touch, axis=1), 1.0)

    def _best(self, task: _Task, candidates: Sequence[_Candidate]) -> GoalPush:
        """The candidate after which the fewest pushes are expected, by more models and with the uncertainty of the pose."""
        pose, goal, hold = task.pose, task.goal, task.around.hold
        models = self._displaced_judges(pose, task.covariance)
        pushes = [(group.picked(number), length) for group, number, length in candidates]
        chance = goal.chance(pose, task.covariance)
        if hold is None:
            # A few models choose the pushes that all of them judge.
            poses = self._poses(task, models[: 1 + _OPTIONS.n_models], pushes)
            value = np.where(task.touch(poses) <= RISK, _value(task.further, poses[:, :, -1], goal, poses[:, :, -1]), np.nan)
            most = np.argsort(np.nan_to_num(value, nan=np.inf))[: _OPTIONS.finalists]
            most = most[np.isfinite(value[most])] if task.keep_out is not None else most
            candidates, pushes = [candidates[k] for k in most], [pushes[k] for k in most]
            if not pushes:
                return GoalPush(PlanStatus.UNTOUCHED, chance)
        poses = self._poses(task, models, pushes)
        ends, touch = poses[:, :, -1], task.touch(poses)
        risks = _EdgeRisk(hold, self._shape, np.array([model.body.centre for model in models]), pose)
        risk = risks.risk(self._margins(hold, models, poses[:, :, 1:]))
        value, allowed = _value(task.further, ends, goal, ends) + _OPTIONS.fall_cost * risk, risk <= risks.allowed
        if not np.any(allowed):
            return GoalPush(PlanStatus.UNHELD, chance, risk=float(np.min(risk)))
        if not np.any(touch <= RISK):
            return GoalPush(PlanStatus.UNTOUCHED, chance, touch=float(np.min(touch)))
        value = np.where(allowed & (touch <= RISK), value, np.nan)
        if not np.any(np.isfinite(value)):
            return GoalPush(PlanStatus.UNREACHABLE, chance)
        best = int(np.nanargmin(value))
        group, number, length = candidates[best]
        return GoalPush(
            PlanStatus.PUSH,
            float(np.mean(np.asarray(goal.relative_error(ends[:, best])) <= 1.0)),
            placed(group, number, pose, length, self._settings.speed_range[0]),
            ends[0, best],
            ends[:, best],
            float(risk[best]),
            float(touch[best]),
            float(value[best]),
        )

    def _displaced_judges(self, pose: Float64Array, covariance: Float64Array) -> list[BatchModel]:
        """The mean model at the observed pose, then posterior models, each with an object displaced by an error of that pose."""
        root = np.linalg.cholesky(covariance + 1e-18 * np.eye(3))
        errors = np.random.default_rng(2).normal(size=(_OPTIONS.n_final_models, 3)) @ root.T
        displacements = compose(inverse(pose), pose + np.vstack([np.zeros(3), errors]))
        # A model that is known to be true judges alone.
        models = self._judges * (len(displacements) // len(self._judges))
        return [model._replace(displacement=shift) for model, shift in zip(models, displacements, strict=True)]

    def _poses(self, task: _Task, models: Sequence[BatchModel], pushes: Sequence[tuple[Strokes, float]]) -> Float64Array:
        """Poses before, during and after pushes under models, shape (n_models, n_pushes, n_poses, 3); without edge and obstacles before and
        after only."""
        settings, hold = self._settings, task.around.hold
        frames = 1 if hold is None and task.keep_out is None else _OPTIONS.frames
        speed, batch = settings.speed_range[0], []
        for stroke, length in pushes:
            path = path_of(stroke.tool[0], stroke.heading()[0], length, speed, settings)
            first = 0.0 if frames == 1 else settings.clearance / speed
            # The path of the tool follows from the observed pose.
            batch.append(BatchPush(moved(task.pose, path), task.pose, np.linspace(first, path.time[-1], frames + 1)[1:]))
        poses = simulated(task.belief, models, batch, None if hold is None else hold.edge)
        before = compose(task.pose, np.array([model.displacement for model in models]))
        return np.concatenate([np.broadcast_to(before[:, None, None], (*poses.shape[:2], 1, 3)), poses], axis=2)

    def _margins(self, hold: EdgeHold | None, models: Sequence[BatchModel], poses: Float64Array) -> Float64Array:
        """Least margin during pushes [m], shape (n_models, n_pushes)."""
        if hold is None:
            return np.full(poses.shape[:2], np.inf)
        centres = np.array([model.body.centre for model in models])
        return np.asarray(np.min(hold.margins(self._shape.cells.centres, centres[:, None, None], poses), axis=2))


_Candidate = tuple[Strokes, int, float]
"""Strokes, which of them, and its travel after contact [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """What one push is planned for, in the table frame of the arm."""

    belief: Belief
    pose: Float64Array
    covariance: Float64Array
    goal: Goal
    wanted: Goal
    """The goal in the frame of the object."""
    around: Surroundings
    keep_out: KeepOut | None
    """None without obstacles."""
    further: _FurtherPushes

    def touch(self, poses: Float64Array) -> Float64Array:
        """Chance that the object enters an obstacle, by poses of pushes under models, (n_models, n_pushes, n_poses, 3): (n_pushes,)."""
        return np.zeros(poses.shape[1]) if self.keep_out is None else self.keep_out.risk(poses)


def _in_arm_frame(
    camera: Float64Array, pose: Float64Array, covariance: Float64Array, goal: Goal
) -> tuple[Float64Array, Float64Array, Goal]:
    """Pose, covariance and goal in the table frame of the arm, from that of the camera."""
    arm_from_camera = inverse(camera)
    turn = np.eye(3)
    turn[:2, :2] = rotation(float(arm_from_camera[2]))
    goal_in_arm = Goal(compose(arm_from_camera, goal.pose), goal.position, goal.yaw)
    return compose(arm_from_camera, pose), turn @ covariance @ turn.T, goal_in_arm


def _room_of(library: Library, goal: Goal, travel: float) -> float:
    """Distance from obstacles in which pushes of a usual length are possible [m]: how far the best push of a library ends from a way that
    leads straight on, the median over directions, and what is uncertain of its end with the chance `RISK`."""
    flat = library.motion[0].reshape(-1, 3)
    angle = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    ahead = travel * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    distance, _ = KDTree(flat[np.all(np.isfinite(flat), axis=1)] / goal.tolerance).query(ahead / goal.tolerance)
    return goal.position * float(np.median(distance)) + DEVIATIONS * library.spread_by_length * travel


def _ranked(library: Library, task: _Task, clear: BoolArray) -> list[tuple[int, int]]:
    """Strokes and lengths that are clear, by the pushes that are expected from now on, the best first: by the mean model, then by all."""

    def value_of(motion: Float64Array) -> Float64Array:
        return _value(task.further, motion, task.wanted, compose(task.pose, motion))

    mean = library.motion[0]
    value = value_of(mean.reshape(1, -1, 3))
    first = np.argsort(np.where(np.isfinite(value) & clear.ravel(), value, np.inf))[: _OPTIONS.screened]
    motion = library.motion.reshape(len(library.motion), -1, 3)[:, first]
    value = np.where(clear.ravel()[first], value_of(motion), np.inf)
    order = np.argsort(np.where(np.isfinite(value), value, np.inf))
    n_lengths = len(library.lengths)
    return [(int(first[k] // n_lengths), int(first[k] % n_lengths)) for k in order if np.isfinite(value[k])]


def _value(further: _FurtherPushes, motion: Float64Array, wanted: Goal, ends: Float64Array) -> Float64Array:
    """Pushes expected from now on for each motion that a push may make, shape (n_models, n_motions, 3), or for each pose where it may end;
    `wanted` in the same frame: shape (n_motions,). `ends`: the poses in the table frame, of the shape of `motion`."""
    at_goal = _probability_within_tolerance(wanted.relative_error(motion))
    remaining = compose(inverse(motion), wanted.pose)
    after = further.after(remaining.reshape(-1, 3)).reshape(at_goal.shape) + further.detour(ends)
    return 1.0 + np.asarray(np.mean((1.0 - at_goal) * np.maximum(after, further.shown(ends)), axis=0))


class _FurtherPushes:
    """Pushes that are expected to make a motion within the tolerances of a goal, looked up in the motions of the mean model."""

    def __init__(self, library: Library, goal: Goal, way: WayRound | None, passed: Sequence[tuple[Float64Array, float]]) -> None:
        flat, variance = library.motion[0].reshape(-1, 3), library.variance.reshape(-1, 3)
        known = np.all(np.isfinite(flat), axis=1)
        self._goal, self._way, self._tree = goal, way, KDTree(flat[known] / goal.tolerance)
        self._passed = passed
        self._spread = np.sqrt(np.sum(variance[known] / goal.tolerance**2, axis=1))
        """Of each motion over the models, in units of the tolerances, shape (n_motions,)."""

    def after(self, wanted: Float64Array) -> Float64Array:
        """Expected number for each of the motions, shape (n, 3): shape (n,); NaN for one that is not known."""
        finite = np.all(np.isfinite(wanted), axis=1)
        query = np.where(finite[:, None], wanted, 0.0)
        query[:, 2] = wrap_angle(query[:, 2])
        distance, index = self._tree.query(query / self._goal.tolerance, k=_OPTIONS.neighbours)
        chance = _probability_within_tolerance(np.hypot(distance, self._spread[index]))
        beyond = np.maximum(distance - 1.0, 0.0) * self._goal.position / _OPTIONS.push_travel
        return np.where(finite, np.min(1.0 + (1.0 - chance) * (1.0 + beyond), axis=1), np.nan)

    def detour(self, poses: Float64Array) -> float | Float64Array:
        """Pushes that the way round obstacles needs beside these, from poses, shape (..., 3): shape (...); inf where there is none."""
        return 0.0 if self._way is None else self._way.extra(poses) / _OPTIONS.push_travel

    def shown(self, poses: Float64Array) -> Float64Array:
        """Pushes that were found to be needed from there before, from poses, shape (..., 3): shape (...); 0 where none was planned."""
        least = np.zeros(poses.shape[:-1])
        for pose, value in self._passed:
            is_there = np.asarray(replace(self._goal, pose=pose).relative_error(poses)) <= 1.0
            least = np.where(is_there, np.maximum(least, value), least)
        return least


class _EdgeRisk:
    """Risks of an object at an edge, under models with given centres of mass, shape (n_models, 2)."""

    def __init__(self, hold: EdgeHold | None, shape: ObjectShape, centres: Float64Array, pose: Float64Array) -> None:
        self._hold, self._shape, self._centres, self._pose = hold, shape, centres, pose
        now = np.full(len(centres), np.inf)
        if hold is not None:
            now = hold.margins(shape.cells.centres, centres, np.tile(pose, (len(centres), 1)))
        self._stands = now >= 0.0 if np.any(now >= 0.0) else np.ones(len(now), dtype=bool)
        self.allowed = max(0.0 if hold is None else hold.limit, float(self.risk(now)))
        """Largest risk of a push [1]: not below that of the present pose, so that pushes back onto the table are allowed."""

    def risk(self, margins: Float64Array) -> Float64Array:
        """Risk of pushes with given least margins, shape (n_models, ...), under the models by which the object is held now: (...)."""
        if self._hold is None:
            return np.zeros(margins.shape[1:])
        return self._hold.risk(margins[self._stands])

    def allows(self, motions: Float64Array, n_poses: int) -> bool:
        """Whether the risk of a motion, shape (n_models, 3), is allowed, by `n_poses` poses along it: a coarse check."""
        if self._hold is None:
            return True
        poses = compose(self._pose, np.linspace(0.0, 1.0, n_poses)[1:, None, None] * motions)
        margins = self._hold.margins(self._shape.cells.centres, self._centres, poses)
        return bool(self.risk(np.min(margins, axis=0)) <= self.allowed)


def _probability_within_tolerance(error: Float64Array) -> Float64Array:
    """Smooth probability that an error [tolerances] is within 1: from 1 at no error to 0 at large ones, since the models are few."""
    return np.asarray(1.0 / (1.0 + np.nan_to_num(error, nan=np.inf) ** 4))


_RANGE: Final = np.array([0.01, 0.3, 0.03])
"""Largest change of contact [m], direction [rad] and length [m] in a step: the derivative holds on one side of a switch only."""
_NUMERICS: Final = SimulationSettings(step=1.0 / 120.0, resolve_events=True)
_ORIGIN: Final = np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class RefinedStroke:
    """A push that brings the mean model nearer to the goal."""

    stroke: Strokes
    """One."""
    length: float
    """Travel after contact [m]."""
    motion: Float64Array
    """Pose of the object after it in its frame before it, shape (3,)."""


def refine(
    belief: Belief,
    stroke: Strokes,
    length: float,
    wanted: Goal,
    settings: PushSettings,
    pose: Float64Array = _ORIGIN,
    *,
    n_evaluations: int = 5,
    damping: float = 0.5,
) -> RefinedStroke | None:
    """A stroke and a length [m] whose motion is nearer to the wanted one; None where the push cannot be improved.

    The rollout gives the derivative of the end by the first pose. To move the path of the pusher by a small motion is to move the object by
    the inverse one and then everything by that motion, so the same derivative tells what another contact and another direction do; the
    velocity at the end tells what another length does. Three numbers of the push for three of the pose: Gauss-Newton.

    `length`: travel after contact [m], at least 3 mm; `wanted`: motion, in the frame of the object before it; `pose`: of the object then,
    table frame of the arm, shape (3,); `n_evaluations`: simulations with their derivative; `damping`: weight of a change of the push by its
    whole range, in tolerances [1]: changes that hardly move the end are not made.
    """
    best: RefinedStroke | None = None
    first = least = np.inf
    step = np.zeros(3)
    for _ in range(n_evaluations):
        origin = best or RefinedStroke(stroke, length, np.zeros(3))
        tried = origin.stroke.changed(float(step[0]), float(step[1]))
        longer = float(np.clip(origin.length + step[2], 0.003, settings.max_distance))
        end, by_push = end_by_push(belief, tried, longer, settings, pose)
        if end is None or by_push is None:
            break
        residual = np.append((end - wanted.pose)[:2], wrap_angle(end[2] - wanted.pose[2])) / wanted.tolerance
        cost = float(residual @ residual)
        first = min(first, cost) if best is None else first
        if cost >= least:
            step *= 0.3  # a shorter step from the best push so far
            continue
        best, least = RefinedStroke(tried, longer, end), cost
        scaled = by_push / wanted.tolerance[:, None] * _RANGE
        step = _RANGE * np.clip(-np.linalg.solve(scaled.T @ scaled + damping**2 * np.eye(3), scaled.T @ residual), -1.0, 1.0)
    return best if least < first else None


def end_by_push(
    belief: Belief, stroke: Strokes, length: float, settings: PushSettings, pose: Float64Array = _ORIGIN
) -> tuple[Float64Array | None, Float64Array | None]:
    """Pose after a push in the frame of the object before it, shape (3,), and its derivative by contact, direction and length, (3, 3).

    Where a turn of everything changes the motion, the derivative leaves that out.
    """
    tool, heading = stroke.tool[0], stroke.heading()[0]
    path = path_of(tool, heading, length, settings.speed_range[0], settings)
    # The motion at the end is averaged over some travel: an object that has been hit runs ahead of the pusher for a moment.
    window = 0.003
    just_before = float(path.time[-1]) - window / settings.speed_range[0]
    first = pose if belief.depends_on_pose else _ORIGIN
    scenario = PushScenario(moved(first, path), first, np.array([just_before, path.time[-1]]))
    law = belief.numerics
    numerics = replace(_NUMERICS, smoothing_speed=law.smoothing_speed, quasi_static=law.quasi_static)
    motion = belief.mean.simulate(scenario, settings=numerics, jacobian=True)
    if motion.status is not SolveStatus.CONVERGED:
        return None, None
    before, end = compose(inverse(first), motion.pose)
    axes = np.eye(3)
    axes[:2, :2] = rotation(float(first[2]))
    by_first = axes.T @ motion.jacobian[-1, :, :3] @ axes
    tangent = stroke.tangent[0]
    moves = np.array([[tangent[0], tangent[1], 0.0], [tool[1], -tool[0], 1.0]])
    columns = [move + move[2] * np.array([-end[1], end[0], 0.0]) - by_first @ move for move in moves]
    by_length = (end - before) / window
    return end, np.column_stack([*columns, by_length])
