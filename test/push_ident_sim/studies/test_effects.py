"""Experiment effects: what a diagnosis wins back of what was lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.experiment import Case, CaseResult
from push_ident_sim.studies.effects.study import won_back
from push_ident_sim.studies.goals.run import LEVELS
from push_ident_sim.studies.registry import EXPERIMENTS


def test_won_back_is_a_share_of_what_was_lost() -> None:
    truth, undiagnosed = np.array([2.0, 3.0, 4.0]), np.array([4.0, 4.0, 7.0])
    row = won_back(undiagnosed, undiagnosed - 0.75 * (undiagnosed - truth), truth)
    assert row == {"lost": 2.0, "share": pytest.approx(0.75), "low": pytest.approx(0.75), "high": pytest.approx(0.75)}
    assert won_back(undiagnosed, undiagnosed, truth)["share"] == 0.0 and won_back(undiagnosed, truth, truth)["share"] == 1.0
    mixed = won_back(undiagnosed, np.array([2.0, 4.0, 5.0]), truth)
    assert mixed["share"] == pytest.approx(4 / 6, abs=1e-4) and mixed["low"] < 0.6 < 0.7 < mixed["high"]
    # One object has no spread.
    assert won_back(undiagnosed[:1], truth[:1], truth[:1]) == {"lost": 2.0, "share": 1.0, "low": None, "high": None}
    assert won_back(truth, undiagnosed, truth) == {"lost": 0.0, "share": None, "low": None, "high": None}


def test_summary_counts_names_and_twins(tmp_path: Path) -> None:
    pushes = {"undiagnosed": 6, "diagnosed": 4, "truth": 4}
    named = {0: ["tool_offset"], 1: ["camera_translation"], 2: ["pusher_lag"], 3: []}

    def values(model: int, kind: str) -> Json:
        found = named[model] if kind == "diagnosed" else []
        return {"reached": [dict.fromkeys(LEVELS, True)], "pushes": [pushes[kind]], "error_m": [1e-3 * pushes[kind]], "named": found}

    results = [CaseResult(Case("tool_offset", model, kind), values(model, kind)) for model in named for kind in pushes]
    study = EXPERIMENTS["effects"]
    summary = study.summarise(results)
    # A camera beside its place is what no push can tell from a tool beside its place.
    assert summary["named"]["tool_offset"] == {"cases": 4, "right": 2, "others": 1}
    assert summary["won_back"]["tool_offset"]["pushes"]["share"] == 1.0
    assert "2 of 4, others in 1" in study.tables(summary) and "4 of 4" in study.tables(summary)
    assert all((tmp_path / name).stat().st_size > 1000 for name in study.draw(summary, tmp_path))
