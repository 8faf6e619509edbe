"""Parameters of goal_pushing_node, the settings made of them, and what is no parameter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from push_ident.nodes.base.parameters import Parameter
from push_ident.nodes.input.table import CORNERS, table_of_corners
from push_ident.planning.edge_goal import EdgeGoal
from push_ident.pushing.push import PushSettings, tool_sizes
from push_ident.types import PusherShape


@dataclass(frozen=True, slots=True)
class GoalPushingSettings:
    """What the node of goals decides on that is no parameter. Times are wall time."""

    executor_discovery: float = 5.0
    """For the executor to be there and to discover this node [s]; one that runs answers within milliseconds."""
    executor_answer: float = 10.0
    """For the executor to accept a push that was sent [s]."""
    n_records: int = 16
    """Latest push records that are remembered."""
    look_period: float = 0.01
    """Between two looks whether the previous goal has ended [s]; see `planning.goal_session`."""
    hold_wait: float = 0.9
    """For the arm to hold when the node is deactivated [s]; a component may take a second."""
    pose_poll: float = 0.002
    """Between two looks for a pose during a steered push [s]: a tenth of what a correction takes."""
    correction_budget: float = 0.02
    """After so long nothing begins any more that makes a correction better [s]: with what is under way then, and where others use the cores
    as well, it still comes before the next of 30 frames a second. On free cores all of it takes less."""
    n_correction_times: int = 2000
    """Latest times of corrections that are kept: over a minute."""
    n_planners: int = 4
    """Objects whose planner of goals is kept: each holds a library of some 3 MB."""
    n_path_planners: int = 2
    """The same of paths."""


GOAL_PUSHING: Final = GoalPushingSettings()
_EDGE: Final = EdgeGoal(None)

PARAMETERS: Final = (
    Parameter("position_tolerance", 0.02, "Largest distance from the goal, where a goal gives 0 [m]", 0.0001, 1.0),
    Parameter("yaw_tolerance", 0.1, "Largest angle to the goal, where a goal gives 0 [rad]", 0.001, 3.15),
    Parameter("edge_overhang", _EDGE.overhang, "Beyond the edge of the table, where a goal at one gives 0 [m]", 0.001, 1.0),
    Parameter(
        "edge_held", _EDGE.held, "Least distance of the centre of mass from the border of its support, for such a goal [m]", 0.0, 1.0
    ),
    Parameter("edge_yaw_tolerance", _EDGE.turn, "Largest angle to the pre-grasp pose, where a goal at an edge gives 0 [rad]", 0.001, 3.15),
    Parameter("edge_risk", _EDGE.limit, "Largest chance that a push leaves it held by less; riskier ones are not made [0..1]", 1e-6, 0.5),
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
    Parameter("path_lead", 0.1, "From a frame to the motion that it corrects: a frame, its processing, a correction [s]", 0.01, 0.5),
    Parameter("path_timeout", 0.3, "Without a correction for so long, the tool stops on a path [s]", 0.05, 5.0),
    Parameter("executor_timeout", 60.0, "Longest silence of the executor during a push [s]; planning sends no feedback", 1.0, 600.0),
    Parameter("client_timeout", 1.0, "Longest silence of a client that says that it lives; then its goal is canceled [s]", 0.3, 10.0),
    Parameter("max_refusals", 8, "Pushes in a row that may be refused or miss before a goal is given up", 1, 100),
)


def check_values(values: dict[str, Any]) -> None:
    """Raise InputError where parameters contradict each other, or the table is none."""
    push_settings(values, PushSettings().tool)
    table_of_corners(values[CORNERS.name])


def push_settings(values: dict[str, Any], tool: PusherShape) -> PushSettings:
    """Limits of the pushes; `tool` is that of the executor. Raises InputError where they contradict each other."""
    x_min, x_max, y_min, y_max = values["workspace"]
    speed = float(values["push_speed"])
    return PushSettings(
        workspace=(x_min, x_max, y_min, y_max),
        **tool_sizes(tool),
        clearance=values["clearance"],
        lowering_gap=values["lowering_gap"],
        speed_range=(speed, speed),
    )
