"""How well the place of an edge of a traced outline is known: as well as its deviation says, for every sensor model."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.perception.outline.edges import EdgeLines, displaced_std, edge_std, hidden_walls, same_curve, without_teeth
from push_ident.perception.pipeline import Perception
from push_ident.types import DepthFrame
from push_ident_sim.cell.sensor_unit import Sensor
from push_ident_sim.cell.sensors import SENSORS, suitable_pose
from push_ident_sim.objects import make_object

SQUARE = np.array([(-0.05, -0.05), (0.05, -0.05), (0.05, 0.05), (-0.05, 0.05)])


def lines_of(scatter, n=20000, seed=0):
    """Lines of sight near the first edge of a square whose place scatters [m]."""
    rng = np.random.default_rng(seed)
    distance = rng.uniform(-0.005, 0.005, n)
    expected = 1.0 / (1.0 + np.exp(distance / 0.0015))
    stopped = distance < scatter * rng.standard_normal(n)
    return EdgeLines(np.zeros(n, dtype=np.int64), expected * (1.0 - expected) / 0.0015, stopped - expected, np.zeros((n, 2)))


@pytest.mark.parametrize("scatter", [0.0, 5e-4, 1e-3, 2e-3])
def test_deviation_of_an_edge_follows_its_scatter(scatter):
    hidden, seen = (edge_std(SQUARE, [lines_of(scatter)], SQUARE, [lines_of(scatter, seed=1)], np.array([[0.0, y]])) for y in (0.5, -0.5))
    assert hidden[0] == pytest.approx(np.hypot(1.0, 1.8) * scatter, abs=3e-4)  # ragged, and displaced
    assert seen[0] == pytest.approx(scatter, abs=2.5e-4)
    assert np.all(hidden[1:] > 9e-4)  # no line of sight passes the others: the prior of 1 mm


def test_walls_that_no_camera_sees_are_hidden():
    assert hidden_walls(SQUARE, np.array([[0.0, -0.5]])).tolist() == [False, True, True, True]
    assert hidden_walls(SQUARE, np.array([[0.0, -0.5], [0.4, 0.0]])).tolist() == [False, False, True, True]
    assert displaced_std(SQUARE, np.array([[0.0, -0.5]]), [lines_of(1e-3)]) == pytest.approx(0.0, abs=1e-5)
    assert displaced_std(SQUARE, np.array([[0.0, 0.5]]), [lines_of(1e-3)]) == pytest.approx(1.8e-3, abs=2.5e-4)


def test_teeth_of_a_pixel_are_no_shape_and_larger_ones_are():
    rng = np.random.default_rng(0)
    along = np.linspace(-0.05, 0.05, 30)
    for height, n in ((0.002, 4), (0.02, 32)):
        teeth = np.stack([along, 0.03 + height * (np.arange(30) % 2) + 1e-5 * rng.standard_normal(30)], axis=1)[::-1]
        assert len(without_teeth(np.vstack([(-0.05, -0.05), (0.05, -0.05), teeth]), 0.0017)) == n


def test_pieces_of_a_curve_share_their_lines_of_sight():
    angle = np.linspace(0.0, 2 * np.pi, 40, endpoint=False)
    circle = 0.03 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert np.all(same_curve(SQUARE) == np.eye(4))
    assert np.all(np.sum(same_curve(circle), axis=1) == 5)


@pytest.mark.parametrize("sensor", ["plain", "kinect_v1", "realsense_d435_848x480", "phoxi"])
def test_edges_are_where_their_deviations_say(sensor):
    """Longer edges of the book, with exact extrinsics: a rigid motion would spread what displaces the hidden edges over all of them."""
    thing, unit, reported = make_object("book", 101), Sensor(sensor, 101), suitable_pose(sensor)
    exact = reported @ SENSORS[sensor].extrinsics_error(101) if sensor in SENSORS else reported
    rng, pose = np.random.default_rng(7), np.array([0.03, -0.02, 0.4])
    camera, perception = unit.camera(thing, reported), Perception(exact)
    seen = unit.look(camera, pose, {})
    for i in range(10):
        found = perception.observe(DepthFrame(i / 30, unit.read(seen, rng), unit.intrinsics), ()).new_shapes
        if found:
            break
    shape, first = found["o1"], perception.first_pose("o1")
    outline, truth = transform_points(first, shape.outline), transform_points(pose, thing.outline)
    end = np.roll(outline, -1, axis=0)
    long = np.linalg.norm(end - outline, axis=1) > 0.03
    share = np.linspace(0.2, 0.8, 9)[:, None]
    error = np.array([signed_distance(a + share * (b - a), truth).mean() for a, b in zip(outline, end, strict=True)])
    ratio = np.sqrt(np.mean((error[long] / shape.outline_std[long]) ** 2))
    assert 0.05 < ratio < 2.5 and shape.outline_error < 4e-3
