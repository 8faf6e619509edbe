"""Parameters of nodes: declared whole, and nothing wrong gets through."""

from __future__ import annotations

import math

import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from push_ident.errors import InputError
from push_ident.nodes.base.parameters import Parameter, Parameters
from push_ident.nodes.push_executor.parameters import PARAMETERS as EXECUTOR
from push_ident.nodes.push_executor.parameters import execution_settings

TABLE = (
    Parameter("speed", 0.05, "speed of the push [m/s]", 0.001, 0.5),
    Parameter("count", 10, "frames at rest", 1, 100),
    Parameter("corner", [0.1, 0.2], "corner [m]", -1.0, 1.0),
    Parameter("method", "slow", "which", choices=("slow", "fast")),
    Parameter("radius", 0.02, "radius of the tool [m]", 0.0, 0.3, read_only=True),
)


@pytest.fixture
def make(context):
    nodes = []

    def build(overrides=None, table=TABLE, **kwargs):
        overrides = [RosParameter(name, value=value) for name, value in (overrides or {}).items()]
        nodes.append(Node("tested", context=context, parameter_overrides=overrides, enable_rosout=False))
        return nodes[-1], Parameters(nodes[-1], table, **kwargs)

    yield build
    for node in nodes:
        node.destroy_node()


def test_defaults_overrides_and_descriptions_are_in_force(make):
    node, parameters = make({"speed": 0.2, "corner": [0.5, -0.5]})
    assert parameters.as_dict() == {"speed": 0.2, "count": 10, "corner": [0.5, -0.5], "method": "slow", "radius": 0.02}
    descriptor = node.describe_parameter("speed")
    assert descriptor.description == "speed of the push [m/s]"
    assert (descriptor.floating_point_range[0].from_value, descriptor.floating_point_range[0].to_value) == (0.001, 0.5)


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        ({"speed": 0.9}, r"speed of tested is 0.9: expected 0.001 to 0.5 \(speed of the push \[m/s\]\)"),
        ({"speed": math.nan}, "speed of tested is nan: expected finite numbers"),
        ({"speed": 1}, "speed of tested is 1: expected float, write 1.0"),
        ({"speed": "quick"}, "speed of tested is 'quick': expected float"),
        ({"count": 0}, "count of tested is 0: expected 1 to 100"),
        ({"corner": [0.1, 2.0]}, "expected -1 to 1"),
        ({"corner": [0.1]}, "expected 2 values, got 1"),
        ({"method": "best"}, "expected one of slow, fast"),
    ],
)
def test_impossible_values_are_refused_at_the_start_and_later_and_leave_the_old_ones(make, overrides, text):
    with pytest.raises(InputError, match=text):
        make(overrides)
    node, parameters = make()
    before = parameters.as_dict()
    for name, value in (*overrides.items(), ("radius", 0.1)):  # that one is read-only
        result = node.set_parameters([RosParameter(name, value=value)])[0]
        assert not result.successful and result.reason
    assert parameters.as_dict() == before


def test_accepted_settings_are_reported_and_kept(make):
    reported = []
    node, parameters = make(on_change=reported.append)
    assert node.set_parameters([RosParameter("speed", value=0.3)])[0].successful
    assert reported == [{"speed": 0.3}] and parameters["speed"] == 0.3


def test_values_that_do_not_go_together_are_refused(make):
    def check(values):
        if values["speed"] * values["count"] > 2.0:
            raise InputError("speed times count is above 2.")

    node, parameters = make(check=check)
    assert not node.set_parameters([RosParameter("speed", value=0.4)])[0].successful
    assert parameters["speed"] == 0.05
    with pytest.raises(InputError, match="above 2"):
        make({"speed": 0.4}, check=check)


def test_rows_that_follow_from_a_list_of_names_are_declared_too(make, capfd):
    node, parameters = make(
        {"tools": ["left", "right"], "left.speed": 0.2, "up.speed": 0.2},
        (Parameter("tools", [""], "their names", read_only=True),),
        further=lambda values: [Parameter(f"{name}.speed", 0.1, "[m/s]", 0.0, 0.5) for name in values["tools"]],
    )
    assert parameters.as_dict() == {"tools": ["left", "right"], "left.speed": 0.2, "right.speed": 0.1}
    assert not node.set_parameters([RosParameter("right.speed", value=0.9)])[0].successful
    reported = capfd.readouterr().err
    assert "up.speed is not one of tested and is ignored; did you mean" in reported and "left.speed" not in reported.split("up.speed")[0]


def test_list_with_one_number_for_each_joint_has_any_length_but_none_outside_its_range(make):
    row = Parameter("posture", [0.0] * 7, "one per joint [rad]", -6.3, 6.3, any_length=True)
    assert make({"posture": [0.1] * 6}, (row,))[1]["posture"] == [0.1] * 6
    assert row.fault([]) == "expected at least one value" and row.fault([0.1] * 5 + [7.0]) == "expected -6.3 to 6.3"


def test_every_setting_of_the_execution_comes_from_a_parameter():
    values = {row.name: row.default for row in EXECUTOR}
    changed = {name: value * 1.001 if isinstance(value, float) else value for name, value in values.items()}
    settings = execution_settings(changed)
    assert settings.limits.force_limit == changed["force_limit"] and settings.min_object_turn == changed["min_object_turn"]
    assert settings.push.cone == changed["random_cone"] and settings.push.distance_range == tuple(values["random_distance"])
    assert settings.motion.home == tuple(values["home_posture"]) and settings.motion.push_height == changed["push_height"]
    assert values["arm_timeout"] == 0.1, "the arm is held a tenth of a second after its last joint state"
