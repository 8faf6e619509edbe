"""Outlines of known objects get better where they rest in other places and headings, and nothing else changes."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares

from helpers.depth_scene import CAMERA, HAMMER, HAMMER_OUTLINE, Prism, rectangle, render
from push_ident.errors import PerceptionError
from push_ident.geometry.outline import cells_in_outline, polygon_area, signed_distance
from push_ident.geometry.se2 import compose, inverse, transform_points
from push_ident.perception.frame.view import FrameView, points_in_table
from push_ident.perception.known_object import NewObject, PoseFit, Segment, SegmentedView, TrackStatus
from push_ident.perception.outline.rests import Rests, with_cells
from push_ident.perception.pipeline import Perception
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.tracking.tracker import KnownObjects
from push_ident.types import DepthFrame, ObjectShape
from push_ident_sim.cell.sensor_unit import Sensor
from push_ident_sim.cell.sensors import suitable_pose
from push_ident_sim.objects import make_object

PLACES = [(0.06, -0.05, 0.3), (0.0, 0.02, 0.9), (-0.06, -0.03, 1.5)]
"""Where the object rests; each rest is seen from another side."""


class Watched:
    """Perception of an object that rests in several places and is moved between them in full view."""

    def __init__(self, camera_in_table, look, settings=None):
        self.perception, self._look, self._time = Perception(camera_in_table, settings), look, 0.0
        self.shapes, self.poses, self.ids, self.n = [], [], set(), 0

    def frame(self, pose, step=1 / 30):
        """The object at a pose in the next frame."""
        self._time += step
        self.n += 1
        seen = self.perception.observe(replace(self._look(np.asarray(pose), len(self.shapes) > 1), stamp=self._time))
        new = [*seen.new_shapes.values(), *seen.refined.values()]
        poses = [known.pose for known in seen.objects if known.status is TrackStatus.TRACKED]
        self.ids |= {*seen.new_shapes, *(known.object_id for known in seen.objects)}
        self.shapes += new
        self.poses += poses
        return seen

    def rest(self, pose, n=70):
        """Some frames at rest, enough for a search after ten of them and for what a better outline takes."""
        return [self.frame(pose) for _ in range(n)]

    def move(self, start, end, n=8):
        """Frames on the way."""
        start, end = np.asarray(start), np.asarray(end)
        return [self.frame(start + (end - start) * i / n) for i in range(1, n)]

    def all_rests(self, places=PLACES):
        """The object rests in each place in turn."""
        self.rest(places[0])
        for start, end in pairwise(places):
            self.move(start, end)
            self.rest(end)
        return self


def watched_by(sensor, name, seed):
    thing, unit, reported = make_object(name, seed), Sensor(sensor, seed), suitable_pose(sensor)
    camera, rng = unit.camera(thing, reported), np.random.default_rng(seed)
    seen = {}

    def look(pose, _):
        key = tuple(pose)
        if key not in seen:
            seen.clear()
            seen[key] = unit.look(camera, pose, {})
        return DepthFrame(0.0, unit.read(seen[key], rng), unit.intrinsics)

    return Watched(reported, look), thing.outline


def in_form(outline, truth):
    """Deviation of an outline from the true one in form: neither in its place nor in size as a whole [m]."""
    along = np.linspace(0.0, 1.0, 8, endpoint=False)[:, None]
    points = np.concatenate([a + along * (b - a) for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True)])
    best = least_squares(lambda pose: signed_distance(transform_points(pose, points), truth), np.zeros(3), x_scale=[1e-3, 1e-3, 1e-2])
    return float(np.std(best.fun))


@pytest.mark.parametrize("sensor", ["kinect_v1", pytest.param("realsense_d435_848x480", marks=pytest.mark.long)])
def test_rests_in_other_headings_show_the_form_better(sensor):
    watched, truth = watched_by(sensor, "hammer", 30)
    watched.all_rests()
    assert watched.ids == {"o1"} and len(watched.shapes) > 1
    first, last = watched.shapes[0], watched.shapes[-1]
    truth = transform_points(compose(inverse(watched.perception.first_pose("o1")), PLACES[0]), truth)
    assert in_form(last.outline, truth) < 0.85 * in_form(first.outline, truth)
    np.testing.assert_array_equal(last.cells.centres, first.cells.centres)
    assert last.outline_std is not None and len(last.outline_std) == len(last.outline)


@pytest.fixture(scope="module")
def toolbox():
    """A toolbox watched by a Kinect in two places; its first pose and outline; whether each of the last 80 frames gave a better outline."""
    watched, _ = watched_by("kinect_v1", "toolbox", 31)
    watched.rest(PLACES[0])
    first_pose, first = watched.perception.first_pose("o1").copy(), watched.perception.known("o1").traced
    watched.move(PLACES[0], PLACES[1])
    refined = [bool(observation.refined) for observation in watched.rest(PLACES[1], 80)]
    return SimpleNamespace(watched=watched, first_pose=first_pose, first=first, refined=refined)


def test_a_better_outline_moves_neither_the_object_frame_nor_the_pose(toolbox):
    assert toolbox.refined.count(True) == 1
    poses, refined = toolbox.watched.poses[-80:], toolbox.refined
    at = refined.index(True)
    step = np.mean(poses[at:], axis=0) - np.mean(poses[at - 8 : at], axis=0)
    assert np.all(np.abs(step) < [3e-4, 3e-4, 4e-3])  # 0.7 mm and 0.5 degrees in the frame of the first rest
    np.testing.assert_array_equal(toolbox.watched.perception.first_pose("o1"), toolbox.first_pose)


def test_a_better_outline_keeps_the_errors_of_poses_that_last(toolbox):
    """Poses were taken for those of a camera that displaces no edge, and were in their regions in 60 % of the frames."""
    watched, first = toolbox.watched, toolbox.first
    assert first.displaced_frame == (0.0, 0.0, 0.0) and not first.frame_covariance.any()
    refined = watched.perception.known("o1").traced
    assert refined.displaced_std == first.displaced_std > 0 and len(refined.camera_positions) == 2
    camera, offset = suitable_pose("kinect_v1")[None, :2, 3], compose(inverse(PLACES[0]), watched.perception.first_pose("o1"))
    for (place,), pose in zip(refined.camera_positions, PLACES, strict=False):
        assert place == pytest.approx(transform_points(inverse(compose(pose, offset)), camera)[0], abs=0.01)
    assert np.hypot(*refined.displaced_frame[:2]) < 1.0 and np.any(refined.displaced_frame)
    assert np.all(np.linalg.eigvalsh(refined.frame_covariance) > 0) and np.sqrt(refined.frame_covariance[0, 0]) < 5e-4


@pytest.mark.parametrize("name", ["book", "hammer"])
def test_a_good_outline_gets_no_worse(name):
    watched, truth = watched_by("plain", name, 30)
    watched.all_rests()
    truth = transform_points(compose(inverse(watched.perception.first_pose("o1")), PLACES[0]), truth)
    assert in_form(watched.shapes[-1].outline, truth) < 1.1 * in_form(watched.shapes[0].outline, truth) + 2e-5


def rests_of(watched, n=70):
    """The object rests in a second place for `n` frames; what each of them gave."""
    watched.rest(PLACES[0], 20)
    watched.move(PLACES[0], PLACES[1])
    return watched.rest(PLACES[1], n)


def ragged_hammer(rng):
    """The hammer as a camera sees it that measures nothing at the end of its handle in the first place."""
    return lambda pose, _: hammer_frame(pose, rng, end_of_handle if np.array_equal(pose, PLACES[0]) else None)


def test_what_a_better_outline_takes_is_spread_over_frames_and_is_the_same_in_each_replay(monkeypatch):
    """Parts are counted where they are done: at most one in a frame at 30 Hz, none where there is a search."""
    n_parts, step, seen = Counter(), Rests.step, []

    def counted(self):
        n_parts[watched.n] += self.is_refining
        step(self)

    monkeypatch.setattr(Rests, "step", counted)
    for _ in range(2):
        watched = Watched(CAMERA, ragged_hammer(np.random.default_rng(0)))
        frames = rests_of(watched)
        at = [i for i, frame in enumerate(frames) if frame.refined]
        assert len(at) == 1 and at[0] > 25  # a search after ten frames at rest, then many parts
        seen.append((at, frames[at[0]].refined["o1"].outline))
        assert max(n_parts.values()) == 1 and n_parts.total() > 15
        n_parts.clear()
    assert seen[0][0] == seen[1][0]
    np.testing.assert_array_equal(seen[0][1], seen[1][1])


def test_a_slow_camera_does_several_parts_in_a_frame():
    watched = Watched(CAMERA, ragged_hammer(np.random.default_rng(0)), PerceptionSettings(rest_frames=4))
    for pose in (PLACES[0], PLACES[1]):
        frames = [watched.frame(pose, step=0.25) for _ in range(20)]  # every frame is a search
        watched.frame(np.mean(PLACES[:2], axis=0), step=0.25) if pose is PLACES[0] else None
    assert any(frame.refined for frame in frames)


def test_an_outline_that_is_ready_while_the_object_moves_is_taken_up_there():
    watched = Watched(CAMERA, ragged_hammer(np.random.default_rng(0)))
    rests_of(watched, 20)
    moving = watched.move(PLACES[1], PLACES[2], 60)
    (at,) = (i for i, frame in enumerate(moving) if frame.refined)
    assert all(known.status is TrackStatus.TRACKED for frame in moving for known in frame.objects)
    steps = np.diff([frame.objects[0].pose for frame in moving], axis=0)
    assert np.allclose(steps[at - 1], np.median(steps, axis=0), atol=[6e-4, 6e-4, 6e-3])


def test_a_recording_that_ends_gives_what_its_last_rest_shows():
    watched = Watched(CAMERA, ragged_hammer(np.random.default_rng(0)))
    assert not any(frame.refined for frame in rests_of(watched, 18))
    better = watched.perception.finish()
    assert polygon_area(better["o1"].outline) == pytest.approx(polygon_area(HAMMER_OUTLINE), rel=0.02)
    assert watched.perception.known("o1").traced.shape is better["o1"]
    assert not watched.perception.finish()


@pytest.mark.parametrize("error", [PerceptionError("No outline can be traced."), ValueError("operands")])
def test_a_failure_stays_with_its_object_and_is_said_once(monkeypatch, error):
    def fails(*_, **__):
        yield
        raise error

    monkeypatch.setattr("push_ident.perception.outline.rests.refine", fails)
    frames = rests_of(Watched(CAMERA, ragged_hammer(np.random.default_rng(0))), 30)
    said = [frame.not_refined for frame in frames if frame.not_refined]
    expected = str(error) if isinstance(error, PerceptionError) else f"ValueError: {error}"
    assert said == [{"o1": expected}]
    assert all(known.status is TrackStatus.TRACKED for frame in frames for known in frame.objects)


def test_a_rest_is_wanted_in_a_new_place_and_heading_only_and_from_an_object_at_rest():
    rng = np.random.default_rng(0)
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=5))
    for i in range(5):
        perception.observe(hammer_frame(np.asarray(PLACES[0]), rng, stamp=i / 30))
    known = perception.known("o1")
    rests, objects = Rests(), KnownObjects()
    frame = hammer_frame(np.asarray(PLACES[0]), rng)
    name = objects.add(NewObject(known.traced, known.area, (), ""), 0.0)
    rests.begin(name, [SegmentedView(FrameView(frame, CAMERA, noise=1e-3), whole_segment())], known.pose)

    def wants(pose, step=(0.0, 0.0, 0.0), traced=known.traced):
        for i in range(5):
            fit = PoseFit(TrackStatus.TRACKED, np.asarray(pose) + i * np.asarray(step), 1e-8 * np.eye(3), 1000, 1.0, 0.0)
            rests.note(frame, {name: fit}, 5)
        objects[name].traced = traced
        return bool(rests.resting(objects))

    near, moved, turned = (known.pose + np.array(by) for by in ([0.01, 0.0, 0.05], [0.03, 0.0, 0.0], [0.0, 0.0, 0.2]))
    assert not wants(known.pose) and not wants(near)
    assert wants(moved) and wants(turned)
    assert not wants(moved, (6e-4, 0.0, 0.0))  # 18 mm/s
    hollow = np.ones(known.traced.top.shape, dtype=bool)
    assert not wants(moved, traced=replace(known.traced, hollow=hollow))


def whole_segment():
    return Segment(slice(200, 260), slice(280, 380), np.ones((60, 100), dtype=bool), np.zeros(2), 0.007, None)


def hammer_frame(pose, rng, hidden=None, others=(), stamp=0.0):
    """Depth of the hammer; nothing is measured where `hidden` says so of places in the object frame, shape (height, width)."""
    frame = render([*(prism.at(pose) for prism in HAMMER), *others], rng=rng, stamp=stamp)
    if hidden is None:
        return frame
    points = points_in_table(frame, CAMERA)
    in_object = transform_points(inverse(pose), points[..., :2].reshape(-1, 2)).reshape(*points.shape[:2], 2)
    return replace(frame, depth=np.where(hidden(in_object), np.float32(np.nan), frame.depth))


def end_of_handle(places):
    return (places[..., 0] > -0.125) & (places[..., 0] < -0.085) & (np.abs(places[..., 1]) < 0.02)


def test_a_part_that_lay_in_a_shadow_comes_back():
    rng = np.random.default_rng(0)

    watched = Watched(CAMERA, ragged_hammer(rng))
    watched.rest(PLACES[0])
    assert polygon_area(watched.shapes[0].outline) < 0.95 * polygon_area(HAMMER_OUTLINE)
    watched.move(PLACES[0], PLACES[1])
    watched.rest(PLACES[1])
    assert watched.ids == {"o1"}
    assert polygon_area(watched.shapes[-1].outline) == pytest.approx(polygon_area(HAMMER_OUTLINE), rel=0.02)
    truth = transform_points(compose(inverse(watched.perception.first_pose("o1")), PLACES[0]), HAMMER_OUTLINE)
    assert np.max(np.abs(signed_distance(truth, watched.shapes[-1].outline))) < 0.003


def test_a_thing_that_touches_it_later_is_no_part_of_it():
    rng = np.random.default_rng(0)
    beside = Prism(rectangle(0.086, -0.04, 0.136, 0.04), 0.035)

    def look(pose, _):
        alone = not np.array_equal(pose, PLACES[1])
        return hammer_frame(pose, rng, others=() if alone else (beside.at(pose),))

    watched = Watched(CAMERA, look, PerceptionSettings(rest_frames=5))
    watched.rest(PLACES[0])
    area = polygon_area(watched.shapes[0].outline)
    watched.move(PLACES[0], PLACES[1])
    watched.rest(PLACES[1])
    assert polygon_area(watched.perception.known("o1").traced.shape.outline) == pytest.approx(area, rel=0.01)


def bar(length, half_width):
    return np.array([(0.0, -half_width), (length, -half_width), (length, half_width), (0.0, half_width)])


def test_an_edge_that_moves_across_a_row_of_centres_changes_no_cells():
    """Half of the rows of a narrow handle may hang on a millimetre; what is known belongs to the cells as they are."""
    cells = cells_in_outline(bar(0.2, 0.0155), 0.01)
    for half_width in (0.0145, 0.0155):
        assert len(cells_in_outline(bar(0.2, half_width), 0.01)) == (40 if half_width < 0.015 else 80)
        kept = with_cells(ObjectShape(cells, bar(0.2, half_width)))
        np.testing.assert_array_equal(kept.cells.centres, cells.centres)


@pytest.mark.parametrize("length", [0.15, 0.25])
def test_a_part_that_appears_or_is_none_changes_the_cells(length):
    shape = ObjectShape(cells_in_outline(bar(0.2, 0.0155), 0.01), bar(length, 0.0155))
    np.testing.assert_array_equal(with_cells(shape).cells.centres, cells_in_outline(shape.outline, 0.01).centres)
