"""Things that touch, that stand on each other, and hollow ones: told apart once a push shows what belongs together."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.depth_scene import CAMERA, HAMMER, Prism, circle, hollow, rectangle, render
from push_ident.errors import PerceptionError
from push_ident.geometry.outline import polygon_area, signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.perception.known_object import TrackStatus
from push_ident.perception.pipeline import Perception
from push_ident.perception.recording import observe_offline
from push_ident.perception.refusals import Reason
from push_ident.perception.settings import PerceptionSettings

REST = 3
STEP = 0.006
"""Travel between two frames [m]."""


def box(x, y, width, depth, height, bottom=0.0):
    return Prism(rectangle(-width / 2, -depth / 2, width / 2, depth / 2), bottom + height, bottom).at((x, y, 0.0))


class Watched:
    """Perception of a scene that changes; every frame is searched."""

    def __init__(self) -> None:
        self.perception = Perception(CAMERA, PerceptionSettings(rest_frames=REST, search_period=0.0, occupancy_period=1e9))
        self.rng = np.random.default_rng(4)
        self.n = 0
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
        return [known.object_id for known in self.seen.objects if known.status is TrackStatus.TRACKED]

    @property
    def reasons(self):
        return [refusal.reason for refusal in self.seen.refused]


# Things that touch


@pytest.mark.parametrize(
    ("scene", "areas"),
    [
        (lambda x: [box(0, -0.03, 0.08, 0.06, 0.05), box(0, 0.03 + x, 0.08, 0.06, 0.05)], (48, 48)),
        (lambda x: [box(0, 0, 0.15, 0.10, 0.05), box(0, 0.065 + x, 0.03, 0.03, 0.05)], (150, 9)),
    ],
    ids=["two equal boxes", "a small box beside a large one"],
)
def test_touching_boxes_that_come_apart_are_given_up_and_become_two_new_objects(scene, areas):
    watched = Watched().see(scene(0.0), REST + 1)
    assert watched.areas == {"o1": pytest.approx(sum(areas), rel=0.03)} and watched.tracked == ["o1"]
    watched.push(scene, 0.05).see(scene(0.05), REST + 2)
    assert watched.removed == {"o1": Reason.TOUCHING}
    assert sorted(watched.tracked) == ["o2", "o3"]
    assert sorted(watched.areas[name] for name in ("o2", "o3")) == pytest.approx(sorted(areas), rel=0.08)


@pytest.mark.parametrize("small", [False, True], ids=["two equal boxes", "a small box along a large one"])
def test_boxes_that_slide_along_each_other_are_refused_until_they_are_apart(small):
    size, middle = ((0.15, 0.10), 0.065) if small else ((0.08, 0.06), 0.06)
    part = (0.03, 0.03) if small else size

    def scene(x, apart=0.0):
        return [box(0, 0, *size, 0.05), box(x, middle + apart, *part, 0.05)]

    watched = Watched().see(scene(0.0), REST + 1)
    assert watched.tracked == ["o1"]
    watched.push(scene, 0.042).see(scene(0.042), 2 * REST)
    assert watched.reasons == [Reason.TOUCHING] and watched.removed == {"o1": Reason.TOUCHING} and not watched.seen.objects
    # The last pose before it was noticed is off by less than half of what the parts moved against each other.
    assert np.linalg.norm(watched.poses["o1"][-1][:2] - watched.poses["o1"][0][:2]) < 0.012
    watched.push(lambda x: scene(0.042, x), 0.04).see(scene(0.042, 0.04), REST + 2)
    assert sorted(watched.tracked) == ["o2", "o3"] and watched.reasons == []


def test_what_is_left_where_a_part_was_taken_away_is_a_new_object():
    large, small = box(0, 0, 0.15, 0.10, 0.05), box(0, 0.065, 0.03, 0.03, 0.05)
    watched = Watched().see([large, small], REST + 1).see([large], 2 * REST)
    assert watched.removed == {"o1": Reason.TOUCHING}
    assert watched.tracked == ["o2"] and watched.areas["o2"] == pytest.approx(150, rel=0.03)


def test_two_known_objects_in_contact_stay_two():
    def scene(x):
        return [box(0, 0.03 + max(0.0, x - 0.06), 0.08, 0.06, 0.05), box(0, -0.09 + x, 0.08, 0.06, 0.05)]

    watched = Watched().see(scene(0.0), REST + 1).push(scene, 0.09).see(scene(0.09), 2 * REST)
    assert sorted(watched.areas) == ["o1", "o2"] and sorted(watched.tracked) == ["o1", "o2"] and not watched.removed
    travels = sorted(float(poses[-1][1] - poses[0][1]) for poses in watched.poses.values())
    assert travels == pytest.approx([0.03, 0.09], abs=0.001)
    assert watched.reasons == []


def test_three_known_objects_in_a_row_are_not_taken_for_a_fourth():
    def scene(x):
        return [box(0, y, 0.08, 0.05, 0.05) for y in (-0.08 + x, 0.0, 0.08 - x)]

    watched = Watched().see(scene(0.0), REST + 1).push(scene, 0.03).see(scene(0.03), 2 * REST)
    assert sorted(watched.areas) == ["o1", "o2", "o3"] == sorted(watched.tracked) and watched.reasons == []


@pytest.mark.parametrize("new", [box(0, 0.08, 0.10, 0.10, 0.05), box(0, 0.04, 0.03, 0.02, 0.05)], ids=["larger", "smaller"])
def test_a_new_thing_that_touches_a_known_one_is_refused_until_they_are_apart(new):
    known = box(0, 0, 0.06, 0.06, 0.05)
    watched = Watched().see([known], REST + 1).see([known, new], 3 * REST)
    assert list(watched.areas) == ["o1"] and not watched.removed
    assert watched.reasons == [Reason.TOUCHES_KNOWN]
    apart = new.at((0.0, 0.05, 0.0))
    watched.see([known, apart], REST + 2)
    assert sorted(watched.tracked) == ["o1", "o2"]


def test_offline_an_object_that_came_apart_is_none():
    def scene(x):
        return [box(0, -0.03, 0.08, 0.06, 0.05), box(0, 0.03 + x, 0.08, 0.06, 0.05)]

    travel = [0.0] * 4 + [0.01, 0.02, 0.03, 0.04, 0.05] + [0.05] * 6
    rng = np.random.default_rng(5)
    frames = [render(scene(x), rng=rng, stamp=0.3 * i) for i, x in enumerate(travel)]
    settings = PerceptionSettings(rest_frames=REST)
    assert sorted(observe_offline(frames, CAMERA, settings=settings)) == ["o2", "o3"]
    # Along each other, so that they still touch in the end.
    sliding = [[box(0, -0.03, 0.08, 0.06, 0.05), box(0.8 * x, 0.03, 0.08, 0.06, 0.05)] for x in travel]
    with pytest.raises(PerceptionError, match="object o1 is several things that touch"):
        observe_offline([render(prisms, rng=rng, stamp=0.3 * i) for i, prisms in enumerate(sliding)], CAMERA, settings=settings)


# Things on each other


@pytest.mark.parametrize("height", [0.015, 0.04])
def test_a_thing_on_another_one_is_refused_at_the_latest_when_it_slides(height):
    def scene(x):
        return [box(0, 0, 0.15, 0.10, 0.03), box(-0.02 + x, 0, 0.06, 0.06, height, bottom=0.03)]

    watched = Watched().see(scene(0.0), REST + 1)
    # Lower than `min_step`, it cannot be told from a thing with a step.
    assert bool(watched.areas) == (height < 0.02)
    watched.push(scene, 0.024).see(scene(0.024), 2 * REST)
    assert Reason.STACKED in watched.reasons and not watched.tracked
    assert watched.removed == ({"o1": Reason.STACKED} if height < 0.02 else {})
    on_table = [box(0, 0, 0.15, 0.10, 0.03), box(0.004, 0.15, 0.06, 0.06, height)]
    watched.see(on_table, REST + 2)
    assert len(watched.tracked) == 2 and not watched.reasons


def test_a_thing_with_steps_stays_one_object_on_its_way():
    def scene(x):
        return [prism.at((0.03 + x, -0.02 + x, 0.4 + 3 * x)) for prism in HAMMER]

    watched = Watched().see(scene(0.0), REST + 1).push(scene, 0.09).see(scene(0.09), REST)
    assert watched.tracked == ["o1"] and len(watched.poses["o1"]) == watched.n - REST and not watched.removed


# Hollow things


@pytest.mark.parametrize(
    ("outer", "inner", "top", "floor"),
    [
        pytest.param(circle(0.07, 16), circle(0.066, 16), 0.05, 0.004, id="bowl"),
        pytest.param(circle(0.04, 16), circle(0.036, 16), 0.09, 0.004, id="mug"),
        pytest.param(rectangle(-0.08, -0.05, 0.08, 0.05), rectangle(-0.076, -0.046, 0.076, 0.046), 0.06, 0.004, id="box without a lid"),
        pytest.param(circle(0.05, 16), circle(0.038, 16), 0.03, 0.0, id="roll of tape"),
    ],
)
def test_a_hollow_thing_is_one_object_with_the_outline_of_its_rim(outer, inner, top, floor):
    def scene(x):
        return [prism.at((x, 0.5 * x, 0.3 + x)) for prism in hollow(outer, inner, top, floor)]

    watched = Watched().see(scene(0.0), REST)
    assert list(watched.areas) == ["o1"]
    (shape,) = watched.seen.new_shapes.values()
    outline = shape.outline + watched.perception.first_pose("o1")[:2]
    truth = transform_points((0.0, 0.0, 0.3), outer)
    assert polygon_area(outline) == pytest.approx(polygon_area(truth), rel=0.03)
    assert np.max(np.abs(signed_distance(outline, truth))) < 0.004
    watched.push(scene, 0.03).see(scene(0.03), 2)
    assert list(watched.areas) == ["o1"] and not watched.removed
    moved = watched.poses["o1"][-1][:2] - watched.perception.first_pose("o1")[:2]
    assert np.linalg.norm(moved - (0.03, 0.015)) < 0.002


def test_things_around_a_lower_one_are_no_rim():
    # Three boxes on three sides of a low one.
    walls = [box(-0.09, 0, 0.04, 0.20, 0.06), box(0, 0.11, 0.10, 0.04, 0.06), box(0, -0.11, 0.10, 0.04, 0.06)]
    watched = Watched().see([*walls, box(0, 0, 0.06, 0.06, 0.02)], REST)
    assert all(area < 100 for area in watched.areas.values())
