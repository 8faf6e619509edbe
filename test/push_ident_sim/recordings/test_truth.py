"""Ground truth from Bullet: seeded, simulated once, exact enough, and observed by a camera with seeded noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.geometry.cells import cell_error
from push_ident.geometry.se2 import inverse, rotation, transform_points
from push_ident.identification.observing.observation import observe_push
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.types import PusherPath
from push_ident_sim.code_digest import CORE, code_digest, code_of
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, generate_truth, load_truth, make_pushes, true_model, truth_file

FEW = TruthSettings(n_train=2, n_test=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("truth")


def test_planar_model_with_the_true_maps_predicts_the_pushes_to_a_millimetre() -> None:
    thing = make_object("hammer", 7)
    model, errors = true_model(thing), []
    for motion in make_pushes(thing, [7], TruthSettings(n_train=4, n_test=0)):
        way = np.abs(motion.pose[-1] - motion.pose[0])
        assert np.hypot(way[0], way[1]) >= 0.01 or way[2] >= 0.1
        path = PusherPath(motion.time, motion.pusher, FEW.pushes.pusher_radius)
        end = simulate(model, PushScenario(path, motion.pose[0], motion.time[-1:])).pose[-1]
        errors.append(cell_error(model.shape.cells, end, motion.pose[-1]))
    # Not each of them: a pusher that slips off a corner may do so a moment earlier in one engine than in the other.
    assert np.median(errors) < 5e-4


def test_pusher_never_drags_a_turning_face_with_more_than_its_friction() -> None:
    # Bullet kept contacts with the normal that the face had before it turned; here they dragged with half as much again.
    thing = make_object("book", 0)
    (motion,) = make_pushes(thing, [7], TruthSettings(n_train=1, n_test=0))
    edge = np.roll(thing.outline, -1, axis=0) - thing.outline
    length = np.linalg.norm(edge, axis=1)
    along = edge / length[:, None]
    ratios = []
    for pose, position, force in zip(motion.pose[:-1], motion.pusher[:-1], motion.force[1:], strict=True):
        from_start = transform_points(inverse(pose), position[None]) - thing.outline
        way, away = np.sum(from_start * along, axis=1), np.abs(along[:, 0] * from_start[:, 1] - along[:, 1] * from_start[:, 0])
        faces = np.flatnonzero((way > 0.002) & (way < length - 0.002) & (away < 0.0085))
        pressed = force @ rotation(pose[2])
        if len(faces) == 1 and np.linalg.norm(pressed) > 0.3:
            tangent = along[faces[0]]
            ratios.append(abs(pressed @ tangent) / abs(pressed @ [tangent[1], -tangent[0]]))
    assert len(ratios) > 20 and np.ptp(motion.pose[:, 2]) > 0.2
    assert max(ratios) < thing.pusher_friction + 1e-3


def test_contact_of_a_push_is_gone_where_object_and_pusher_are_put_down_anew() -> None:
    """Bullet kept that of the eighth push here, which parts along its normal; the object was then shot away before the pusher came near."""
    for motion in make_pushes(make_object("crimp", 8018), [8018, 2, 5], TruthSettings(n_train=8, n_test=0))[7:]:
        np.testing.assert_allclose(motion.pose[3], motion.pose[0], atol=1e-6)


def test_pushes_are_seeded_simulated_once_and_a_damaged_file_is_refused_with_a_remedy(folder: Path, tmp_path: Path) -> None:
    path = generate_truth(folder, "toolbox", 3, FEW)
    written, content = path.stat().st_mtime_ns, path.read_bytes()
    assert generate_truth(folder, "toolbox", 3, FEW) == path and path.stat().st_mtime_ns == written
    again = generate_truth(tmp_path, "toolbox", 3, FEW)
    assert again.read_bytes() == content and not list(tmp_path.glob("*.partial"))
    changed = ({"start_range": 0.1}, {"effects": InjectedEffects.of({"tool_offset": (0.004, 0.0)})})
    others = (("toolbox", 4, FEW), ("book", 3, FEW), *(("toolbox", 3, replace(FEW, **change)) for change in changed))
    assert len({truth_file(folder, *which) for which in others} | {path}) == 5
    again.write_bytes(content[:200])
    with pytest.raises(InputError, match="delete the file"):
        load_truth(tmp_path, "toolbox", 3, FEW)


def test_digest_of_code_changes_with_the_code_but_not_with_what_explains_it(tmp_path: Path) -> None:
    texts = ('"""One."""\nA = 1\n"""Of A."""\n', "# Two.\nA  =  1\n", "A = 2\n")
    files = [tmp_path / f"{i}.py" for i in range(3)]
    for file, text in zip(files, texts, strict=True):
        file.write_text(text)
    first, explained, changed = (code_digest([file]) for file in files)
    assert first == explained != changed
    assert {"sampling.py", "push.py"} < {file.name for file in code_of(CORE, ("pushing", "types.py"))}


def test_camera_adds_seeded_noise_to_the_truth_with_rests_before_and_after(folder: Path) -> None:
    train, test, thing = load_truth(folder, "toolbox", 3, FEW)
    assert len(train) == 2 and len(test) == 1
    again = load_truth(folder, "toolbox", 3, FEW)[0]
    np.testing.assert_array_equal(train[0].poses.pose, again[0].poses.pose)
    clean = load_truth(folder, "toolbox", 3, FEW, CameraNoise(position_std=1e-9, yaw_std=1e-9, rate=240.0))[0][0].poses
    observed, seen = train[0].poses, observe_push(train[0])
    assert seen.touched and train[0].wrench is None
    np.testing.assert_allclose(seen.pose[-1][:2], clean.pose[-1][:2], atol=2e-3)
    residual = observed.pose - np.column_stack([np.interp(observed.time, clean.time, column) for column in clean.pose.T])
    np.testing.assert_allclose(residual.std(axis=0) / np.sqrt(np.diag(observed.covariance[0])), 1.0, atol=0.35)
    assert np.ptp(clean.pose[:90], axis=0).max() < 1e-6 and np.ptp(clean.pose[-90:], axis=0).max() < 1e-4
    np.testing.assert_array_equal(train[0].shape.cells.centres, thing.cells)


def test_force_sensor_measures_the_sliding_friction_of_a_push(folder: Path) -> None:
    train, _, thing = load_truth(folder, "toolbox", 3, FEW, CameraNoise(force_std=0.01))
    model = true_model(thing)
    for record in train:
        assert record.wrench is not None
        motion = simulate(model, PushScenario(record.pusher, record.poses.pose[0], record.pusher.time[-1:]))
        impulse = np.trapezoid(record.wrench.force, record.wrench.time, axis=0)
        expected = np.trapezoid(motion.force, motion.force_time, axis=0)
        np.testing.assert_allclose(impulse, expected, atol=0.05 * np.linalg.norm(expected))
