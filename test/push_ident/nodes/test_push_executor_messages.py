"""The numbers of the execution are those of the messages."""

from __future__ import annotations

from push_ident.nodes.push_executor.parameters import PARAMETERS, execution_settings
from push_ident.pushing.executed_push import Purpose
from push_ident.pushing.motion import MotionSettings
from push_ident.pushing.ports import Phase
from push_ident.pushing.push import PushCode, PushSettings
from push_ident.pushing.push_request import ExecutionSettings, Mode
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import PushRecord


def test_modes_phases_purposes_and_codes_are_those_of_the_messages() -> None:
    assert {mode: getattr(ExecutePush.Goal, f"MODE_{mode.name}") for mode in Mode} == {mode: mode.value for mode in Mode}
    assert {phase: getattr(ExecutePush.Feedback, f"PHASE_{phase.name}") for phase in Phase} == {phase: phase.value for phase in Phase}
    assert {why: getattr(PushRecord, f"PURPOSE_{why.name}") for why in Purpose} == {why: why.value for why in Purpose}
    codes = {name: int(code) for name, code in PushCode.__members__.items() if name != "SUCCESS"}  # the action says NONE: no error
    assert codes == {name: getattr(ExecutePush.Result, name) for name in codes}


def test_every_setting_of_the_execution_comes_from_a_parameter() -> None:
    values = {row.name: row.default for row in PARAMETERS}
    changed = {name: value * 1.001 if isinstance(value, float) else value for name, value in values.items()}
    settings = execution_settings(changed)
    assert settings.limits.force_limit == changed["force_limit"] and settings.min_object_turn == changed["min_object_turn"]
    assert settings.push.cone == changed["random_cone"] and settings.push.distance_range == tuple(values["random_distance"])
    assert settings.motion.home == tuple(values["home_posture"]) and settings.motion.push_height == changed["push_height"]
    assert values["arm_timeout"] == 0.1, "the arm is held a tenth of a second after its last joint state"
    assert isinstance(settings, ExecutionSettings)
    assert isinstance(settings.push, PushSettings) and isinstance(settings.motion, MotionSettings)
