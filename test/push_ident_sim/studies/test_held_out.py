"""The study of recorded pushes known by their ends."""

from __future__ import annotations

from pathlib import Path

import pytest

from helpers.recordings import icra16_file
from push_ident.errors import InputError
from push_ident.identification.fitting.budget import Budget
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings
from push_ident_sim.studies.held_out import harmed
from push_ident_sim.studies.registry import EXPERIMENTS

STUDY = EXPERIMENTS["held-out"]
NAME = "30_90_30_30_30_90__exp"


def settings_of(folder: Path) -> CaseSettings:
    return CaseSettings(folder, Budget(max_seconds=20.0), TruthSettings(), CameraNoise(), recordings=folder)


def test_pushes_are_learned_from_or_predicted_and_known_supports_stand_beside_them(tmp_path: Path) -> None:
    icra16_file(tmp_path / f"{NAME}.txt", announced=28, n=28)
    assert STUDY.find_objects is not None and STUDY.find_objects(tmp_path) == (NAME,)
    values = STUDY.run(Case(NAME, 0, "2-pushes"), settings_of(tmp_path))
    errors = values["errors_m"]
    assert {len(of_model) for of_model in errors.values()} == {25} and len(values["within_90"]) == 25
    assert max(errors["identified"]) < 1e-3
    assert sum(errors["best"]) <= sum(errors["supports"])
    with pytest.raises(InputError, match="expected 30 and more"):
        STUDY.run(Case(NAME, 0, "5-pushes"), settings_of(tmp_path))


def test_a_set_is_harmed_from_two_per_cent_on() -> None:
    def result(name: str, identified: float) -> CaseResult:
        errors = {"identified": [identified], "scalar": [0.002], "uniform": [0.002]}
        return CaseResult(Case(name, 0, "2-pushes"), {"errors_m": errors, "within_90": [True], "beyond": [False], "time_s": 1.0})

    summary = STUDY.summarise([result("better", 0.001), result("equal", 0.00203), result("worse", 0.00205)])
    assert harmed(summary, "2-pushes") == ["worse"] and harmed(summary, "5-pushes") == []
    assert "1 / 0 / 0 of 3 sets" in STUDY.answer(summary) and "| worse " in STUDY.tables(summary)
