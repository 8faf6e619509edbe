"""What is one object and what is none: things that touch, that stand on each other, hollow ones; where contact may be elsewhere."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from helpers.depth_scene import CAMERA, INTRINSICS, Prism, box, circle, hammer, hollow, rectangle, render
from push_ident.errors import InputError, PerceptionError
from push_ident.geometry.outline import polygon_area, signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.perception.frame.robot import Cylinder
from push_ident.perception.frame.table import fit_table
from push_ident.perception.frame.view import OBJECT, FrameView, points_in_table
from push_ident.perception.known_object import Template, TrackStatus
from push_ident.perception.pipeline import Perception
from push_ident.perception.recording import observe_offline
from push_ident.perception.refusals import Reason
from push_ident.perception.search import search
from push_ident.perception.search.hollows import cover_hollows
from push_ident.perception.search.segments import find_segments
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.tracking.pose_fit import UpperSide, contradictions
from push_ident.survey.survey import survey_frames
from push_ident.types import CameraIntrinsics, DepthFrame

POSE = np.array([0.03, -0.02, 0.4])
BOX = rectangle(-0.06, -0.04, 0.06, 0.04)
MUG = hollow(circle(0.06, 48), circle(0.056, 48), 0.08)
REST = 3
SETTINGS = PerceptionSettings(rest_frames=REST)


def observe(prisms, n=REST, *, settings=SETTINGS, robot=(), change=lambda depth: None, perception=None, begin=0.0, rng=3):
    """The last of n observations of a scene, its depth changed in place by `change`, what was taken in, and with which doubts."""
    rng = None if rng is None else np.random.default_rng(rng)
    perception, shapes, doubts = perception or Perception(CAMERA, settings), {}, []
    for i in range(n):
        frame = render(prisms, rng=rng, stamp=begin + 0.3 * i)
        depth = frame.depth.copy()
        change(depth)
        observation = perception.observe(DepthFrame(frame.stamp, depth, INTRINSICS), robot)
        shapes |= observation.new_shapes
        doubts += observation.doubts.values()
    return observation, shapes, doubts


def beside_the_middle(points, opening):
    """Which points, shape (..., 2 or 3), are seen from the origin across the view of the camera, within `opening` [rad] on each side."""
    ahead = CAMERA[:2, 3] / np.linalg.norm(CAMERA[:2, 3])
    return np.abs(points[..., :2] @ ahead) < np.tan(opening / 2.0) * np.abs(points[..., :2] @ (-ahead[1], ahead[0]))


def of(reason, observation):
    return [refusal for refusal in observation.refused if refusal.reason is reason]


def test_each_refusal_says_why_and_where():
    at_border = Prism(rectangle(-0.02, 0.37, 0.06, 0.43), 0.04)
    rod = Prism(np.add(circle(0.02), (0.1, 0.19)), 0.3)
    beside = Prism(rectangle(0.05, 0.1, 0.13, 0.17), 0.05)
    grain = Prism(rectangle(-0.15, -0.2, -0.137, -0.187), 0.03)
    observation, shapes, _ = observe([*hammer(POSE), at_border, rod, beside, grain], robot=(Cylinder(0.1, 0.19, 0.02),))
    assert list(shapes) == ["o1"]
    assert {refusal.reason for refusal in observation.refused} == {Reason.AT_WORKSPACE_BORDER, Reason.BESIDE_ROBOT, Reason.TOO_SMALL}
    for reason, place, height in ((Reason.AT_WORKSPACE_BORDER, (0.02, 0.385), 0.04), (Reason.BESIDE_ROBOT, (0.09, 0.135), 0.05)):
        (refusal,) = of(reason, observation)
        assert np.linalg.norm(refusal.outline.mean(axis=0) - place) < 0.02
        assert refusal.height == pytest.approx(height, abs=0.006) and refusal.why == reason.value
    assert "enlarge workspace_low" in observation.why_no_pose() and observation.counts["at_workspace_border"] == 1


def test_a_narrow_halo_does_not_matter_and_a_wide_unmeasured_area_is_named():
    square = Prism(rectangle(-0.05, -0.04, 0.05, 0.04), 0.05)
    body = render([square]).depth < render([]).depth - 0.001

    def without(margin):
        """Nothing is measured within `margin` pixels of the box."""
        around = cv2.dilate(body.astype(np.uint8), np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)) > 0
        return lambda depth: np.putmask(depth, around & ~body, np.nan)

    assert list(observe([square], change=without(9))[1]) == ["o1"]
    observation, shapes, _ = observe([square], change=without(70))
    assert not shapes and of(Reason.BESIDE_UNMEASURED, observation)


def test_a_segment_without_a_shape_leaves_the_others_and_is_tried_less_and_less_often(monkeypatch):
    tried, original = [], search.trace_object

    def fails_for_the_box(views, **settings):
        if views[0].segment.centre[0] < -0.05:
            tried.append(views[0].view.frame.stamp)
            raise InputError("two corners are the same")
        return original(views, **settings)

    monkeypatch.setattr(search, "trace_object", fails_for_the_box)
    scene = [*hammer(POSE), Prism(rectangle(-0.2, 0.1, -0.1, 0.18), 0.05)]
    perception = Perception(CAMERA, replace(SETTINGS, search_period=0.0))
    observation, shapes, _ = observe(scene, perception=perception)
    (refusal,) = of(Reason.NO_SHAPE, observation)
    assert list(shapes) == ["o1"] and "two corners are the same" in refusal.why
    observation, _, _ = observe(scene, 20, perception=perception, begin=10.0)
    assert of(Reason.NO_SHAPE, observation) and np.allclose(np.diff(tried)[1:], 0.3 * 2 * REST * 2, atol=0.31), tried
    monkeypatch.undo()
    assert list(observe(scene, 30, perception=perception, begin=20.0)[1]) == ["o2"]


def test_an_outline_that_does_not_cover_its_segment_is_refused(monkeypatch):
    monkeypatch.setattr(search, "fuse_views", lambda traced, views: replace(traced, pose=np.add(traced.pose, (0.06, 0.0, 0.0))))
    observation, shapes, _ = observe([Prism(BOX, 0.05)])
    assert not shapes and "covers" in of(Reason.NO_SHAPE, observation)[0].why


@pytest.mark.parametrize("change", [(0.0, 0.0, np.pi / 2), (0.0, 0.03, 0.0)])
def test_an_outline_that_its_own_frames_do_not_fit_is_refused(change, monkeypatch):
    """Else the object is lost in the next frame, and perhaps found where it is not."""
    monkeypatch.setattr(search, "fuse_views", lambda traced, views: replace(traced, pose=np.add(traced.pose, change)))
    for check in ("check_covered", "check_seen"):
        monkeypatch.setattr(search, check, lambda *_: None)
    observation, shapes, _ = observe([Prism(BOX, 0.05)])
    assert not shapes and "do not fit the outline" in of(Reason.NO_SHAPE, observation)[0].why


def test_a_thing_that_would_be_given_up_in_the_next_frame_is_no_object(monkeypatch):
    monkeypatch.setattr(search, "compare_upper_side", lambda *_: UpperSide(5e-4, 0.03, 0.0, 0.0))
    observation, shapes, _ = observe([Prism(BOX, 0.05)])
    assert not shapes and "5 cm^2 within its outline are lower" in of(Reason.NO_SHAPE, observation)[0].why


def test_a_thing_seen_on_both_sides_of_what_hides_its_middle_is_behind_it():
    """Nothing is measured in the shadow beside the nearer one, so that the parts do not touch it in the image."""
    nearer = Prism(rectangle(0.0, -0.02, 0.04, 0.02), 0.25)
    column = render([nearer]).depth < render([]).depth - 0.001
    beside = cv2.dilate(column.astype(np.uint8), np.ones((1, 25), np.uint8)) > 0
    scene = [nearer, Prism(rectangle(-0.1, -0.12, -0.03, 0.12), 0.05)]
    observation, shapes, _ = observe(scene, change=lambda depth: np.putmask(depth, beside & ~column, np.nan))
    assert len(of(Reason.BEHIND_ANOTHER, observation)) == 2 and len(shapes) == 1


def test_a_thing_whose_foot_stands_on_another_one_is_stacked_though_table_is_around_most_of_it():
    lower, upper = box(0.03, 0.0, 0.2, 0.13, 0.06), box(-0.03, 0.0, 0.05, 0.12, 0.12, bottom=0.06)
    observation, shapes, _ = observe([lower, upper])
    assert not shapes and of(Reason.STACKED, observation)[0].height == pytest.approx(0.18, abs=0.006)


def test_a_slab_on_another_thing_is_stacked_though_the_table_is_seen_below_its_border():
    support, slab = box(-0.08, 0.1, 0.06, 0.06, 0.06), box(0.0, 0.0, 0.16, 0.22, 0.04, bottom=0.06)
    observation, shapes, _ = observe([support, slab])
    assert not shapes and [refusal.height for refusal in of(Reason.STACKED, observation)] == pytest.approx([0.1], abs=0.006)


@pytest.mark.parametrize("turn", [0.0, np.pi / 2, -np.pi / 2])
def test_boxes_side_by_side_whose_fronts_are_in_one_plane_are_not_one_thing(turn):
    pair = [Prism(rectangle(-0.05, -0.1, 0.05, 0.0), 0.06), Prism(rectangle(-0.05, 0.0, 0.05, 0.1), 0.10)]
    observation, shapes, _ = observe([prism.at((0.0, 0.0, turn)) for prism in pair])
    assert all(polygon_area(shape.outline) == pytest.approx(0.01, rel=0.1) for shape in shapes.values())
    # Lines of sight that the higher box stops do not show where the lower one ends in front of it.
    assert bool(shapes) == (turn < 1.0) and len(shapes) + len(observation.refused) == 2


def test_points_under_the_table_and_a_rough_table_are_named():
    points = points_in_table(render([], rng=np.random.default_rng(0)), CAMERA)
    bin_floor, rough = points.copy(), points.copy()  # the rim of a bin lies at the height of the table
    bin_floor[(np.abs(points[..., 0]) < 0.2) & (np.abs(points[..., 1]) < 0.2), 2] -= 0.03
    rough[..., 2] += np.random.default_rng(1).normal(scale=0.009, size=points.shape[:2]).astype(np.float32)
    for wrong, why in ((bin_floor, "under the table"), (rough, "deviate by|agree on a plane")):
        with pytest.raises(PerceptionError, match=why):
            fit_table(wrong, PerceptionSettings())


def over_the_floor(prisms, rng):
    """Depth of prisms on a table of 50 x 40 cm that stands 70 cm above a floor, of which more is in view."""
    lower = CAMERA.copy()
    lower[2, 3] += 0.7
    table = Prism(rectangle(-0.25, -0.2, 0.25, 0.2), 0.7)
    raised = [Prism(prism.polygon, prism.top + 0.7, prism.bottom + 0.7) for prism in prisms]
    return [render([table, *raised], lower, rng=rng, stamp=i / 30) for i in range(12)]


@pytest.mark.parametrize("rng", [np.random.default_rng(4), None], ids=["noise", "no noise"])
def test_a_floor_beside_the_table_is_no_reflection_and_no_table(rng):
    frames, perception = over_the_floor([Prism(BOX, 0.05)], rng), Perception(CAMERA, PerceptionSettings(rest_frames=3))
    new = [name for frame in frames for name in perception.observe(frame).new_shapes]
    survey = survey_frames(frames)
    assert new == ["o1"] and [thing.height for thing in survey.objects] == pytest.approx([0.05], abs=0.004)
    assert np.subtract(survey.settings.workspace_high, survey.settings.workspace_low) == pytest.approx((0.4, 0.5), abs=0.02)


@pytest.mark.parametrize(
    ("frame", "tilt", "why"),
    [
        (render([Prism(BOX, 0.05)]), 0.26, "tilted by 0.2.. rad .* calibrate the camera"),
        (replace(render([Prism(BOX, 0.05)]), depth=1e3 * render([Prism(BOX, 0.05)]).depth), 0.0, "1000.0 times too large.*16UC1"),
    ],
    ids=["a camera that hangs otherwise", "millimetres taken for metres"],
)
def test_why_no_table_is_found_is_the_cause(frame, tilt, why):
    turned = CAMERA.copy()
    turned[:3, :3] = [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]] @ CAMERA[:3, :3]
    with pytest.raises(PerceptionError, match=why):
        Perception(turned, PerceptionSettings()).observe(frame)


def test_an_image_too_coarse_for_an_object_is_named():
    coarse = CameraIntrinsics(80, 60, 65.6, 65.6, 39.5, 29.5)
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=1, search_period=0.0))
    for i in range(4):
        seen = perception.observe(render([Prism(BOX, 0.05)], stamp=i / 30, intrinsics=coarse))
    assert not seen.objects and "use a finer image" in seen.why_no_pose()


def test_the_least_height_of_an_object_follows_the_noise():
    plate = [Prism(BOX, 0.0045).at(POSE)]
    assert list(observe(plate, rng=None)[1]) == ["o1"] and not observe(plate)[1]


@pytest.mark.parametrize(
    ("prisms", "lowest", "doubt"),
    [
        (hammer(POSE), 0.012, ""),
        ([Prism(BOX, 0.25)], 0.012, ""),  # higher than the tool, and no robot
        ([Prism(circle(0.03), 0.02), Prism(circle(0.05), 0.07, 0.05)], 0.012, ""),  # a mushroom whose cap the tool meets
        ([Prism(BOX, 0.010)], 0.006, ""),
        ([Prism(BOX, 0.010)], 0.012, "mm high"),
        ([Prism(BOX, 0.010), Prism(0.6 * BOX, 0.025)], 0.012, "of its edge is lower"),
        ([Prism(circle(0.015), 0.10), Prism(circle(0.05), 0.12, 0.10)], 0.012, "no side below it"),
    ],
)
def test_an_object_that_the_tool_may_not_touch_where_its_outline_is_has_a_doubt(prisms, lowest, doubt):
    _, shapes, doubts = observe(prisms, 4, settings=replace(SETTINGS, min_object_height=0.004, tool_reach=(lowest, 0.092)), rng=0)
    assert shapes and len(doubts) == bool(doubt) and all(doubt in one for one in doubts)


STEP = 0.006
"""Travel between two frames [m]."""


class Watched:
    """Perception of a scene that changes; every frame is searched."""

    def __init__(self) -> None:
        self.perception = Perception(CAMERA, PerceptionSettings(rest_frames=REST, search_period=0.0, occupancy_period=1e9))
        self.rng, self.n = np.random.default_rng(4), 0
        self.areas: dict[str, float] = {}
        self.poses: dict[str, list[np.ndarray]] = {}
        self.removed: dict[str, Reason] = {}

    def see(self, prisms, n=1):
        for _ in range(n):
            self.seen = self.perception.observe(render(prisms, rng=self.rng, stamp=0.1 * self.n))
            self.n += 1
            self.areas |= {name: abs(polygon_area(shape.outline)) * 1e4 for name, shape in self.seen.new_shapes.items()}
            self.removed |= {removal.object_id: removal.reason for removal in self.seen.removed}
            for known in self.seen.objects:
                if known.pose is not None:
                    self.poses.setdefault(known.object_id, []).append(known.pose)
        return self

    def push(self, scene, travel):
        """Let `scene(x)` move from x = 0 to `travel` [m]."""
        for x in np.arange(STEP, travel, STEP):
            self.see(scene(x))
        return self.see(scene(travel))

    @property
    def tracked(self):
        return sorted(known.object_id for known in self.seen.objects if known.status is TrackStatus.TRACKED)

    @property
    def reasons(self):
        return [refusal.reason for refusal in self.seen.refused]


def apart(x, along=0.0):
    """Two equal boxes that touch at x = 0."""
    return [box(0, -0.03, 0.08, 0.06, 0.05), box(along, 0.03 + x, 0.08, 0.06, 0.05)]


def slid(x, away=0.0):
    """A small box that slides along a large one."""
    return [box(0, 0, 0.15, 0.10, 0.05), box(x, 0.065 + away, 0.03, 0.03, 0.05)]


def test_touching_boxes_that_come_apart_are_given_up_and_become_two_new_objects():
    watched = Watched().see(apart(0.0), REST + 1)
    assert watched.areas == {"o1": pytest.approx(96, rel=0.03)} and watched.tracked == ["o1"]
    watched.push(apart, 0.05).see(apart(0.05), REST + 2)
    assert watched.removed == {"o1": Reason.TOUCHING} and watched.tracked == ["o2", "o3"]
    assert [watched.areas[name] for name in ("o2", "o3")] == pytest.approx([48, 48], rel=0.08)


def test_boxes_that_slide_along_each_other_are_refused_until_they_are_apart():
    watched = Watched().see(slid(0.0), REST + 1)
    assert watched.tracked == ["o1"]
    watched.push(slid, 0.042).see(slid(0.042), 2 * REST)
    assert watched.reasons == [Reason.TOUCHING] and watched.removed == {"o1": Reason.TOUCHING} and not watched.seen.objects
    # The last pose before it was noticed is off by less than half of what the parts moved against each other.
    assert np.linalg.norm(watched.poses["o1"][-1][:2] - watched.poses["o1"][0][:2]) < 0.012
    watched.push(lambda x: slid(0.042, x), 0.04).see(slid(0.042, 0.04), REST + 2)
    assert watched.tracked == ["o2", "o3"] and watched.reasons == []


def test_what_is_left_where_a_part_was_taken_away_is_a_new_object():
    large, small = slid(0.0)
    watched = Watched().see([large, small], REST + 1).see([large], 2 * REST)
    assert watched.removed == {"o1": Reason.TOUCHING}
    assert watched.tracked == ["o2"] and watched.areas["o2"] == pytest.approx(150, rel=0.03)


def test_known_objects_in_contact_stay_what_they_are():
    def scene(x):
        pushed = [box(-0.06, 0.03 + max(0.0, x - 0.06), 0.08, 0.06, 0.05), box(-0.06, -0.09 + x, 0.08, 0.06, 0.05)]
        return pushed + [box(0.06, y, 0.08, 0.05, 0.05) for y in (-0.08 + min(x, 0.03), 0.0, 0.08 - min(x, 0.03))]

    watched = Watched().see(scene(0.0), REST + 1).push(scene, 0.09).see(scene(0.09), 2 * REST)
    assert watched.tracked == sorted(watched.areas) == ["o1", "o2", "o3", "o4", "o5"] and not watched.removed and watched.reasons == []
    travels = sorted(abs(float(poses[-1][1] - poses[0][1])) for poses in watched.poses.values())
    assert travels == pytest.approx([0.0, 0.03, 0.03, 0.03, 0.09], abs=0.001)


def test_a_new_thing_that_touches_a_known_one_is_refused_until_they_are_apart():
    known, new = box(0, 0, 0.06, 0.06, 0.05), box(0, 0.08, 0.10, 0.10, 0.05)
    watched = Watched().see([known], REST + 1).see([known, new], 3 * REST)
    assert list(watched.areas) == ["o1"] and not watched.removed and watched.reasons == [Reason.TOUCHES_KNOWN]
    assert watched.see([known, new.at((0.0, 0.05, 0.0))], REST + 2).tracked == ["o1", "o2"]


def test_offline_an_object_that_came_apart_is_none():
    travel, settings = [0.0] * 4 + [0.01, 0.02, 0.03, 0.04] + [0.05] * 7, PerceptionSettings(rest_frames=REST)

    def tracks(scene):
        rng = np.random.default_rng(5)
        frames = [render(scene(x), rng=rng, stamp=0.3 * i) for i, x in enumerate(travel)]
        return sorted(observe_offline(frames, CAMERA, settings=settings))

    assert tracks(apart) == ["o2", "o3"]
    with pytest.raises(PerceptionError, match="object o1 is several things that touch"):  # in the end as well
        tracks(lambda x: apart(0.0, 0.8 * x))


@pytest.mark.parametrize("height", [0.015, 0.04])
def test_a_thing_on_another_one_is_refused_at_the_latest_when_it_slides(height):
    def scene(x):
        return [box(0, 0, 0.15, 0.10, 0.03), box(-0.02 + x, 0, 0.06, 0.06, height, bottom=0.03)]

    watched = Watched().see(scene(0.0), REST + 1)
    assert bool(watched.areas) == (height < 0.02)  # Lower than `min_step`, it cannot be told from a thing with a step.
    watched.push(scene, 0.024).see(scene(0.024), 2 * REST)
    assert Reason.STACKED in watched.reasons and not watched.tracked
    assert watched.removed == ({"o1": Reason.STACKED} if height < 0.02 else {})
    watched.see([box(0, 0, 0.15, 0.10, 0.03), box(0.004, 0.15, 0.06, 0.06, height)], REST + 2)
    assert len(watched.tracked) == 2 and not watched.reasons


@pytest.mark.parametrize(
    ("outer", "inner", "top", "floor"),
    [
        (circle(0.04, 16), circle(0.036, 16), 0.09, 0.004),
        (rectangle(-0.08, -0.05, 0.08, 0.05), rectangle(-0.076, -0.046, 0.076, 0.046), 0.06, 0.004),
        (circle(0.05, 16), circle(0.038, 16), 0.03, 0.0),
    ],
    ids=["mug", "box without a lid", "roll of tape"],
)
def test_a_hollow_thing_is_one_object_with_the_outline_of_its_rim(outer, inner, top, floor):
    def scene(x):
        return [prism.at((x, 0.5 * x, 0.3 + x)) for prism in hollow(outer, inner, top, floor)]

    watched = Watched().see(scene(0.0), REST)
    (shape,) = watched.seen.new_shapes.values()
    outline, truth = shape.outline + watched.perception.first_pose("o1")[:2], transform_points((0.0, 0.0, 0.3), outer)
    assert polygon_area(outline) == pytest.approx(polygon_area(truth), rel=0.03)
    assert np.max(np.abs(signed_distance(outline, truth))) < 0.004
    watched.push(scene, 0.03).see(scene(0.03), 2)
    assert list(watched.areas) == ["o1"] and not watched.removed
    assert np.linalg.norm((watched.poses["o1"][-1] - watched.perception.first_pose("o1"))[:2] - (0.03, 0.015)) < 0.002


def test_things_around_a_lower_one_are_no_rim():
    walls = [box(-0.09, 0, 0.04, 0.20, 0.06), box(0, 0.11, 0.10, 0.04, 0.06), box(0, -0.11, 0.10, 0.04, 0.06)]
    assert all(area < 100 for area in Watched().see([*walls, box(0, 0, 0.06, 0.06, 0.02)], REST).areas.values())


def test_a_round_rim_may_be_torn_where_it_runs_along_the_line_of_sight():
    def tear(depth):
        at = points_in_table(DepthFrame(0.0, depth, INTRINSICS), CAMERA)
        depth[beside_the_middle(at, 0.6) & (at[..., 2] > 0.06)] = np.nan

    _, shapes, _ = observe(MUG, change=tear)
    assert [polygon_area(shape.outline) for shape in shapes.values()] == [pytest.approx(np.pi * 0.06**2, rel=0.05)]


def test_a_hook_has_no_rim():
    hook = [wall for wall in MUG[1:] if not beside_the_middle(wall.polygon.mean(axis=0), 2.2) or wall.polygon[0, 1] < 0]
    view = FrameView(render(hook, rng=np.random.default_rng(0)), CAMERA)
    assert np.count_nonzero(view.labels == OBJECT) > 1000 and cover_hollows(view).lid is None


def test_what_is_no_higher_than_the_noise_at_its_distance_may_be_nothing():
    """Noise grows with the square of the depth: the same plate is a thing near the camera, and none far away."""
    plates = [box(0.3, 0.0, 0.06, 0.06, 0.007), box(-0.35, 0.0, 0.06, 0.06, 0.007)]
    segments, counts = find_segments(FrameView(render(plates), CAMERA, noise=0.0015))
    assert {segment.centre[0] > 0: segment.fault for segment in segments} == {True: None, False: Reason.TOO_LOW}
    assert counts["segments"] == 1


def test_a_thing_on_which_another_one_stands_is_refused_too():
    """What is seen of the lower one beside the upper one is no outline."""
    lower, upper = Prism(circle(0.07), 0.07), Prism(np.add(circle(0.09), (-0.06, 0.0)), 0.25, 0.07)
    observation, shapes, _ = observe([lower, upper])
    assert not shapes and len(of(Reason.STACKED, observation)) == 2


@pytest.mark.parametrize(("change", "is_refused"), [(0.0, False), (0.02, True)])
def test_a_tip_that_nobody_saw_is_no_outline(change, is_refused, monkeypatch):
    def with_tip(traced, views):
        outline = traced.shape.outline
        tip = np.array(outline)
        tip[np.argmax(tip.sum(axis=1))] += change
        return replace(traced, shape=replace(traced.shape, outline=tip))

    monkeypatch.setattr(search, "fuse_views", with_tip)
    monkeypatch.setattr(search, "check_shape", lambda *_, **__: None)  # has another limit
    observation, shapes, _ = observe([Prism(rectangle(-0.03, -0.03, 0.03, 0.03), 0.05)])
    assert bool(shapes) != is_refused
    assert not is_refused or "nothing was measured at" in of(Reason.NO_SHAPE, observation)[0].why


def test_where_lines_of_sight_contradict_an_outline_is_told_apart():
    perception = Perception(CAMERA, SETTINGS)
    observe([box(0.0, 0.0, 0.12, 0.12, 0.05)], perception=perception)
    template, pose = Template(perception.known("o1").traced), perception.first_pose("o1")

    def share(*prisms):
        return contradictions(template, perception.view(render(prisms)), pose)

    handle = Prism(circle(0.02), 0.05).at((0.0, 0.065, 0.0))
    assert share(box(0.0, 0.0, 0.12, 0.12, 0.05)) == pytest.approx((0.0, 0.0), abs=0.002)
    outside, inside = share(box(0.0, 0.0, 0.12, 0.12, 0.05), handle)
    assert outside > 0.02 and inside < 0.002
    outside, inside = share(box(0.0, -0.01, 0.12, 0.1, 0.05))
    assert inside > 0.05 and outside < 0.002


def test_a_thing_on_another_one_is_stacked_though_it_is_hidden_in_part():
    """To move the nearer one away would not help."""
    lower, upper = box(-0.05, 0.0, 0.2, 0.2, 0.06), box(-0.05, 0.0, 0.12, 0.16, 0.08, bottom=0.06)
    nearer = box(0.1, 0.05, 0.03, 0.03, 0.3)
    observation, _, _ = observe([lower, upper, nearer])
    (refusal,) = [one for one in observation.refused if one.height == pytest.approx(0.14, abs=0.006)]
    assert refusal.reason is Reason.STACKED
    moved, _, _ = observe([box(-0.05, 0.0, 0.12, 0.16, 0.14), nearer])
    assert [one.reason for one in moved.refused if one.height == pytest.approx(0.14, abs=0.006)] == [Reason.BEHIND_ANOTHER]
