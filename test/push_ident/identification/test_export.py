"""Exported models, loaded and pushed in the engines they are for."""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pinocchio
import pybullet as bullet
import pytest
from pybullet_utils.bullet_client import BulletClient

from helpers.objects import hammer, random_push
from push_ident.cli.main import main
from push_ident.errors import InputError
from push_ident.geometry.cells import cell_error
from push_ident.geometry.convex import convex_pieces
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.outline import signed_distance
from push_ident.identification.export.description import describe
from push_ident.identification.export.files import SUFFIXES, write_description
from push_ident.identification.export.samples import drawn_objects, ranges
from push_ident.identification.predicting.prediction import predict
from push_ident.identification.results.model_file import load_model, save_model
from push_ident.identification.results.posterior import Estimate, ModelPosterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.physics.effect_values import effect_values
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY, SimulationSettings, body_of_cells, simulate
from push_ident.types import Float64Array, ObjectModel, ObjectShape, PusherPath
from push_ident_sim.engines.bullet.support import cone_friction_correction
from push_ident_sim.objects import OBJECT_NAMES, make_object
from push_ident_sim.recordings.truth import true_model

HEIGHT = 0.04
BULLET_SWELLING = 1e-3
"""By which Bullet makes a mesh too large [m]."""


def arrow() -> ObjectModel:
    """An object whose outline does not follow its cells, with maps that vary by a factor of about three."""
    outline = np.array([(0.0, 0.0), (-0.06, -0.06), (0.11, 0.005), (-0.05, 0.07)])
    cells = cells_in_outline(outline, 0.0115)
    mass, friction = np.exp(np.random.default_rng(3).uniform(-0.6, 0.6, (2, len(cells))))
    return ObjectModel(ObjectShape(cells, outline), 0.7 * mass / mass.sum(), 0.28 * friction, 0.22)


MODELS = {"hammer": hammer(1), "arrow": arrow()}


@pytest.fixture(params=MODELS)
def model(request: pytest.FixtureRequest) -> ObjectModel:
    return MODELS[request.param]


@pytest.fixture
def client() -> Iterator[BulletClient]:
    client = BulletClient(connection_mode=bullet.DIRECT)
    yield client
    client.disconnect()


def export(model: ObjectModel, folder: Path, format_name: str, *, sliding: bool = True) -> Path:
    path = folder / f"thing{SUFFIXES[format_name]}"
    write_description(path, describe(model, object_id="o1", source="model.json", height=HEIGHT, sliding=sliding), format_name)
    return path


@dataclass
class Links:
    """All links of a loaded object, those without a cell included; in the object frame."""

    name: list[str]
    mass: Float64Array
    centre: Float64Array
    """Of mass, shape (n_links, 3)."""
    inertia: Float64Array
    """About the own centre of mass, (I_xx, I_yy, I_zz), shape (n_links, 3)."""
    friction: Float64Array

    def assert_carries(self, model: ObjectModel) -> None:
        """Each cell's mass, place, inertia and friction, the outline's friction, and the whole body's inertia in the plane."""
        cells = [self.name.index(f"object_o1_cell_{i}") for i in range(len(model.mass))]
        np.testing.assert_allclose(self.mass[cells], model.mass, rtol=1e-12)
        np.testing.assert_allclose(self.friction[cells], model.friction, rtol=1e-12)
        assert self.friction[self.name.index("object_o1")] == pytest.approx(model.pusher_friction, rel=1e-12)
        places = np.column_stack([model.shape.cells.centres, np.full(len(cells), HEIGHT / 2)])
        np.testing.assert_allclose(self.centre[cells], places, atol=1e-12)
        plate = model.shape.cells.areas / 6
        np.testing.assert_allclose(self.inertia[cells, 2], model.mass * plate, rtol=1e-12)
        body = body_of_cells(model.shape, model.mass, model.friction)
        total = self.mass.sum()
        centre = self.mass @ self.centre[:, :2] / total
        inertia = np.sum(self.mass * np.sum((self.centre[:, :2] - centre) ** 2, axis=1) + self.inertia[:, 2])
        assert total == pytest.approx(body.mass, rel=1e-9)
        np.testing.assert_allclose(centre, body.centre, atol=1e-9)
        assert inertia == pytest.approx(body.inertia, rel=1e-9)


def links_in_mujoco(path: Path) -> Links:
    engine = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(engine)
    mujoco.mj_forward(engine, data)
    bodies = range(1, engine.nbody)
    assert np.all(engine.geom_priority == 1)
    np.testing.assert_array_equal(engine.body_iquat[1:], np.tile([1.0, 0, 0, 0], (engine.nbody - 1, 1)))
    friction = np.array([engine.geom_friction[engine.body_geomadr[body], 0] for body in bodies])
    names = [engine.body(body).name for body in bodies]
    return Links(names, engine.body_mass[1:], data.xipos[1:], engine.body_inertia[1:], friction)


def links_in_bullet(client: BulletClient, body: int) -> Links:
    numbers = range(-1, client.getNumJoints(body))
    infos = [client.getDynamicsInfo(body, i) for i in numbers]
    root = client.getBasePositionAndOrientation(body)[0]
    centre = [root, *(client.getLinkState(body, i, computeForwardKinematics=1)[0] for i in numbers[1:])]
    names = [client.getBodyInfo(body)[0].decode(), *(client.getJointInfo(body, i)[12].decode() for i in numbers[1:])]
    mass, friction, inertia = (np.array([info[k] for info in infos]) for k in (0, 1, 2))
    return Links(names, mass, np.array(centre), inertia, friction)


def links_in_sdf(path: Path) -> Links:
    links = list(ElementTree.parse(path).iterfind("model/link"))

    def values(tag: str, default: str = "nan") -> Float64Array:
        return np.array([[float(v) for v in link.findtext(tag, default).split()] for link in links])

    pose, inertial_pose = values("pose", "0 0 0 0 0 0"), values("inertial/pose")
    inertia = np.hstack([values(f"inertial/inertia/{tag}") for tag in ("ixx", "iyy", "izz")])
    friction = values("collision/surface/friction/ode/mu")[:, 0]
    return Links([link.get("name", "") for link in links], values("inertial/mass")[:, 0], (pose + inertial_pose)[:, :3], inertia, friction)


@pytest.mark.parametrize("sliding", [True, False], ids=["sliding", "fixed"])
def test_engines_read_the_maps_to_the_last_digit(model: ObjectModel, sliding: bool, tmp_path: Path, client: BulletClient) -> None:
    mjcf, urdf, sdf = (export(model, tmp_path, name, sliding=sliding) for name in ("mjcf", "urdf", "sdf"))
    links_in_mujoco(mjcf).assert_carries(model)
    assert mujoco.MjModel.from_xml_path(str(mjcf)).nv == (3 + len(model.mass) if sliding else 6)
    links_in_bullet(client, client.loadURDF(str(urdf), flags=bullet.URDF_USE_INERTIA_FROM_FILE)).assert_carries(model)
    # A parser that keeps to the specification: Bullet's forgives much.
    parsed = pinocchio.buildModelFromUrdf(str(urdf), pinocchio.JointModelFreeFlyer())
    assert pinocchio.computeTotalMass(parsed) == pytest.approx(model.total_mass, rel=1e-9)
    held = links_in_sdf(sdf)
    held.assert_carries(model)
    if not sliding:  # Bullet takes neither friction nor inertia from SDF, and knows no joint to the world, which sliding cells need
        (body,) = client.loadSDF(str(sdf))
        seen = links_in_bullet(client, body)
        order = [seen.name.index(name) for name in held.name]
        np.testing.assert_allclose(seen.mass[order], held.mass, rtol=1e-12)
        np.testing.assert_allclose(seen.centre[order], held.centre, atol=1e-12)


def points_around(outline: Float64Array, rng: np.random.Generator) -> Float64Array:
    low, high = outline.min(axis=0) - 0.02, outline.max(axis=0) + 0.02
    points = rng.uniform(low, high, (200, 2))
    distance = signed_distance(points, outline)
    return points[(distance > 0.004) & (distance < 0.02)]


def test_solid_outline_is_the_exact_polygon_in_mujoco_and_larger_only_by_a_mesh_margin_in_bullet(
    model: ObjectModel, tmp_path: Path, client: BulletClient
) -> None:
    radius, points = 0.002, points_around(model.shape.outline, np.random.default_rng(0))
    spec = mujoco.MjSpec.from_file(str(export(model, tmp_path, "mjcf")))
    probe = spec.worldbody.add_body(name="probe", mocap=True)
    probe.add_geom(name="probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0])
    engine = spec.compile()
    data = mujoco.MjData(engine)
    pieces = [i for i in range(engine.ngeom) if engine.geom(i).name.startswith("object_o1_outline")]
    body = client.loadURDF(str(export(model, tmp_path, "urdf")))
    frame = next(i for i in range(client.getNumJoints(body)) if client.getJointInfo(body, i)[12] == b"object_o1")
    probe = client.createMultiBody(0, client.createCollisionShape(bullet.GEOM_SPHERE, radius=radius))
    for point, expected in zip(points, signed_distance(points, model.shape.outline), strict=True):
        data.mocap_pos[0] = [*point, HEIGHT / 2]
        mujoco.mj_kinematics(engine, data)
        seen = min(mujoco.mj_geomDistance(engine, data, engine.geom("probe").id, piece, 0.1, None) for piece in pieces)
        assert seen == pytest.approx(expected - radius, abs=2e-6)
        client.resetBasePositionAndOrientation(probe, [*point, HEIGHT / 2], [0, 0, 0, 1])
        seen = min(close[8] for close in client.getClosestPoints(body, probe, 0.1, frame, -1))
        assert seen == pytest.approx(expected - radius - BULLET_SWELLING, abs=2e-5)


def random_pushes(model: ObjectModel, n: int, seed: int) -> Iterator[tuple[Float64Array, PusherPath]]:
    """First poses of the object, and pushes."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        pose = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(-np.pi, np.pi)])
        yield pose, random_push(model.shape, pose, rng)


def samples(pusher: PusherPath, step: float) -> Iterator[tuple[Float64Array, Float64Array]]:
    """Position and velocity of the pusher at each time step."""
    time = np.arange(pusher.time[0], pusher.time[-1], step)
    now, then = (np.column_stack([np.interp(t, pusher.time, pusher.position[:, k]) for k in (0, 1)]) for t in (time, time + step))
    return zip(now, (then - now) / step, strict=True)


def pushed_in_mujoco(path: Path, pusher: PusherPath, pose: Float64Array) -> Float64Array:
    """Last pose of the object on a table of MuJoCo's defaults."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1])
    tool = spec.worldbody.add_body(name="tool", pos=[0, 0, 0.03])
    for axis, name in enumerate("xy"):
        tool.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=np.eye(3)[axis])
    # So heavy that nothing slows it down within a step.
    cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
    tool.add_geom(type=cylinder, size=[pusher.radius, 0.025, 0], mass=1e3, contype=2, conaffinity=2)
    engine = spec.compile()
    data = mujoco.MjData(engine)
    body = [engine.joint(f"object_o1_{name}").qposadr[0] for name in ("x", "y", "yaw")]
    position, velocity = ([getattr(engine.joint(name), kind)[0] for name in "xy"] for kind in ("qposadr", "dofadr"))
    data.qpos[body] = pose
    for here, speed in samples(pusher, engine.opt.timestep):
        data.qpos[position], data.qvel[velocity] = here, speed
        mujoco.mj_step(engine, data)
    return np.array(data.qpos[body])


def pushed_in_bullet(client: BulletClient, path: Path, pusher: PusherPath, pose: Float64Array, model: ObjectModel) -> Float64Array:
    """Last pose of the object, set up as the comment in the file says; what is missing of Coulomb's law in Bullet is added."""
    step = 1 / 240
    client.resetSimulation()
    client.setGravity(0, 0, -GRAVITY)
    client.setPhysicsEngineParameter(fixedTimeStep=step, enableConeFriction=1, restitutionVelocityThreshold=0.0)
    table = client.createMultiBody(0, client.createCollisionShape(bullet.GEOM_BOX, halfExtents=[1, 1, 0.05]), basePosition=[0, 0, -0.05])
    client.changeDynamics(table, -1, lateralFriction=1.0)
    body = client.loadURDF(str(path), flags=bullet.URDF_USE_INERTIA_FROM_FILE)
    # A capsule touches at one point. At the several points where a cylinder touches, Bullet at times gets the friction wrong.
    capsule = client.createCollisionShape(bullet.GEOM_CAPSULE, radius=pusher.radius - BULLET_SWELLING, height=0.05)
    tool = client.createMultiBody(
        0, linkMasses=[1, 1000], linkCollisionShapeIndices=[-1, capsule], linkVisualShapeIndices=[-1, -1],
        linkPositions=[[0, 0, 0.05], [0, 0, 0]], linkOrientations=[[0, 0, 0, 1]] * 2, linkInertialFramePositions=[[0, 0, 0]] * 2,
        linkInertialFrameOrientations=[[0, 0, 0, 1]] * 2, linkParentIndices=[0, 1], linkJointTypes=[bullet.JOINT_PRISMATIC] * 2,
        linkJointAxis=[[1, 0, 0], [0, 1, 0]],
    )  # fmt: skip
    client.changeDynamics(tool, 1, lateralFriction=1.0)
    for moving in (body, tool):
        joints = range(client.getNumJoints(moving))
        client.setJointMotorControlArray(moving, joints, bullet.VELOCITY_CONTROL, forces=[0.0] * len(joints))
        for link in joints:
            client.changeDynamics(moving, link, linearDamping=0, angularDamping=0, jointDamping=0, restitution=0)
    for joint, value in enumerate(pose):
        client.resetJointState(body, joint, value)
    limit = model.friction * model.mass * GRAVITY
    for here, speed in samples(pusher, step):
        for axis in (0, 1):
            client.resetJointState(tool, axis, here[axis], speed[axis])
        states = client.getJointStates(body, range(3))
        turn = np.array([[np.cos(states[2][0]), np.sin(states[2][0])], [-np.sin(states[2][0]), np.cos(states[2][0])]])
        velocity = np.array([state[1] for state in states])
        wrench = cone_friction_correction(model.shape.cells.centres @ turn, model.mass, model.shape.cells.size, limit, velocity)
        client.setJointMotorControlArray(body, range(3), bullet.TORQUE_CONTROL, forces=wrench.tolist())
        client.stepSimulation()
    return np.array([state[0] for state in client.getJointStates(body, range(3))])


def test_engines_move_the_exported_object_as_our_own_simulation_does(model: ObjectModel, tmp_path: Path, client: BulletClient) -> None:
    mjcf, urdf = (export(model, tmp_path, name) for name in ("mjcf", "urdf"))
    cells, way, off = model.shape.cells, [], []
    for pose, pusher in random_pushes(model, 2, 7):
        own = simulate(model, PushScenario(pusher, pose, pusher.time[-1:])).pose[-1]
        ends = pushed_in_mujoco(mjcf, pusher, pose), pushed_in_bullet(client, urdf, pusher, pose, model)
        way.append(cell_error(cells, own, pose))
        off.append([cell_error(cells, own, end) for end in ends])
    assert np.mean(way) > 0.03
    assert np.all(np.mean(off, axis=0) < 0.02 * np.mean(way))


@pytest.mark.long
def test_exports_of_ten_objects_end_within_half_a_millimetre_of_the_model_in_mujoco(tmp_path: Path) -> None:
    """But for pushes that slip round a corner, or stick and slip: there small differences decide."""
    off, fine = [], SimulationSettings(step=1 / 1920, resolve_events=True)
    for seed, name in itertools.product((900, 901), OBJECT_NAMES):
        model = true_model(make_object(name, seed))
        path = export(model, tmp_path, "mjcf")
        for pose, pusher in random_pushes(model, 10, seed - 850):
            own = simulate(model, PushScenario(pusher, pose, pusher.time[-1:]), settings=fine).pose[-1]
            off.append(cell_error(model.shape.cells, own, pushed_in_mujoco(path, pusher, pose)))
    assert len(off) == 100 and np.median(off) < 1.5e-4 and np.mean(np.array(off) < 5e-4) >= 0.95


def test_tilted_table_goes_into_mujocos_gravity(tmp_path: Path) -> None:
    """With it the exported object ends where ours does; without, it would not."""
    model, effects = MODELS["hammer"], effect_values({"table_tilt": [0.05, -0.04], "pusher_friction": [0.2]})
    path = tmp_path / "thing.xml"
    write_description(path, describe(model, object_id="o1", source="model.json", height=HEIGHT, effects=effects), "mjcf")
    off, without = [], []
    for pose, pusher in random_pushes(model, 2, 8):
        end = pushed_in_mujoco(path, pusher, pose)
        for errors, acting in ((off, effects), (without, None)):
            own = simulate(model, PushScenario(pusher, pose, pusher.time[-1:]), effects=acting).pose[-1]
            errors.append(cell_error(model.shape.cells, own, end))
    assert np.mean(off) < 1e-3 < 2.5e-3 < np.mean(without)
    engine = mujoco.MjModel.from_xml_path(str(path))
    np.testing.assert_array_equal(engine.numeric("object_o1_table_tilt").data, [0.05, -0.04])


def test_anisotropic_base_goes_into_the_friction_directions_of_sdf(tmp_path: Path) -> None:
    model, (a, b) = MODELS["arrow"], (0.12, -0.09)
    path = tmp_path / "thing.sdf"
    write_description(path, describe(model, object_id="o1", source="m", effects=effect_values({"base_anisotropy": [a, b]})), "sdf")
    surfaces = [foot.find("surface/friction/ode") for foot in ElementTree.parse(path).iter("collision") if foot.get("name") == "foot"]
    for ode, friction in zip(surfaces, model.friction, strict=True):
        assert ode is not None
        mu, mu2 = (float(ode.findtext(tag, "")) for tag in ("mu", "mu2"))
        along = np.array(ode.findtext("fdir1", "").split(), dtype=float)[:2]
        across = np.array([-along[1], along[0]])
        tensor = mu * np.outer(along, along) + mu2 * np.outer(across, across)
        np.testing.assert_allclose(tensor, friction * np.array([[1 + a, b], [b, 1 - a]]), atol=1e-12)


def test_effects_that_a_format_cannot_express_stand_in_a_comment(tmp_path: Path) -> None:
    effects = effect_values({"wear": [0.03], "pusher_friction": [0.1]})
    for format_name, suffix in SUFFIXES.items():
        path = tmp_path / f"thing{suffix}"
        write_description(path, describe(MODELS["arrow"], object_id="o1", source="m", effects=effects), format_name)
        text = path.read_text(encoding="utf-8")
        assert "Effect wear (w = 0.03" in text and "is NOT in this file" in text
        assert "Effect pusher_friction (excess = 0.1) is in the friction of the outline." in text


@pytest.fixture(scope="module")
def model_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    parameters = UnknownsSpec.of(MODELS["arrow"].shape, Prior())
    z = np.random.default_rng(3).normal(size=parameters.size)
    posterior = ModelPosterior(parameters, z, np.eye(len(z)), Estimate(0.83, 0.4), total_mass_identifiable=False)
    path = tmp_path_factory.mktemp("models") / "model--1.json"
    save_model(path, posterior, object_id="o1 <&\x01>")
    return path


def command(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["push-ident", "export", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


@pytest.mark.parametrize("format_name", SUFFIXES)
def test_command_writes_beside_the_model_and_the_same_bytes_again(
    format_name: str, model_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert command(monkeypatch, model_file, "--format", format_name) == 0
    path = model_file.with_suffix(SUFFIXES[format_name])
    root = ElementTree.parse(path).getroot()
    assert root.tag in ("sdf", "robot", "mujoco")
    assert "model- -1.json" in path.read_text() and "push_ident" in path.read_text()
    again = tmp_path / path.name
    assert command(monkeypatch, model_file, "--format", format_name, "--out", again) == 0
    assert again.read_bytes() == path.read_bytes()
    meshes = {element.get("filename") or element.text for tag in (".//mesh[@filename]", ".//uri") for element in root.iterfind(tag)}
    assert meshes == (set() if format_name == "mjcf" else {f"{path.name}.obj"})
    assert all((tmp_path / str(mesh)).read_bytes() == (path.parent / str(mesh)).read_bytes() for mesh in meshes)
    if format_name == "mjcf":
        assert command(monkeypatch, model_file, "--format", "mjcf", "--out", again, "--height", HEIGHT, "--cells", "fixed") == 0
        links = links_in_mujoco(again)
        links.name = [name.replace("object_o1_____", "object_o1") for name in links.name]
        links.assert_carries(load_model(model_file)[1].model)


def test_samples_share_the_outline_and_ranges_say_what_they_have_in_common(
    model_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In MuJoCo each sample has the masses that the file of numbers states, and all scatter as the posterior says."""
    for name in SUFFIXES:
        folder, known = tmp_path / name, tmp_path / f"{name}.json"
        assert command(monkeypatch, model_file, "--format", name, "--samples", 40, "--out", folder, "--ranges", known) == 0
        assert sum(path.suffix == ".obj" for path in folder.iterdir()) == (name != "mjcf")
    samples, text = [json.loads((tmp_path / name / "samples.json").read_text())["samples"] for name in ("mjcf", "urdf")]
    assert samples == text and len(samples) == 40
    links = links_in_mujoco(tmp_path / "mjcf" / "sample_007.xml")
    np.testing.assert_allclose([m for m in links.mass if m > 1e-6], samples[7]["mass_kg"], rtol=1e-12)
    quantities = {q["name"]: q for q in json.loads((tmp_path / "mjcf.json").read_text())["quantities"]}
    total = np.array([one["total_mass_kg"] for one in samples])
    posterior = load_model(model_file)[1]
    assert quantities["total mass"]["std"] == pytest.approx(posterior.total_mass.std, rel=0.3)
    assert np.std(np.log(total)) == pytest.approx(posterior.total_mass.std / posterior.total_mass.value, rel=0.35)
    assert np.mean((total > quantities["total mass"]["low_5_percent"]) & (total < quantities["total mass"]["high_95_percent"])) >= 0.8


def test_ends_of_samples_scatter_as_predicted(model_file: Path) -> None:
    posterior = load_model(model_file)[1]
    drawn = drawn_objects(posterior, 60, 3)
    for pose, pusher in random_pushes(posterior.model, 3, 9):
        scenario = PushScenario(pusher, pose, pusher.time[-1:])
        ends = np.array([simulate(one.model, scenario, effects=one.effects).pose[-1] for one in drawn])
        stated = np.std(predict(posterior, scenario, first_covariance=np.zeros((3, 3)), n_samples=60).ends, axis=0)
        assert np.all(np.std(ends, axis=0) < 2.0 * stated + 1e-4) and np.all(np.std(ends, axis=0) > 0.5 * stated - 1e-4)


def test_ranges_hold_what_was_drawn_with_correlations(model_file: Path) -> None:
    known = ranges(load_model(model_file)[1])
    assert np.all(known.low < known.mean) and np.all(known.mean < known.high) and known.names[0] == "total mass"
    np.testing.assert_allclose(np.diag(known.correlation), 1.0)
    # A heavier object of the same shape has more inertia.
    assert known.correlation[0, known.names.index("yaw inertia about the centre of mass")] > 0.5
    with pytest.raises(InputError, match="expected at least 1"):
        drawn_objects(load_model(model_file)[1], 0)


def test_what_cannot_be_exported_ends_in_one_clear_line(
    model_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = model_file.read_bytes()
    for arguments, says in (
        ((model_file, "--format", "usd"), "expected one of sdf, urdf, mjcf"),
        ((model_file,), "There is nothing to write"),
        ((model_file, "--format", "sdf", "--cells", "welded"), "expected one of sliding, fixed"),
        ((model_file, "--format", "mjcf", "--out", model_file), "is the model itself"),
        ((model_file, "--format", "urdf", "--out", model_file / "thing.urdf"), "Cannot write"),
        ((tmp_path / "missing.json", "--format", "sdf"), "Cannot read"),
    ):
        assert command(monkeypatch, *arguments) == 1
        error = capsys.readouterr().err
        assert says in error and len(error.strip().splitlines()) == 1
    assert model_file.read_bytes() == before
    with pytest.raises(InputError, match="no area"):
        convex_pieces([(0.0, 0.0), (0.1, 0.1), (0.3, 0.3), (0.2, 0.2)])
