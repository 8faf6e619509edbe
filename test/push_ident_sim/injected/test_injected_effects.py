"""Injected effects: at size zero they change nothing; otherwise each follows its law in Bullet, by closed forms."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.sim_objects import CAMERA, block, disc, points_in_table
from push_ident.cli.main import app
from push_ident.errors import InputError
from push_ident.geometry.se2 import rotation, transform_points
from push_ident.offline.loading import load_pushes
from push_ident.pushing.push import PushSettings
from push_ident.types import PusherPath
from push_ident_sim.cell.camera import INTRINSICS, DepthCamera
from push_ident_sim.engines.bullet.push_world import PushWorld
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.injected import INJECTED, InjectedEffects
from push_ident_sim.injected.sensing import PoseSensor, check_rendered, true_camera
from push_ident_sim.objects import SimObject, make_object
from push_ident_sim.recordings.recording import RecordingSettings, record_pushes, seal
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, make_pushes, observe_motion

G, STEP, RADIUS = 9.81, 1.0 / 240.0, 0.008
MU, MASS = 0.3, 0.6
SPEED = 0.4
EXACT = CameraNoise(position_std=1e-9, yaw_std=1e-9, rate=100.0)


def thrown(
    effects: dict[str, float | tuple[float, ...]],
    *,
    heading: float = 0.0,
    speed: float = SPEED,
    pose: tuple[float, float, float] = (0, 0, 0),
    friction: float = MU,
    seconds: float = 0.04,
    pushes_done: int = 0,
) -> np.ndarray:
    """Mean acceleration (along the throw, to its left, turning) of a disc that was thrown, per mu g."""
    velocities: list[np.ndarray] = []
    away = PusherPath(np.array([0.0, seconds]), np.full((2, 2), 0.6), RADIUS)
    first = speed * np.array([np.cos(heading), np.sin(heading), 0.0])
    with closing(PushWorld(disc(friction), RADIUS, effects=InjectedEffects.of(effects))) as world:
        watch = lambda: velocities.append(world.object_velocity())  # noqa: E731
        world.push(pose, away, velocity=first, pushes_done=pushes_done, watch=watch, longest_rest=0.0)
    mean = (velocities[-1] - first) / (len(velocities) * STEP)
    return np.array([*(mean[:2] @ rotation(heading)), mean[2]]) / (friction * G if friction > 0 else 1.0)


def pushed(
    effects: dict[str, float | tuple[float, ...]],
    *,
    aside: float = 0.0,
    heading: float = 0.0,
    speed: float = 0.1,
    distance: float = 0.08,
    sim_object: SimObject | None = None,
    pushes_done: int = 0,
) -> tuple[TrueMotion, np.ndarray]:
    """A push of the block's left face, and the mean load of each cell in its last half."""
    sim_object = sim_object or block()
    loads: list[np.ndarray] = []
    start = np.array([sim_object.outline[:, 0].min() - RADIUS, aside]) - 0.02 * np.array([np.cos(heading), np.sin(heading)])
    end = start + distance * np.array([np.cos(heading), np.sin(heading)])
    path = PusherPath(np.array([0.0, distance / speed]), np.array([start, end]), RADIUS)
    with closing(PushWorld(sim_object, RADIUS, effects=InjectedEffects.of(effects))) as world:
        motion = world.push(np.zeros(3), path, pushes_done=pushes_done, watch=lambda: loads.append(world.cell_loads()))
    n = int(distance / speed / STEP)
    return motion, np.mean(loads[n // 2 : n - 1], axis=0)


def first_touch(motion: TrueMotion) -> int:
    return int(np.argmax(np.linalg.norm(motion.force, axis=1) > 0))


def test_effects_of_size_zero_are_no_effects() -> None:
    zero = InjectedEffects.of({name: effect.defaults for name, effect in INJECTED.items()})
    assert zero == InjectedEffects() and not zero
    settings = TruthSettings(n_train=1, n_test=0)
    (motion,), (same,) = (make_pushes(make_object("hammer", 3), [5], own) for own in (settings, replace(settings, effects=zero)))
    for name in ("time", "pose", "pusher", "reported", "force"):
        np.testing.assert_array_equal(getattr(motion, name), getattr(same, name))
    assert motion.reported is motion.pusher
    seen = [observe_motion(motion, RADIUS, CameraNoise(), np.random.default_rng(1), effects)[0] for effects in (None, zero)]
    np.testing.assert_array_equal(seen[0].pose, seen[1].pose)


@pytest.mark.parametrize(
    ("effects", "throw", "expected"),
    [
        ({}, {}, (-1.0, 0.0)),
        ({"table_tilt": (0.05, 0.03)}, {"seconds": 3 * STEP}, (-np.cos(np.hypot(0.05, 0.03)) + np.sin(0.05) / MU, np.sin(0.03) / MU)),
        ({"table_anisotropy": (0.2, 0.0)}, {}, (-1.2, 0.0)),
        ({"table_anisotropy": (0.2, 0.0)}, {"heading": np.pi / 2}, (-0.8, 0.0)),
        ({"table_anisotropy": (0.0, 0.2)}, {"pose": (0, 0, np.pi / 2), "seconds": STEP}, (-1.0, -0.2)),
        ({"base_anisotropy": (0.2, 0.0)}, {"pose": (0, 0, np.pi / 2)}, (-0.8, 0.0)),
        ({"position_dependent_friction": (2.0, 0.0)}, {"pose": (0.1, 0.0, 0.0), "heading": np.pi / 2}, (-1.2, 0.0)),
        ({"speed_dependent_friction": 0.2}, {"seconds": 3 * STEP}, (-1.0 - 0.2 * np.log(0.4 / 0.11), 0.0)),
        ({"stribeck_friction": (0.5, 0.1)}, {"speed": 0.02, "friction": 0.02, "seconds": 4 * STEP}, (-1.5, 0.0)),
        ({"stribeck_friction": (0.5, 0.1)}, {}, (-1.0, 0.0)),
        ({"wear": 0.05}, {"pushes_done": 5}, (-1.25, 0.0)),
        ({"tether": 20.0}, {"friction": 0.0, "seconds": 0.3}, (SPEED * (np.cos(0.3 * np.sqrt(20.0 / MASS)) - 1.0) / 0.3, 0.0)),
        ({"viscous_film": 3.0}, {"friction": 0.02, "seconds": 3 * STEP}, (-1.0 - 3.0 * SPEED / MASS / (0.02 * G), 0.0)),
    ],
)
def test_thrown_disc_is_slowed_by_the_law_of_the_effect(effects: dict, throw: dict, expected: tuple[float, float]) -> None:
    along, left, turning = thrown(effects, **throw)
    assert along == pytest.approx(expected[0], rel=0.03)
    assert left == pytest.approx(expected[1], abs=0.01)
    # On a slope of friction the outer cells turn the disc; else nothing does.
    assert "position_dependent_friction" in effects or abs(turning) < 0.05


def test_compliant_table_springs_back() -> None:
    ends = []
    away = PusherPath(np.array([0.0, 0.1]), np.full((2, 2), 0.6), RADIUS)
    for effects in ({}, {"compliant_table": 5e-3}):
        with closing(PushWorld(disc(), RADIUS, effects=InjectedEffects.of(effects))) as world:
            motion = world.push(np.zeros(3), away, velocity=(0.03, 0.0, 0.0))
        ends.append((float(motion.pose[:, 0].max()), float(motion.pose[-1, 0])))
    (slid, stayed), (swung, returned) = ends
    assert stayed == pytest.approx(slid, abs=1e-5)
    # The spring takes notice of a throw one time step late.
    assert swung > 5e-4 and returned == pytest.approx(-0.03 * STEP, abs=1e-5)


def test_high_push_leans_the_object_on_its_far_side_and_loose_contents_slide_back() -> None:
    # Moment of the push mu W h, over the weight W.
    for effects, shift in (({}, 0.0), ({"push_height": MU * 0.05}, MU * 0.05), ({"moving_contents": (0.01, 0.05)}, -0.01)):
        _, loads = pushed(effects, distance=0.1)
        assert loads.sum() == pytest.approx(MASS * G, rel=1e-3)
        np.testing.assert_allclose(loads @ block().cells / loads.sum(), [shift, 0.0], atol=5e-4)


def test_friction_of_the_pusher_drags_along_the_face() -> None:
    for effects, expected in (({}, 0.3), ({"pusher_friction": 0.2}, 0.5), ({"pusher_friction": -0.3}, 0.0), ({"rolling_finger": 1.0}, 0.0)):
        motion, _ = pushed(effects, heading=np.radians(50), aside=-0.01, distance=0.05)
        forces = np.array([force @ rotation(pose[2]) for pose, force in zip(motion.pose[:-1], motion.force[1:], strict=True)])
        ratio = [along / normal for normal, along in forces if normal > 0.3]
        assert np.quantile(ratio, 0.95) == pytest.approx(expected, abs=0.03), effects


def test_object_bounces_off_the_pusher() -> None:
    for e in (0.0, 0.5):
        motion, _ = pushed({"restitution": e}, speed=0.3)
        touch = first_touch(motion)
        fastest = np.diff(motion.pose[touch - 1 : touch + 3, 0]).max() / STEP
        assert fastest == pytest.approx(0.3 * (1 + e), abs=1.5 * MU * G * STEP)


def test_object_is_larger_than_its_outline() -> None:
    motions = [pushed({"outline_error": offset}, speed=0.05, distance=0.03)[0] for offset in (-0.002, 0.002)]
    np.testing.assert_allclose(np.diff([motion.pusher[first_touch(motion), 0] for motion in motions]), -0.004, atol=3e-4)


def test_reported_tool_pose_has_the_injected_error() -> None:
    speed, far = 0.1, slice(100, 180)

    def aside(effects: dict) -> np.ndarray:
        motion, _ = pushed(effects, speed=speed)
        return (motion.pusher - motion.reported)[far]

    np.testing.assert_allclose(aside({"pusher_lag": 0.05}), [[-speed * 0.05, 0.0]] * 80, atol=speed * STEP)
    np.testing.assert_allclose(aside({"tool_offset": (0.001, -0.002)}), [[0.001, -0.002]] * 80, atol=1e-6)
    np.testing.assert_allclose(np.hypot(*aside({"pusher_wobble": (0.001, 5.0)}).T), 0.001, atol=1e-5)
    motion, _ = pushed({"tool_drift": (2e-4, -1e-4)}, pushes_done=7)
    np.testing.assert_allclose((motion.pusher - motion.reported)[far], [[14e-4, -7e-4]] * 80, atol=1e-6)
    motion, _ = pushed({"pusher_speed_scale": 0.05}, speed=speed)
    np.testing.assert_allclose(motion.pusher[far, 0] - motion.pusher[0, 0], 1.05 * speed * motion.time[far], atol=speed * STEP)


def observed(motion: TrueMotion, effects: dict, noise: CameraNoise = EXACT) -> tuple[np.ndarray, np.ndarray]:
    poses, _, _ = observe_motion(motion, RADIUS, noise, np.random.default_rng(4), InjectedEffects.of(effects))
    return poses.time, poses.pose


def test_camera_sees_the_object_elsewhere_later_less_often_and_with_correlated_noise() -> None:
    motion, _ = pushed({}, aside=0.02)
    time, plain = observed(motion, {})
    np.testing.assert_allclose(observed(motion, {"camera_translation": (0.002, -0.001)})[1], np.add(plain, [0.002, -0.001, 0.0]), atol=1e-7)
    turned = observed(motion, {"camera_rotation": 0.1})[1]
    np.testing.assert_allclose(turned, np.column_stack([plain[:, :2] @ rotation(0.1).T, plain[:, 2] + 0.1]), atol=1e-7)
    np.testing.assert_allclose(observed(motion, {"camera_scale": 0.05})[1], plain * [1.05, 1.05, 1.0], atol=1e-7)
    late = observed(motion, {"pose_latency": 0.1})[1]
    np.testing.assert_allclose(late[10:], plain[:-10], atol=1e-7)
    kept = observed(motion, {"dropped_frames": 0.4})[0]
    assert np.all(np.isin(kept, time)) and len(kept) / len(time) == pytest.approx(0.6, abs=0.1)
    flips = np.abs(observed(motion, {"pose_flips": 0.2})[1][:, 2] - plain[:, 2]) % (2 * np.pi) > 1.0
    assert flips.mean() == pytest.approx(0.2, abs=0.1)
    # Correlated noise keeps its deviation.
    noise = CameraNoise(position_std=1e-3, yaw_std=0.01, rest=20.0)
    errors = observed(motion, {"noise_correlation": 0.6}, noise)[1][:550]
    np.testing.assert_allclose(errors.std(axis=0), [1e-3, 1e-3, 0.01], rtol=0.15)
    assert [np.corrcoef(e[1:], e[:-1])[0, 1] for e in errors.T] == pytest.approx([0.6] * 3, abs=0.12)


def test_rendered_camera_has_the_errors_of_the_pose_sensor() -> None:
    sim_object, pose = block(), np.array([0.05, 0.08, 0.3])

    def centre(effects: dict) -> np.ndarray:
        camera = DepthCamera(sim_object, *true_camera(InjectedEffects.of(effects), CAMERA, INTRINSICS))
        points = points_in_table(camera.render(pose, {}))
        return np.nanmean(points[points[..., 2] > 0.025][:, :2], axis=0)

    true = centre({})
    np.testing.assert_allclose(centre({"camera_translation": (0.01, -0.02)}), np.add(true, [0.01, -0.02]), atol=3e-4)
    np.testing.assert_allclose(centre({"camera_rotation": 0.1}), rotation(0.1) @ true, atol=3e-4)
    # Across the line of sight; along it the picture is foreshortened, and the table seems to tilt.
    assert centre({"camera_scale": 0.05})[1] == pytest.approx(1.05 * true[1], rel=2e-3)
    with pytest.raises(InputError, match="pose_flips"):
        check_rendered(InjectedEffects.of({"pose_flips": 0.1}))


def test_poses_come_one_by_one_late_and_lossy() -> None:
    sensor = PoseSensor(InjectedEffects.of({"pose_latency": 0.1, "dropped_frames": 0.5}), np.full(3, 1e-9), np.random.default_rng(3))
    arrived = [(stamp, now, pose) for now in 0.01 * np.arange(400) for stamp, pose in sensor.measure(now, np.array([now, 0.0, 0.0]))]
    assert len(arrived) == pytest.approx(195, abs=40)
    for stamp, now, pose in arrived:
        assert stamp <= now + 1e-9 and pose[0] == pytest.approx(stamp - 0.1, abs=1e-6)


def test_effects_are_read_and_refused_by_name() -> None:
    effects = InjectedEffects.parse(["table_tilt=0.02", "stribeck_friction=0.3,0.05", "wear=0"])
    assert effects.as_dict() == {"stribeck_friction": (0.3, 0.05), "table_tilt": (0.02, 0.0)}
    assert effects["pusher_wobble"] == (0.0, 4.0) and "wear" not in effects
    for text, reason in (("tilt=1", "expected some of"), ("wear", "no size"), ("wear=x", "no size"), ("wear=1,2", "w \\[1\\]")):
        with pytest.raises(InputError, match=reason):
            InjectedEffects.parse([text])
    for text in ("restitution=nan", "restitution=2", "compliant_table=1e-5"):
        with pytest.raises(InputError, match="expected 0"):
            InjectedEffects.parse([text])


def test_command_writes_a_bag_whose_effect_appears_only_in_the_truth(tmp_path: Path) -> None:
    bag, truth = tmp_path / "tilted", tmp_path / "truth.json"
    call = ["simulate", "--object", "toolbox", "--effect", "table_tilt=0.03", "--pushes", "1", "--out", str(bag), "--truth", str(truth)]
    app(call, standalone_mode=False)
    loaded = load_pushes([bag])
    assert len(loaded.records) == 1 and loaded.records[0].wrench is not None
    assert json.loads(truth.read_text())["effects"] == {"table_tilt": [0.03, 0.0]}
    assert b"tilt" not in (bag / "tilted.mcap").read_bytes().replace(b"tilted", b"")
    with pytest.raises(InputError, match="exists already"):
        app(call, standalone_mode=False)


def test_filmed_pushes_can_be_tracked(tmp_path: Path) -> None:
    noise = CameraNoise(rate=10.0, rest=1.0, force_std=0.05)
    truth = record_pushes(tmp_path / "film", RecordingSettings("toolbox", n_pushes=1, noise=noise, camera=True))
    assert seal(truth) == seal(json.loads(json.dumps(truth)))
    (record,) = load_pushes([tmp_path / "film"]).records
    (motion,) = make_pushes(make_object("toolbox"), [0, 3, 0], TruthSettings(n_train=1, n_test=0, pushes=PushSettings()), in_a_row=True)
    moved, observed_motion = (p[-1] - p[0] for p in (motion.pose, record.poses.pose))
    # Of the same point of the object: its frames differ.
    first = transform_points(motion.pose[0], np.zeros((1, 2)))[0] - record.poses.pose[0, :2]
    expected = moved[:2] + (np.eye(2) - rotation(moved[2])) @ first
    np.testing.assert_allclose(observed_motion[:2], expected, atol=2e-3)
    assert observed_motion[2] == pytest.approx(moved[2], abs=0.02)
