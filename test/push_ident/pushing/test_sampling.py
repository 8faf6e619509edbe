"""Choice of pushes: random ones, those that a goal asks for, and those that bring an object back to the middle."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.errors import PlanningError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.pushing.push import PushCode, PushSettings
from push_ident.pushing.sampling import is_near_edge, push_from_goal, recentring_pushes, sample_push
from push_ident.types import CellGrid, ObjectShape
from push_ident_sim.objects import make_object

SETTINGS = PushSettings(workspace=(-0.2, 0.2, -0.25, 0.25))
BAR = np.array([[-0.08, -0.02], [0.08, -0.02], [0.08, 0.02], [-0.08, 0.02]])
SLOTTED = np.array(
    [[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [0.013, 0.05], [0.013, -0.02], [-0.013, -0.02], [-0.013, 0.05], [-0.05, 0.05]]
)
"""A slot 26 mm wide, too narrow for the pusher of 36 mm."""


def shape_of(outline: np.ndarray) -> ObjectShape:
    return ObjectShape(CellGrid(np.zeros((1, 2)), 0.01), outline)


def test_random_contacts_are_uniform_over_the_length_of_the_outline() -> None:
    rng = np.random.default_rng(0)
    contacts = np.array([sample_push(shape_of(BAR), [0, 0, 0], rng, SETTINGS).contact_point for _ in range(600)])
    on_long_side = np.abs(np.abs(contacts[:, 1]) - 0.02) < 1e-9
    # 0.16 of every 0.20 m; three standard deviations of the share are 0.05.
    assert np.mean(on_long_side) == pytest.approx(0.8, abs=0.05)
    along = contacts[on_long_side, 0]
    assert (np.mean(along), np.std(along)) == pytest.approx((0.0, 0.16 / np.sqrt(12)), abs=0.01)


def test_random_pushes_keep_cone_and_ranges_and_touch_where_they_say() -> None:
    rng = np.random.default_rng(1)
    tool = make_object("wrench")
    shape, pose = ObjectShape(CellGrid(tool.cells, tool.cell_size), tool.outline), np.array([0.01, -0.03, 0.8])
    outline = transform_points(pose, shape.outline)
    for _ in range(100):
        push = sample_push(shape, pose, rng, SETTINGS)
        inward = (push.contact_point - push.tool_at_contact) / SETTINGS.pusher_radius
        assert inward @ push.heading >= np.cos(SETTINGS.cone) - 1e-9
        assert 0.04 <= push.distance <= 0.10 and 0.1 <= push.speed <= 0.2
        assert signed_distance(push.contact_point[None], outline)[0] == pytest.approx(0.0, abs=1e-9)
        approach = push.tool_at_contact - np.linspace(SETTINGS.clearance, 2e-4, 300)[:, None] * push.heading
        assert np.min(signed_distance(approach, outline)) > SETTINGS.pusher_radius - 2e-4


def test_random_pushes_never_go_into_a_slot_and_bring_an_object_at_the_edge_back_in() -> None:
    rng = np.random.default_rng(2)
    for _ in range(100):
        x, y = sample_push(shape_of(SLOTTED), [0, 0, 0], rng, SETTINGS).contact_point
        assert not (abs(x) < 0.0131 and -0.021 < y < 0.0499)
        push = sample_push(shape_of(BAR), [0.1, 0.14, 0.0], rng, SETTINGS)
        assert np.all([0.18, 0.16] + push.distance * push.heading <= [0.2 + 1e-9, 0.25 + 1e-9])
    with pytest.raises(PlanningError, match="leave the workspace") as error:
        sample_push(shape_of(BAR), [1.0, 0.0, 0.0], rng, SETTINGS)
    assert error.value.code == PushCode.UNREACHABLE


@pytest.mark.parametrize(
    ("pose", "asked", "direction", "contact", "outward"),
    [
        ([0.02, 0.0, np.pi / 2], [0.06, 0.01], np.pi, [0.04, 0.01], [1.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.09, -0.03], np.pi / 2 + 0.2, [0.08, -0.02], [0.0, -1.0]),
    ],
    ids=["beside a face", "at a corner"],
)
def test_goal_is_moved_to_the_nearest_point_of_the_side_that_faces_the_push(
    pose: list[float], asked: list[float], direction: float, contact: list[float], outward: list[float]
) -> None:
    push = push_from_goal(shape_of(BAR), pose, asked, direction, 0.05, 0.1, SETTINGS)
    assert push.contact_point == pytest.approx(contact)
    assert push.tool_at_contact == pytest.approx(np.add(contact, SETTINGS.pusher_radius * np.array(outward)))


@pytest.mark.parametrize(
    ("contact", "direction", "distance", "speed", "code", "text"),
    [
        ([0, -0.02], -np.pi / 2, 0.05, 0.1, PushCode.INVALID_GOAL, "does not push into"),
        ([np.nan, 0], 0.0, 0.05, 0.1, PushCode.INVALID_GOAL, "contact_point"),
        ([0, -0.02], np.inf, 0.05, 0.1, PushCode.INVALID_GOAL, "direction"),
        ([0, -0.02], np.pi / 2, -0.05, 0.1, PushCode.INVALID_GOAL, "distance is -0.050"),
        ([0, -0.02], np.pi / 2, 0.05, 3.0, PushCode.INVALID_GOAL, "speed is 3.000"),
        ([0, -0.02], np.pi / 2, 0.25, 0.1, PushCode.LIMIT, "start|end"),
    ],
)
def test_impossible_goal_is_refused_with_its_code(
    contact: list[float], direction: float, distance: float, speed: float, code: PushCode, text: str
) -> None:
    settings = PushSettings(workspace=(-0.2, 0.2, -0.15, 0.15))
    with pytest.raises(PlanningError, match=text) as error:
        push_from_goal(shape_of(BAR), [0, 0, 0], contact, direction, distance, speed, settings)
    assert error.value.code == code


def test_goal_inside_a_slot_and_goal_behind_another_object_are_unreachable() -> None:
    with pytest.raises(PlanningError, match=r"be lowered|would touch") as error:
        push_from_goal(shape_of(SLOTTED), [0, 0, 0], [0, -0.02], -np.pi / 2, 0.05, 0.1, SETTINGS)
    assert error.value.code == PushCode.UNREACHABLE
    beyond = BAR + np.array([0.0, 0.06])
    with pytest.raises(PlanningError, match="would touch"):
        push_from_goal(shape_of(BAR[:, ::-1].copy()), [0, 0, 0], [0, -0.08], np.pi / 2, 0.15, 0.1, SETTINGS, obstacles=[beyond])


@pytest.mark.parametrize("name", ["hammer", "crimp"])
def test_object_at_the_edge_has_a_push_that_brings_it_back_and_one_in_the_middle_needs_none(name: str) -> None:
    tool = make_object(name)
    shape = ObjectShape(CellGrid(tool.cells, tool.cell_size), tool.outline)
    assert not is_near_edge(shape, [0.0, 0.0, 0.4], SETTINGS)
    rng = np.random.default_rng(4)
    for edge in ([0.2, 0.0], [-0.2, 0.05], [0.0, 0.25], [0.05, -0.25]):
        yaw = rng.uniform(-3, 3)
        # Moved out until the outline is 1 cm from the edge, on that side.
        outward = np.sign(edge) * (np.abs(edge) >= 0.2)
        reach = np.max(transform_points([0, 0, yaw], shape.outline) @ outward)
        pose = np.array([*(np.array(edge) * (outward == 0) + outward * (np.abs(edge) @ np.abs(outward) - 0.01 - reach)), yaw])
        if np.linalg.norm(pose[:2]) < SETTINGS.distance_range[0]:
            continue  # as long as the workspace is wide: it is in the middle
        assert is_near_edge(shape, pose, SETTINGS)
        push = next(recentring_pushes(shape, pose, SETTINGS))
        before, after = np.linalg.norm(pose[:2]), np.linalg.norm(pose[:2] + push.distance * push.heading)
        assert after < before - 0.01
        assert push.heading @ -pose[:2] > 0.5 * before
