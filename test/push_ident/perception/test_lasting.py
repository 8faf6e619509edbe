"""Errors of poses that last: zero at the first pose, growing as the object turns, and part of the covariance of every pose."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.perception.lasting import CameraAccuracy, camera_covariance
from push_ident.perception.pipeline import Perception
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.shape import TracedObject
from push_ident.perception.tracking import Scene, Template, TrackStatus, fit_pose
from push_ident.types import CellGrid, DepthFrame, ObjectShape
from push_ident_sim.cell.sensor_unit import Sensor
from push_ident_sim.cell.sensors import suitable_pose
from push_ident_sim.objects import make_object

CAMERA = np.array([0.55, 0.0])
WITHIN_90 = 6.2514


def test_error_of_the_extrinsics_is_that_of_poses_in_the_frame_of_the_first_one():
    """Against the poses that cameras in wrong places and headings report."""
    rng, accuracy = np.random.default_rng(0), CameraAccuracy(2e-3, 3e-3)
    first, later = np.array([0.1, -0.05, 0.3]), np.array([-0.04, 0.12, 1.4])
    wrong = rng.standard_normal((20000, 3)) * [accuracy.position, accuracy.position, accuracy.heading]
    offset = compose(inverse(first), compose(wrong, first))
    error = compose(wrong, later) - compose(later, offset)
    assert camera_covariance(later, first, accuracy) == pytest.approx(np.cov(error.T, bias=True), abs=1e-7)
    assert camera_covariance(first, first, accuracy) == pytest.approx(np.zeros((3, 3)), abs=1e-15)


def fits_of_displaced_edges(turn, displaced=1e-3):
    """Pose error of a box of 12 x 8 cm, whose camera displaces edges with hidden walls, against the stated standard deviation."""
    unit, reported = Sensor("ideal", 0), suitable_pose("ideal")
    thing, rng = make_object("book", 1), np.random.default_rng(0)
    first = np.array([0.0, 0.0, 0.2])
    camera = unit.camera(thing, reported)
    seen_from = transform_points(inverse(first), reported[None, :2, 3])
    shape = ObjectShape(CellGrid(thing.cells, thing.cell_size), thing.outline)
    height = float(np.max(thing.height))
    traced = TracedObject(
        shape, first, np.full((1, 1), height, dtype=np.float32), np.zeros(2), 1.0, seen_from=seen_from, displaced_std=displaced
    )
    pose = first + (0.0, 0.0, turn)
    frame = DepthFrame(0.0, unit.read(unit.look(camera, pose, {}), rng), unit.intrinsics)
    plain = Template(TracedObject(shape, first, traced.top, np.zeros(2), 1.0))
    return (fit_pose(template, Scene(frame, reported), pose) for template in (Template(traced), plain))


@pytest.mark.parametrize("turn", [0.0, 0.7, 1.5])
def test_displaced_edges_widen_the_covariance_as_the_object_turns(turn):
    wide, plain = fits_of_displaced_edges(turn)
    assert wide.status is plain.status is TrackStatus.TRACKED and np.allclose(wide.pose, plain.pose)
    more = np.sqrt(np.linalg.eigvalsh(wide.covariance - plain.covariance))
    if turn == 0.0:
        assert more[2] < 2e-5
    else:
        assert 2e-4 * turn < more[2] < 2e-3 and abs(more[1]) < 1e-5  # along one direction: all edges alike


@pytest.mark.parametrize("sensor", ["plain", "kinect_v1", "realsense_d435_640x480", "phoxi"])
def test_turned_objects_are_within_their_90_percent_regions(sensor):
    """Two objects, turned by 0.4 and by 0.8 rad: the errors of their poses are those of camera and outline."""
    squares = []
    for name, seed in (("book", 103), ("toolbox", 104)):
        thing, unit, reported = make_object(name, seed), Sensor(sensor, seed), suitable_pose(sensor)
        rng, camera = np.random.default_rng(seed), unit.camera(thing, reported)
        perception = Perception(reported, PerceptionSettings(camera_accuracy=unit.accuracy(reported)))
        first, stamp, offset = np.array([0.02, -0.03, 0.3]), 0.0, None
        for turn in (*np.zeros(12), *np.linspace(0.1, 0.4, 4), *np.full(4, 0.4), *np.linspace(0.5, 0.8, 4), *np.full(4, 0.8)):
            pose = first + (0.0, 0.0, turn)
            observed = perception.observe(DepthFrame(stamp, unit.read(unit.look(camera, pose, {}), rng), unit.intrinsics))
            stamp += 1 / 30
            if observed.new_shapes:
                offset = compose(inverse(pose), perception.first_pose("o1"))
            elif offset is not None and turn > 0.0:
                (known,) = observed.objects
                error = known.pose - compose(pose, offset)
                error[2] = wrap_angle(error[2])
                squares.append(float(error @ np.linalg.solve(known.covariance, error)))
    assert np.mean(np.array(squares) < WITHIN_90) >= 0.75
