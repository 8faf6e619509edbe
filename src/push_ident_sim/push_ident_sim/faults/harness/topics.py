"""The topics of a cell: their messages and qualities of service."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PolygonStamped, PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import Float32MultiArray, String
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from push_ident_msgs.msg import MassFrictionMap, PushCorrection, PushPrediction, PushRecord

__all__ = ["OBJECT", "SEEN", "TOPICS", "Topic", "qos_of"]

OBJECT: Final = "truth"
"""Id of the object whose poses come from the simulated cell."""
SEEN: Final = "o1"
"""Id of the first object that perception sees."""


@dataclass(frozen=True, slots=True)
class Topic:
    """What a topic carries, and how it is published."""

    kind: type
    latched: bool = False
    best_effort: bool = False


TOPICS: Final[dict[str, Topic]] = {
    "joint_states": Topic(JointState),
    "joint_trajectory": Topic(JointTrajectory),
    "robot_description": Topic(String, latched=True),
    "pusher/wrench": Topic(WrenchStamped),
    "pusher/pose": Topic(PoseStamped),
    "pusher/shape": Topic(SolidPrimitive, latched=True),
    "tool/pose": Topic(PoseStamped),
    "push_record": Topic(PushRecord),
    "push_correction": Topic(PushCorrection, best_effort=True),
    "recording": Topic(DiagnosticStatus, latched=True),
    "/clock": Topic(Clock),
    "/diagnostics": Topic(DiagnosticArray),
    "depth/image_rect": Topic(Image, best_effort=True),
    "depth/camera_info": Topic(CameraInfo, best_effort=True),
    "depth/camera_accuracy": Topic(PoseWithCovarianceStamped, latched=True),
    "workspace/occupancy": Topic(OccupancyGrid, latched=True),
    "workspace/refused": Topic(MarkerArray, latched=True),
    f"objects/{OBJECT}/pose": Topic(PoseWithCovarianceStamped),
    f"objects/{SEEN}/pose": Topic(PoseWithCovarianceStamped),
    f"objects/{OBJECT}/cells": Topic(OccupancyGrid, latched=True),
    f"objects/{OBJECT}/outline": Topic(PolygonStamped, latched=True),
    f"objects/{OBJECT}/outline_std": Topic(Float32MultiArray, latched=True),
    f"objects/{OBJECT}/mass_friction_map": Topic(MassFrictionMap, latched=True),
    f"objects/{OBJECT}/prediction": Topic(PushPrediction),
}
"""By name."""


def qos_of(topic: str) -> QoSProfile:
    """As the nodes of the suite publish it."""
    known = TOPICS[topic]
    return QoSProfile(
        depth=1 if known.latched else 100,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if known.latched else DurabilityPolicy.VOLATILE,
        reliability=ReliabilityPolicy.BEST_EFFORT if known.best_effort else ReliabilityPolicy.RELIABLE,
    )
