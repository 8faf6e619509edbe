"""What is no object, and why; one thing that cannot be taken in does not take others with it; where contact may be elsewhere."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from helpers.depth_scene import CAMERA, INTRINSICS, Prism, circle, hammer, rectangle, render
from push_ident.errors import InputError, PerceptionError
from push_ident.perception.frame.robot import Cylinder
from push_ident.perception.frame.table import fit_table
from push_ident.perception.frame.view import points_in_table
from push_ident.perception.pipeline import Perception
from push_ident.perception.refusals import Reason
from push_ident.perception.search import search
from push_ident.perception.settings import PerceptionSettings
from push_ident.survey.survey import survey_frames
from push_ident.types import DepthFrame

POSE = np.array([0.03, -0.02, 0.4])
BOX = rectangle(-0.06, -0.04, 0.06, 0.04)
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


def of(reason, observation):
    return [refusal for refusal in observation.refused if refusal.reason is reason]


@pytest.mark.parametrize("height", [0.06, 0.25])
def test_a_tall_object_is_no_robot(height):
    assert list(observe([Prism(BOX, height).at(POSE)])[1]) == ["o1"]


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
    box = Prism(rectangle(-0.05, -0.04, 0.05, 0.04), 0.05)
    body = render([box]).depth < render([]).depth - 0.001

    def without(margin):
        """Nothing is measured within `margin` pixels of the box."""
        around = cv2.dilate(body.astype(np.uint8), np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)) > 0
        return lambda depth: np.putmask(depth, around & ~body, np.nan)

    assert list(observe([box], change=without(9))[1]) == ["o1"]
    observation, shapes, _ = observe([box], change=without(70))
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
    original = search.trace_object

    def displaced(views, **settings):
        traced = original(views, **settings)
        return replace(traced, pose=np.add(traced.pose, (0.06, 0.0, 0.0)))

    monkeypatch.setattr(search, "trace_object", displaced)
    monkeypatch.setattr(search, "fuse_views", lambda traced, views: traced)
    observation, shapes, _ = observe([Prism(BOX, 0.05)])
    assert not shapes and "covers" in of(Reason.NO_SHAPE, observation)[0].why


def test_points_under_the_table_and_a_rough_table_are_named():
    rng = np.random.default_rng(0)
    points = points_in_table(render([], rng=rng), CAMERA)
    bin_floor, rough = points.copy(), points.copy()  # the rim of a bin lies at the height of the table
    bin_floor[(np.abs(points[..., 0]) < 0.2) & (np.abs(points[..., 1]) < 0.2), 2] -= 0.03
    rough[..., 2] += rng.normal(size=points.shape[:2]).astype(np.float32) * np.float32(0.009)
    for wrong, why in ((bin_floor, "under the table"), (rough, "deviate by|agree on a plane")):
        with pytest.raises(PerceptionError, match=why):
            fit_table(wrong, PerceptionSettings())


def test_the_least_height_of_an_object_follows_the_noise():
    plate = [Prism(BOX, 0.0045).at(POSE)]
    assert list(observe(plate, rng=None)[1]) == ["o1"] and not observe(plate)[1]


@pytest.mark.parametrize(
    ("prisms", "reach", "doubt"),
    [
        (hammer(POSE), (0.012, 0.092), ""),
        ([Prism(BOX, 0.15)], (0.012, 0.092), ""),  # higher than the tool
        ([Prism(circle(0.03), 0.02), Prism(circle(0.05), 0.07, 0.05)], (0.012, 0.092), ""),  # a mushroom whose cap the tool meets
        ([Prism(BOX, 0.010)], (0.006, 0.092), ""),
        ([Prism(BOX, 0.010)], (0.012, 0.092), "mm high"),
        ([Prism(BOX, 0.010), Prism(0.6 * BOX, 0.025)], (0.012, 0.092), "of its edge is lower"),
        ([Prism(circle(0.015), 0.10), Prism(circle(0.05), 0.12, 0.10)], (0.012, 0.092), "no side below it"),
    ],
)
def test_an_object_that_the_tool_may_not_touch_where_its_outline_is_has_a_doubt(prisms, reach, doubt):
    _, shapes, doubts = observe(prisms, 4, settings=replace(SETTINGS, min_object_height=0.004, tool_reach=reach), rng=0)
    assert shapes and len(doubts) == bool(doubt) and all(doubt in one for one in doubts)


def test_a_survey_says_so():
    rng = np.random.default_rng(0)
    survey = survey_frames([render([Prism(BOX, 0.010)], rng=rng, stamp=i / 30) for i in range(10)], CAMERA)
    assert any(note.startswith("object o1: it is") and "lower the tool" in note for note in survey.notes)
