"""Outlines get better where objects rest in other poses, nothing else changes; errors of poses that last are part of their covariance."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares

from helpers.depth_scene import CAMERA, HAMMER_OUTLINE, Prism, hammer, rectangle, render
from push_ident.errors import InputError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.outline import dense, polygon_area, signed_distance
from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.perception.frame.view import FrameView, points_in_table
from push_ident.perception.known_object import NewObject, PoseFit, Segment, SegmentedView, Template, TrackStatus
from push_ident.perception.outline.rests import Rests, with_cells
from push_ident.perception.pipeline import Perception
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.tracking.pose_fit import fit_pose, frame_step, in_table
from push_ident.perception.tracking.tracker import KnownObjects
from push_ident.types import CameraAccuracy, DepthFrame, ObjectShape
from push_ident_sim.cell.sensor_unit import Sensor
from push_ident_sim.cell.sensors import SENSORS, suitable_pose
from push_ident_sim.objects import make_object

POSES = [(0.06, -0.05, 0.3), (0.0, 0.02, 0.9), (-0.06, -0.03, 1.5)]
"""In which the object rests; each rest is seen from another side."""


class Watched:
    """Perception of an object that rests in several poses and is moved between them in full view."""

    def __init__(self, camera_in_table, look, settings=None):
        self.perception, self._look, self._time = Perception(camera_in_table, settings), look, 0.0
        self.shapes, self.poses, self.ids, self.n = [], [], set(), 0

    def frame(self, pose, step=1 / 30):
        """The object at a pose in the next frame."""
        self._time += step
        self.n += 1
        seen = self.perception.observe(replace(self._look(np.asarray(pose)), stamp=self._time))
        if seen.new_shapes:
            self.first_pose = self.perception.first_pose("o1").copy()
        self.shapes += [*seen.new_shapes.values(), *seen.refined.values()]
        self.poses += [known.pose for known in seen.objects if known.status is TrackStatus.TRACKED]
        self.ids |= {*seen.new_shapes, *(known.object_id for known in seen.objects)}
        return seen

    def rest(self, pose, n=70, after=70):
        """Frames at rest, enough for a search after ten of them and for what a better outline takes, or `after` more than there is one."""
        frames = []
        while len(frames) < n and not any(frame.refined for frame in frames[: max(len(frames) - after, 0)]):
            frames.append(self.frame(pose))
        return frames

    def move(self, start, end, n=8):
        """Frames on the way."""
        start, end = np.asarray(start), np.asarray(end)
        return [self.frame(start + (end - start) * i / n) for i in range(1, n)]

    def rest_in_two(self, n=70, after=70):
        """The object rests in two poses; what the frames of the second rest gave."""
        self.rest(POSES[0], 20)
        self.move(*POSES[:2])
        return self.rest(POSES[1], n, after)

    def truth(self, outline):
        """A true outline in the frame of the first pose, in that of the object as it was traced."""
        return transform_points(compose(inverse(self.perception.first_pose("o1")), POSES[0]), outline)


def filmed_by(sensor, name, seed):
    """A thing before a sensor in two rests, and how far its first and its last outline are from the true form."""
    thing, unit, reported = make_object(name, seed), Sensor(sensor, seed), suitable_pose(sensor)
    camera, rng = unit.camera(thing, reported), np.random.default_rng(seed)
    look = cache(lambda *pose: unit.look(camera, np.array(pose), {}))
    watched = Watched(reported, lambda pose: DepthFrame(0.0, unit.read(look(*pose), rng), unit.intrinsics))
    frames = watched.rest_in_two(after=8)
    in_form = [form_error(shape.outline, watched.truth(thing.outline)) for shape in (watched.shapes[0], watched.shapes[-1])]
    return SimpleNamespace(watched=watched, refined=[bool(frame.refined) for frame in frames], in_form=in_form)


def form_error(outline, truth):
    """Deviation of an outline from the true one in form: neither in its position nor in size as a whole [m]."""
    points = dense(outline, 0.005)
    best = least_squares(lambda pose: signed_distance(transform_points(pose, points), truth), np.zeros(3), x_scale=[1e-3, 1e-3, 1e-2])
    return float(np.std(best.fun))


@pytest.fixture(scope="module")
def filmed():
    """A hammer before a Kinect in two rests."""
    return filmed_by("kinect_v1", "hammer", 30)


def test_a_rest_in_another_heading_shows_the_form_better(filmed):
    (first, last), watched = filmed.in_form, filmed.watched
    assert watched.ids == {"o1"} and len(watched.shapes) > 1 and last < 0.95 * first
    np.testing.assert_array_equal(watched.shapes[-1].cells.squares, watched.shapes[0].cells.squares)
    assert len(watched.shapes[-1].outline_std) == len(watched.shapes[-1].outline)


def test_a_better_outline_moves_neither_the_object_frame_nor_the_pose(filmed):
    assert filmed.refined.count(True) == 1
    poses, at = filmed.watched.poses[-len(filmed.refined) :], filmed.refined.index(True)
    step = np.mean(poses[at:], axis=0) - np.mean(poses[at - 8 : at], axis=0)
    assert np.all(np.abs(step) < [3e-4, 3e-4, 4e-3])  # 0.7 mm and 0.5 degrees in the frame of the first rest
    np.testing.assert_array_equal(filmed.watched.perception.first_pose("o1"), filmed.watched.first_pose)


def test_a_better_outline_keeps_the_errors_of_poses_that_last(filmed):
    """Poses were taken for those of a camera that displaces no edge, and were in their regions in 60 % of the frames."""
    perception = filmed.watched.perception
    refined, camera = perception.known("o1").traced, suitable_pose("kinect_v1")[None, :2, 3]
    assert refined.displaced_std > 0 and len(refined.camera_positions) == 2
    offset = compose(inverse(POSES[0]), perception.first_pose("o1"))
    for (position,), pose in zip(refined.camera_positions, POSES, strict=False):
        assert position == pytest.approx(transform_points(inverse(compose(pose, offset)), camera)[0], abs=0.01)
    assert np.hypot(*refined.displaced_frame[:2]) < 1.0 and np.any(refined.displaced_frame)
    assert np.all(np.linalg.eigvalsh(refined.frame_covariance) > 0) and np.sqrt(refined.frame_covariance[0, 0]) < 5e-4


IN_FULL = (pytest.param(*one, marks=pytest.mark.long) for one in (("plain", "hammer"), ("realsense_d435_848x480", "hammer")))


@pytest.mark.parametrize(("sensor", "name"), [("plain", "book"), *IN_FULL])
def test_a_good_outline_gets_no_worse(sensor, name):
    first, last = filmed_by(sensor, name, 30).in_form
    assert last < 1.1 * first + 2e-5


def hammer_frame(pose, rng, hidden=None, others=(), stamp=0.0):
    """Depth of the hammer; nothing is measured where `hidden` says so of positions in the object frame, shape (height, width)."""
    frame = render([*hammer(pose), *others], rng=rng, stamp=stamp)
    if hidden is None:
        return frame
    points = points_in_table(frame, CAMERA)
    in_object = transform_points(inverse(pose), points[..., :2].reshape(-1, 2)).reshape(*points.shape[:2], 2)
    return replace(frame, depth=np.where(hidden(in_object), np.float32(np.nan), frame.depth))


def end_of_handle(positions):
    return (positions[..., 0] > -0.125) & (positions[..., 0] < -0.085) & (np.abs(positions[..., 1]) < 0.02)


def ragged(settings=None):
    """The hammer before a camera that measures nothing at the end of its handle in the first rest."""
    rng = np.random.default_rng(0)
    return Watched(CAMERA, lambda pose: hammer_frame(pose, rng, end_of_handle if np.array_equal(pose, POSES[0]) else None), settings)


def test_a_part_that_lay_in_a_shadow_comes_back_over_several_frames_and_the_same_in_each_replay(monkeypatch):
    """Parts of the work are counted where they are done: at most one in a frame at 30 Hz, none where there is a search."""
    n_parts, step, seen = Counter(), Rests.step, []

    def counted(self):
        n_parts[watched.n] += self.is_refining
        step(self)

    monkeypatch.setattr(Rests, "step", counted)
    for after in (20, 0):
        watched = ragged()
        frames = watched.rest_in_two(after=after)
        (at,) = (i for i, frame in enumerate(frames) if frame.refined)
        assert at > 25 and max(n_parts.values()) == 1 and n_parts.total() > 15  # a search after ten frames, then many parts
        n_parts.clear()
        seen.append((at, watched.shapes[-1].outline))
    assert seen[0][0] == seen[1][0] and watched.ids == {"o1"}
    np.testing.assert_array_equal(seen[0][1], seen[1][1])
    assert polygon_area(watched.shapes[0].outline) < 0.95 * polygon_area(HAMMER_OUTLINE)
    assert polygon_area(seen[0][1]) == pytest.approx(polygon_area(HAMMER_OUTLINE), rel=0.02)
    assert np.max(np.abs(signed_distance(watched.truth(HAMMER_OUTLINE), seen[0][1]))) < 0.003


def test_a_slow_camera_does_several_parts_in_a_frame():
    watched = ragged(PerceptionSettings(rest_frames=4))
    for pose, n in ((POSES[0], 8), (np.mean(POSES[:2], axis=0), 1), (POSES[1], 15)):
        frames = [watched.frame(pose, step=0.25) for _ in range(n)]  # every frame is a search
    assert any(frame.refined for frame in frames)


def test_an_outline_that_is_ready_while_the_object_moves_is_taken_up_there():
    watched = ragged()
    watched.rest_in_two(n=20)
    moving = watched.move(POSES[1], POSES[2], 60)
    (at,) = (i for i, frame in enumerate(moving) if frame.refined)
    assert all(known.status is TrackStatus.TRACKED for frame in moving for known in frame.objects)
    steps = np.diff([frame.objects[0].pose for frame in moving], axis=0)
    assert np.allclose(steps[at - 1], np.median(steps, axis=0), atol=[6e-4, 6e-4, 6e-3])


def test_a_recording_that_ends_gives_what_its_last_rest_shows():
    watched = ragged()
    assert not any(frame.refined for frame in watched.rest_in_two(n=18))
    better = watched.perception.finish()
    assert polygon_area(better["o1"].outline) == pytest.approx(polygon_area(HAMMER_OUTLINE), rel=0.02)
    assert watched.perception.known("o1").traced.shape is better["o1"] and not watched.perception.finish()


def test_a_failure_of_any_kind_stays_with_its_object_and_is_reported_once(monkeypatch):
    def fails(*_, **__):
        yield
        raise ValueError("operands")

    monkeypatch.setattr("push_ident.perception.outline.rests.refine", fails)
    frames = ragged().rest_in_two(n=30)
    assert [frame.not_refined for frame in frames if frame.not_refined] == [{"o1": "ValueError: operands"}]
    assert all(known.status is TrackStatus.TRACKED for frame in frames for known in frame.objects)


def test_a_rest_is_wanted_in_a_new_pose_only_and_from_an_object_at_rest():
    rng = np.random.default_rng(0)
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=5))
    for i in range(5):
        frame = hammer_frame(POSES[0], rng, stamp=i / 30)
        perception.observe(frame)
    known, rests, objects = perception.known("o1"), Rests(), KnownObjects()
    name = objects.add(NewObject(known.traced, known.area, (), ""), 0.0)
    segment = Segment(slice(200, 260), slice(280, 380), np.ones((60, 100), dtype=bool), np.zeros(2), 0.007, None)
    rests.begin(name, [SegmentedView(FrameView(frame, CAMERA, noise=1e-3), segment)], known.pose)

    def wants(by, step=(0.0, 0.0, 0.0), traced=known.traced):
        for i in range(5):
            pose = known.pose + np.array(by) + i * np.asarray(step)
            rests.note(frame, {name: PoseFit(TrackStatus.TRACKED, pose, 1e-8 * np.eye(3), 1000, 1.0, 0.0)}, 5)
        objects[name].template = Template(traced)
        return bool(rests.resting(objects))

    moved = (0.03, 0.0, 0.0)
    assert not wants((0.0, 0.0, 0.0)) and not wants((0.01, 0.0, 0.05))
    assert wants(moved) and wants((0.0, 0.0, 0.2))
    assert not wants(moved, (6e-4, 0.0, 0.0))  # 18 mm/s
    assert not wants(moved, traced=replace(known.traced, hollow=np.ones(known.traced.top.shape, dtype=bool)))


def test_a_thing_that_touches_it_later_is_no_part_of_it():
    rng, beside = np.random.default_rng(0), Prism(rectangle(0.086, -0.04, 0.136, 0.04), 0.035)

    def look(pose):
        return hammer_frame(pose, rng, others=(beside.at(pose),) if np.array_equal(pose, POSES[1]) else ())

    watched = Watched(CAMERA, look, PerceptionSettings(rest_frames=5))
    watched.rest_in_two(n=50)
    outline = watched.perception.known("o1").traced.shape.outline
    assert polygon_area(outline) == pytest.approx(polygon_area(watched.shapes[0].outline), rel=0.01)


@pytest.mark.parametrize(
    ("length", "half_width", "is_kept"), [(0.2, 0.0145, True), (0.2, 0.0155, True), (0.15, 0.0155, False), (0.25, 0.0155, False)]
)
def test_cells_change_for_a_part_that_appears_or_is_none_and_not_for_an_edge_that_crosses_a_row(length, half_width, is_kept):
    """What is known belongs to the cells as they are; only their outer edges follow the outline."""
    cells, outline = cells_in_outline(rectangle(0.0, -0.0155, 0.2, 0.0155), 0.01), rectangle(0.0, -half_width, length, half_width)
    anew = cells_in_outline(outline, 0.01)
    kept = with_cells(ObjectShape(cells, outline)).cells
    np.testing.assert_array_equal(kept.squares, cells.squares if is_kept else anew.squares)
    assert kept.areas.sum() == pytest.approx(polygon_area(outline))


WITHIN_90 = 6.2514
"""Of chi squared with 3 degrees of freedom."""


@pytest.mark.parametrize("wrong", [{"position": -1e-3}, {"heading": np.nan}])
def test_an_accuracy_that_is_none_is_refused_by_name(wrong):
    with pytest.raises(InputError, match=f"{next(iter(wrong))} of the camera"):
        CameraAccuracy(**wrong)


def test_displaced_edges_widen_the_covariance_of_a_turned_object_along_one_direction():
    """Other edges hide their walls then, and a camera displaces all of them alike."""
    unit, reported, thing, rng = Sensor("ideal", 1), suitable_pose("ideal"), make_object("book", 1), np.random.default_rng(0)
    camera, first = unit.camera(thing, reported), np.array([0.0, 0.0, 0.2])

    def frame(seen, stamp):
        return DepthFrame(stamp, unit.read(seen, rng), unit.intrinsics)

    perception, seen = Perception(reported @ SENSORS["ideal"].extrinsics_error(1)), unit.look(camera, first, {})
    for i in range(10):
        perception.observe(frame(seen, i / 30))
    traced = perception.known("o1").traced
    for turn, least, most in ((0.0, 0.0, 1e-4), (1.5, 4e-4, 2e-3)):
        motion = np.array([0.0, 0.0, turn])
        view = FrameView(frame(unit.look(camera, first + motion, {}), 1.0), perception.camera_in_table)
        start = np.array([*transform_points(motion, traced.pose[None, :2])[0], traced.pose[2] + turn])
        wide, plain = (fit_pose(Template(replace(traced, displaced_std=std)), view, start) for std in (1e-3, 0.0))
        assert wide.status is plain.status is TrackStatus.TRACKED and np.allclose(wide.pose, plain.pose)
        more = np.linalg.eigvalsh(wide.covariance - plain.covariance)
        assert least <= np.sqrt(max(more[2], 0.0)) < most and abs(more[1]) < 1e-9


@pytest.mark.parametrize(
    ("sensor", "name"),
    [
        ("plain", "hammer"),
        *(pytest.param(name, "toolbox", marks=pytest.mark.long) for name in ("kinect_v1", "realsense_d435_640x480", "phoxi")),
    ],
)
def test_poses_of_a_turned_object_are_within_their_90_percent_regions(sensor, name):
    """Turned by 0.4 and by 0.8 rad: the errors are those of camera and outline."""
    thing, unit, reported = make_object(name, 101), Sensor(sensor, 101), suitable_pose(sensor)
    rng, camera, perception = np.random.default_rng(101), unit.camera(thing, reported), Perception(reported)
    first, offset, squares = np.array([0.02, -0.03, 0.3]), None, []
    for i, turn in enumerate((*np.zeros(12), *np.linspace(0.1, 0.4, 4), *np.full(4, 0.4), *np.linspace(0.5, 0.8, 4), *np.full(4, 0.8))):
        pose = np.add(first, (0.0, 0.0, turn))
        observed = perception.observe(DepthFrame(i / 30, unit.read(unit.look(camera, pose, {}), rng), unit.intrinsics))
        if observed.new_shapes:
            table = unit.table_as_seen(perception.camera_in_table, reported)
            offset = compose(inverse(compose(table, pose)), perception.first_pose("o1"))
        elif offset is not None and turn > 0.0:
            (known,) = observed.objects
            error = known.pose - compose(compose(table, pose), offset)
            error[2] = wrap_angle(error[2])
            squares.append(float(error @ np.linalg.solve(known.covariance, error)))
    assert np.mean(np.array(squares) < WITHIN_90) > 0.4  # books fare worse: decision 12


def test_frame_of_an_outline_of_several_rests_keeps_the_scatter_of_the_first_view():
    """Fits of one number: the edge of each view scatters by itself, and the frame follows the outline before."""
    rng, n_rests = np.random.default_rng(0), 4
    edge = rng.standard_normal((200000, n_rests + 1))
    frame, stated = np.zeros(len(edge)), np.zeros((3, 3))
    for n in range(2, n_rests + 1):
        frame += edge[:, :n].mean(axis=1) - edge[:, : n - 1].mean(axis=1)
        stated += frame_step((1.0 + 1.0 / (n - 1)) * np.eye(3), 0.7, n)
    assert stated == pytest.approx(np.var(frame) * np.eye(3), rel=0.02, abs=1e-12)
    pose = edge[:, n_rests] - edge[:, :n_rests].mean(axis=1) + frame
    assert np.var(pose) == pytest.approx(1.0 + 1.0 / n_rests + stated[0, 0], rel=0.02)


def test_covariance_of_the_object_frame_turns_with_the_object():
    along = np.diag([4.0, 1.0, 9.0])
    assert in_table(along, np.array([5.0, 5.0, np.pi / 2])) == pytest.approx(np.diag([1.0, 4.0, 9.0]))
    assert frame_step(in_table(along, np.array([0.0, 0.0, 0.4])), 0.4, 2) == pytest.approx(along / 4)
