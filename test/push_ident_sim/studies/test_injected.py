"""Causes that are put into recordings are those of the catalogue, and how their names are counted."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.objects import hammer, random_records
from push_ident.physics.effect_values import EffectValues, driven_path, measurement_times, reported_poses
from push_ident_sim.injected.into_recordings import displacement, values_of, with_causes
from push_ident_sim.studies.common.study import Case, CaseResult
from push_ident_sim.studies.injected import STUDY, draw_causes


@pytest.mark.parametrize("model", range(3))
def test_the_model_with_a_cause_sees_the_recording_as_it_was(model: int) -> None:
    record = replace(random_records(hammer(1), 1, 1)[0], order=9)
    drawn = [draw_causes(Case("recording", seed, "single")) for seed in range(40 * model, 40 * model + 40)]
    for name, (size, angle) in {name: of_case for causes in drawn for name, of_case in causes.items()}.items():
        values = values_of(name, size, angle, [record])
        # Of a clock that is late it is no linear function.
        assert displacement([record], with_causes([record], {name: values})) == pytest.approx(size, rel=0.25), name
        (changed,) = with_causes([record], {name: values})
        acting = EffectValues((name,), np.array(values))
        step = float(np.median(np.diff(record.pusher.time)))
        reported = np.column_stack([changed.pusher.position, np.zeros(len(changed.pusher.time))])
        driven = driven_path(acting, step, reported, record.order)[0][:, :2]
        # The lag is exact for a path that is linear between samples: its command is a derivative by differences.
        assert np.abs(driven - record.pusher.position).max() < (2e-3 if name == "pusher_lag" else 1e-9), name
        assert measurement_times(acting, changed.poses.time)[0] == pytest.approx(record.poses.time, abs=1e-9)
        assert changed.poses.pose == pytest.approx(reported_poses(acting, record.poses.pose)[0], abs=1e-9)
        thinner = values[0] if name == "outline_error" else 0.0
        assert changed.pusher.radius == pytest.approx(record.pusher.radius - thinner)


def case(named: dict[str, list[float]], causes: dict[str, list[float]], before: dict[str, list[float]]) -> CaseResult:
    outcome = {"verdict": "named", "named": named, "confusable": [], "something_else": 0.1, "gap": None, "account_holds": None}
    gain = {"log_density": 3.0, "standard_error": 1.0}
    values = {"n": 14, "causes": causes, "seconds": 1.0, **outcome, "before": {**outcome, "named": before}, "gain": gain}
    return CaseResult(Case("recording", 0, "single"), values)


def test_names_count_against_what_the_recording_had_before() -> None:
    rotated = {"camera_rotation": [0.01]}
    cases = [
        case({"camera_rotation": [0.011]}, rotated, {}),
        case({"camera_rotation": [0.03]}, rotated, {"camera_rotation": [0.02]}),
        case({"outline_error": [0.002]}, rotated, {"outline_error": [0.002]}),
        case({"table_tilt": [0.02, 0.0]}, rotated, {}),
        case({"tool_offset": [0.003, 0.0]}, {"camera_translation": [0.001, 0.0]}, {"tool_offset": [0.002, 0.0]}),
    ]
    row = STUDY.summarise(cases)["variants"]["single"]
    assert (row["detectable"], row["all_named"], row["wrong"]) == (5, 3, 1)
    assert row["size_errors"] == pytest.approx([0.1, 0.0, 0.0])
    assert "5" in STUDY.tables(STUDY.summarise(cases))
