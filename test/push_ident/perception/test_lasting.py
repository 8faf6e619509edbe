"""Errors of poses that last: zero at the first pose, growing as the object turns, and part of the covariance of every pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.geometry.se2 import compose, inverse, transform_points, wrap_angle
from push_ident.perception.frame.view import FrameView
from push_ident.perception.known_object import Template, TrackStatus
from push_ident.perception.pipeline import Perception
from push_ident.perception.tracking.pose_fit import fit_pose, frame_step, in_table
from push_ident.types import CameraAccuracy, DepthFrame
from push_ident_sim.cell.sensor_unit import Sensor
from push_ident_sim.cell.sensors import SENSORS, suitable_pose
from push_ident_sim.objects import make_object

WITHIN_90 = 6.2514


@pytest.mark.parametrize("wrong", [{"position": -1e-3}, {"heading": np.nan}, {"position": np.inf}])
def test_an_accuracy_that_is_none_is_refused_by_name(wrong):
    (name,) = wrong
    with pytest.raises(InputError, match=f"{name} of the camera .* expected a standard deviation of 0 or more"):
        CameraAccuracy(**wrong)


def fits_of_displaced_edges(turn):
    """The pose of a turned book by a camera that may displace edges by 1 mm, and by one that does not."""
    unit, reported, thing, rng = Sensor("ideal", 1), suitable_pose("ideal"), make_object("book", 1), np.random.default_rng(0)
    camera, first = unit.camera(thing, reported), np.array([0.0, 0.0, 0.2])
    exact = reported @ SENSORS["ideal"].extrinsics_error(1)

    def frame(pose, stamp):
        return DepthFrame(stamp, unit.read(unit.look(camera, pose, {}), rng), unit.intrinsics)

    perception = Perception(exact)
    for i in range(10):
        perception.observe(frame(first, i / 30))
    traced = perception.known("o1").traced
    turned, start = frame(np.add(first, (0.0, 0.0, turn)), 1.0), np.add(traced.pose, (0.0, 0.0, turn))
    start[:2] = transform_points((0.0, 0.0, turn), traced.pose[None, :2])[0]
    templates = (Template(replace(traced, displaced_std=std)) for std in (1e-3, 0.0))
    return (fit_pose(template, FrameView(turned, perception.camera_in_table), start) for template in templates)


def test_displaced_edges_widen_the_covariance_of_a_turned_object_along_one_direction():
    """Other edges hide their walls then, and all of them are displaced alike."""
    unturned, turned = fits_of_displaced_edges(0.0), fits_of_displaced_edges(1.5)
    for fits, least, most in ((unturned, 0.0, 1e-4), (turned, 4e-4, 2e-3)):
        wide, plain = fits
        assert wide.status is plain.status is TrackStatus.TRACKED and np.allclose(wide.pose, plain.pose)
        more = np.linalg.eigvalsh(wide.covariance - plain.covariance)
        assert least <= np.sqrt(max(more[2], 0.0)) < most and abs(more[1]) < 1e-9


@pytest.mark.parametrize("sensor", ["plain", "kinect_v1", "realsense_d435_640x480", pytest.param("phoxi", marks=pytest.mark.long)])
def test_turned_objects_are_within_their_90_percent_regions(sensor):
    """Two objects, turned by 0.4 and by 0.8 rad: the errors of their poses are those of camera and outline."""
    squares = []
    for name, seed in (("hammer", 101), ("toolbox", 101)):
        thing, unit, reported = make_object(name, seed), Sensor(sensor, seed), suitable_pose(sensor)
        rng, camera = np.random.default_rng(seed), unit.camera(thing, reported)
        perception = Perception(reported)
        first, stamp, offset = np.array([0.02, -0.03, 0.3]), 0.0, None
        for turn in (*np.zeros(12), *np.linspace(0.1, 0.4, 4), *np.full(4, 0.4), *np.linspace(0.5, 0.8, 4), *np.full(4, 0.8)):
            pose = np.add(first, (0.0, 0.0, turn))
            observed = perception.observe(DepthFrame(stamp, unit.read(unit.look(camera, pose, {}), rng), unit.intrinsics))
            stamp += 1 / 30
            if observed.new_shapes:
                table = unit.table_as_seen(perception.camera_in_table, reported)
                offset = compose(inverse(compose(table, pose)), perception.first_pose("o1"))
            elif offset is not None and turn > 0.0:
                (known,) = observed.objects
                error = known.pose - compose(compose(table, pose), offset)
                error[2] = wrap_angle(error[2])
                squares.append(float(error @ np.linalg.solve(known.covariance, error)))
    assert np.mean(np.array(squares) < WITHIN_90) > 0.4  # books fare worse: decision 12


def test_frame_of_an_outline_of_several_rests_keeps_the_scatter_of_the_first_view():
    """Fits of one number: the edge of each view scatters by itself, and the frame follows the outline before."""
    rng, n_rests = np.random.default_rng(0), 4
    edge = rng.standard_normal((200000, n_rests + 1))
    frame, stated = np.zeros(len(edge)), np.zeros((3, 3))
    for n in range(2, n_rests + 1):
        before, after = edge[:, : n - 1].mean(axis=1), edge[:, :n].mean(axis=1)
        stated += frame_step((1.0 + 1.0 / (n - 1)) * np.eye(3), 0.7, n)
        frame += after - before
    assert stated == pytest.approx(np.var(frame) * np.eye(3), rel=0.02, abs=1e-12)
    pose = edge[:, n_rests] - edge[:, :n_rests].mean(axis=1) + frame
    assert np.var(pose) == pytest.approx(1.0 + 1.0 / n_rests + stated[0, 0], rel=0.02)


def test_covariance_of_the_object_frame_turns_with_the_object():
    along = np.diag([4.0, 1.0, 9.0])
    assert in_table(along, np.array([5.0, 5.0, np.pi / 2])) == pytest.approx(np.diag([1.0, 4.0, 9.0]))
    assert frame_step(in_table(along, np.array([0.0, 0.0, 0.4])), 0.4, 2) == pytest.approx(along / 4)
