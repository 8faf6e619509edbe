"""The studies of the paper's figures, each on its smallest size."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from push_ident.identification.fitting.budget import Budget
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, generate_truth
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings
from push_ident_sim.studies.registry import EXPERIMENTS


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> CaseSettings:
    truth, folder = TruthSettings(n_train=4, n_test=2), tmp_path_factory.mktemp("truth")
    generate_truth(folder, "toolbox", 3, truth)
    return CaseSettings(folder, Budget(max_seconds=0.2, processor_time=True), truth, CameraNoise())


@pytest.mark.parametrize("name", ["convergence", "maps", "coverage"])
def test_case_gives_table_answer_and_figure(name: str, settings: CaseSettings, tmp_path: Path) -> None:
    study = EXPERIMENTS[name]
    cases = [Case("toolbox", 3, variant) for variant in study.variants[:1]]
    summary = json.loads(json.dumps(study.summarise([CaseResult(case, study.run(case, settings)) for case in cases]), allow_nan=False))
    assert study.tables(summary).startswith("|") and study.answer(summary).endswith(".")
    (figure,) = study.draw(summary, tmp_path)
    assert "<svg" in (tmp_path / figure).read_text()
    written = (tmp_path / figure).read_bytes()
    study.draw(summary, tmp_path)
    assert (tmp_path / figure).read_bytes() == written
