"""Things that touch, that stand on each other, and hollow ones: told apart once a push shows what belongs together."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.depth_scene import CAMERA, box, circle, hammer, hollow, rectangle, render
from push_ident.errors import PerceptionError
from push_ident.geometry.outline import polygon_area, signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.perception.known_object import TrackStatus
from push_ident.perception.pipeline import Perception
from push_ident.perception.recording import observe_offline
from push_ident.perception.refusals import Reason
from push_ident.perception.settings import PerceptionSettings

REST, STEP = 3, 0.006
"""Frames at rest; travel between two frames [m]."""


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


@pytest.mark.parametrize(
    ("scene", "areas"),
    [
        (lambda x: [box(0, -0.03, 0.08, 0.06, 0.05), box(0, 0.03 + x, 0.08, 0.06, 0.05)], (48, 48)),
        (lambda x: [box(0, 0, 0.15, 0.10, 0.05), box(0, 0.065 + x, 0.03, 0.03, 0.05)], (9, 150)),
    ],
    ids=["two equal boxes", "a small box beside a large one"],
)
def test_touching_boxes_that_come_apart_are_given_up_and_become_two_new_objects(scene, areas):
    watched = Watched().see(scene(0.0), REST + 1)
    assert watched.areas == {"o1": pytest.approx(sum(areas), rel=0.03)} and watched.tracked == ["o1"]
    watched.push(scene, 0.05).see(scene(0.05), REST + 2)
    assert watched.removed == {"o1": Reason.TOUCHING} and watched.tracked == ["o2", "o3"]
    assert sorted(watched.areas[name] for name in ("o2", "o3")) == pytest.approx(areas, rel=0.08)


def test_boxes_that_slide_along_each_other_are_refused_until_they_are_apart():
    def scene(x, apart=0.0):
        return [box(0, 0, 0.15, 0.10, 0.05), box(x, 0.065 + apart, 0.03, 0.03, 0.05)]

    watched = Watched().see(scene(0.0), REST + 1)
    assert watched.tracked == ["o1"]
    watched.push(scene, 0.042).see(scene(0.042), 2 * REST)
    assert watched.reasons == [Reason.TOUCHING] and watched.removed == {"o1": Reason.TOUCHING} and not watched.seen.objects
    # The last pose before it was noticed is off by less than half of what the parts moved against each other.
    assert np.linalg.norm(watched.poses["o1"][-1][:2] - watched.poses["o1"][0][:2]) < 0.012
    watched.push(lambda x: scene(0.042, x), 0.04).see(scene(0.042, 0.04), REST + 2)
    assert watched.tracked == ["o2", "o3"] and watched.reasons == []


def test_what_is_left_where_a_part_was_taken_away_is_a_new_object():
    large, small = box(0, 0, 0.15, 0.10, 0.05), box(0, 0.065, 0.03, 0.03, 0.05)
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


@pytest.mark.parametrize("new", [box(0, 0.08, 0.10, 0.10, 0.05), box(0, 0.04, 0.03, 0.02, 0.05)], ids=["larger", "smaller"])
def test_a_new_thing_that_touches_a_known_one_is_refused_until_they_are_apart(new):
    known = box(0, 0, 0.06, 0.06, 0.05)
    watched = Watched().see([known], REST + 1).see([known, new], 3 * REST)
    assert list(watched.areas) == ["o1"] and not watched.removed and watched.reasons == [Reason.TOUCHES_KNOWN]
    assert watched.see([known, new.at((0.0, 0.05, 0.0))], REST + 2).tracked == ["o1", "o2"]


def test_offline_an_object_that_came_apart_is_none():
    travel, settings = [0.0] * 4 + [0.01, 0.02, 0.03, 0.04] + [0.05] * 7, PerceptionSettings(rest_frames=REST)

    def tracks(scene):
        rng = np.random.default_rng(5)
        frames = [render(scene(x), rng=rng, stamp=0.3 * i) for i, x in enumerate(travel)]
        return sorted(observe_offline(frames, CAMERA, settings=settings))

    assert tracks(lambda x: [box(0, -0.03, 0.08, 0.06, 0.05), box(0, 0.03 + x, 0.08, 0.06, 0.05)]) == ["o2", "o3"]
    with pytest.raises(PerceptionError, match="object o1 is several things that touch"):  # in the end as well
        tracks(lambda x: [box(0, -0.03, 0.08, 0.06, 0.05), box(0.8 * x, 0.03, 0.08, 0.06, 0.05)])


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


def test_a_thing_with_steps_stays_one_object_on_its_way():
    def scene(x):
        return hammer((0.03 + x, -0.02 + x, 0.4 + 3 * x))

    watched = Watched().see(scene(0.0), REST + 1).push(scene, 0.09).see(scene(0.09), REST)
    assert watched.tracked == ["o1"] and len(watched.poses["o1"]) == watched.n - REST and not watched.removed


@pytest.mark.parametrize(
    ("outer", "inner", "top", "floor"),
    [
        (circle(0.07, 16), circle(0.066, 16), 0.05, 0.004),
        (circle(0.04, 16), circle(0.036, 16), 0.09, 0.004),
        (rectangle(-0.08, -0.05, 0.08, 0.05), rectangle(-0.076, -0.046, 0.076, 0.046), 0.06, 0.004),
        (circle(0.05, 16), circle(0.038, 16), 0.03, 0.0),
    ],
    ids=["bowl", "mug", "box without a lid", "roll of tape"],
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
