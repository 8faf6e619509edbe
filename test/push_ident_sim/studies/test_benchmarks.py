"""Benchmarks run, and their page holds what was measured."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from push_ident.cli.main import app
from push_ident.errors import InputError
from push_ident_sim.studies.common.benchmark import Settings
from push_ident_sim.studies.common.pages import write_benchmarks
from push_ident_sim.studies.common.timing import growth_exponent, interleaved
from push_ident_sim.studies.registry import BENCHMARKS


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """As in the processes of the command; on a busy machine more of them wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_calls_are_timed_in_turns() -> None:
    order: list[str] = []
    times, results = interleaved({"a": lambda: order.append("a"), "b": lambda: order.append("b") or 3}, 2, {"b": 2})
    assert order == ["a", "b"] + 2 * ["a", "b", "b"]
    assert results == {"a": None, "b": 3}
    assert times["a"]["n"] == 2 and times["b"]["n"] == 4


def test_waiting_for_others_is_not_counted() -> None:
    times, _ = interleaved({"sleep": lambda: time.sleep(0.05)}, 1)
    assert times["sleep"]["median_s"] < 0.02


def test_growth_exponent_is_the_power() -> None:
    assert growth_exponent([100, 1000, 10000], [3e-3, 3e-3 * 10**1.5, 3.0]) == pytest.approx(1.5)


EACH = [pytest.param(name, marks=pytest.mark.long if name == "command-line" else ()) for name in BENCHMARKS]


@pytest.mark.parametrize("name", EACH)
def test_pieces_give_a_summary_with_tables_targets_and_pictures(name: str, tmp_path: Path) -> None:
    benchmark = BENCHMARKS[name]
    pieces = benchmark.pieces(Settings(tmp_path / "truth", quick=True))
    measured = benchmark.summarise([piece.measure(*piece.arguments) for piece in pieces])
    summary = json.loads(json.dumps(measured, allow_nan=False))
    assert benchmark.tables(summary).startswith(("|", "4 training pushes"))
    assert all(target.measured for target in benchmark.targets(summary))
    for picture in benchmark.draw(summary, tmp_path):
        assert (tmp_path / picture).stat().st_size > 5000


def test_command_measures_in_fresh_processes_and_writes_the_page(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "benchmarks.md"
    app(["bench", "bullet", "--quick", "--page", str(page)], standalone_mode=False)
    result = json.loads((tmp_path / "benchmarks" / "bullet.json").read_text())
    assert result["quick"] and result["machine"]["cores"]
    assert BENCHMARKS["bullet"].tables(result["summary"]) in page.read_text()
    assert "Against PyBullet" in capfd.readouterr().out


def test_command_names_what_there_is() -> None:
    with pytest.raises(InputError, match="engine"):
        app(["bench", "alchemy"], standalone_mode=False)


def test_page_without_results_names_the_command_that_makes_them(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="push-ident bench"):
        write_benchmarks(BENCHMARKS.values(), tmp_path / "benchmarks.md")
