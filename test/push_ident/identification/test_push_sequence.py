"""Pushes that are planned from an outline alone: each begins where the one before is expected to end, and is possible anywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import hammer_shape
from push_ident.errors import InputError
from push_ident.geometry.outline import outline_distance
from push_ident.geometry.se2 import transform_points
from push_ident.identification.predicting.push_sequence import PushSequence, plan_pushes, unknown_effects
from push_ident.pushing.push import PushSettings

SETTINGS = PushSettings(workspace=(-np.inf, np.inf, -np.inf, np.inf))


@pytest.fixture(scope="module")
def sequence() -> PushSequence:
    return plan_pushes(hammer_shape(), 3, SETTINGS, first_pose=(0.2, -0.1, 1.0), seed=3)


def test_each_push_begins_where_the_one_before_is_expected_to_end_and_other_pushes_are_then_known_better(sequence: PushSequence) -> None:
    starts = [push.pose_object_in_table for push in sequence.pushes]
    np.testing.assert_array_equal(starts, [[0.2, -0.1, 1.0], *sequence.ends[:-1]])
    assert np.all(np.linalg.norm(sequence.ends - starts, axis=1) > 5e-3)
    assert sequence.errors.shape == (4,) and sequence.errors[-1] < 0.6 * sequence.errors[0]


def test_a_push_in_the_object_frame_touches_the_outline_wherever_the_object_lies(sequence: PushSequence) -> None:
    for number, push in enumerate(sequence.pushes):
        plan, elsewhere = sequence.in_object(number), np.array([1.0, 2.0, -0.7])
        outline = transform_points(elsewhere, sequence.shape.outline)
        tool = transform_points(elsewhere, plan.tool_at_contact[None])
        assert outline_distance(tool, np.zeros((1, 3)), outline)[0] == pytest.approx(SETTINGS.pusher_radius, abs=1e-6)
        assert push.plan is not None and plan.distance == push.plan.distance
        back = transform_points(push.pose_object_in_table, plan.contact_point[None])[0]
        np.testing.assert_allclose(back, push.plan.contact_point, atol=1e-12)


def test_the_same_seed_plans_the_same_pushes_and_no_push_is_refused(sequence: PushSequence) -> None:
    again = plan_pushes(hammer_shape(), 1, replace(SETTINGS), first_pose=(0.2, -0.1, 1.0), seed=3)
    assert again.pushes[0].plan is not None
    np.testing.assert_array_equal(again.pushes[0].pusher.position, sequence.pushes[0].pusher.position)
    with pytest.raises(InputError, match="expected 1 push or more"):
        plan_pushes(hammer_shape(), 0)
    assert "table_tilt" in unknown_effects() and "wear" not in unknown_effects()
