"""Models of depth sensors: shadow from geometry, noise, lattice of disparities, edges, holes, and what a unit publishes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.types import CameraIntrinsics
from push_ident_sim.cell.camera import INTRINSICS, DepthCamera, Mesh, Placed, View
from push_ident_sim.cell.sensor_unit import Sensor
from push_ident_sim.cell.sensors import SENSORS, AxialNoise, SensorModel, suitable_pose
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.recording import RecordingSettings

FROM_ABOVE = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0], [0.0, 0.0, 0.0, 1.0]])
"""1 m above the table, image x along the x of the table."""
SMALL = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)
AWAY = (5.0, 5.0, 0.0)


def box(edge: float = 0.1) -> Mesh:
    """Cube on the table, its frame in the middle of its bottom."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)]) * edge
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])


def plane(depth: float, camera: CameraIntrinsics = SMALL) -> View:
    """A wall across the whole image."""
    shape = (camera.height, camera.width)
    wall = np.full(shape, depth, dtype=np.float32)
    return View(wall, np.ones(shape, np.float32), np.full(shape, 0.5, np.float32), np.ones(shape, dtype=bool))


def read(model: SensorModel, view: View, seed: int = 0) -> np.ndarray:
    return Sensor(model).read(view, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def camera() -> DepthCamera:
    return DepthCamera(make_object("book"), FROM_ABOVE)


@pytest.mark.parametrize(("baseline", "side"), [(0.05, 1), (0.27, -1)])
def test_shadow_of_a_box_lies_on_the_side_away_from_the_projector_and_is_as_wide_as_similar_triangles_have_it(
    camera: DepthCamera, baseline: float, side: int
) -> None:
    edge, height = 0.1, 1.0
    view = camera.view([Placed(box(edge), (0.0, 0.0, 0.0))], {}, side * baseline)
    depth = read(SensorModel("shadow", INTRINSICS, baseline=baseline, side=side, depth_unit=1e-6), view)
    row = depth[240]
    on_top = np.flatnonzero(row < height - edge / 2)
    dark = np.flatnonzero(np.isnan(row))
    # On the table it is baseline x edge / (height - edge) wide.
    assert len(dark) == pytest.approx(INTRINSICS.fx / height * baseline * edge / (height - edge), abs=1.0)
    assert np.all(np.diff(dark) == 1)
    assert dark[-1] == on_top[0] - 1 if side > 0 else dark[0] == on_top[-1] + 1
    np.testing.assert_allclose(depth[np.isfinite(depth)], view.depth[np.isfinite(depth)], atol=2e-6)


def test_several_things_hide_each_other_and_have_their_own_albedo(camera: DepthCamera) -> None:
    things = [Placed(box(0.1), (0.1, 0.0, 0.3), albedo=0.1), Placed(make_object("book"), (-0.15, 0.0, 0.0)), Placed(box(0.02), AWAY)]
    lifted = np.eye(4)
    lifted[:3, 3] = 0.1, 0.0, 0.3
    view = camera.view([*things, Placed(box(0.04), lifted, albedo=0.9)], {})
    at = {name: (240, round(319.5 + 600.0 * x / z)) for name, x, z in (("small", 0.1, 0.66), ("large", 0.055, 0.9), ("table", 0.4, 1.0))}
    assert [round(float(view.depth[p]), 4) for p in at.values()] == [0.66, 0.9, 1.0]
    assert [round(float(view.albedo[p]), 4) for p in at.values()] == [0.9, 0.1, 0.5]
    rendered = camera.render_scene([*things, Placed(box(0.04), lifted)], {})
    np.testing.assert_array_equal(view.depth, rendered)
    u = np.arange(640) - 319.5
    np.testing.assert_allclose(view.cosine[0, 420:], 600.0 / np.sqrt(600.0**2 + u[420:] ** 2 + 239.5**2), atol=1e-5)


@pytest.mark.parametrize("name", ["kinect_v1", "realsense_d435_848x480"])
def test_noise_grows_with_range_by_the_law_of_the_sensor_and_is_correlated_over_the_window(name: str) -> None:
    model = replace(SENSORS[name], intrinsics=INTRINSICS, disparity_step=0.0, depth_unit=1e-6, common_field=False, static_share=0.0)
    law = {"kinect_v1": lambda z: 0.0012 + 0.0019 * (z - 0.4) ** 2, "realsense_d435_848x480": lambda z: 0.08 * z**2 / (424.0 * 0.05)}
    for z in (0.6, 1.8):
        errors = read(model, plane(z, INTRINSICS)) - z
        assert errors.std() == pytest.approx(law[name](z), rel=0.05)
        shared = [np.mean(errors[:, : 640 - lag] * errors[:, lag:]) / errors.var() for lag in (1, model.window)]
        assert shared == pytest.approx([1.0 - 1.0 / model.window, 0.0], abs=0.06)
    if model.noise.grazing:  # Nguyen, Izadi & Lovell 2012
        flat, steep = model.noise.deviation(np.full(2, 1.0, np.float32), np.cos(np.radians([59.0, 70.0])).astype(np.float32))
        assert steep - flat == pytest.approx(1e-4 * (70.0 / 20.0) ** 2, rel=1e-3)


def test_disparity_has_whole_steps_and_depth_whole_units() -> None:
    kinect = replace(SENSORS["kinect_v1"], depth_unit=1e-7)
    view = plane(1.3, kinect.intrinsics)
    steps = 580.0 * 0.075 / 0.125 / read(kinect, view)
    steps = steps[np.isfinite(steps)]
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)
    assert 3 < len(np.unique(np.rint(steps))) < 20
    units = read(SENSORS["phoxi"], plane(0.8, SENSORS["phoxi"].intrinsics))[::7, ::7] * 1e4
    np.testing.assert_allclose(units, np.rint(units), atol=2e-3)
    assert len(np.unique(np.rint(units))) > 5


@pytest.mark.parametrize(("fattening", "width"), [(0.5, 104), (0.0, 100), (-1.0, 90)])
def test_edge_is_displaced_by_its_share_of_half_the_window(fattening: float, width: int) -> None:
    """A window of 9 pixels still holds the edge 4.5 pixels beside it: the fifth pixel from the edge has its centre there."""
    view = plane(1.0)
    view.depth[70:170, 110:210] = 0.9
    view.lit[70:170, 100:110] = False
    depth = read(SensorModel("edge", SMALL, window=9, fattening=fattening), view)
    near = depth < 0.95
    assert near[120].sum() == near[:, 160].sum() == width
    # Where the nearer surface covers the shadow there is depth, and where it recedes beside the shadow there is none.
    moved = (width - 100) // 2
    assert np.isnan(depth[120]).sum() == 10 - moved and np.isnan(depth[120, 100]) and near[120, 209 + min(moved, 0)]


def test_ragged_edge_has_the_stated_spread_and_some_of_its_pixels_fly() -> None:
    view = plane(1.0)
    view.depth[:, 160:] = 0.8
    ragged = read(SensorModel("ragged", SMALL, edge_jitter=0.8), view) < 0.9
    assert np.std(160 - np.argmax(ragged, axis=1)) == pytest.approx(0.8, abs=0.25)
    edge = read(SensorModel("flying", SMALL, flying=0.3, edge_dropout=0.2), view)[:, 159:161]
    assert np.mean(np.isnan(edge)) == pytest.approx(0.2, abs=0.08)
    assert np.mean((edge > 0.805) & (edge < 0.995)) == pytest.approx(0.3, abs=0.08)


def test_surfaces_that_are_grazing_dark_or_out_of_the_second_picture_read_less() -> None:
    depth = read(SensorModel("band", SMALL, baseline=0.05, common_field=True), plane(0.5))
    assert np.all(np.isnan(depth[:, :30])) and np.all(np.isfinite(depth[:, 30:]))
    grazing, dark = plane(1.0), plane(2.0)
    grazing.cosine[:, 100:200], grazing.cosine[:, 200:] = np.cos(np.radians(80.0)), np.cos(np.radians(86.0))
    dark.albedo[:, 100:200], dark.albedo[:, 200:] = 0.2, 0.04
    for view, law in ((grazing, {"grazing": (np.radians(75.0), np.radians(85.0))}), (dark, {"signal": (0.02, 0.08)})):
        depth = read(SensorModel("weak", SMALL, **law), view)
        share = [np.mean(np.isfinite(part)) for part in np.split(depth, [100, 200], axis=1)]
        assert share == pytest.approx([1.0, 0.5, 0.0], abs=0.03)


def test_images_repeat_with_the_seeds_and_what_stands_still_is_of_the_unit() -> None:
    model, view = SENSORS["kinect_v1"], plane(1.0, SENSORS["kinect_v1"].intrinsics)
    np.testing.assert_array_equal(read(model, view, 3), read(model, view, 3))
    assert not np.array_equal(read(model, view, 3), read(model, view, 4), equal_nan=True)
    still = replace(model, static_share=1.0, disparity_step=0.0, depth_unit=1e-6)
    first, again, other = (Sensor(still, seed).read(view, np.random.default_rng(i)) for i, seed in enumerate((0, 0, 1)))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other, equal_nan=True)


@pytest.mark.parametrize("name", ["plain", "phoxi"])
def test_sensor_sees_an_object_and_all_of_the_workspace(name: str) -> None:
    sensor, reported = Sensor(name), suitable_pose(name)
    sim_object, intrinsics = make_object("toolbox"), sensor.intrinsics
    camera = sensor.camera(sim_object, reported)
    depth = sensor.read(sensor.look(camera, (0.0, 0.0, 0.4), {}), np.random.default_rng(0))
    perfect = camera.render((0.0, 0.0, 0.4), {})
    assert depth.shape == (intrinsics.height, intrinsics.width) and depth.dtype == np.float32
    assert np.mean(np.isfinite(depth)) > 0.8 and np.nanmedian(np.abs(depth - perfect)) < 0.003
    on_object = perfect < camera.render(AWAY, {}) - 0.02
    assert on_object.sum() > 2000 and np.mean(np.isfinite(depth[on_object])) > 0.9
    corners = np.array([[x, y, 0.0, 1.0] for x in (-0.2, 0.2) for y in (-0.3, 0.3)]) @ np.linalg.inv(reported).T
    u, v = intrinsics.fx * corners[:, 0] / corners[:, 2] + intrinsics.cx, intrinsics.fy * corners[:, 1] / corners[:, 2] + intrinsics.cy
    assert np.all((u > 0) & (u < intrinsics.width) & (v > 0) & (v < intrinsics.height))


def test_true_pose_differs_from_the_published_one_by_the_stated_error() -> None:
    model = replace(SENSORS["kinect_v1"], rotation_std=2e-3, translation_std=3e-3)
    errors = [model.extrinsics_error(seed) for seed in range(300)]
    turns = np.array([(e[2, 1] - e[1, 2], e[0, 2] - e[2, 0], e[1, 0] - e[0, 1]) for e in errors]) / 2
    assert turns.std(axis=0) == pytest.approx([2e-3] * 3, rel=0.15)
    assert np.array([e[:3, 3] for e in errors]).std(axis=0) == pytest.approx([3e-3] * 3, rel=0.15)
    unit = Sensor(model, 7)
    true = unit.camera(make_object("book"), FROM_ABOVE).pose_camera_in_table
    np.testing.assert_allclose(np.linalg.inv(FROM_ABOVE) @ true, model.extrinsics_error(7), atol=1e-12)
    assert unit.intrinsics == model.intrinsics


def test_true_lens_displaces_a_point_by_the_stated_distortion(camera: DepthCamera) -> None:
    k = 0.05
    lens = DepthCamera(make_object("book"), FROM_ABOVE, INTRINSICS, distortion=k)
    sim_object = [Placed(box(0.1), (0.3, 0.0, 0.0))]
    left = [int(np.argmax(c.render_scene(sim_object, {})[240, 330:] < 0.95)) for c in (camera, lens)]
    # The left edge of its top is at x = 0.25 m, z = 0.9 m; a pixel at r shows what else is at r (1 + k r^2).
    r = 0.25 / 0.9
    assert left[0] - left[1] == pytest.approx(INTRINSICS.fx * k * r**3, abs=1.0)


def test_impossible_sensors_are_refused() -> None:
    with pytest.raises(InputError, match="'kinect' is not known, expected one of plain, ideal, kinect_v1"):
        Sensor("kinect")
    with pytest.raises(InputError, match="not known"):
        RecordingSettings(camera=True, sensor="kinect")
    with pytest.raises(InputError, match="ask for a camera"):
        RecordingSettings(sensor="kinect_v1")
    for wrong in ({"flying": 0.7, "edge_dropout": 0.5}, {"side": 0}, {"grazing": (1.0, 0.5)}, {"disparity_step": 0.1}, {"window": 0}):
        with pytest.raises(InputError, match="Sensor wrong: "):
            SensorModel("wrong", SMALL, **wrong)
    assert AxialNoise.of_disparity(0.1, 500.0, 0.1).quadratic == pytest.approx(0.002)
