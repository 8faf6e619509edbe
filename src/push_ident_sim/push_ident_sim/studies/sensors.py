"""How exactly models of depth sensors show an object to perception, and what that costs identification.

The object is pushed in Bullet and perceived from rendered depth images only, as in a cell; its true motion is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from push_ident.errors import PerceptionError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.identification.identify import identify
from push_ident.identification.predicting.next_push import PlannedPush, candidate_pushes
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.perception.frame.robot import Cylinder
from push_ident.perception.known_object import TrackStatus
from push_ident.perception.pipeline import Perception
from push_ident.pushing.push import PushSettings
from push_ident.types import DepthFrame, Float64Array, ObjectShape, PoseTrack, PusherPath, PushRecord
from push_ident_sim.cell.camera import DepthImage, View
from push_ident_sim.cell.robot import PUSHER_RADIUS
from push_ident_sim.cell.sensor_unit import Sensor
from push_ident_sim.cell.sensors import SENSORS, suitable_pose
from push_ident_sim.engines.bullet.push_world import PushWorld
from push_ident_sim.objects import OBJECT_NAMES, SimObject, make_object
from push_ident_sim.recordings.recording import standing_tool
from push_ident_sim.recordings.truth import true_model
from push_ident_sim.studies.common.measuring import (
    NOMINAL,
    error_row,
    gaussian_level,
    grouped,
    micrometres,
    predicted_end,
    root_mean_square,
    solve_values,
)
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.studies.common.tables import markdown_table, mean_millimetres, millimetres

_PUSHES: Final = PushSettings(pusher_radius=PUSHER_RADIUS)
"""Of the pushes that are drawn."""
_RATE: Final = 30.0
"""Frames a second."""
_PATIENCE: Final = 60
"""Frames in which an object must be found."""


class FilmedObject:
    """An object pushed by a rod and observed only by a depth camera.

    The camera has the pose that suits its `sensor`; perception gets the pose and the intrinsics that the unit publishes. `unit`: seed of
    the calibration errors; `rest`: frames before and after each push. Raises PerceptionError where the object was not found.
    """

    shape: ObjectShape
    """As perceived: the latest outline."""
    true_pose: Float64Array
    """Shape (3,)."""

    def __init__(self, sim_object: SimObject, seed: Sequence[int], *, sensor: str, unit: int, rest: int) -> None:
        self._rng = np.random.default_rng(seed)
        # Of its own, so that where the object lies does not depend on how many numbers a model of noise draws.
        self._places = np.random.default_rng([*seed, 1])
        self.sim_object, self._rest = sim_object, rest
        self._world = PushWorld(sim_object, PUSHER_RADIUS)
        reported = suitable_pose(sensor)
        self._unit = Sensor(sensor, unit)
        self._camera = self._unit.camera(sim_object, reported)
        self._perception = Perception(reported)
        self._accuracy = self._unit.accuracy(reported)
        self._clock = 0.0
        self._view: tuple[Float64Array, View | DepthImage] | None = None
        self.exact: list[PushRecord] = []
        """The pushes so far, with poses as those of `test_pushes`."""
        self.true_pose = self._somewhere()
        for _ in range(_PATIENCE):
            if "o1" in self._look(self.true_pose, None):
                break
        else:
            raise PerceptionError(f"The {sim_object.name} was not found within {_PATIENCE} frames.")
        self._table = self._unit.table_as_seen(self._perception.camera_in_table, reported)
        self.offset = compose(inverse(self.as_reported(self.true_pose)), self._perception.first_pose("o1"))
        """Object frame of perception in the true one."""

    def as_reported(self, true_pose: Float64Array) -> Float64Array:
        """A true pose in the table frame of this camera, which has the error of its extrinsics."""
        return compose(self._table, true_pose)

    def execute(self, push: PlannedPush) -> PushRecord:
        """Make a push planned from `true_pose`; an object near the edge is put back afterwards."""
        path = _driven(push.pusher)
        motion = self._world.push(self.true_pose, path)
        begin = self._clock + self._rest / _RATE
        poses: list[tuple[float, Float64Array, Float64Array]] = []
        exact: list[Float64Array] = []
        for time in np.arange(-self._rest, round(motion.time[-1] * _RATE) + self._rest) / _RATE:
            tool = motion.pusher_at(time) if 0 <= time <= motion.time[-1] else None
            stamp = self._clock
            tracked = self._look(motion.pose_at(time), tool)
            if "o1" in tracked:
                poses.append((stamp, *tracked["o1"]))
                exact.append(compose(self.as_reported(motion.pose_at(time)), self.offset))
        self.true_pose = motion.pose[-1]
        if not poses:
            raise PerceptionError(f"The {self.sim_object.name} was lost during a push.")
        time, pose, covariance = (np.array(column) for column in zip(*poses, strict=True))
        rest = np.array([begin - self._rest / _RATE, *(begin + motion.time), begin + motion.time[-1] + self._rest / _RATE])
        reported = motion.reported[np.r_[0, 0 : len(motion.time), len(motion.time) - 1]]
        record = PushRecord("o1", self.shape, PoseTrack(time, pose, covariance, self._accuracy), PusherPath(rest, reported, PUSHER_RADIUS))
        self.exact.append(replace(record, poses=self._exact_track(time, np.array(exact))))
        if np.hypot(*self.true_pose[:2]) > 0.09:
            self._put_back()
        return record

    def true_push(self, rng: np.random.Generator) -> PlannedPush:
        """A random push from where the object truly lies, the same one before every camera."""
        return candidate_pushes(true_model(self.sim_object).shape, self.true_pose, rng, 1, _PUSHES)[0]

    def test_pushes(self, n: int, rng: np.random.Generator) -> list[PushRecord]:
        """Random test pushes, the same before every camera, with the poses as this camera reports them, but without noise."""
        records = []
        for _ in range(n):
            start = np.array([*rng.uniform(-0.05, 0.05, size=2), rng.uniform(-np.pi, np.pi)])
            push = candidate_pushes(true_model(self.sim_object).shape, start, rng, 1, _PUSHES)[0]
            motion = self._world.push(start, _driven(push.pusher))
            pose = np.array([compose(self.as_reported(p), self.offset) for p in motion.pose])
            path = PusherPath(motion.time, motion.reported, PUSHER_RADIUS)
            records.append(PushRecord("o1", self.shape, self._exact_track(motion.time, pose), path))
        return records

    @property
    def exact_shape(self) -> ObjectShape:
        """The true outline in the object frame of perception, with the perceived cells."""
        return ObjectShape(self.shape.cells, transform_points(inverse(self.offset), self.sim_object.outline))

    def close(self) -> None:
        """End the physics."""
        self._world.close()

    def _exact_track(self, time: Float64Array, pose: Float64Array) -> PoseTrack:
        """Without an error of their own."""
        return PoseTrack(time, pose, np.broadcast_to(1e-4**2 * np.eye(3), (len(pose), 3, 3)), self._accuracy)

    def _look(self, true_pose: Float64Array, tool: Float64Array | None) -> dict[str, tuple[Float64Array, Float64Array]]:
        """One frame; pose and covariance of the objects that perception tracks."""
        links = {} if tool is None else {"hand_pusher": standing_tool(tool)}
        robot = [] if tool is None else [Cylinder(float(tool[0]), float(tool[1]), PUSHER_RADIUS)]
        if self._view is None or links or not np.array_equal(self._view[0], true_pose):
            self._view = np.full(3, np.nan) if links else np.array(true_pose), self._unit.look(self._camera, true_pose, links)
        depth = self._unit.read(self._view[1], self._rng)
        observed = self._perception.observe(DepthFrame(self._clock, depth, self._unit.intrinsics), robot)
        self._clock += 1.0 / _RATE
        for shapes in (observed.new_shapes, observed.refined):
            if "o1" in shapes:
                self.shape = shapes["o1"]
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
        for _ in range(10):  # frames
            self._look(away, None)
        yaw = self.true_pose[2] + self._places.uniform(-0.5, 0.5)
        self.true_pose = np.array([*self._somewhere()[:2], yaw])
        for _ in range(_PATIENCE):
            if "o1" in self._look(self.true_pose, None):
                return
        raise PerceptionError(f"The object was not found again within {_PATIENCE} frames after it was put back.")

    def _somewhere(self) -> Float64Array:
        return np.array([*self._places.uniform(-0.04, 0.04, size=2), self._places.uniform(-np.pi, np.pi)])


def _driven(path: PusherPath) -> PusherPath:
    """The part of a path in which the tool moves, from time 0."""
    moves = np.flatnonzero(np.linalg.norm(np.diff(path.position, axis=0), axis=1) > 0)
    part = slice(moves[0], moves[-1] + 2)
    return PusherPath(path.time[part] - path.time[moves[0]], path.position[part], path.radius)


N_PUSHES: Final = 4
N_TEST: Final = 8
_REST: Final = 20
"""Frames before and after each push: long enough for a better outline."""


def _run(case: Case, settings: CaseSettings) -> Json:
    seed = [case.model, OBJECT_NAMES.index(case.object_name)]
    # No two cases share a unit of a sensor: five objects before one badly calibrated unit would count as five.
    sim_object, unit = make_object(case.object_name, case.model), len(OBJECT_NAMES) * seed[0] + seed[1]
    filmed = FilmedObject(sim_object, [*seed, 8], sensor=case.variant, unit=unit, rest=_REST)
    try:
        first = filmed.shape
        rng = np.random.default_rng([*seed, 9])
        records = [filmed.execute(filmed.true_push(rng)) for _ in range(N_PUSHES)]
        test = filmed.test_pushes(N_TEST, np.random.default_rng([*seed, 10]))
    finally:
        filmed.close()
    # As the node does it: pushes are fitted again with a better outline.
    perceived = identify([replace(push, shape=filmed.shape) for push in records], budget=settings.budget)
    exact = identify([replace(push, shape=filmed.exact_shape) for push in filmed.exact], budget=settings.budget)
    truth = filmed.exact_shape.outline
    return solve_values(perceived) | {
        # With the offset of the surface from the outline that the pushes show, as every prediction of the package has it.
        "errors_m": {
            name: micrometres(held_out_errors(result.model, test, effects=result.posterior.effects))
            for name, result in (("perceived", perceived), ("exact", exact))
        },
        "first_outline_m": outline_error(first.outline, truth),
        "last_outline_m": outline_error(filmed.shape.outline, truth),
        "poses_m": micrometres(_pose_errors(records, filmed.exact)),
        "levels": {
            "poses": _pose_levels(records, filmed.exact),
            "ends": [end[0] for push in test if (end := predicted_end(perceived.posterior, push, push.poses.pose[-1]))],
        },
    }


def outline_error(outline: Float64Array, truth: Float64Array) -> float:
    """Root mean square distance of an outline from the true one [m]; in one frame [m], shapes (n, 2) and (m, 2)."""
    return round(float(np.sqrt(np.mean(signed_distance(_points_along(outline), truth) ** 2))), 6)


def _points_along(polygon: Float64Array) -> Float64Array:
    parts = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        n = max(1, int(np.linalg.norm(b - a) / 5e-4))
        parts.append(a + np.linspace(0.0, 1.0, n, endpoint=False)[:, None] * (b - a))
    return np.concatenate(parts)


def _pose_errors(records: Sequence[PushRecord], exact: Sequence[PushRecord]) -> list[float]:
    """Root mean square over the outline of its displacement by the error of the poses, one value a push [m]."""
    errors = []
    for record, true in zip(records, exact, strict=True):
        displacements = [
            transform_points(a, record.shape.outline) - transform_points(b, record.shape.outline)
            for a, b in zip(record.poses.pose, true.poses.pose, strict=True)
        ]
        errors.append(float(np.sqrt(np.mean(np.sum(np.square(displacements), axis=2)))))
    return errors


def _pose_levels(records: Sequence[PushRecord], exact: Sequence[PushRecord]) -> list[float]:
    """Of the pose at the end of each push: smallest probability of a region that contains the true one."""
    levels = []
    for record, true in zip(records, exact, strict=True):
        error = record.poses.pose[-1] - true.poses.pose[-1]
        error[2] = wrap_angle(error[2])
        levels.append(round(float(gaussian_level(error @ np.linalg.solve(record.poses.covariance[-1], error), 3)), 4))
    return levels


def _summarise(results: Sequence[CaseResult]) -> Json:
    return {"sensors": {name: _row(cases) for name, cases in grouped(results, "variant").items()}}


def _row(results: Sequence[CaseResult]) -> Json:
    values = [r.values for r in results]
    return {
        "cases": len(results),
        "errors": {name: error_row(results, name) for name in ("perceived", "exact")},
        **{key: root_mean_square(v[key] for v in values) for key in ("first_outline_m", "last_outline_m")},
        "poses_m": root_mean_square(error for v in values for error in v["poses_m"]),
        "within": {name: _within([level for v in values for level in v["levels"][name]]) for name in ("poses", "ends")},
    }


def _within(levels: Sequence[float]) -> float:
    return round(float(np.mean([level <= NOMINAL for level in levels])), 4)


def _tables(summary: Json) -> str:
    head = [
        "sensor",
        "cases",
        "outline, one view [mm]",
        "after the pushes",
        "poses [mm]",
        "cell error [mm]",
        "with exact outline and poses",
        f"poses within their {100 * NOMINAL:.0f} % region",
        "predicted ends",
    ]
    rows = [
        [
            name,
            str(row["cases"]),
            *(millimetres(row[key]) for key in ("first_outline_m", "last_outline_m", "poses_m")),
            *(mean_millimetres(row["errors"][name]) for name in ("perceived", "exact")),
            *(f"{100 * row['within'][name]:.0f} %" for name in ("poses", "ends")),
        ]
        for name, row in summary["sensors"].items()
    ]
    return markdown_table(head, rows)


def _answer(summary: Json) -> str:
    errors = {name: row["errors"]["perceived"]["mean_m"] for name, row in summary["sensors"].items()}
    best, worst = min(errors, key=errors.__getitem__), max(errors, key=errors.__getitem__)
    return f"Held-out pushes are predicted to {millimetres(errors[best], 1)} mm ({best}) to {millimetres(errors[worst], 1)} mm ({worst})."


STUDY = Experiment(
    name="sensors",
    title="How exact are perception and predictions through depth sensors?",
    question=(
        "Each case has another unit, and perception gets the pose, the intrinsics and the accuracy that it publishes. "
        f"The object is pushed {N_PUSHES} times by a rod that hides a part of "
        f"it, with {_REST} frames at rest before and after each push, in which the outline gets better. Errors of outlines and "
        f"poses are root mean squares. The poses of the {N_TEST} held-out pushes have the error of the extrinsics and no other. "
        "Regions are counted at the ends of pushes."
    ),
    variants=tuple(SENSORS),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    answer=_answer,
    stages=("geometry", "perception", "physics", "identification"),
)
