"""Poses that no object can have."""

from __future__ import annotations

from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped

from push_ident.nodes.convert.messages import planar_pose_to_msg


def right_pose() -> PoseWithCovarianceStamped:
    return planar_pose_to_msg(Time(sec=5), [0.1, 0.2, 0.3], np.eye(3) * 1e-6)


def wrong_poses() -> dict[str, PoseWithCovarianceStamped]:
    found: dict[str, PoseWithCovarianceStamped] = {}

    def add(name: str, change: Any) -> None:
        message = found[name] = right_pose()
        change(message)

    def set_covariance(value: float, *entries: int) -> Any:
        def change(message: PoseWithCovarianceStamped) -> None:
            for entry in entries:
                message.pose.covariance[entry] = value

        return change

    add("NaN in the covariance", set_covariance(np.nan, 0))
    add("NaN beside the diagonal", set_covariance(np.nan, 1))
    add("infinite covariance", set_covariance(np.inf, 7))
    add("not symmetric", set_covariance(1e-7, 1))
    add("not positive definite", set_covariance(-1.0, 35))
    add("huge covariance", set_covariance(1e300, 0, 7, 35))
    add("no covariance", set_covariance(0.0, *range(36)))
    add("NaN", lambda m: setattr(m.pose.pose.position, "x", np.nan))
    add("far", lambda m: setattr(m.pose.pose.position, "y", 1e300))
    add("zero quaternion", lambda m: setattr(m.pose.pose, "orientation", type(m.pose.pose.orientation)(w=0.0)))
    add("huge quaternion", lambda m: setattr(m.pose.pose.orientation, "x", 1e308))
    add("negative stamp", lambda m: setattr(m.header.stamp, "sec", -1))
    add("too many nanoseconds", lambda m: setattr(m.header.stamp, "nanosec", 2**32 - 1))
    add("wrong frame", lambda m: setattr(m.header, "frame_id", "[/x]\x00" * 1000))
    add("tilted against the table", lambda m: setattr(m.pose.pose, "orientation", type(m.pose.pose.orientation)(x=0.6, w=0.8)))
    return found
