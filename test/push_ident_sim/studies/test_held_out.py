"""The study of recorded pushes known by their ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from helpers.recordings import icra16_file
from push_ident.bags.importers.shapes import right_triangle
from push_ident.errors import InputError
from push_ident.identification.fitting.budget import Budget
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings
from push_ident_sim.studies.common.study import Case, CaseResult, CaseSettings
from push_ident_sim.studies.held_out import harmed, on_supports
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


def test_known_supports_bear_the_weight_by_statics() -> None:
    shape, supports = right_triangle(0.15, 0.15), np.array([[0.01, 0.01], [0.09, 0.03], [0.01, 0.13]])
    model = on_supports(shape, supports, 0.3)
    # The centroid of the triangle is at a third of its legs: (50, 50) mm.
    assert model.centre_of_friction == pytest.approx([0.05, 0.05], abs=1e-3)
    load = model.mass * model.friction
    near = [float(load[np.linalg.norm(shape.cells.centres - place, axis=1) < 0.02].sum()) for place in supports]
    assert np.array(near) / load.sum() == pytest.approx([0.25, 0.5, 0.25], abs=0.02)


def test_a_set_is_harmed_from_two_per_cent_on() -> None:
    def result(name: str, identified: float) -> CaseResult:
        errors = {"identified": [identified], "scalar": [0.002], "uniform": [0.002]}
        return CaseResult(Case(name, 0, "2-pushes"), {"errors_m": errors, "within_90": [True], "beyond": [False], "time_s": 1.0})

    summary = STUDY.summarise([result("better", 0.001), result("equal", 0.00203), result("worse", 0.00205)])
    assert harmed(summary, "2-pushes") == ["worse"] and harmed(summary, "5-pushes") == []
    assert "1 / 0 / 0 of 3 sets" in STUDY.answer(summary) and "| worse " in STUDY.tables(summary)
