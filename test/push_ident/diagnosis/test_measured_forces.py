"""A diagnosis with measured forces: errors of the sensor have names, and forces show what poses do not."""

from __future__ import annotations

from dataclasses import replace

from helpers.diagnosis import TRUTH, simulated_pushes
from helpers.objects import with_forces
from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.fits import fit_base
from push_ident.diagnosis.scores import EffectScore, effect_information, score_effects
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.verdict import Verdict
from push_ident.physics.effects import CAUSES, FORCE_CAUSES
from push_ident.types import PushRecord

SETTINGS = DiagnosisSettings()


def pushes(effects: dict[str, list[float]], n: int = 6) -> list[PushRecord]:
    return [with_forces(record, TRUTH, effects) for record in simulated_pushes(n, 3, effects)]


def scores_of(records: list[PushRecord]) -> list[EffectScore]:
    return score_effects(effect_information(fit_base(records, SETTINGS)), SETTINGS.policy.selection)


def test_an_offset_of_the_sensor_is_named_and_without_it_nothing_is() -> None:
    stale = diagnose(pushes({"force_offset": [0.8, -0.5]}))
    assert stale.verdict is Verdict.NAMED and [effect.name for effect in stale.effects] == ["force_offset"]
    assert abs(stale.effects[0].parameters["x"] - 0.8) < 0.1 and abs(stale.effects[0].parameters["y"] + 0.5) < 0.1
    assert diagnose(pushes({})).verdict is Verdict.NO_GAP


def test_errors_of_a_force_sensor_are_causes_only_where_there_is_one() -> None:
    with_sensor = pushes({}, 2)
    without = [replace(record, wrench=None) for record in with_sensor]
    names = [{score.name for score in scores_of(records)} for records in (with_sensor, without)]
    assert names == [{*CAUSES, *FORCE_CAUSES} - {"force_delay"}, set(CAUSES)]


def test_forces_show_friction_that_changes_from_push_to_push_where_slow_poses_do_not() -> None:
    worn = pushes({"wear": [0.1]})
    by_forces, by_poses = (
        next(score for score in scores_of(records) if score.name == "wear") for records in (worn, [replace(r, wrench=None) for r in worn])
    )
    assert by_forces.smallest_detectable < 0.5 * by_poses.smallest_detectable
    assert by_forces.expected_log_bayes_factor > by_poses.expected_log_bayes_factor + 3.0
