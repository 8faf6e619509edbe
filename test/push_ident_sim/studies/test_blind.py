"""The blind check: cases determined by their seeds, a truth that is sealed before scoring, and figures that count what they name."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.errors import InputError
from push_ident.physics.effects import CAUSES
from push_ident_sim.injected import INJECTED, InjectedEffects
from push_ident_sim.objects import OBJECT_NAMES, make_object
from push_ident_sim.recordings.truth import CameraNoise
from push_ident_sim.studies.blind import cases as sealing
from push_ident_sim.studies.blind.cases import (
    CAMERA,
    FIRST_REPORT_MODEL,
    NULLS,
    Scenario,
    Truth,
    draw_truth,
    make_records,
    n_pushes_of_null,
)
from push_ident_sim.studies.blind.scoring import score_case
from push_ident_sim.studies.blind.summary import figures, interval, judge, summarise_cases
from push_ident_sim.studies.common.study import Case, CaseResult

NOISE = CameraNoise()


def cases(first: int, n_models: int, variant: str = "14-pushes") -> list[Case]:
    return [Case(name, first + i, variant) for i in range(n_models) for name in OBJECT_NAMES]


# --- cases and their seal


def test_one_round_holds_nulls_every_effect_from_small_to_large_pairs_and_strangers_in_both_engines() -> None:
    truths = [draw_truth(c.object_name, c.model) for c in cases(0, 50)]
    kinds = Counter((t.scenario.engine, t.scenario.kind) for t in truths)
    assert all(kinds[engine, kind] >= 4 for engine in ("bullet", "planar") for kind in ("null", "single", "pair", "foreign", "outside"))
    for name in CAUSES:
        sizes = [t.scenario.size for t in truths if t.scenario.kind == "single" and t.names == (name,)]
        assert min(sizes) < 0.2 and max(sizes) >= 3.0
        # Bullet's spring is no tether of the catalogue.
        assert {t.scenario.engine for t in truths if t.names == (name,)} == ({"planar"} if name == "tether" else {"bullet", "planar"})
    assert all(t.effects or t.outside or t.scenario.kind == "null" for t in truths)
    assert {name for t in truths if not t.scenario.names for name, _ in t.effects.values} == {"noise_correlation", "dropped_frames"}


def test_report_set_is_another_one_and_what_a_camera_cannot_film_is_a_null_there() -> None:
    tune, report = ([draw_truth(c.object_name, c.model).effects for c in cases(first, 4)] for first in (0, FIRST_REPORT_MODEL))
    assert not any(a == b for a, b in zip(tune, report, strict=True) if a), "both sets are drawn from other seeds"
    truths = [draw_truth(c.object_name, c.model, CAMERA) for c in cases(0, 50)]
    assert {t.scenario.engine for t in truths} == {"camera"}
    filmed = {name for t in truths for name, _ in t.effects.values}
    assert "tether" not in filmed and "table_tilt" in filmed
    assert not any(INJECTED[name].acts_on == "poses" for name in filmed) and not any(t.outside for t in truths)


def test_truth_is_sealed_before_scoring_and_scored_by_one_policy_and_one_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = cases(FIRST_REPORT_MODEL, 2)
    sealed = sealing.seal_cases(chosen, tmp_path)
    assert {len(sealed[key]) for key in ("truth_sha256", "policy_sha256", "code_sha256")} == {64}
    assert sealed["phase"] == "report" and sealed["n_cases"] == 10
    assert sealed["policy"]["selection"]["cost_false_alarm"] == DiagnosisSettings().policy.selection.cost_false_alarm
    assert sealing.seal_cases(chosen, tmp_path) == sealed
    assert sealing.seal_cases(cases(FIRST_REPORT_MODEL, 3), tmp_path)["truth_sha256"] != sealed["truth_sha256"]
    for what in ("policy", "code"):
        changed = sealing.decision_hashes() | {f"{what}_sha256": "another"}
        with monkeypatch.context() as patch:
            patch.setattr(sealing, "decision_hashes", lambda changed=changed: changed)
            with pytest.raises(InputError, match=f"another {what}"):
                sealing.seal_cases(chosen, tmp_path)
            # The policy may change as often as it has to on the set that is there for it.
            assert sealing.seal_cases(cases(0, 2), tmp_path)[f"{what}_sha256"] == "another"
    with pytest.raises(InputError, match="separate them"):
        sealing.seal_cases([*cases(0, 1), *chosen], tmp_path)


# --- figures


@pytest.mark.parametrize(("hits", "n"), [(0, 7), (8, 10), (40, 40)])
def test_ends_of_the_interval_are_the_shares_at_which_the_count_is_just_likely(hits: int, n: int) -> None:
    found = interval(hits, n)
    for end in (found["low"], found["high"]):
        if 0.0 < end < 1.0:
            assert abs(hits / n - end) == pytest.approx(1.6449 * np.sqrt(end * (1 - end) / n), rel=1e-6)
    assert found["low"] <= hits / n <= found["high"]
    assert interval(0, 0)["share"] is None


def outcome(
    kind: str, truth: str, verdict: str, named: str = "", confusable: str = "", gain: float = 0.0, certain_gain: float = 0.0, **more: Any
) -> CaseResult:
    """Of one case; names are separated by blanks."""
    mechanism = "friction_by_speed" if kind == "foreign" else ""
    values: dict[str, Any] = {
        "verdict": verdict,
        "effects": [{"name": n, "parameters": {"offset": 1.05e-3}, "std": {"offset": 1e-4}, "evidence": 20.0} for n in named.split()],
        "confusable": confusable.split(),
        "gap": {"before_m": 4e-3, "after_m": 1e-3, "noise_m": 5e-4, "shrink": 0.8},
        "seconds": 10.0,
        "truth": {
            "engine": "planar",
            "kind": kind,
            "names": truth.split(),
            "size": 1.0,
            "mechanism": mechanism,
        },
        "true_parameters": {name: [1e-3] for name in truth.split()},
        "detectability": {name: {"gain": gain, "certain_gain": certain_gain} for name in truth.split()},
    }
    return CaseResult(Case("book", 0, "14-pushes"), values | more)


def test_figures_count_what_they_say() -> None:
    results = [
        outcome("null", "", "no_gap"),
        outcome("null", "", "one_of", "wear", "tether"),
        outcome("single", "outline_error", "named", "outline_error", "", 30, 20),
        outcome("single", "pusher_lag", "one_of", "pose_latency", "pusher_lag", 8, 4),
        outcome("single", "wear", "named", "table_tilt", "", 9, 3),
        outcome("single", "wear", "no_gap", "", "", -1, 0.5),
        # Twins that no push can tell apart.
        outcome("single", "tool_offset", "one_of", "camera_translation", "tool_offset", 40, 30),
        outcome("pair", "pusher_lag wear", "several", "wear table_tilt", "", 20, 40),
        outcome("foreign", "viscous_film", "named", "friction_by_speed", visibility=80.0),
        outcome("foreign", "viscous_film", "named", "stribeck_friction", visibility=80.0),
        outcome("foreign", "viscous_film", "named", "table_tilt", visibility=8.0),
        outcome("outside", "compliant_table", "unknown", visibility=80.0),
        outcome("outside", "gust", "named", "table_tilt", visibility=None),
        outcome("outside", "compliant_table", "no_gap", visibility=2.0),
    ]
    counted = figures([judge(r) for r in results])
    shares = {name: (round(f["share"] * f["n"]), f["n"]) for name, f in counted.items() if f.get("share") is not None}
    expected = {
        "false_alarms": (1, 2), "top1_detectable": (2, 4), "top1_surely": (2, 2), "wrong_names": (1, 5), "in_set": (3, 4),
        "silent_undetectable": (1, 1), "pairs_both": (0, 1), "pairs_one": (1, 1),
        "unknown_flagged": (1, 2), "unknown_misnamed": (1, 3), "size_intervals": (1, 1),
        "mechanism_detectable": (2, 4), "mechanism_foreign": (2, 2), "wrong_foreign": (1, 3),
    }  # fmt: skip
    assert {name: shares[name] for name in expected} == expected
    assert counted["set_size"]["value"] == pytest.approx(1.25) and counted["shrink"]["value"] == pytest.approx(0.8)


def test_causes_that_are_stated_surely_are_counted_with_their_twins() -> None:
    stated = {"nothing": 0.0, "tool_offset": 0.5, "camera_translation": 0.49, "something_else": 0.02}
    null = outcome("null", "", "no_gap", probabilities={"nothing": 0.92, "wear": 0.08, "something_else": 0.03})
    single = outcome("single", "tool_offset", "one_of", "camera_translation", "tool_offset", 20.0, 15.0, probabilities=stated)
    outside = outcome("outside", "", "named", "wear", probabilities={"nothing": 0.01, "wear": 0.95, "something_else": 0.3})
    found = figures([judge(case) for case in (null, single, outside, outcome("null", "", "no_gap"))])
    assert found["stated_surely"]["n"] == 3 and found["stated_surely"]["share"] == pytest.approx(2 / 3)
    ranges = {row["from"]: row for row in summarise_cases([null, single, outside])["by_probability"]}
    assert ranges[0.9]["right"]["n"] == 2 and ranges[0.9]["right"]["share"] == pytest.approx(0.5)
    assert ranges[0.97]["right"]["share"] == 1.0 and ranges[0.97]["stated"] == pytest.approx(0.99)
    assert ranges[0.3]["right"]["n"] == 1 and ranges[0.3]["right"]["share"] == 1.0


def test_variant_of_nulls_has_no_effect_and_any_number_of_pushes_in_both_engines() -> None:
    truths = [draw_truth(c.object_name, c.model, NULLS) for c in cases(0, 20)]
    assert {(t.scenario.engine, t.scenario.kind) for t in truths} == {("bullet", "null"), ("planar", "null")}
    assert {name for t in truths for name, _ in t.effects.values} == {"noise_correlation", "dropped_frames"}
    assert {n_pushes_of_null(c.object_name, c.model) for c in cases(0, 50)} == set(range(6, 21))


# --- one case


def test_case_is_diagnosed_and_compared_with_the_truth() -> None:
    truth = Truth(Scenario("planar", "single", ("outline_error",), 2.0), InjectedEffects.of({"outline_error": 0.002}), ())
    records = make_records(truth, "book", 2, 4, NOISE)
    values = score_case(records, truth, make_object("book", 2), DiagnosisSettings())
    case = judge(CaseResult(Case("book", 2, "6-pushes"), values))
    assert case.detectable and case.clearly_detectable and case.right
    assert values["true_parameters"] == {"outline_error": [0.002]}
    # The diagnosis gains about what is expected of the true size in the linear range.
    assert values["detectability"]["outline_error"]["gain"] == pytest.approx(values["effects"][0]["evidence"], rel=0.2)
    assert json.dumps(values)
