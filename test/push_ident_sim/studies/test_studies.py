"""Studies, each on its smallest size; statistics that they share, on numbers whose answer is known; and their commands and pages."""

from __future__ import annotations

import ctypes
import json
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.objects import record_of, straight_push, uniform
from helpers.paths import ROOT
from helpers.recordings import icra16_file, mit_content, mit_file
from push_ident.bags.importers import MIT_SHAPES, import_mit
from push_ident.bags.importers.shapes import shape_of_outline
from push_ident.cli.main import app
from push_ident.errors import InputError
from push_ident.geometry.outline import polygon_area
from push_ident.geometry.se2 import compose, transform_points
from push_ident.identification.fitting.budget import Budget
from push_ident.planning.path_steps import PathSteps
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, generate_truth
from push_ident_sim.studies import sensors
from push_ident_sim.studies.common import runner
from push_ident_sim.studies.common.measuring import error_row, failures, gaussian_level, interleaved, mean_of, root_mean_square, share
from push_ident_sim.studies.common.objects import plate_in_bullet, random_object
from push_ident_sim.studies.common.pages import write_experiments
from push_ident_sim.studies.common.pushed import PushedObject
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings, Settings
from push_ident_sim.studies.common.tables import causes_text
from push_ident_sim.studies.convergence import error_at
from push_ident_sim.studies.paths import HALF_WIDTH, PATHS, Displacement, follow_steered
from push_ident_sim.studies.pusht import BLOCK, GOAL, TICK, Game, actions
from push_ident_sim.studies.recorded import draw_pushes, find_sets, known_of
from push_ident_sim.studies.registry import BENCHMARKS, EXPERIMENTS
from push_ident_sim.studies.sensors import FilmedObject, outline_error

# --- edge


def test_known_object_is_pushed_out_over_the_edge_and_held(tmp_path: Path) -> None:
    settings = CaseSettings(tmp_path, Budget(), TruthSettings(), CameraNoise(), goals=1)
    study, case = EXPERIMENTS["edge"], Case("book", 11, "truth")
    summary = study.summarise([CaseResult(case, study.run(case, settings))])
    row = summary["kinds"]["truth"]
    assert row["falls"] == 0 and row["success"]["share"] == 1.0 and row["causes"] == {}
    assert row["pushes"] >= 1 and row["least_margin_m"] > 0.0
    assert "1/1" in study.tables(summary)


# --- paths


@pytest.fixture(scope="module")
def pushed() -> Iterator[PushedObject]:
    with closing(PushedObject(plate_in_bullet(random_object(np.random.default_rng(3))), "truth", np.random.default_rng(5))) as pushed:
        yield pushed


def test_known_object_is_steered_along_a_line_in_one_contact_and_returns_to_it_after_a_displacement(pushed: PushedObject) -> None:
    planner, displacement = PathSteps(pushed.truth.shape, pushed.settings, HALF_WIDTH), Displacement()
    steered = follow_steered(pushed, planner, "ahead", 0.2)
    displaced = follow_steered(pushed, planner, "ahead", 0.2, displacement)
    assert steered["end"] == "ARRIVED" and steered["contacts"] == 1 and steered["rms_m"] < 0.003 and steered["rms_rad"] < np.radians(2.0)
    assert displaced["end"] == "ARRIVED" and displacement.at > 0.5 and displaced["back_s"] < 3.0
    study, case = EXPERIMENTS["paths"], Case("uneven", 1, "truth")
    results = [
        CaseResult(case, {"paths": [steered | {"name": name} for name in PATHS]}),
        CaseResult(replace(case, variant="displaced"), {"paths": [displaced, displaced | {"back_s": None}]}),
    ]
    text = study.tables(study.summarise(results))
    assert "1/1" in text and f"{1e3 * steered['rms_m']:.1f} mm" in text and "1/2" in text


# --- Push-T


def test_block_is_the_t_of_the_game() -> None:
    assert polygon_area(BLOCK.outline) == pytest.approx(0.12 * 0.03 + 0.03 * 0.09)
    # Ends of bar and stem in the frame of the game, which lies at (256, 256) pixels, turned by 45 degrees, at the goal.
    corners = np.array([[-0.06, 0.0], [0.06, 0.03], [-0.015, 0.12]])
    expected = transform_points(np.array([0.256, 0.256, np.pi / 4]), corners)
    gaps = np.linalg.norm(transform_points(GOAL, BLOCK.outline)[:, None] - expected, axis=2)
    np.testing.assert_allclose(gaps.min(axis=0), 0.0, atol=1e-9)


@pytest.mark.parametrize("length", [0.002, 0.05, 0.3])
def test_disc_is_led_along_a_line_to_rest(length: float) -> None:
    start, heading = np.array([0.2, 0.3]), np.array([0.6, -0.8])
    place, velocity, along = start.copy(), np.zeros(2), []
    targets = actions(start, start + length * heading, 0.15)
    for target in targets:
        for _ in range(10):
            velocity = velocity + 0.01 * (100.0 * (target - place) - 20.0 * velocity)
            place = place + 0.01 * velocity
            along.append(float((place - start) @ heading))
    np.testing.assert_allclose(place, start + length * heading, atol=1e-9)
    np.testing.assert_allclose(velocity, 0.0, atol=1e-8)
    # Never back, and never beyond the end.
    assert np.min(np.diff(along)) > -1e-3 * length and max(along) < 1.001 * length
    assert len(targets) * TICK <= length / 0.15 + 0.3


def test_absent_game_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gym_pusht", None)
    with pytest.raises(InputError, match="gym_pusht is not installed; run `.*pip install"):
        Game.new()


# --- demo


def test_pushes_and_runs_of_the_demo_are_counted() -> None:
    def run(*pushes: tuple[float, float, float, int]) -> dict[str, object]:
        keys = ("predicted_m", "expected_m", "uniform_m")
        test = [dict(zip(keys, push, strict=False)) | {"ways": push[3] * [{"chance": 1.0 / push[3]}]} for push in pushes]
        return {"training": [{"moved_m": 0.05}, test[0]], "per_push": test[1:], "time_s": 100.0}

    first = (0.001, 0.001, 0.01, 1)
    good, bad = (
        run(first, (0.001, 0.001, 0.008, 1), (0.002, 0.001, 0.008, 2)),
        run(first, (0.009, 0.001, 0.004, 1), (0.001, 0.002, 0.002, 1)),
    )
    study = EXPERIMENTS["demo"]
    summary = study.summarise([CaseResult(Case("hammer", seed, "plain"), values) for seed, values in enumerate((good, bad))])
    assert (summary["pushes"], summary["far"], summary["within"], summary["two_ways"], summary["worse"]) == (6, 1, 4, 1, 1)


# --- statistics, and figures of the paper


def test_statistics_of_known_numbers() -> None:
    curve = {"n_simulations": [0, 4, 10], "error_m": [0.02, 0.01, 0.005]}
    errors = error_at(curve, "n_simulations", np.array([0, 3, 4, 9, 10, 99]))
    np.testing.assert_array_equal(errors, [0.02, 0.02, 0.01, 0.01, 0.005, 0.005])
    # 90 % quantiles of the chi-square distribution with one, two and three degrees of freedom.
    assert [float(gaussian_level(q, n)) for n, q in ((1, 2.7055), (2, 4.6052), (3, 6.2514))] == pytest.approx([0.9] * 3, abs=1e-5)
    # Clopper and Pearson (1934): 9 of 10 lie within 55.5 to 99.7 %; none of 500 below 0.74 %.
    row = share([True] * 9 + [False])
    assert (row["low"], row["high"]) == (0.555, 0.9975)
    assert share([False] * 500)["high"] == 0.0074 and share([])["share"] is None
    assert causes_text(failures(["A", "B", "B", "good"], "good")) == "2 B, 1 A"
    assert mean_of([1.0, None, 2.0]) == 1.5 and mean_of([None]) is None
    assert root_mean_square([3.0, None, 4.0]) == pytest.approx(np.sqrt(12.5))


def test_standard_error_counts_ground_truths_not_pushes() -> None:
    results = [
        CaseResult(Case("book", model, variant), {"errors_m": {"identified": [0.001 * (model + 1)] * 3 + [None]}})
        for model in (0, 1)
        for variant in ("a", "b")
    ]
    row = error_row(results)
    assert row["mean_m"] == pytest.approx(0.0015) and row["standard_error_m"] == pytest.approx(0.0005)
    assert row["pushes"] == 12 and row["not_simulated"] == 4


def test_calls_are_timed_in_turns_by_the_processor_time() -> None:
    order: list[str] = []
    times, results = interleaved({"a": lambda: order.append("a"), "b": lambda: order.append("b") or 3}, 2)
    assert order == ["a", "b"] * 3 and results == {"a": None, "b": 3} and times["a"]["n"] == 2
    waiting, _ = interleaved({"sleep": lambda: time.sleep(0.05)}, 1)
    assert waiting["sleep"]["median_s"] < 0.02


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> CaseSettings:
    truth, folder = TruthSettings(n_train=4, n_test=2), tmp_path_factory.mktemp("truth")
    generate_truth(folder, "toolbox", 3, truth)
    return CaseSettings(folder, Budget(max_seconds=None, max_simulations=60), truth, CameraNoise())


@pytest.mark.parametrize("name", ["few-pushes", "convergence", "maps", "coverage"])
def test_case_gives_table_answer_and_figure(name: str, settings: CaseSettings, tmp_path: Path) -> None:
    study = EXPERIMENTS[name]
    cases = [Case("toolbox", 3, variant) for variant in study.variants[:1]]
    summary = json.loads(json.dumps(study.summarise([CaseResult(case, study.run(case, settings)) for case in cases]), allow_nan=False))
    assert study.tables(summary).startswith("|") and study.answer(summary).endswith(".")
    written = [(tmp_path / figure).read_text() for figure in study.draw(summary, tmp_path)]
    assert len(written) == (name != "few-pushes") and all("<svg" in text for text in written)
    assert [(tmp_path / figure).read_text() for figure in study.draw(summary, tmp_path)] == written


# --- recordings of others, and sensors

STUDY = EXPERIMENTS["recorded"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three pushes as files whose names are not in the order of time, the bag of them, and a file of CMU."""
    folder = tmp_path_factory.mktemp("recordings")
    outline = MIT_SHAPES["rect1"].outline
    assert outline is not None
    model, pusher = uniform(shape_of_outline(outline), mass=0.8374), straight_push((0.2, 0.02), 0.0, radius=0.00475, rate=250.0)
    for number, start in enumerate((2e5, 0.0, 1e5)):
        record = record_of(model, pusher, np.array([0.28 + 1e-3 * number, 0.0, 0.0]), np.random.default_rng(1), noise=0.05)
        mit_file(folder / "even" / "rect1", mit_content(record, 1.46e9 + start), number=number, surface="even")
    import_mit([folder / "even"], folder / "as" / "bag")
    icra16_file(folder / "hardboard" / "triangle.txt")
    return folder


def test_every_set_of_a_folder_is_known_by_its_form(folder: Path, tmp_path: Path) -> None:
    sets = find_sets(folder)
    assert {name: len(one.paths) for name, one in sets.items()} == {"even-rect1": 3, "as-bag": 1, "hardboard-triangle": 1}
    assert STUDY.find_objects is not None and set(STUDY.find_objects(folder)) == set(sets)
    assert len(draw_pushes(sets["hardboard-triangle"], 9, np.random.default_rng(0)).records) == 2
    for wrong, reason in ((tmp_path, "no recording in it"), (tmp_path / "elsewhere", "no such folder")):
        with pytest.raises(InputError, match=reason):
            find_sets(wrong)


def test_files_and_their_bag_give_the_same_pushes_in_the_order_in_which_they_were_made(folder: Path) -> None:
    sets = find_sets(folder)
    files, bag = (draw_pushes(sets[name], 9, np.random.default_rng(0)) for name in ("even-rect1", "as-bag"))
    assert files.n_all == bag.n_all == 3 and files.mass == 0.8374 and bag.mass is None
    for one, other in zip(files.records, bag.records, strict=True):
        np.testing.assert_allclose(one.poses.pose, other.poses.pose, atol=1e-9)
    assert [round(1e3 * record.poses.pose[0, 0]) for record in files.records] == [281, 282, 280]
    drawn = draw_pushes(sets["even-rect1"], 2, np.random.default_rng(1), ends_only=True, with_forces=False)
    assert len(drawn.records) == 2 and all(len(r.poses.time) == 2 and r.wrench is None for r in drawn.records)


def test_what_authors_measured_is_read_by_patterns_of_names(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "known.json").write_text('{"even-*": {"friction": 0.25}}')
    assert known_of(tmp_path, "even-rect1")["friction"] == 0.25 and known_of(tmp_path, "other") == {} == known_of(folder, "even-rect1")
    (tmp_path / "known.json").write_text("[1]")
    with pytest.raises(InputError, match="an object of objects"):
        known_of(tmp_path, "even-rect1")


def test_draws_of_a_set_are_counted_with_named_effects_measured_friction_and_refusals() -> None:
    named = {"n": 14, "n_all": 60, "verdict": "named", "effects": [{"name": "wear", "parameters": {"w": -0.02}}], "refused": []}
    named |= {"something_else": 0.05, "gap": None, "friction": 0.25, "known": {"friction": 0.28}, "seconds": 10.0}
    other = named | {"verdict": "not_trustworthy", "effects": [], "refused": ["no push touches"], "something_else": None, "friction": None}
    summary = STUDY.summarise([CaseResult(Case("hex", seed, "14-pushes"), draw) for seed, draw in enumerate((named, other))])
    row = summary["diagnosed"]["hex, 14-pushes"]
    assert row["draws"] == 2 and row["pushes"] == [14, 60] and row["verdicts"] == {"named": 1, "not_trustworthy": 1}
    assert row["named"] == {"wear": {"n": 1, "mean": {"w": -0.02}}} and row["something_else"] == 0.05 and row["friction"] == 0.25
    assert "hex, 14-pushes was refused: no push touches" in STUDY.tables(summary) and "2 draws" in STUDY.answer(summary)


def test_error_of_an_outline_is_its_distance_from_the_true_one():
    square = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
    # An object that is wider by 1 mm on every side.
    assert outline_error(np.sign(square) * (np.abs(square) + 1e-3), square) == pytest.approx(1e-3, rel=0.05)


def test_true_motion_is_the_same_before_every_camera_and_exact_poses_are_as_the_camera_reports_them():
    first = None
    for sensor, most in (("ideal", 3e-4), ("kinect_v1", 3e-3)):
        filmed = FilmedObject(make_object("toolbox", 3), [3, 3, 8], sensor=sensor, unit=17, rest=6)
        record = filmed.execute(filmed.true_push(np.random.default_rng(1)))
        (test,) = filmed.test_pushes(1, np.random.default_rng(2))
        filmed.close()
        first = first or (filmed.true_pose, test)
        np.testing.assert_array_equal(filmed.true_pose, first[0])
        np.testing.assert_array_equal(test.pusher.position, first[1].pusher.position)
        assert (np.linalg.norm(filmed.as_reported(np.zeros(3))) < 1e-4) == (sensor == "ideal")
        (exact,) = filmed.exact
        np.testing.assert_array_equal(exact.poses.time, record.poses.time)
        assert np.max(np.abs(record.poses.pose - exact.poses.pose)[:, :2]) < most
        assert exact.poses.pose[-1] == pytest.approx(compose(filmed.as_reported(filmed.true_pose), filmed.offset), abs=1e-9)


def test_case_gives_all_that_the_table_shows(tmp_path, monkeypatch):
    for name, value in (("N_PUSHES", 1), ("N_TEST", 2), ("_REST", 10)):
        monkeypatch.setattr(sensors, name, value)
    settings = CaseSettings(tmp_path, Budget(max_seconds=10.0, processor_time=True), TruthSettings(), CameraNoise())
    case = Case("toolbox", 3, "kinect_v1")
    summary = EXPERIMENTS["sensors"].summarise([CaseResult(case, EXPERIMENTS["sensors"].run(case, settings))])
    assert 5e-4 < summary["sensors"]["kinect_v1"]["last_outline_m"] < 5e-3
    assert "kinect_v1" in EXPERIMENTS["sensors"].tables(summary) and "(kinect_v1)" in EXPERIMENTS["sensors"].answer(summary)


# --- commands and pages


def command(*arguments: object) -> None:
    app([*map(str, arguments)], standalone_mode=False)


# --- experiments


def test_command_runs_resumes_and_reports(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out, file = tmp_path / "out", tmp_path / "docs" / "goals.json"
    call = ["experiment", "goals", "--seed", 11, "--goals", 1, "--variants", "truth", "--jobs", 1, "--out", out, "--json", file]
    # What Bullet printed in earlier tests of this process may still be in the buffer of the C library.
    ctypes.CDLL(None).fflush(None)
    capfd.readouterr()
    command(*call, "--models", 1)
    assert "argv" not in capfd.readouterr().out
    result = json.loads(file.read_text())
    assert result["success"] == {"truth": {"20mm_0.1rad": 1.0, "10mm_5deg": 1.0, "5mm_2deg": 1.0}} and result["failed"] == []
    assert 0 <= result["pushes_mean"] <= 6 and result["time_mean_s"] >= 0 and result["falls"] == 0
    (case,) = (out / "goals").glob("*.json")
    written = case.stat().st_mtime_ns
    command(*call, "--models", 2)
    assert case.stat().st_mtime_ns == written
    result = json.loads(file.read_text())
    assert (result["models"], result["goals"], result["seed"]) == (2, 1, 11)

    command("experiment", "report", "--results", file.parent)
    study, page = EXPERIMENTS["goals"], file.with_suffix(".md").read_text()
    assert study.tables(result["summary"]) in page and study.answer(result["summary"]) in (file.parent / "index.md").read_text()
    assert "--seed 11 --models 2" in page and "2 of 2" in study.answer(result["summary"])


def test_no_case_begins_after_the_time_is_up() -> None:
    counts: list[int] = []
    has_begun, may_end = threading.Event(), threading.Event()

    def report(done: int, _: int) -> None:
        """The time is up once the first call has begun, and it ends only after that."""
        counts.append(done)
        assert has_begun.wait(60.0)
        if len(counts) > 1:
            may_end.set()

    first = lambda: has_begun.set() or may_end.wait(60.0)  # noqa: E731
    with ThreadPoolExecutor(1) as pool:
        done = runner.run_calls(pool, [(first, ()), *[(time.sleep, (0.0,))] * 5], report, until=time.monotonic())
    assert done == [True] and counts[-1] == 1


PUBLISHED = sorted(path for path in (ROOT / "docs" / "results").glob("*.json") if path.stem in EXPERIMENTS)


@pytest.mark.parametrize("file", PUBLISHED, ids=lambda path: path.stem)
def test_published_page_is_made_from_its_file_and_its_seeds_are_those_of_the_makefile(file: Path, tmp_path: Path) -> None:
    shutil.copy(file, tmp_path)
    write_experiments(EXPERIMENTS.values(), tmp_path, "command")
    assert (tmp_path / f"{file.stem}.md").read_text() == file.with_suffix(".md").read_text()
    run = json.loads(file.read_text())
    seed = f" --seed {run['seed']}" if run["seed"] else ""
    assert f"$(call experiment,{file.stem}{seed} --models {run['models']}" in (ROOT / "Makefile").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "known"),
    [
        (["experiment", "alchemy"], "convergence"),
        (["experiment", "maps", "--objects", "spoon"], "hammer"),
        (["experiment", "maps", "--variants", "x"], "four"),
        (["experiment", "goals", "--objects", "hammer"], "uneven"),
        (["bench", "alchemy"], "engine"),
        (["experiment", "report", "--results", "nowhere"], "--json"),
    ],
)
def test_unknown_name_is_refused_with_those_that_there_are(arguments: list[str], known: str) -> None:
    with pytest.raises(InputError, match=known):
        command(*arguments)


# --- benchmarks


@pytest.mark.parametrize("name", [name for name in BENCHMARKS if name != "identification"])
def test_pieces_of_a_benchmark_give_tables_and_targets(name: str) -> None:
    benchmark = BENCHMARKS[name]
    measured = benchmark.summarise([piece.measure(*piece.arguments) for piece in benchmark.pieces(Settings(quick=True))])
    summary = json.loads(json.dumps(measured, allow_nan=False))
    assert benchmark.tables(summary).startswith("|")
    assert all(target.measured for target in benchmark.targets(summary))


def test_command_measures_in_fresh_processes_and_writes_the_page(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "benchmarks.md"
    command("bench", "identification", "--quick", "--page", page)
    result = json.loads((tmp_path / "benchmarks" / "identification.json").read_text())
    assert result["quick"] and result["machine"]["cores"]
    assert BENCHMARKS["identification"].tables(result["summary"]) in page.read_text()
    assert "Identification to convergence" in capfd.readouterr().out
