"""How fast an object is learned online from depth images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.errors import PerceptionError
from push_ident.geometry.se2 import compose, inverse
from push_ident.identification.next_push import Criterion, PlannedPush, candidate_pushes
from push_ident.identification.push_study import CurveOptions, choose_at_random, choose_by, learning_curve
from push_ident.perception.labels import Cylinder
from push_ident.perception.pipeline import Perception
from push_ident.perception.tracking import TrackStatus
from push_ident.pushing.push import PushSettings
from push_ident.types import DepthFrame, Float64Array, ObjectShape, PoseTrack, PusherPath, PushRecord
from push_ident_sim.cell.camera import DepthCamera, DepthNoise
from push_ident_sim.cell.robot import PUSHER_RADIUS
from push_ident_sim.engines.bullet.push_world import PushWorld
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.objects import OBJECT_NAMES, SimObject, make_object
from push_ident_sim.recordings.recording import standing_tool
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, log_millimetres, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.measuring import grouped, micrometres
from push_ident_sim.studies.common.seeing import CAMERA_POSE, RATE

__all__ = ["STUDY"]

_RANDOM, _CHOSEN = "random", "chosen"
_N_PUSHES: Final = 8
_SHOWN: Final = (1, 2, 4, 8)
_N_TEST: Final = 12
_AIM: Final = 0.003
"""After four pushes [m]."""
_REST: Final = 10
"""Frames before and after each push."""
_PATIENCE: Final = 60
"""Frames in which an object must be found."""
_NEAR_EDGE: Final = 0.09
"""An object further from the middle than this is put back [m]."""
_TURNED: Final = 0.5
"""Largest turn when it is put back by hand [rad]."""
_PUSHES: Final = PushSettings(pusher_radius=PUSHER_RADIUS)


class _FilmedObject:
    """An object pushed in Bullet by a rod and observed only by a depth camera."""

    def __init__(self, thing: SimObject, seed: Sequence[int]) -> None:
        self._rng = np.random.default_rng(seed)
        self._world = PushWorld(thing, PUSHER_RADIUS)
        self._camera, self._noise = DepthCamera(thing, CAMERA_POSE), DepthNoise()
        self._perception = Perception(CAMERA_POSE)
        self._clock = 0.0
        self._true_pose = self._somewhere()
        for _ in range(_PATIENCE):
            found = self._look(self._true_pose, None)
            if "o1" in found:
                break
        else:
            raise PerceptionError(f"The {thing.name} was not found within {_PATIENCE} frames.")
        self.pose = found["o1"][0]
        self.offset = compose(inverse(self._true_pose), self._perception.first_pose("o1"))
        """Object frame of perception in the true one."""

    shape: ObjectShape
    pose: Float64Array

    def execute(self, push: PlannedPush) -> PushRecord:
        path = _driven(push.pusher)
        motion = self._world.push(self._true_pose, path)
        begin = self._clock + _REST / RATE
        poses: list[tuple[float, Float64Array, Float64Array]] = []
        for time in np.arange(-_REST, round(motion.time[-1] * RATE) + _REST) / RATE:
            tool = motion.pusher_at(time) if 0 <= time <= motion.time[-1] else None
            stamp = self._clock
            found = self._look(motion.pose_at(time), tool)
            if "o1" in found:
                poses.append((stamp, *found["o1"]))
        self._true_pose = motion.pose[-1]
        time, pose, covariance = (np.array(column) for column in zip(*poses, strict=True))
        rest = np.array([begin - _REST / RATE, *(begin + motion.time), begin + motion.time[-1] + _REST / RATE])
        reported = motion.reported[np.r_[0, 0 : len(motion.time), len(motion.time) - 1]]
        record = PushRecord("o1", self.shape, PoseTrack(time, pose, covariance), PusherPath(rest, reported, PUSHER_RADIUS))
        self.pose = pose[-1]
        if np.hypot(*self._true_pose[:2]) > _NEAR_EDGE:
            self._put_back()
        return record

    def test_pushes(self, n: int, rng: np.random.Generator) -> list[PushRecord]:
        """Random test pushes, with the true poses of the object frame of perception."""
        records = []
        for _ in range(n):
            start = np.array([*rng.uniform(-0.05, 0.05, size=2), rng.uniform(-np.pi, np.pi)])
            push = candidate_pushes(self.shape, compose(start, self.offset), rng, 1, _PUSHES)[0]
            motion = self._world.push(start, _driven(push.pusher))
            records.append(self._true_record(motion))
        return records

    def close(self) -> None:
        self._world.close()

    def _true_record(self, motion: TrueMotion) -> PushRecord:
        pose = np.array([compose(p, self.offset) for p in motion.pose])
        exact = np.broadcast_to(np.diag([1e-4, 1e-4, 1e-4]) ** 2, (len(pose), 3, 3))
        return PushRecord("o1", self.shape, PoseTrack(motion.time, pose, exact), PusherPath(motion.time, motion.reported, PUSHER_RADIUS))

    def _look(self, true_pose: Float64Array, tool: Float64Array | None) -> dict[str, tuple[Float64Array, Float64Array]]:
        """One frame; pose and covariance of the objects that perception finds."""
        links = {} if tool is None else {"hand_pusher": standing_tool(tool)}
        robot = [] if tool is None else [Cylinder(float(tool[0]), float(tool[1]), PUSHER_RADIUS)]
        depth = self._noise.apply(self._camera.render(true_pose, links), self._rng)
        observed = self._perception.observe(DepthFrame(self._clock, depth, self._camera.intrinsics), robot)
        self._clock += 1.0 / RATE
        if "o1" in observed.new_shapes:
            self.shape = observed.new_shapes["o1"]
        return {
            known.object_id: (known.pose, known.covariance)
            for known in observed.objects
            if known.status is TrackStatus.TRACKED and known.pose is not None and known.covariance is not None
        }

    def _put_back(self) -> None:
        """As a person does: lifted, and placed near the middle without turning it round, where perception has to find it again.

        After half a turn a wrench or a box looks the same to a depth camera.
        """
        away = np.array([5.0, 0.0, 0.0])
        for _ in range(_REST):
            self._look(away, None)
        yaw = self._true_pose[2] + self._rng.uniform(-_TURNED, _TURNED)
        self._true_pose = np.array([*self._somewhere()[:2], yaw])
        for _ in range(_PATIENCE):
            found = self._look(self._true_pose, None)
            if "o1" in found:
                self.pose = found["o1"][0]
                return
        raise PerceptionError(f"The object was not found again within {_PATIENCE} frames after it was put back.")

    def _somewhere(self) -> Float64Array:
        return np.array([*self._rng.uniform(-0.04, 0.04, size=2), self._rng.uniform(-np.pi, np.pi)])


def _driven(path: PusherPath) -> PusherPath:
    """The part of a path in which the tool moves, from time 0."""
    moves = np.flatnonzero(np.linalg.norm(np.diff(path.position, axis=0), axis=1) > 0)
    part = slice(moves[0], moves[-1] + 2)
    return PusherPath(path.time[part] - path.time[moves[0]], path.position[part], path.radius)


def _run(case: Case, settings: CaseSettings) -> Json:
    own = [case.model, OBJECT_NAMES.index(case.object_name)]
    thing = make_object(case.object_name, case.model)
    # Noise, test pushes and the first push are the same for both policies.
    filmed = _FilmedObject(thing, [*own, 5])
    try:
        test = filmed.test_pushes(_N_TEST, np.random.default_rng([*own, 6]))
        policy = choose_at_random if case.variant == _RANDOM else choose_by(Criterion.ERROR, _PUSHES)
        rng = np.random.default_rng([*own, 7])
        options = CurveOptions(n_pushes=_N_PUSHES, n_candidates=60)
        errors = learning_curve(filmed, policy, test, rng, push_settings=_PUSHES, options=options)
    finally:
        filmed.close()
    return {"errors_m": micrometres(errors)}


def _summarise(results: Sequence[CaseResult]) -> Json:
    summary: Json = {"pushes": list(range(1, _N_PUSHES + 1)), "curves": {}}
    for variant, own in grouped(results, "variant").items():
        rows = {"all": own, **grouped(own, "object_name")}
        summary["curves"][variant] = {name: _curve([r.values["errors_m"] for r in cases]) for name, cases in rows.items()}
    return summary


def _curve(errors: Sequence[Sequence[float]]) -> Json:
    values = np.array(errors, dtype=np.float64)
    spread = np.nanstd(values, axis=0, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.full(values.shape[1], np.nan)
    return {"n": len(values), "mean_m": micrometres(np.nanmean(values, axis=0)), "standard_error_m": micrometres(spread)}


def _tables(summary: Json) -> str:
    head = ["mean cell error on held-out pushes [mm]", "cases", *(f"after {n}" for n in _SHOWN)]
    rows = [
        [f"{variant}, {name}", str(curve["n"]), *(_cell(curve, n - 1) for n in _SHOWN)]
        for variant, curves in summary["curves"].items()
        for name, curve in curves.items()
    ]
    return markdown_table(head, rows)


def _cell(curve: Json, i: int) -> str:
    mean, error = curve["mean_m"][i], curve["standard_error_m"][i]
    return f"{1e3 * mean:.2f}" + (f" ± {1e3 * error:.2f}" if error is not None and np.isfinite(error) else "")


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (axes,) = new_figure(1, width=6.0, height=4.2)
    for (name, curves), colour in zip(summary["curves"].items(), (COLOURS["uniform"], COLOURS["gauss_newton"]), strict=False):
        curve = curves["all"]
        bars = [1e3 * (error or 0.0) for error in curve["standard_error_m"]]
        axes.errorbar(summary["pushes"], 1e3 * np.array(curve["mean_m"]), bars, label=name, color=colour, marker="o", capsize=3)
    axes.axhline(1e3 * _AIM, color=COLOURS["truth"], lw=1.0, ls=":")
    axes.set_xlabel("pushes learned from")
    axes.set_xticks(summary["pushes"])
    log_millimetres(axes, "mean cell error on held-out pushes [mm]", low=0.5, high=20.0)
    label_below(axes, 2)
    save(figure, folder / "online.png")
    return {"online.png": "Error on held-out pushes by the number of pushes; bars are standard errors, dotted: 3 mm."}


STUDY = Experiment(
    name="online",
    place=70,
    title="Learning an object online from depth images",
    question=(
        "How many pushes does it take to learn an object when shape and poses come from depth images (30 Hz, 640 x 480, the noise of a "
        "real camera)? Perception segments it at rest. Then it is pushed eight times from where it lies, and put back by hand when it "
        "nears the edge; each push is learned as the node does it. `random`: any safe push. `chosen`: after the first, the one of 60 "
        f"safe pushes with the smallest expected error. The errors are those on {_N_TEST} other random pushes, the same for both, whose "
        "true motion is known."
    ),
    variants=(_RANDOM, _CHOSEN),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "perception", "physics", "identification"),
)
