"""An object of Bullet that is wrong in known ways, and the corrected one in that engine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.diagnosis import TRUTH, simulated_pushes
from helpers.objects import random_push
from push_ident.cli.scene import scene_of
from push_ident.errors import InputError
from push_ident.geometry.cells import cell_error
from push_ident.geometry.se2 import compose, inverse
from push_ident.identification.export.description import describe
from push_ident.identification.export.files import write_description
from push_ident.physics.effect_values import effect_values
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.simulators.bullet_scene import BulletScene
from push_ident.types import Float64Array, PusherPath

FINE = SimulationSettings(step=1 / 1920, resolve_events=True)
BODY = """<robot name="block"><link name="base">
<inertial><origin xyz="0.02 0.01 0.015"/><mass value="0.5"/><inertia ixx="1e-4" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0 0 0.015"/><geometry><box size="0.16 0.06 0.03"/></geometry></collision>
<contact><lateral_friction value="0.4"/></contact></link></robot>"""

SDF = """<sdf version="1.6"><model name="block"><link name="base"><pose>0 0 0.015 0 0 0</pose>
<inertial><pose>0.02 0.01 0 0 0 0</pose><mass>0.5</mass><inertia><ixx>1e-4</ixx><iyy>1e-3</iyy><izz>1e-3</izz></inertia></inertial>
<collision name="box"><geometry><box><size>0.16 0.06 0.03</size></box></geometry>
<surface><friction><ode><mu>0.4</mu><mu2>0.4</mu2></ode></friction></surface></collision></link></model></sdf>"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The outline of `TRUTH` as one even body."""
    file = tmp_path / "thing.urdf"
    even = replace(TRUTH, mass=np.full(len(TRUTH.mass), 0.01), friction=np.full(len(TRUTH.mass), 0.6))
    write_description(file, describe(even, object_id="thing", source="somebody", sliding=False), "urdf")
    return file


def off(scene: BulletScene, pushes: int = 4) -> float:
    """Mean distance of its ends from those of the true simulation [m]."""
    errors = []
    for record in simulated_pushes(pushes, 5):
        first, times = record.poses.pose[0], record.poses.time[-1:]
        own = simulate(TRUTH, PushScenario(record.pusher, first, times), settings=FINE).pose[-1]
        errors.append(cell_error(TRUTH.shape.cells, own, scene.simulate(first, record.pusher, times)[-1]))
    return float(np.mean(errors))


def test_object_and_contact_take_most_of_the_gap_and_the_rest_is_bullets_friction(path: Path, tmp_path: Path) -> None:
    scene = BulletScene(path)
    corrected = scene.with_object(TRUTH).with_precise_contact(TRUTH.pusher_friction)
    assert off(corrected) < 0.2 * off(scene) and off(corrected) < 4e-3
    written = corrected.write(tmp_path / "fixed.urdf")
    assert [file.name for file in written] == ["fixed.urdf.obj", "fixed.urdf"] and "enableConeFriction=1" in corrected.contact_settings
    # The file is the object.
    assert off(replace(BulletScene(tmp_path / "fixed.urdf"), precise=True), 2) == pytest.approx(off(corrected, 2), abs=1.5e-3)


def test_a_body_of_any_centre_of_mass_is_placed_and_seen_by_its_frame(tmp_path: Path) -> None:
    file = tmp_path / "block.urdf"
    file.write_text(BODY, encoding="utf-8")
    away = PusherPath(np.array([0.0, 0.2]), np.array([[0.5, 0.5], [0.6, 0.5]]), 0.01)
    pose, table, frame = np.array([0.1, -0.05, 0.8]), np.array([0.2, -0.1, 0.7]), np.array([0.01, -0.02, 0.4])
    for scene in (BulletScene(file), BulletScene(file, table_in_world=table, object_in_body=frame)):
        np.testing.assert_allclose(scene.simulate(pose, away, np.array([0.1, 0.2])), [pose, pose], atol=1e-4)
    push = random_push(TRUTH.shape, np.zeros(3), np.random.default_rng(0))
    ends: list[Float64Array] = []
    # Bullet's pyramid of friction lies along the axes of the world.
    for scene in (BulletScene(file), BulletScene(file, table_in_world=np.array([0.2, -0.1, 0.0]))):
        ends.append(scene.simulate(np.zeros(3), push, push.time[-1:])[-1])
    np.testing.assert_allclose(*ends, atol=2e-3)
    framed = BulletScene(file, object_in_body=frame).simulate(frame, push, push.time[-1:])[-1]
    np.testing.assert_allclose(compose(framed, inverse(frame)), ends[0], atol=2e-3)


def test_a_tilt_is_in_the_gravity_of_the_world(path: Path) -> None:
    scene = BulletScene(path, table_in_world=np.array([0.0, 0.0, np.pi / 2])).with_object(TRUTH, effect_values({"table_tilt": [0.05, 0.0]}))
    np.testing.assert_allclose(scene.gravity, [0.0, 0.05 * 9.81, -9.81], atol=1e-9)


def test_what_bullet_cannot_be_is_said(path: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Bullet cannot read"):
        BulletScene(tmp_path / "missing.urdf")
    with pytest.raises(InputError, match="no identified object"):
        BulletScene(path).write(tmp_path / "out.urdf")
    square = PusherPath(np.array([0.0, 1.0]), np.zeros((2, 2)), 0.0, polygon=0.01 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    with pytest.raises(InputError, match="round pusher"):
        BulletScene(path).simulate(np.zeros(3), square, np.array([0.5]))


def test_options_name_a_scene_by_its_suffix(path: Path, tmp_path: Path) -> None:
    scene = scene_of(path, "", "", "0.1,0,0", "", "0.5,0.8")
    assert isinstance(scene, BulletScene) and (scene.table_friction, scene.pusher_friction) == (0.5, 0.8)
    with pytest.raises(InputError, match="--engine-friction"):
        scene_of(tmp_path / "thing.sdf", "", "", "", "", "0.5")


def test_an_sdf_is_the_object_of_the_same_urdf_with_its_inertia_and_friction(tmp_path: Path) -> None:
    files = {tmp_path / "block.urdf": BODY, tmp_path / "block.sdf": SDF, tmp_path / "heavy.sdf": SDF.replace("<izz>1e-3", "<izz>1e-2")}
    files[tmp_path / "smooth.sdf"] = SDF.replace("0.4", "0.2")
    ends = []
    # A tool that leaves the object in motion, which inertia and friction then decide.
    throw = PusherPath(np.array([0.0, 0.1, 0.2]), np.array([[0.07, -0.06], [0.07, 0.02], [0.07, -0.06]]), 0.01)
    for file, text in files.items():
        file.write_text(text, encoding="utf-8")
        ends.append(BulletScene(file).simulate(np.zeros(3), throw, np.array([0.5]))[0])
    # A micrometre at the start changes an end in Bullet by as much.
    np.testing.assert_allclose(ends[1], ends[0], atol=5e-3)
    assert min(np.abs(ends[2] - ends[1]).max(), np.abs(ends[3] - ends[1]).max()) > 0.02


def test_a_corrected_sdf_is_written_as_one_with_what_the_world_needs(path: Path, tmp_path: Path) -> None:
    file = tmp_path / "block.sdf"
    file.write_text(SDF, encoding="utf-8")
    scene = BulletScene(file).with_object(TRUTH, effect_values({"table_tilt": [0.05, 0.0]})).with_precise_contact(0.3)
    assert [one.name for one in scene.write(tmp_path / "fixed.sdf")] == ["fixed.sdf.obj", "fixed.sdf"]
    assert "<sdf" in (tmp_path / "fixed.sdf").read_text(encoding="utf-8") and "<gravity>0.4905" in scene.contact_settings
    assert set(scene.words) == set(BulletScene(path).words)


def test_an_sdf_that_bullet_cannot_be_is_refused(tmp_path: Path) -> None:
    second = SDF[SDF.index("<collision") : SDF.index("</link>")].replace("0.4", "0.1").replace('"box"', '"other"')
    for text, expected in (
        ("<sdf", "Cannot read"),
        (SDF.replace("1e-4", "much"), "Cannot read"),
        (SDF.replace("</link>", f"{second}</link>"), "collisions of the link `base`"),
        (SDF.replace("</link></model>", "</link><model name='part'><link name='inner'/></model></model>"), "has the links"),
        (SDF.replace("<model", "<other").replace("</model", "</other"), "0 models"),
    ):
        (tmp_path / "block.sdf").write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=expected):
            BulletScene(tmp_path / "block.sdf")
