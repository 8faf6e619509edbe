"""Errors of poses that last: they are the same in all frames at one pose, and no residual shows them.

The object frame is that of the first detection, so they are zero there, and grow as the object turns and moves:

- A camera displaces edges where depth jumps (`edges`), that is, where the object hides its wall. Those of the first view are out of place
  in the outline; in each later view others are displaced. A pose settles between both. With the displacement h of all such edges, the
  pose is wrong by h N^-1 J'd, N = J'J, J the derivative of the expected lines of sight by the pose, and d that of the measured by h. An
  outline of several rests has each edge out of place by h times the share of the rests that hide its wall. It is put into the frame in
  which the pose at the last of them stays the same, with the error that it has there; that error f h then turns with the object.
- Edges scatter, each by itself. A pose has the variance V of the view at hand and V / n of an outline of n rests, and its residuals show
  both. What they do not show: the frame was defined with the scatter of the first view alone. Each further rest L changes the outline, and
  the frame follows the old one: it moves by the error of the old outline in the pose at L less that of the new one, of the variance
  V / (n - 1) - V / n. The pose at L with the old outline has V + V / (n - 1), hence the frame 1 / n^2 of its covariance.

The error of the extrinsics is none of these: it moves all poses alike. It is stated once, of the camera (`CameraAccuracy`), and whoever
compares poses with the pusher takes it as an unknown.
"""

from __future__ import annotations

import numpy as np

from push_ident.geometry.se2 import rotation
from push_ident.types import Float64Array

__all__ = ["displaced_pose", "frame_step", "in_table"]


def displaced_pose(scores: Float64Array, normal: Float64Array, of_frame: Float64Array, yaw: float) -> Float64Array:
    """Change of a pose (x, y, yaw) by edges that are displaced, all alike, per metre [-, -, rad/m], shape (3,), table frame.

    Args:
        scores: J'd, shape (3,).
        normal: J'J, shape (3, 3).
        of_frame: f, as `TracedObject.displaced_frame`.
        yaw: Of the object [rad].
    """
    return np.asarray(np.linalg.solve(normal, scores) + np.append(rotation(yaw) @ of_frame[:2], of_frame[2]))


def frame_step(covariance: Float64Array, yaw: float, n_rests: int) -> Float64Array:
    """Covariance of the step of an object frame that follows the old outline, shape (3, 3), object frame.

    Args:
        covariance: Of the pose at the latest rest, with the old outline, of errors that do not last, shape (3, 3), table frame.
        yaw: Of the object there [rad].
        n_rests: Of the new outline.
    """
    return in_table(covariance, np.array([0.0, 0.0, -yaw])) / n_rests**2


def in_table(covariance: Float64Array, pose: Float64Array) -> Float64Array:
    """Covariance of (x, y, yaw), shape (3, 3), given in the object frame, in the table frame."""
    turn = np.eye(3)
    turn[:2, :2] = rotation(float(pose[2]))
    return np.asarray(turn @ covariance @ turn.T)
