"""Ground truth from Bullet, and the experiments on it: seeded, resumable, whole."""

from __future__ import annotations

import ctypes
import json
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from push_ident.cli.main import app
from push_ident.errors import InputError
from push_ident.geometry.cells import cell_error
from push_ident.geometry.se2 import inverse, rotation, transform_points
from push_ident.identification.observing.observation import observe_push
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.types import PusherPath
from push_ident_sim.code_digest import code_digest, files_behind
from push_ident_sim.objects import make_object
from push_ident_sim.recordings import truth
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, generate_truth, load_truth, make_pushes, true_model, truth_file
from push_ident_sim.studies.common import runner
from push_ident_sim.studies.common.experiment import Case, CaseResult
from push_ident_sim.studies.common.files import write_json
from push_ident_sim.studies.common.measuring import curve_on_grid, error_row
from push_ident_sim.studies.common.pages import write_experiments
from push_ident_sim.studies.common.runner import RunOptions, run_experiment
from push_ident_sim.studies.convergence import study as convergence
from push_ident_sim.studies.registry import EXPERIMENTS

FEW = TruthSettings(n_train=2, n_test=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("truth")


# --- ground truth --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["hammer", "book"])
def test_planar_model_with_the_true_maps_predicts_the_pushes_to_a_millimetre(name: str) -> None:
    thing = make_object(name, 7)
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
    for motion in make_pushes(make_object("crimp", 8018), [8018, 2, 5], TruthSettings(n_train=10, n_test=0))[7:]:
        np.testing.assert_allclose(motion.pose[3], motion.pose[0], atol=1e-6)


def test_pushes_are_seeded_and_simulated_once(folder: Path) -> None:
    path = generate_truth(folder, "toolbox", 3, FEW)
    written, content = path.stat().st_mtime_ns, path.read_bytes()
    assert generate_truth(folder, "toolbox", 3, FEW) == path and path.stat().st_mtime_ns == written
    path.unlink()
    assert generate_truth(folder, "toolbox", 3, FEW).read_bytes() == content
    assert not list(folder.glob("*.partial"))
    others = {
        truth_file(folder, *which) for which in (("toolbox", 4, FEW), ("book", 3, FEW), ("toolbox", 3, TruthSettings(2, 1, placing=0.1)))
    }
    assert len(others | {path}) == 4


def test_truth_and_results_depend_on_the_code_that_makes_the_truth() -> None:
    names = {"bullet_object", "push_world", "cone_friction", "objects", "truth", "true_motion", "sampling"}
    behind_truth = {path.stem for path in files_behind(Path(truth.__file__))}
    behind_results = {path.stem for path in files_behind(Path(convergence.__file__))}
    assert names <= behind_truth <= behind_results
    # What is shown of the truth, and the model that is fitted to it, leave it as it is.
    assert not {"drawing", "convergence", "identify", "lcp", "rollout"} & behind_truth


def test_digest_of_code_changes_with_the_code_but_not_with_what_explains_it(tmp_path: Path) -> None:
    texts = ('"""One."""\nA = 1\n"""Of A."""\n', "# Two.\nA  =  1\n", "A = 2\n")
    files = [tmp_path / f"{i}.py" for i in range(3)]
    for file, text in zip(files, texts, strict=True):
        file.write_text(text)
    first, explained, changed = (code_digest([file]) for file in files)
    assert first == explained != changed


def test_camera_adds_seeded_noise_to_the_truth_with_rests_before_and_after(folder: Path) -> None:
    train, test, thing = load_truth(folder, "toolbox", 3, FEW)
    assert len(train) == 2 and len(test) == 1
    again = load_truth(folder, "toolbox", 3, FEW)[0]
    np.testing.assert_array_equal(train[0].poses.pose, again[0].poses.pose)
    clean = load_truth(folder, "toolbox", 3, FEW, CameraNoise(position_std=1e-9, yaw_std=1e-9, rate=240.0))[0]
    true_end = clean[0].poses.pose[-1]
    seen = observe_push(train[0])
    assert seen.touched
    np.testing.assert_allclose(seen.pose[-1][:2], true_end[:2], atol=2e-3)
    residual = train[0].poses.pose - [
        np.array([np.interp(t, clean[0].poses.time, column) for column in clean[0].poses.pose.T]) for t in train[0].poses.time
    ]
    np.testing.assert_allclose(residual.std(axis=0) / np.sqrt(np.diag(train[0].poses.covariance[0])), 1.0, atol=0.35)
    assert np.ptp(clean[0].poses.pose[:90], axis=0).max() < 1e-6 and np.ptp(clean[0].poses.pose[-90:], axis=0).max() < 1e-4
    assert train[0].wrench is None
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


def test_damaged_file_is_refused_with_a_remedy(folder: Path) -> None:
    path = generate_truth(folder, "book", 1, TruthSettings(n_train=1, n_test=0))
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match="delete the file"):
        load_truth(folder, "book", 1, TruthSettings(n_train=1, n_test=0))


# --- measures ------------------------------------------------------------------------------------------------------------


def test_learning_curve_holds_its_last_point() -> None:
    curve = {"n_simulations": [0, 4, 10], "error_m": [0.02, 0.01, 0.005]}
    np.testing.assert_array_equal(
        curve_on_grid(curve, "n_simulations", np.array([0, 3, 4, 9, 10, 99])), [0.02, 0.02, 0.01, 0.01, 0.005, 0.005]
    )


def test_standard_error_counts_ground_truths_not_pushes() -> None:
    results = [
        CaseResult(Case("book", model, variant), {"errors_m": {"identified": [0.001 * (model + 1)] * 3 + [None]}})
        for model in (0, 1)
        for variant in ("a", "b")
    ]
    row = error_row(results)
    assert row["mean_m"] == pytest.approx(0.0015) and row["standard_error_m"] == pytest.approx(0.0005)
    assert row["pushes"] == 12 and row["not_simulated"] == 4


# --- the command ---------------------------------------------------------------------------------------------------------


def command(*arguments: object) -> None:
    app(["experiment", *map(str, arguments)], standalone_mode=False)


def test_command_runs_resumes_and_reports(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out, summary, page = tmp_path / "out", tmp_path / "docs" / "experiments" / "real-protocol.json", tmp_path / "docs" / "experiments.md"
    call = ["real-protocol", "--objects", "toolbox", "--models", 1, "--variants", "pair-0,pair-1", "--seconds", 2, "--jobs", 1]
    call += ["--out", out, "--json", summary]
    # What Bullet said in earlier tests of this process may still stand in the buffer of the C library.
    ctypes.CDLL(None).fflush(None)
    capfd.readouterr()
    command(*call)
    printed = capfd.readouterr().out
    assert "toolbox" in printed and "argv" not in printed
    content = json.loads(summary.read_text())
    assert content["failed"] == [] and content["summary"]["all"]["identified"]["pushes"] == 10
    first, second = sorted((out / "real-protocol").glob("*.json"))
    written = first.stat().st_mtime_ns
    second.unlink()
    command(*call)
    assert first.stat().st_mtime_ns == written and second.is_file()

    command("report", "--page", page)
    assert EXPERIMENTS["real-protocol"].tables(content["summary"]) in page.read_text()
    assert (page.parent / "experiments" / "real-protocol.png").stat().st_size > 5000


def test_cases_of_live_nodes_run_one_at_a_time_however_many_processes_are_asked_for(folder: Path, tmp_path: Path) -> None:
    assert EXPERIMENTS["settle"].one_at_a_time and EXPERIMENTS["live"].one_at_a_time
    options = RunOptions(tmp_path, folder, ("toolbox",), 1, 3, ("pair-0",), jobs=2, max_seconds=1.0, truth=FEW)
    for alone, jobs in ((True, 1), (False, 2)):
        experiment = replace(EXPERIMENTS["real-protocol"], one_at_a_time=alone, needs_truth=False)
        assert run_experiment(experiment, options)["machine"]["jobs"] == jobs


def test_no_case_begins_after_the_time_is_up() -> None:
    counts: list[tuple[int, int]] = []
    has_begun, may_end = threading.Event(), threading.Event()

    def first() -> bool:
        has_begun.set()
        return may_end.wait(60.0)

    def report(*count: int) -> None:
        """The time is up once the first call has begun, and it ends only after that."""
        assert has_begun.wait(60.0)
        if counts:
            may_end.set()
        counts.append((count[0], count[1]))

    with ThreadPoolExecutor(1) as pool:
        done = runner.run_calls(pool, [(first, ()), *[(time.sleep, (0.0,))] * 5], report, until=time.monotonic())
    assert done == [True] and counts[-1] == (1, 6)


def test_long_variants_of_the_blind_check_are_spread_over_a_run(tmp_path: Path) -> None:
    options = RunOptions(tmp_path, tmp_path, (), 6, 31000, ("14-pushes", "6-chosen", "camera"))
    planned = runner.cases_of(EXPERIMENTS["blind"], options)
    assert Counter(case.variant for case in planned) == {"14-pushes": 30, "6-chosen": 10, "camera": 10}
    # Wherever a run is stopped, no more than the cases of one seed are missing from the balance.
    assert Counter(case.variant for case in planned[: len(planned) // 2]) == {"14-pushes": 15, "6-chosen": 5, "camera": 5}
    assert {case.truth for case in planned if case.variant == "6-chosen"} <= {case.truth for case in planned if case.variant == "14-pushes"}


def test_command_names_what_there_is() -> None:
    for arguments, named in ((["alchemy"], "training"), (["maps", "--objects", "spoon"], "hammer"), (["maps", "--variants", "x"], "four")):
        with pytest.raises(InputError, match=named):
            command(*arguments)


def test_page_names_the_variants_that_were_not_run(tmp_path: Path) -> None:
    delays = {"n_frames": 900, "n_poses": 900, "median_s": 0.009, "p99_s": 0.016, "worst_s": 0.019, "cpu_per_frame_s": 0.011, "load": 1.5}
    run = {
        **{"experiment": "perception", "objects": ["hammer"], "models": 1, "seed": 0, "max_seconds": 30.0, "failed": []},
        "machine": {"processor": "any", "cores": 2, "jobs": 1, "python": "3.11"},
        "summary": {"objects": {}, "coverage": {}, "latency": delays},
    }
    variants = EXPERIMENTS["perception"].variants
    for chosen, command, not_run in ((["latency"], "--models 1 --variants latency`", "Not run: clear, "), (variants, "--models 1`", "")):
        write_json(tmp_path / "experiments" / "perception.json", {**run, "variants": list(chosen)})
        write_experiments(EXPERIMENTS.values(), tmp_path / "experiments.md", "command")
        text = (tmp_path / "experiments.md").read_text()
        assert command in text and (not_run in text if not_run else "Not run" not in text)
    write_json(tmp_path / "experiments" / "perception.json", {**run, "variants": list(variants), "planned": 9, "finished": 4})
    write_experiments(EXPERIMENTS.values(), tmp_path / "experiments.md", "command")
    assert "4 of 9 planned cases" in (tmp_path / "experiments.md").read_text()


def test_report_without_results_names_the_command_that_makes_them(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--json"):
        write_experiments(EXPERIMENTS.values(), tmp_path / "experiments.md", "command")
