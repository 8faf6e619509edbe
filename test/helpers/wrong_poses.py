"""Poses that no object can have."""

from __future__ import annotations

from functools import reduce

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion

from push_ident.nodes.convert.messages import planar_pose_to_msg


def right_pose() -> PoseWithCovarianceStamped:
    return planar_pose_to_msg(Time(sec=5), [0.1, 0.2, 0.3], np.eye(3) * 1e-6)


def wrong_poses() -> dict[str, PoseWithCovarianceStamped]:
    covariances = {
        "NaN in the covariance": (np.nan, 0),
        "NaN beside the diagonal": (np.nan, 1),
        "infinite covariance": (np.inf, 7),
        "not symmetric": (1e-7, 1),
        "not positive definite": (-1.0, 35),
        "huge covariance": (1e300, 0, 7, 35),
        "not positive definite, without that of the yaw": (1.0, 1, 6),
    }
    fields: dict[str, tuple[str, object]] = {
        "NaN": ("pose.pose.position.x", np.nan),
        "far": ("pose.pose.position.y", 1e300),
        "zero quaternion": ("pose.pose.orientation", Quaternion(w=0.0)),
        "huge quaternion": ("pose.pose.orientation.x", 1e308),
        "negative stamp": ("header.stamp.sec", -1),
        "too many nanoseconds": ("header.stamp.nanosec", 2**32 - 1),
        "wrong frame": ("header.frame_id", "[/x]\x00" * 1000),
        "tilted against the table": ("pose.pose.orientation", Quaternion(x=0.6, w=0.8)),
    }
    found = {name: right_pose() for name in (*covariances, *fields)}
    for name, (value, *entries) in covariances.items():
        found[name].pose.covariance[entries] = value
    for name, (path, given) in fields.items():
        *owners, field = path.split(".")
        setattr(reduce(getattr, owners, found[name]), field, given)
    return found
