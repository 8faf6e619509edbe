"""One right message of every topic, and one right goal of every kind, from which fuzzing starts."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point
from nav_msgs.msg import Path
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from helpers.objects import hammer
from push_ident.geometry.table import Table
from push_ident.identification.predicting.prediction import predict
from push_ident.identification.predicting.scoring import PushScore, ScoreSummary
from push_ident.identification.results.posterior import prior_posterior
from push_ident.nodes.convert.markers import GoalDrawing, goal_markers_to_msg, refusals_to_msg
from push_ident.nodes.convert.messages import (
    camera_accuracy_to_msg,
    depth_frame_to_msgs,
    force_to_msg,
    outline_std_to_msg,
    planar_pose_to_msg,
    position_to_msg,
    pusher_shape_to_msg,
    shape_to_msgs,
    stamp_to_msg,
    transform_to_msg,
)
from push_ident.nodes.convert.model import map_to_msg, path_to_msg, posterior_to_msg, prediction_to_msg, score_to_msg
from push_ident.nodes.convert.table import edge_to_msg, table_to_msg
from push_ident.nodes.convert.tool_path import correction_to_msg, path_goal
from push_ident.perception.refusals import Reason, Refusal
from push_ident.physics.overhang import TableEdge
from push_ident.physics.scenario import PushScenario
from push_ident.pushing.steering import PathRequest, ToolCorrection
from push_ident.pushing.tool_path import Corridor, ToolPath
from push_ident.types import CameraAccuracy, CameraIntrinsics, DepthFrame, PusherPath, PusherShape
from push_ident_msgs.action import ExecutePush, PushToGoal
from push_ident_msgs.msg import GapReport, HandCommand, HandStatus, PushRecord
from push_ident_sim.cell.robot import HOME, JOINT_NAMES, robot_description

OBJECT = "o1"
STAMP = stamp_to_msg(12.5)
CAMERA = CameraIntrinsics(8, 6, 9.0, 9.0, 3.5, 2.5)
LINE = np.array([[0.15, 0.0], [0.12, 0.0], [0.06, 0.0]])
STEERED = ToolPath(np.array([0.0, 0.3, 0.9]), LINE)
CORNERS = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]])


@cache
def right_messages() -> dict[str, Any]:
    shape = hammer().shape
    cells, outline = shape_to_msgs(shape, OBJECT, STAMP)
    image, info = depth_frame_to_msgs(DepthFrame(0.0, np.full((6, 8), 0.8, np.float32), CAMERA), STAMP)
    path = PusherPath(np.linspace(0.0, 1.0, 4), np.linspace([-0.25, 0.0], [-0.05, 0.0], 4), 0.01)
    posterior = prior_posterior(shape)
    prediction = prediction_to_msg(predict(posterior, PushScenario(path, np.zeros(3), np.linspace(0, 1, 5))), OBJECT, (1, "fine"))
    tip = JointTrajectoryPoint(positions=list(HOME), velocities=[0.0] * len(HOME))
    tip.time_from_start.sec = 2
    prefix = f"objects/{OBJECT}/"
    return {
        prefix + "pose": planar_pose_to_msg(STAMP, [0.1, 0.2, 0.3], 1e-6 * np.eye(3)),
        prefix + "cells": cells,
        prefix + "outline": outline,
        prefix + "outline_std": outline_std_to_msg(replace(shape, outline_std=np.full(len(shape.outline), 1e-3))),
        prefix + "mass_friction_map": map_to_msg(posterior, OBJECT, STAMP, None, 0),
        prefix + "prediction": prediction,
        prefix + "next_push_prediction": prediction,
        prefix + "next_push": path_to_msg(path),
        prefix + "push_score": score_to_msg(
            PushScore(1, "push 1", 1.0, 0.002, 0.003, 2.0, 0.009), ScoreSummary(1, 0.002, 0.003, 0.009, 1.0), OBJECT, 1.0
        ),
        prefix + "model": posterior_to_msg(posterior, OBJECT, STAMP, n_pushes=1, is_known=True),
        "pusher/pose": position_to_msg(STAMP, [-0.2, 0.0, 0.01]),
        "pusher/shape": pusher_shape_to_msg(PusherShape(0.01), 0.1),
        "pusher/wrench": force_to_msg(STAMP, [1.0, 2.0]),
        "push_record": _record(),
        "push_correction": correction_to_msg(ToolCorrection(1, 12.5, False, STEERED.time, STEERED.position)),
        "joint_states": JointState(name=list(JOINT_NAMES), position=list(HOME)),
        "joint_trajectory": JointTrajectory(joint_names=list(JOINT_NAMES), points=[tip]),
        "robot_description": String(data=robot_description()),
        "depth/image_rect": image,
        "depth/camera_info": info,
        "depth/camera_accuracy": camera_accuracy_to_msg(CameraAccuracy(0.002, 0.01), STAMP),
        "depth/camera_pose": transform_to_msg(STAMP, np.eye(4)),
        "tool/pose": position_to_msg(STAMP, [-0.3, 0.3, 0.2]),
        "workspace/table": table_to_msg(Table.rectangle(np.array([-0.5, 0.15, -0.4, 0.4])), STAMP),
        "workspace/edge": edge_to_msg(TableEdge.between(np.array([0.15, -0.4]), np.array([0.15, 0.4])), STAMP),
        "workspace/refused": refusals_to_msg([Refusal(Reason.AT_IMAGE_BORDER, "cut by the border", CORNERS, 0.05)], STAMP),
        "push_to_goal/markers": goal_markers_to_msg(
            GoalDrawing(OBJECT, CORNERS, "path: 100 mm", LINE, CORNERS + 0.02, "push 3", LINE[:2], LINE - 0.1, CORNERS - 0.1), STAMP
        ),
        "gap_report": GapReport(object_id=OBJECT, json='{"verdict": "named", "effects": []}'),
        "recording": DiagnosticStatus(name="bag_recorder_node", message="recording"),
        "/clock": Clock(clock=STAMP),
        "/diagnostics": DiagnosticArray(status=[DiagnosticStatus(name="/other_node", values=[KeyValue(key="streams", value="at rest")])]),
        "Robotiq3FGripper/InputRegisters": HandStatus(g_act=1, g_gto=1, g_imc=3, g_sta=2, g_pra=255),
        "Robotiq3FGripper/OutputRegisters": HandCommand(r_act=1, r_gto=1, r_pra=200, r_spa=255),
    }


@cache
def right_goals() -> dict[str, list[Any]]:
    straight = ExecutePush.Goal(
        object_id=OBJECT, contact_point=Point(x=0.05), frame_id=f"object_{OBJECT}", direction=3.14, distance=0.06, speed=0.2
    )
    edge = [Point(x=0.15, y=-0.3), Point(x=0.15, y=0.3)]
    return {
        "execute_push": [straight, path_goal(OBJECT, PathRequest(STEERED, Corridor(LINE, 0.03), 4.0))],
        "push_to_goal": [
            _goal(),
            _path_goal(),
            PushToGoal.Goal(kind=PushToGoal.Goal.KIND_EDGE, object_id=OBJECT, edge=edge, overhang=0.03),
        ],
    }


def _record() -> PushRecord:
    record = PushRecord(push_id=1, object_id=OBJECT, start=stamp_to_msg(11.0), stop=STAMP, end=STAMP, distance=0.08, speed=0.15)
    record.header.frame_id, record.header.stamp = "table", STAMP
    return record


def _goal() -> PushToGoal.Goal:
    goal = PushToGoal.Goal(object_id=OBJECT)
    goal.goal.header.frame_id = "table"
    return goal


def _path_goal() -> PushToGoal.Goal:
    goal = PushToGoal.Goal(kind=PushToGoal.Goal.KIND_PATH, object_id=OBJECT, speed=0.05)
    poses = [position_to_msg(stamp_to_msg(t), [0.05 * t, 0.0, 0.0]) for t in (1.0, 1.5, 2.0)]
    goal.path = Path(poses=poses)
    goal.path.header.frame_id = "table"
    return goal
