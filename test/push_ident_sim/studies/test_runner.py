"""Experiments and benchmarks as commands: seeded, resumed, shown on their pages."""

from __future__ import annotations

import ctypes
import json
import shutil
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from helpers.paths import ROOT
from push_ident.cli.main import app
from push_ident.errors import InputError
from push_ident_sim.studies.common import runner
from push_ident_sim.studies.common.pages import write_experiments
from push_ident_sim.studies.common.study import Settings
from push_ident_sim.studies.registry import BENCHMARKS, EXPERIMENTS


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
