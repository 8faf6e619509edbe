"""Between identified models and messages."""

from __future__ import annotations

from array import array

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, Pose, PoseStamped
from nav_msgs.msg import Path
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from push_ident.errors import InputError
from push_ident.identification.predicting.prediction import Prediction
from push_ident.identification.predicting.scoring import PushScore, ScoreSummary
from push_ident.identification.results.model_file import model_of_text, model_text
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.limits import LIMITS, plain_text
from push_ident.nodes.convert.markers import MARKERS
from push_ident.nodes.convert.messages import (
    TABLE_FRAME,
    object_frame,
    planar_pose_of,
    planar_pose_to_msg,
    position_from_msg,
    position_to_msg,
    stamp_from_msg,
    stamp_to_msg,
)
from push_ident.types import Float64Array, PusherPath, PusherShape, SolveStatus
from push_ident_msgs.msg import MassFrictionMap, PushPrediction
from push_ident_msgs.msg import ModelPosterior as ModelPosteriorMsg
from push_ident_msgs.msg import PushScore as PushScoreMsg

_STATUS = {
    SolveStatus.CONVERGED: MassFrictionMap.STATUS_OK,
    SolveStatus.MAX_ITERATIONS: MassFrictionMap.STATUS_NOT_CONVERGED,
    SolveStatus.BUDGET_SPENT: MassFrictionMap.STATUS_NOT_CONVERGED,
    SolveStatus.OUT_OF_REACH: MassFrictionMap.STATUS_NOT_CONVERGED,
    SolveStatus.STALLED: MassFrictionMap.STATUS_NOT_CONVERGED,
    SolveStatus.POOR_FIT: MassFrictionMap.STATUS_NOT_CONVERGED,
    SolveStatus.SIMULATION_FAILED: MassFrictionMap.STATUS_FAILED,
    SolveStatus.UNEXPLAINED: MassFrictionMap.STATUS_FAILED,
    SolveStatus.NO_CONTACT: MassFrictionMap.STATUS_PRIOR,
}
_LOW, _HIGH = np.array([0.17, 0.25, 0.55]), np.array([0.98, 0.80, 0.15])
"""Colours of a cell with little friction force and of one with much."""
_CLOUD_FIELDS = ("x", "y", "z", "mass", "friction", "mass_friction", "mass_friction_std")


def map_status(status: SolveStatus | None) -> tuple[int, str]:
    """Message code and text of a solve; None is an object that was never pushed."""
    return (MassFrictionMap.STATUS_PRIOR, "not pushed yet") if status is None else (_STATUS[status], status.value)


def posterior_to_msg(posterior: ModelPosterior, object_id: str, stamp: Time, *, n_pushes: int, is_known: bool) -> ModelPosteriorMsg:
    """The whole posterior of an object; `stamp` and the rest as in the message."""
    msg = ModelPosteriorMsg(header=Header(stamp=stamp, frame_id=object_frame(object_id)), object_id=object_id)
    msg.n_pushes, msg.is_known, msg.model = int(n_pushes), bool(is_known), model_text(posterior, object_id)
    return msg


def posterior_from_msg(msg: ModelPosteriorMsg) -> tuple[float, ModelPosterior]:
    """Stamp [s] and posterior. Raises PushIdentError where there is none in it."""
    return stamp_from_msg(msg.header.stamp), model_of_text(msg.model, f"model of object {plain_text(msg.object_id)}")


def map_to_msg(posterior: ModelPosterior, object_id: str, stamp: Time, status: SolveStatus | None, n_pushes: int) -> MassFrictionMap:
    """The maps of an object with their standard deviations."""
    model = posterior.model
    msg = MassFrictionMap(object_id=object_id, n_pushes=int(n_pushes), cell_size=float(model.shape.cells.size))
    msg.header = Header(stamp=stamp, frame_id=object_frame(object_id))
    msg.status, msg.status_text = map_status(status)
    x, y = model.shape.cells.centres.T
    arrays = {
        "x": x,
        "y": y,
        "mass": model.mass,
        "mass_std": posterior.mass_std,
        "friction": model.friction,
        "friction_std": posterior.friction_std,
        "mass_friction": model.mass * model.friction,
        "mass_friction_std": posterior.mass_friction_std,
    }
    for name, values in arrays.items():
        setattr(msg, name, array("d", values.tolist()))
    centre = model.centre_of_friction
    msg.centre_of_friction.x, msg.centre_of_friction.y = float(centre[0]), float(centre[1])
    msg.pusher_friction, msg.pusher_friction_std = float(posterior.pusher_friction.value), float(posterior.pusher_friction.std)
    msg.total_mass, msg.total_mass_std = float(posterior.total_mass.value), float(posterior.total_mass.std)
    msg.total_mass_identifiable = bool(posterior.total_mass_identifiable)
    return msg


def cloud_to_msg(msg: MassFrictionMap) -> PointCloud2:
    """The maps as a point cloud, one point a cell, for viewers."""
    columns = [getattr(msg, name) if name != "z" else np.zeros(len(msg.x)) for name in _CLOUD_FIELDS]
    points = np.column_stack([np.asarray(c, dtype=np.float32) for c in columns])
    cloud = PointCloud2(header=msg.header, height=1, width=len(points), is_bigendian=False, is_dense=True)
    cloud.fields = [PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, name in enumerate(_CLOUD_FIELDS)]
    cloud.point_step = 4 * len(_CLOUD_FIELDS)
    cloud.row_step = cloud.point_step * len(points)
    cloud.data = array("B", points.tobytes())
    return cloud


def prediction_to_msg(prediction: Prediction, object_id: str, status: tuple[int, str], *, push_id: int = 0) -> PushPrediction:
    """A predicted motion; its stamp is the first time."""
    start = float(prediction.time[0])
    msg = PushPrediction(object_id=object_id, push_id=int(push_id), cell_error_std=float(prediction.cell_error_std))
    msg.header = Header(stamp=stamp_to_msg(max(start, 0.0)), frame_id=TABLE_FRAME)
    msg.status, msg.status_text = status
    msg.touched = prediction.status is not SolveStatus.NO_CONTACT
    for time, pose, covariance in zip(prediction.time, prediction.pose, prediction.covariance, strict=True):
        since = round(1e9 * (float(time) - start))
        msg.time_from_start.append(Duration(sec=int(since // 10**9), nanosec=int(since % 10**9)))
        msg.poses.append(planar_pose_to_msg(msg.header.stamp, pose, covariance).pose)
    return msg


def prediction_path_to_msg(msg: PushPrediction) -> Path:
    """The predicted poses as a path, for viewers."""
    path = Path(header=msg.header)
    start = stamp_from_msg(msg.header.stamp)
    for since, pose in zip(msg.time_from_start, msg.poses, strict=True):
        stamp = stamp_to_msg(start + since.sec + 1e-9 * since.nanosec)
        path.poses.append(PoseStamped(header=Header(stamp=stamp, frame_id=TABLE_FRAME), pose=pose.pose))
    return path


def path_to_msg(pusher: PusherPath) -> Path:
    """Path of the tool that makes a push, stamped from 0 (a plan has no date)."""
    stamps = [stamp_to_msg(float(time - pusher.time[0])) for time in pusher.time]
    poses = [position_to_msg(stamp, [x, y, 0.0]) for stamp, (x, y) in zip(stamps, pusher.position, strict=True)]
    return Path(header=Header(frame_id=TABLE_FRAME), poses=poses)


def score_to_msg(score: PushScore, summary: ScoreSummary, object_id: str, stamp: float) -> PushScoreMsg:
    """The score of one push, and the running record of its object."""
    return PushScoreMsg(
        header=Header(stamp=stamp_to_msg(stamp), frame_id=TABLE_FRAME),
        object_id=object_id,
        number=int(score.number),
        source=score.source,
        cell_error=float(score.cell_error),
        expected_cell_error=float(score.expected_cell_error),
        mahalanobis2=float(score.mahalanobis2),
        within_90=bool(score.within_90),
        uniform_cell_error=float(score.uniform_cell_error),
        n=int(summary.n),
        mean_cell_error=float(summary.mean_cell_error),
        mean_expected_cell_error=float(summary.mean_expected_cell_error),
        mean_uniform_cell_error=float(summary.mean_uniform_cell_error),
        share_within_90=float(summary.share_within_90),
    )


def markers_to_msg(msg: MassFrictionMap, pose: Float64Array) -> MarkerArray:
    """Cells coloured by their friction force, more transparent where it is less certain; centre of friction as a ball.

    `pose`: of the object in the table frame, shape (3,).
    """
    placed: Pose = planar_pose_to_msg(msg.header.stamp, pose, np.eye(3)).pose.pose
    load, std = np.array(msg.mass_friction), np.array(msg.mass_friction_std)
    share = load / max(float(load.max()), 1e-12)
    alpha = np.clip(1.0 - 0.8 * std / np.maximum(load, 1e-12), 0.15, 1.0)
    cells = _marker(msg, placed, 0, Marker.CUBE_LIST)
    cells.scale.x = cells.scale.y = 0.95 * msg.cell_size
    cells.scale.z = MARKERS.cell
    for x, y, s, a in zip(msg.x, msg.y, share, alpha, strict=True):
        red, green, blue = _LOW + s * (_HIGH - _LOW)
        cells.points.append(Point(x=float(x), y=float(y), z=0.0))
        cells.colors.append(ColorRGBA(r=float(red), g=float(green), b=float(blue), a=float(a)))
    centre = _marker(msg, placed, 1, Marker.SPHERE_LIST)
    centre.scale.x = centre.scale.y = centre.scale.z = 0.8 * msg.cell_size
    centre.color = ColorRGBA(r=0.85, g=0.1, b=0.1, a=1.0)
    centre.points.append(Point(x=msg.centre_of_friction.x, y=msg.centre_of_friction.y, z=MARKERS.cell))
    return MarkerArray(markers=[cells, centre])


def _marker(msg: MassFrictionMap, pose: Pose, number: int, kind: int) -> Marker:
    header = Header(stamp=msg.header.stamp, frame_id=TABLE_FRAME)
    return Marker(header=header, ns=msg.object_id, id=number, type=kind, action=Marker.ADD, pose=pose)


def pusher_path_from_msg(path: Path, tool: PusherShape) -> PusherPath:
    """Path of the pusher with its stamps.

    Raises InputError: another frame than `table`, fewer than two poses, stamps that do not increase, or poses of a tool that is no cylinder
    which are tilted against the table.
    """
    if len(path.poses) < 2:
        raise InputError(f"The pusher path has {len(path.poses)} poses, expected at least 2 with increasing stamps.")
    LIMITS.POINTS.check(len(path.poses), "Pusher path")
    samples = []
    for pose in path.poses:
        if not pose.header.frame_id:
            pose.header.frame_id = path.header.frame_id
        samples.append(position_from_msg(pose))
    time, position = np.array([time for time, _ in samples]), np.array([position[:2] for _, position in samples])
    LIMITS.PUSH_SECONDS.check(float(time[-1] - time[0]), "Pusher path")
    LIMITS.PUSH_TRAVEL.check(float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum()), "Pusher path")
    yaw = None if tool.is_cylinder else np.unwrap([planar_pose_of(pose.pose)[2] for pose in path.poses])
    return PusherPath(time, position, tool.radius, tool.polygon, yaw, tool.fingers)
