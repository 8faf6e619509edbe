"""Statistics that studies share, on numbers whose answer is known; and the studies of the paper's figures, each on its smallest size."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest

from push_ident.identification.fitting.budget import Budget
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, generate_truth
from push_ident_sim.studies.common.measuring import error_row, failures, interleaved, mean_of, root_mean_square, share
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings
from push_ident_sim.studies.common.tables import causes_text
from push_ident_sim.studies.convergence import error_at
from push_ident_sim.studies.coverage import gaussian_level
from push_ident_sim.studies.registry import EXPERIMENTS


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
    return CaseSettings(folder, Budget(max_seconds=0.2, processor_time=True), truth, CameraNoise())


@pytest.mark.parametrize("name", ["real-protocol", "convergence", "maps", "coverage"])
def test_case_gives_table_answer_and_figure(name: str, settings: CaseSettings, tmp_path: Path) -> None:
    study = EXPERIMENTS[name]
    cases = [Case("toolbox", 3, variant) for variant in study.variants[:1]]
    summary = json.loads(json.dumps(study.summarise([CaseResult(case, study.run(case, settings)) for case in cases]), allow_nan=False))
    assert study.tables(summary).startswith("|") and study.answer(summary).endswith(".")
    written = [(tmp_path / figure).read_text() for figure in study.draw(summary, tmp_path)]
    assert len(written) == (name != "real-protocol") and all("<svg" in text for text in written)
    assert [(tmp_path / figure).read_text() for figure in study.draw(summary, tmp_path)] == written
