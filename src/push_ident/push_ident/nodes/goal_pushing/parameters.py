"""Parameters of goal_pushing_node, and the settings made of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from push_ident.nodes.base.parameters import Parameter
from push_ident.nodes.input.table import CORNERS, table_of_corners
from push_ident.planning.edge_goal import EdgeGoal
from push_ident.planning.goal_ports import SessionLimits
from push_ident.pushing.push import PushSettings

__all__ = ["PARAMETERS", "SteeringValues", "check_values", "push_settings", "session_limits", "steering_values"]

_EDGE: Final = EdgeGoal(None)

PARAMETERS: Final = (
    Parameter("position_tolerance", 0.02, "Largest distance from the goal, where a goal gives 0 [m]", 0.0001, 1.0),
    Parameter("yaw_tolerance", 0.1, "Largest angle to the goal, where a goal gives 0 [rad]", 0.001, 3.15),
    Parameter("edge_overhang", _EDGE.overhang, "Beyond the edge of the table, where a goal at one gives 0 [m]", 0.001, 1.0),
    Parameter(
        "edge_held", _EDGE.held, "Least distance of the centre of mass from the border of its support, for such a goal [m]", 0.0, 1.0
    ),
    Parameter("edge_yaw_tolerance", _EDGE.turn, "Largest angle to the pre-grasp pose, where a goal at an edge gives 0 [rad]", 0.001, 3.15),
    Parameter(
        "edge_risk",
        _EDGE.limit,
        "Largest chance that a push leaves it held by less; riskier ones are not made [0..1]",
        1e-6,
        0.5,
    ),
    CORNERS,
    Parameter("time_limit", 300.0, "Longest time for a goal that gives 0, wall time [s]", 1.0, 86400.0),
    Parameter("max_pushes", 15, "Most pushes for a goal that gives 0", 1, 1000),
    Parameter("workspace", [-0.20, 0.20, -0.25, 0.25], "x_min, x_max, y_min, y_max of the tool, as of the executor [m]", -2.0, 2.0),
    Parameter("clearance", 0.03, "Travel of the pusher before it touches, as of the executor [m]", 0.005, 0.2),
    Parameter("lowering_gap", 0.005, "Least gap to any object where the tool comes down, as of the executor [m]", 0.001, 0.1),
    Parameter("push_speed", 0.1, "Speed of the pushes; slow, since the model is best known there [m/s]", 0.01, 0.25),
    Parameter("pose_timeout", 1.0, "Oldest pose, by time of receipt, that a push is planned from [s]", 0.05, 60.0),
    Parameter("object_patience", 10.0, "How long is waited for the object to come into view [s]", 0.5, 600.0),
    Parameter("learn_timeout", 30.0, "How long is waited until identification has learned a push [s]", 0.0, 600.0),
    Parameter("path_position_tolerance", 0.003, "Distance from a path that counts as one tolerance, where a goal gives 0 [m]", 0.0001, 1.0),
    Parameter("path_yaw_tolerance", 0.035, "Angle to a path that counts as one tolerance, where a goal gives 0 [rad]", 0.001, 3.15),
    Parameter("path_speed", 0.05, "Of an object along a path, where a goal gives 0 [m/s]", 0.001, 0.25),
    Parameter("path_corridor", 0.06, "How far from its path a tool may be corrected; the arm must reach all of it [m]", 0.005, 0.2),
    Parameter(
        "path_lead",
        0.1,
        "From a frame to the motion that it corrects: a frame, its processing, a correction [s]",
        0.01,
        0.5,
    ),
    Parameter("path_timeout", 0.3, "Without a correction for so long, the tool stops on a path [s]", 0.05, 5.0),
    Parameter("executor_timeout", 60.0, "Longest silence of the executor during a push [s]; planning sends no feedback", 1.0, 600.0),
    Parameter("client_timeout", 1.0, "Longest silence of a client that says that it lives; then its goal is canceled [s]", 0.3, 10.0),
    Parameter("max_refusals", 8, "Pushes in a row that may be refused or miss before a goal is given up", 1, 100),
)


def check_values(values: dict[str, Any]) -> None:
    """Raise InputError where parameters contradict each other, or the table is none."""
    push_settings(values, PushSettings().pusher_radius)
    table_of_corners(values[CORNERS.name])


def push_settings(values: dict[str, Any], pusher_radius: float) -> PushSettings:
    """Limits of the pushes; `pusher_radius` [m] is that of the executor. Raises InputError where they contradict each other."""
    x_min, x_max, y_min, y_max = values["workspace"]
    speed = float(values["push_speed"])
    return PushSettings(
        workspace=(x_min, x_max, y_min, y_max),
        pusher_radius=pusher_radius,
        clearance=values["clearance"],
        lowering_gap=values["lowering_gap"],
        speed_range=(speed, speed),
    )


def session_limits(values: dict[str, Any]) -> SessionLimits:
    """How long is waited for what."""
    return SessionLimits(
        pose_timeout=values["pose_timeout"],
        object_patience=values["object_patience"],
        learn_timeout=values["learn_timeout"],
        max_refusals=values["max_refusals"],
    )


@dataclass(frozen=True, slots=True)
class SteeringValues:
    """Numbers of corrected pushes along a path."""

    half_width: float
    """Of their corridors [m]."""
    lead: float
    """From a frame to the motion that it corrects [s]."""
    timeout: float
    """Longest time without a correction [s]."""


def steering_values(values: dict[str, Any]) -> SteeringValues:
    """How pushes along a path are corrected."""
    return SteeringValues(values["path_corridor"], values["path_lead"], values["path_timeout"])
