"""A scene of MuJoCo that is wrong in known ways: its gap in parts, and the corrected scene in that engine."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from helpers.diagnosis import TRUTH, simulated_pushes
from push_ident.cli.main import main
from push_ident.errors import InputError
from push_ident.geometry.cells import cell_error
from push_ident.geometry.convex import convex_pieces
from push_ident.geometry.se2 import compose, inverse
from push_ident.physics.effect_values import effect_values, true_pose
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.simulators.gap import ENGINE, MODEL, simulator_gap
from push_ident.simulators.measured import Measured, corrected_path, inexpressible
from push_ident.simulators.mujoco_scene import MujocoScene
from push_ident.simulators.page import write_gap_page
from push_ident.simulators.protocol import CONTACT, OBJECT, FunctionSimulator
from push_ident.types import Float64Array, ObjectModel, PusherPath

FINE = SimulationSettings(step=1 / 1920, resolve_events=True)
RADIUS = simulated_pushes(1, 0)[0].pusher.radius


def scene(tool: str = "", joint: str = "<freejoint/>") -> str:
    """The outline of `TRUTH` as an even body of MuJoCo's default contacts, turned and displaced in the world."""
    meshes, geoms = [], []
    for number, piece in enumerate(convex_pieces(TRUTH.shape.outline)):
        vertices = " ".join(f"{x} {y} {z}" for z in (0.0, 0.03) for x, y in piece)
        meshes.append(f'<mesh name="piece{number}" vertex="{vertices}"/>')
        geoms.append(f'<geom type="mesh" mesh="piece{number}" density="500" friction="0.5 0 0"/>')
    finger = f'<body name="finger" mocap="true" pos="1 1 0.02"><geom type="capsule" size="{RADIUS} 0.015" friction="0.5 0 0"/></body>'
    return (
        f"<mujoco><asset>{''.join(meshes)}</asset><worldbody>"
        '<geom name="table" type="plane" size="2 2 0.1" friction="0.5 0 0"/>'
        f'<body name="thing" pos="0.3 0.2 0.0001" euler="0 0 30">{joint}{"".join(geoms)}</body>{tool or finger}</worldbody></mujoco>'
    )


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "scene.xml"
    file.write_text(scene(), encoding="utf-8")
    return file


def our_own(model: ObjectModel) -> FunctionSimulator:
    """The model of this package as somebody else's simulator."""

    def own(first_pose: Float64Array, tool_path: PusherPath, times: Float64Array) -> Float64Array:
        return simulate(model, PushScenario(tool_path, first_pose, times)).pose

    return FunctionSimulator(own)


def test_a_wrong_scene_is_divided_and_corrected_in_its_own_engine(path: Path, tmp_path: Path) -> None:
    records, seen = simulated_pushes(8, 3), list[str]()
    gap = simulator_gap(records, MujocoScene(path, "thing", "finger"), on_progress=seen.append)
    assert gap.parts == (OBJECT, CONTACT, ENGINE, MODEL) and len(seen) > 8
    assert gap.sizes.sum() == pytest.approx(gap.errors[0].mean())
    fixed = gap.errors[gap.stages.index("with precise contact")]
    assert fixed.mean() < 0.25 * gap.errors[0].mean()
    # The engine does with the identified object what the model does.
    assert abs(gap.sizes[gap.parts.index(ENGINE)]) < 5e-4
    assert gap.causes[0] == OBJECT and any("mass and friction of its geoms" in line for line in gap.lines())
    assert gap.observed.shape == gap.ends.shape == (2, 8, 3)
    write_gap_page(tmp_path / "gap.html", gap, TRUTH.shape.outline, ["written scene.xml"])
    page = (tmp_path / "gap.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 9 and all(part in page for part in gap.parts) and "<li>written scene.xml</li>" in page
    assert gap.lines()[0].startswith("scene.xml misses the ends of 8 pushes by") and gap.as_json()["simulator"] == "scene.xml"


def test_a_corrected_scene_is_a_file_that_moves_the_object_alike(path: Path, tmp_path: Path) -> None:
    """The true object in it ends where the true simulation ends, also in another frame of the world and of the body."""
    table, frame = np.array([0.2, -0.1, 0.7]), np.array([0.01, -0.02, 0.4])
    corrected = MujocoScene(path, "thing", "finger").with_object(TRUTH).with_precise_contact(TRUTH.pusher_friction)
    file = tmp_path / "fixed.xml"
    assert corrected.write(file) == [file] and 'cone="elliptic" impratio="10"' in corrected.contact_settings
    again = MujocoScene(file, "thing", "finger")
    for record in simulated_pushes(4, 5)[1:]:  # the first one slips round a corner
        first, times = record.poses.pose[0], record.poses.time[-1:]
        own = simulate(TRUTH, PushScenario(record.pusher, first, times), settings=FINE).pose[-1]
        end = again.simulate(first, record.pusher, times)[-1]
        assert cell_error(TRUTH.shape.cells, own, end) < 3e-4
        elsewhere = MujocoScene(file, "thing", "finger", table_in_world=table).simulate(first, record.pusher, times)[-1]
        assert cell_error(TRUTH.shape.cells, elsewhere, end) < 2e-4
        framed = MujocoScene(file, "thing", "finger", object_in_body=frame)
        moved = framed.simulate(compose(first, frame), record.pusher, times)[-1]
        assert cell_error(TRUTH.shape.cells, compose(moved, inverse(frame)), end) < 2e-4


def test_the_tool_of_a_tilted_scene_stays_where_its_path_begins(path: Path) -> None:
    """Also while the object comes to rest, where a free one would slide onto the object."""
    for record in simulated_pushes(4, 5)[1:3]:
        first, times = record.poses.pose[0], record.poses.time[-1:]
        tilt = effect_values({"table_tilt": (first[:2] - record.pusher.position[0]) / (0.5 * 9.81 * 0.5**2)})
        corrected = MujocoScene(path, "thing", "finger").with_object(TRUTH, tilt).with_precise_contact(TRUTH.pusher_friction)
        own = simulate(TRUTH, PushScenario(record.pusher, first, times), effects=tilt, settings=FINE).pose[-1]
        assert cell_error(TRUTH.shape.cells, own, corrected.simulate(first, record.pusher, times)[-1]) < 1e-3


def test_an_object_that_is_recorded_around_the_tool_is_moved_out_of_it_and_not_thrown(path: Path) -> None:
    corrected = MujocoScene(path, "thing", "finger").with_object(TRUTH).with_precise_contact(TRUTH.pusher_friction)
    left = float(TRUTH.shape.outline[:, 0].min())
    for depth in (0.001, 0.003):
        inside = np.tile([left + depth - RADIUS, 0.0], (2, 1))
        end = corrected.simulate(np.zeros(3), PusherPath(np.array([0.0, 0.5]), inside, RADIUS), np.array([0.5]))[-1]
        np.testing.assert_allclose(end, [depth, 0.0, 0.0], atol=2e-4)


def test_errors_of_tool_clock_and_camera_act_outside_any_engine() -> None:
    """The own model without effects, measured with them, is the own model with them."""
    effects = effect_values(
        {"tool_offset": [0.004, -0.002], "pusher_lag": [0.05], "pose_latency": [0.03], "camera_rotation": [0.02], "camera_scale": [0.01]}
        | {"tool_drift": [0.002, -0.001]}
    )
    assert inexpressible(effects) == () and inexpressible(effect_values({"wear": [0.1]})) == ("wear",)
    path = simulated_pushes(1, 4)[0].pusher
    assert corrected_path(effect_values({"outline_error": [0.002]}), path).radius == pytest.approx(path.radius + 0.002)
    for record in simulated_pushes(3, 4):
        first, times = record.poses.pose[0], record.poses.time[5::10]
        outside = Measured(our_own(TRUTH), effects, record.order).simulate(first, record.pusher, times)
        scenario = PushScenario(record.pusher, true_pose(effects, first), times, record.order)
        inside = simulate(TRUTH, scenario, effects=effects).pose
        assert max(cell_error(TRUTH.shape.cells, a, b) for a, b in zip(outside, inside, strict=True)) < 3e-4


def test_a_cause_that_is_added_takes_its_part_of_the_gap() -> None:
    records = simulated_pushes(4, 6, {"tool_offset": [0.005, -0.004]})
    gap = simulator_gap(records, our_own(TRUTH), effects=("tool_offset",))
    assert gap.parts[0] == "tool_offset" and gap.parts[-1] == MODEL
    assert gap.sizes[0] > 0.5 * gap.errors[0].mean() and gap.errors[1].mean() < 2e-3


def test_a_cause_that_no_scene_can_have_takes_what_the_model_gains_by_it() -> None:
    records = simulated_pushes(8, 6, {"table_anisotropy": [0.3, 0.0]})
    gap = simulator_gap(records, our_own(TRUTH), effects=("table_anisotropy",))
    assert gap.parts[1:] == ("table_anisotropy", MODEL) and gap.stages[1:] == ("the model", "the model with table_anisotropy")
    assert gap.left_out == ("table_anisotropy",) and gap.sizes[1] > 0.3 * gap.errors[0].mean()
    np.testing.assert_array_equal(gap.corrected, gap.errors[0])
    assert any("table_anisotropy is in no scene" in line for line in gap.lines())


def test_what_no_simulation_can_be_is_said(path: Path, tmp_path: Path) -> None:
    records = simulated_pushes(4, 1)
    with pytest.raises(InputError, match="no body `cup`; it has"):
        MujocoScene(path, "cup", "finger")
    with pytest.raises(InputError, match="cannot read"):
        MujocoScene(tmp_path / "missing.xml", "thing", "finger")
    arm = f'<body name="arm"><joint axis="0 0 1"/><geom size="0.01"/><body name="finger"><geom size="{RADIUS}"/></body></body>'
    path.write_text(scene(tool=arm), encoding="utf-8")
    with pytest.raises(InputError, match="hangs on `arm`"):
        MujocoScene(path, "thing", "finger")
    path.write_text(scene().replace("</asset>", '<mesh name="lost" file="lost.stl"/></asset>'), encoding="utf-8")
    with pytest.raises(InputError, match="lost"):
        MujocoScene(path, "thing", "finger")
    path.write_text(scene(joint='<joint axis="0 0 1"/>'), encoding="utf-8")
    with pytest.raises(InputError, match="expected a free joint"):
        MujocoScene(path, "thing", "finger")
    with pytest.raises(InputError, match="expected 4 or more"):
        simulator_gap(records[:3], our_own(TRUTH))
    with pytest.raises(InputError, match="expected finite poses"):
        simulator_gap(records, FunctionSimulator(lambda first, path, times: np.full((len(times), 2), 0.0)))


@pytest.mark.long
def test_command_writes_the_corrected_scene(path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def command(*words: object) -> int:
        monkeypatch.setattr(sys, "argv", ["push-ident", "fix", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0)

    assert command(path, "bags/hammer_depth") == 1
    assert "--object-body" in capsys.readouterr().err
    assert command(path, "bags/hammer_depth", "--object-body", "thing", "--pusher-body", "finger", "--with", "pusher_friction") == 0
    said = capsys.readouterr().out
    assert "misses the ends of" in said and "pusher_friction" in said and "the error of this scene falls from" in said
    fixed = path.with_name("scene_fixed.xml")
    assert MujocoScene(fixed, "thing", "finger").simulate(np.zeros(3), simulated_pushes(1, 0)[0].pusher, np.array([0.1])).shape == (1, 3)
