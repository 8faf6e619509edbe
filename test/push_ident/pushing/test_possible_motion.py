"""What a push can have made of an object, by the path of its pusher and the outline alone."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import hammer, random_records, square, straight_push
from push_ident.geometry.se2 import transform_points
from push_ident.pushing.possible_motion import displacement, why_impossible
from push_ident.types import CameraAccuracy, Float64Array, PusherPath

SHAPE = square()
"""90 mm wide."""
PUSH = straight_push((-0.08, 0.01), 0.0, travel=0.1)
"""Along x: the tool touches after 27 mm and takes the object 73 mm with it."""
FIRST, END = np.zeros(3), np.array([0.073, 0.0, -0.2])
COVARIANCE = np.diag([3e-4, 3e-4, 3e-3]) ** 2


def why(
    end: Float64Array, pusher: PusherPath = PUSH, *, covariance: Float64Array = COVARIANCE, camera: CameraAccuracy | None = None
) -> str:
    return why_impossible(SHAPE, pusher, FIRST, end, covariance_before=COVARIANCE, covariance_after=covariance, camera=camera)


def test_displacement_is_the_root_mean_square_over_the_cells() -> None:
    shape, one, other = hammer().shape, np.array([0.1, -0.2, 0.3]), np.array([0.05, -0.1, 2.0])
    moved = transform_points(one, shape.cells.centres) - transform_points(other, shape.cells.centres)
    expected = np.sqrt(np.mean(np.sum(moved**2, axis=1)))
    assert displacement(shape, one, other) == pytest.approx(expected, rel=1e-12)
    assert displacement(shape, one, other + np.array([0.0, 0.0, 4.0 * np.pi])) == pytest.approx(expected, rel=1e-9)


def test_ends_of_pushes_are_possible() -> None:
    assert why(END) == ""
    for record in random_records(hammer(3), 12, 3):
        first, last = record.poses.pose[[0, -1]]
        stated = record.poses.covariance[0]
        assert why_impossible(record.shape, record.pusher, first, last, covariance_before=stated, covariance_after=stated) == ""


@pytest.mark.parametrize(
    ("end", "reason"),
    [
        (END + np.array([0.0, 0.25, 0.0]), r"rests \d+ mm from everything that the tool passed"),
        (END - [0.0, 0.15, 0.0], r"rests \d+ mm from everything that the tool passed"),
        (END + np.array([0.15, 0.0, 0.0]), r"rests \d+ mm from everything that the tool passed"),
        (END - [0.05, 0.0, 0.0], r"the tool rests \d+ mm inside of it"),
    ],
)
def test_end_away_from_the_path_or_around_the_tool_is_impossible(end: Float64Array, reason: str) -> None:
    assert re.search(reason, why(end)), why(end)


def test_object_that_the_tool_came_never_near_stays() -> None:
    beside = replace(PUSH, position=PUSH.position + np.array([0.0, 0.2]))
    assert "the tool came no nearer to it than 1" in why(np.array([0.0, 0.1, 0.0]), beside)
    assert why(np.array([1e-3, 0.0, 0.0]), beside) == ""


def test_short_push_makes_no_half_turn_and_what_poses_and_camera_may_err_by_counts() -> None:
    assert "turned by 180°" in why(np.array([0.01, 0.0, np.pi]), straight_push((-0.063, 0.0), 0.0, travel=0.02))
    assert why(END + np.array([0.0, 0.25, 1.0]), covariance=np.eye(3)) == ""
    aside = END + np.array([0.0, 0.12, 0.0])
    assert why(aside) and why(aside, camera=CameraAccuracy(position=0.02)) == ""


def test_pose_seen_soon_after_the_tool_stopped_may_be_older() -> None:
    behind, stopped = END - np.array([0.05, 0.0, 0.0]), 0.4 + 0.1 / 0.15
    stated = {"covariance_before": COVARIANCE, "covariance_after": COVARIANCE}
    assert why_impossible(SHAPE, PUSH, FIRST, behind, **stated, observed_at=stopped + 0.1) == ""
    assert "inside of it" in why_impossible(SHAPE, PUSH, FIRST, behind, **stated, observed_at=stopped + 0.6)


def test_path_of_two_samples_is_looked_at_between_them_and_a_polygon_is_taken_for_the_circle_around_it() -> None:
    assert why(END, PusherPath(PUSH.time[[0, -1]], PUSH.position[[0, -1]], PUSH.radius)) == ""
    # What is left behind in the middle of a long path.
    long = PusherPath(np.array([0.0, 2.0]), np.array([[-0.3, 0.06], [0.3, 0.06]]), 0.008)
    assert why(np.array([-0.02, 0.02, 0.1]), long) == ""
    plate = np.array([[-5e-3, -0.03], [5e-3, -0.03], [5e-3, 0.03], [-5e-3, 0.03]])
    beside = PusherPath(PUSH.time, PUSH.position + np.array([0.0, 0.08]), 0.0)
    assert why(END, beside) and why(END, replace(beside, polygon=plate)) == ""
