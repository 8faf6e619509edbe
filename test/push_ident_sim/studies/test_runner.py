"""Experiments and benchmarks as commands: seeded, resumed, shown on their pages."""

from __future__ import annotations

import ctypes
import json
import shutil
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from helpers.paths import ROOT
from push_ident.cli.main import app
from push_ident.errors import InputError
from push_ident_sim.studies.common import runner
from push_ident_sim.studies.common.pages import write_experiments
from push_ident_sim.studies.common.runner import RunOptions
from push_ident_sim.studies.common.study import Settings
from push_ident_sim.studies.registry import BENCHMARKS, EXPERIMENTS


def command(*arguments: object) -> None:
    app([*map(str, arguments)], standalone_mode=False)


# --- experiments


def test_command_runs_resumes_and_reports(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out, results = tmp_path / "out", tmp_path / "docs"
    summary = results / "real-protocol.json"
    call = ["experiment", "real-protocol", "--objects", "toolbox", "--models", 1, "--variants", "pair-0,pair-1", "--seconds", 0.5]
    call += ["--jobs", 1, "--out", out, "--json", summary]
    # What Bullet printed in earlier tests of this process may still be in the buffer of the C library.
    ctypes.CDLL(None).fflush(None)
    capfd.readouterr()
    command(*call)
    printed = capfd.readouterr().out
    assert "toolbox" in printed and "argv" not in printed
    content = json.loads(summary.read_text())
    assert content["failed"] == [] and content["summary"]["objects"]["all"]["identified"]["pushes"] == 10
    first, second = sorted((out / "real-protocol").glob("*.json"))
    written = first.stat().st_mtime_ns
    second.unlink()
    command(*call)
    assert first.stat().st_mtime_ns == written and second.is_file()

    command("experiment", "report", "--results", results)
    study, page = EXPERIMENTS["real-protocol"], (results / "real-protocol.md").read_text()
    assert study.tables(content["summary"]) in page and study.answer(content["summary"]) in (results / "index.md").read_text()
    assert "--models 1 --variants pair-0,pair-1`" in page


def test_no_case_begins_after_the_time_is_up() -> None:
    counts: list[int] = []
    has_begun, may_end = threading.Event(), threading.Event()

    def first() -> bool:
        has_begun.set()
        return may_end.wait(60.0)

    def report(done: int, _: int) -> None:
        """The time is up once the first call has begun, and it ends only after that."""
        assert has_begun.wait(60.0)
        if counts:
            may_end.set()
        counts.append(done)

    with ThreadPoolExecutor(1) as pool:
        done = runner.run_calls(pool, [(first, ()), *[(time.sleep, (0.0,))] * 5], report, until=time.monotonic())
    assert done == [True] and counts[-1] == 1


def test_long_variants_of_the_blind_check_are_spread_over_a_run(tmp_path: Path) -> None:
    options = RunOptions(tmp_path, tmp_path, (), 6, 31000, ("14-pushes", "6-chosen", "camera"))
    planned = runner.cases_of(EXPERIMENTS["blind"], options)
    assert Counter(case.variant for case in planned) == {"14-pushes": 30, "6-chosen": 10, "camera": 10}
    # Wherever a run is stopped, no more than the cases of one seed are missing from the balance.
    assert Counter(case.variant for case in planned[: len(planned) // 2]) == {"14-pushes": 15, "6-chosen": 5, "camera": 5}
    assert {case.truth for case in planned if case.variant == "6-chosen"} <= {case.truth for case in planned if case.variant == "14-pushes"}


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
