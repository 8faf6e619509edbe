"""The table of the demo counts what its aims are about."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from push_ident_sim.studies.common.experiment import Case, CaseResult
from push_ident_sim.studies.demo.study import STUDY


def push(predicted: float, expected: float, uniform: float, n_ways: int = 1) -> dict[str, Any]:
    return {"predicted_m": predicted, "expected_m": expected, "uniform_m": uniform, "ways": n_ways * [{"chance": 1.0 / n_ways}]}


def run(*test: dict[str, Any]) -> dict[str, Any]:
    return {"training": [{"moved_m": 0.05}, push(0.001, 0.001, 0.01)], "per_push": list(test), "time_s": 100.0, "load": 1.0}


def test_ratios_losses_and_pushes_far_off_are_counted(tmp_path: Path) -> None:
    good = run(push(0.001, 0.001, 0.008), push(0.002, 0.001, 0.008, 2))
    bad = run(push(0.009, 0.001, 0.004), push(0.001, 0.002, 0.002))
    summary = STUDY.summarise([CaseResult(Case("hammer", seed, "plain"), values) for seed, values in enumerate((good, bad))])
    assert (summary["n_pushes"], summary["beyond"], summary["two_ways"]) == (6, 1, 1)
    text = STUDY.tables(summary)
    assert "1 of 2" in text and "1 of 6" in text
    assert list(STUDY.draw(summary, tmp_path)) == ["demo.png"] and (tmp_path / "demo.png").is_file()
