"""What is no object, and why; one thing that cannot be taken in does not take others with it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from helpers.depth_scene import CAMERA, HAMMER, INTRINSICS, Prism, circle, rectangle, render
from push_ident.errors import InputError, PerceptionError
from push_ident.perception.frame.robot import Cylinder
from push_ident.perception.frame.table import fit_table
from push_ident.perception.frame.view import points_in_table
from push_ident.perception.pipeline import Perception
from push_ident.perception.refusals import Reason
from push_ident.perception.search import search
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import DepthFrame

POSE = np.array([0.03, -0.02, 0.4])
BOX = Prism(rectangle(-0.2, 0.1, -0.1, 0.18), 0.05)
REST = 3
SETTINGS = PerceptionSettings(rest_frames=REST)


def observe(prisms, n=REST, *, settings=SETTINGS, robot=(), change=lambda depth: None, perception=None, begin=0.0):
    """The last of n observations of a scene, its depth changed in place by `change`, and what was taken in."""
    rng = np.random.default_rng(3)
    perception = perception or Perception(CAMERA, settings)
    shapes = {}
    for i in range(n):
        frame = render(prisms, rng=rng, stamp=begin + 0.3 * i)
        depth = frame.depth.copy()
        change(depth)
        observation = perception.observe(DepthFrame(frame.stamp, depth, INTRINSICS), robot)
        shapes |= observation.new_shapes
    return observation, shapes


def of(reason, observation):
    return [refusal for refusal in observation.refused if refusal.reason is reason]


def hammer():
    return [prism.at(POSE) for prism in HAMMER]


@pytest.mark.parametrize("height", [0.06, 0.13, 0.25])
def test_a_tall_object_is_no_robot(height):
    _, shapes = observe([Prism(rectangle(-0.04, -0.03, 0.04, 0.03), height).at(POSE)])
    assert list(shapes) == ["o1"]


def test_each_refusal_says_why_and_where():
    at_border = Prism(rectangle(-0.02, 0.37, 0.06, 0.43), 0.04)
    rod = Prism(np.add(circle(0.02), (0.1, 0.19)), 0.3)
    beside = Prism(rectangle(0.05, 0.1, 0.13, 0.17), 0.05)
    grain = Prism(rectangle(-0.15, -0.2, -0.137, -0.187), 0.03)
    observation, shapes = observe([*hammer(), at_border, rod, beside, grain], robot=(Cylinder(0.1, 0.19, 0.02),))
    assert list(shapes) == ["o1"]
    refused = {reason: of(reason, observation) for reason in Reason}
    assert {reason for reason, found in refused.items() if found} == {Reason.AT_WORKSPACE_BORDER, Reason.BESIDE_ROBOT, Reason.TOO_SMALL}
    for reason, place, height in ((Reason.AT_WORKSPACE_BORDER, (0.02, 0.385), 0.04), (Reason.BESIDE_ROBOT, (0.09, 0.135), 0.05)):
        (refusal,) = refused[reason]
        assert np.linalg.norm(refusal.outline.mean(axis=0) - place) < 0.02
        assert refusal.height == pytest.approx(height, abs=0.006)
        assert refusal.why == reason.value
    assert "enlarge workspace_low" in observation.why_no_pose()
    assert observation.counts["at_workspace_border"] == 1


def test_a_narrow_halo_does_not_matter_and_a_wide_unmeasured_area_is_named():
    box = Prism(rectangle(-0.05, -0.04, 0.05, 0.04), 0.05)
    body = render([box]).depth < render([]).depth - 0.001

    def without(margin):
        """Nothing is measured within `margin` pixels of the box."""
        around = cv2.dilate(body.astype(np.uint8), np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)) > 0

        def change(depth):
            depth[around & ~body] = np.nan

        return change

    assert list(observe([box], change=without(9))[1]) == ["o1"]
    observation, shapes = observe([box], change=without(70))
    assert not shapes and of(Reason.BESIDE_UNMEASURED, observation)
    assert "the camera measures nothing beside it" in observation.why_no_pose()


def test_a_segment_without_a_shape_leaves_the_others_and_is_tried_less_and_less_often(monkeypatch):
    tried = []
    original = search.trace_object

    def fails_for_the_box(views, **settings):
        if views[0].segment.centre[0] < -0.05:
            tried.append(views[0].view.frame.stamp)
            raise InputError("two corners are the same")
        return original(views, **settings)

    monkeypatch.setattr(search, "trace_object", fails_for_the_box)
    settings = replace(SETTINGS, search_period=0.0)
    perception = Perception(CAMERA, settings)
    observation, shapes = observe([*hammer(), BOX], perception=perception)
    assert list(shapes) == ["o1"]
    (refusal,) = of(Reason.NO_SHAPE, observation)
    assert "two corners are the same" in refusal.why
    observation, _ = observe([*hammer(), BOX], 20, perception=perception, begin=10.0)
    assert of(Reason.NO_SHAPE, observation) and np.allclose(np.diff(tried)[1:], 0.3 * 2 * REST * 2, atol=0.31), tried
    monkeypatch.undo()
    _, shapes = observe([*hammer(), BOX], 30, perception=perception, begin=20.0)
    assert list(shapes) == ["o2"]


def test_an_outline_that_does_not_cover_its_own_segment_is_refused(monkeypatch):
    original = search.trace_object

    def half(views, **settings):
        traced = original(views, **settings)
        return replace(traced, pose=np.add(traced.pose, (0.06, 0.0, 0.0)))

    monkeypatch.setattr(search, "trace_object", half)
    monkeypatch.setattr(search, "fuse_views", lambda traced, views, **settings: traced)
    observation, shapes = observe([BOX])
    assert not shapes
    assert "covers" in of(Reason.NO_SHAPE, observation)[0].why


def test_points_under_the_table_and_a_rough_table_are_named():
    # The rim of a bin lies at the height of the table, its floor below it.
    rng = np.random.default_rng(0)
    points = points_in_table(render([], rng=rng), CAMERA)
    floor = (np.abs(points[..., 0]) < 0.2) & (np.abs(points[..., 1]) < 0.2)
    points[floor, 2] -= 0.03
    with pytest.raises(PerceptionError, match="under the table"):
        fit_table(points, PerceptionSettings())
    points = points_in_table(render([], rng=rng), CAMERA)
    points[..., 2] += rng.normal(size=points.shape[:2]).astype(np.float32) * np.float32(0.009)
    with pytest.raises(PerceptionError, match=r"deviate by|agree on a plane"):
        fit_table(points, PerceptionSettings())


def test_the_least_height_of_an_object_follows_the_noise():
    plate = Prism(rectangle(-0.06, -0.04, 0.06, 0.04), 0.0045).at(POSE)

    def exact(prisms, n):
        perception = Perception(CAMERA, SETTINGS)
        shapes = {}
        for i in range(n):
            shapes |= perception.observe(render(prisms, stamp=0.3 * i)).new_shapes
        return shapes

    assert list(exact([plate], REST)) == ["o1"]
    _, shapes = observe([plate])
    assert not shapes
