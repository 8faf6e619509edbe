"""Node `identification`: learns the maps of every object while it is pushed, publishes them, and predicts pushes."""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter, deque
from pathlib import Path
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PolygonStamped, PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMsg
from numpy.linalg import LinAlgError
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import SolidPrimitive

from push_ident.errors import InputError, PushIdentError
from push_ident.identification.model_file import load_model, save_model
from push_ident.identification.observation import observe_push
from push_ident.identification.online import OnlineIdentifier
from push_ident.identification.parameters import Prior
from push_ident.identification.prediction import predict
from push_ident.nodes.convert import (
    cylinder_radius_from_msg,
    force_from_msg,
    planar_pose_from_msg,
    position_from_msg,
    shape_from_msgs,
    stamp_to_msg,
)
from push_ident.nodes.convert_model import (
    cloud_to_msg,
    map_status,
    map_to_msg,
    prediction_path_to_msg,
    prediction_to_msg,
    pusher_path_from_msg,
)
from push_ident.nodes.discovery import ObjectTopics
from push_ident.nodes.parameters import Parameter, Parameters
from push_ident.nodes.run import run_node
from push_ident.physics.simulation import compile_kernels
from push_ident.pushing.assembly import PushAssembler
from push_ident.types import PushRecord
from push_ident_msgs.msg import MassFrictionMap, PushPrediction
from push_ident_msgs.msg import PushRecord as PushRecordMsg
from push_ident_msgs.srv import LoadModel, PredictPush, SaveModel

__all__ = ["PARAMETERS", "IdentificationNode", "main"]

_LATCHED: Final = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_RELIABLE: Final = QoSProfile(depth=500, reliability=ReliabilityPolicy.BEST_AVAILABLE)
_SILENCE: Final = 2.0
"""Wall time without a message after which a push counts as finished [s]: the source has gone."""
_HIDDEN: Final = 10.0
"""The same where no object was seen since the push [s]: the arm may still be in the way."""
_JUMP_BACK: Final = 1.0
"""Stamps this much older than the latest mean that time was set back [s]."""

PARAMETERS: Final = (
    Parameter("total_mass", 0.5, "Nominal total mass of an object [kg]", 0.001, 1000.0, read_only=True),
    Parameter("total_mass_known", False, "Whether total_mass was weighed, for every object", read_only=True),
    Parameter("friction", 0.3, "Nominal support friction coefficient [-]", 0.001, 10.0, read_only=True),
    Parameter("pusher_friction", 0.3, "Nominal friction coefficient of the pusher [-]", 0.001, 10.0, read_only=True),
    Parameter("push_gap", 0.5, "Pause of the pusher that ends a push [s]", 0.05, 10.0, read_only=True),
    Parameter("update_period", 0.5, "Shortest time between two updates during a push [s]", 0.02, 10.0),
)


class IdentificationNode(Node):
    """Collects, hands pushes to a worker thread that solves, and publishes what it finds."""

    def __init__(self) -> None:
        super().__init__("identification_node")
        self._settings = Parameters(self, PARAMETERS)
        self._prior = Prior(
            total_mass=self._settings["total_mass"],
            total_mass_std=0.0 if self._settings["total_mass_known"] else Prior().total_mass_std,
            friction=self._settings["friction"],
            pusher_friction=self._settings["pusher_friction"],
        )
        self._lock = threading.RLock()  # of what callbacks collect
        self._solving = threading.Lock()  # of changes of an identifier; reading its posterior needs none
        self._assembler = PushAssembler(self._settings["push_gap"])
        self._identifiers: dict[str, OnlineIdentifier] = {}
        self._sources: dict[str, list[str]] = {}
        self._latest: dict[str, tuple[float, Any, Any]] = {}
        self._cells: dict[str, OccupancyGrid] = {}
        self._outlines: dict[str, PolygonStamped] = {}
        self._outputs: dict[str, tuple[Publisher, ...]] = {}
        self._radius = 0.0
        self._counts: Counter[str] = Counter()
        self._last_error = ""
        self._solve_time = 0.0
        self._received = time.monotonic()
        self._flushed = True

        self._wake = threading.Condition()
        self._finished: deque[list[PushRecord]] = deque()
        self._peek_due = False
        self._closing = False
        self._worker = threading.Thread(target=self._work, name="identify", daemon=True)

        self.create_subscription(PoseStamped, "pusher/pose", self._on_pusher, _RELIABLE)
        self.create_subscription(SolidPrimitive, "pusher/shape", self._on_pusher_shape, _LATCHED)
        self.create_subscription(WrenchStamped, "pusher/wrench", self._on_wrench, qos_profile_sensor_data)
        self.create_subscription(PushRecordMsg, "push_record", self._on_push_record, _RELIABLE)
        self._topics = ObjectTopics(self, self._on_new_object)
        self.create_service(PredictPush, "predict_push", self._predict_push)
        self.create_service(SaveModel, "save_model", self._save_model)
        self.create_service(LoadModel, "load_model", self._load_model)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # On the wall clock: these must run when simulated time stands still.
        wall = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self._report, clock=wall)
        self.create_timer(0.1, self._collect, clock=wall)
        self._worker.start()

    def close(self) -> None:
        """Stop the worker; the solve under way is let go."""
        with self._wake:
            self._closing = True
            self._wake.notify()
        self._worker.join(timeout=1.0)

    # ---- what comes in

    def _on_new_object(self, object_id: str) -> None:
        prefix = f"objects/{object_id}"
        self.create_subscription(OccupancyGrid, f"{prefix}/cells", lambda m: self._on_shape(object_id, cells=m), _LATCHED)
        self.create_subscription(PolygonStamped, f"{prefix}/outline", lambda m: self._on_shape(object_id, outline=m), _LATCHED)
        self.create_subscription(PoseWithCovarianceStamped, f"{prefix}/pose", lambda m: self._on_pose(object_id, m), _RELIABLE)
        with self._lock:
            self._outputs[object_id] = (
                self.create_publisher(MassFrictionMap, f"{prefix}/mass_friction_map", _LATCHED),
                self.create_publisher(PointCloud2, f"{prefix}/mass_friction_cloud", _LATCHED),
                self.create_publisher(PushPrediction, f"{prefix}/prediction", _LATCHED),
                self.create_publisher(PathMsg, f"{prefix}/prediction_path", _LATCHED),
            )
        self.get_logger().info(f"object {object_id} found")

    def _on_shape(self, object_id: str, *, cells: OccupancyGrid | None = None, outline: PolygonStamped | None = None) -> None:
        with self._lock:
            if cells is not None:
                self._cells[object_id] = cells
            if outline is not None:
                self._outlines[object_id] = outline
            if object_id not in self._cells:
                return
            try:
                shape = shape_from_msgs(self._cells[object_id], self._outlines.get(object_id))
            except InputError as error:
                self._refuse("shapes", str(error))
                return
            known = self._identifiers.get(object_id)
            if known is None or len(known.posterior.parameters.shape.cells) != len(shape.cells):
                self._identifiers[object_id] = OnlineIdentifier(shape, self._prior)
                self._sources[object_id] = []
            self._assembler.set_shape(object_id, shape)
            self._counts["shapes"] += 1

    def _on_pose(self, object_id: str, msg: PoseWithCovarianceStamped) -> None:
        try:
            stamp, pose, covariance = planar_pose_from_msg(msg)
        except InputError as error:
            self._refuse("poses", str(error))
            return
        with self._lock:
            self._arrived(stamp)
            self._assembler.add_pose(object_id, stamp, pose, covariance)
            self._latest[object_id] = (stamp, pose, covariance)
            self._counts["poses"] += 1

    def _on_pusher(self, msg: PoseStamped) -> None:
        try:
            stamp, position = position_from_msg(msg)
        except InputError as error:
            self._refuse("pusher samples", str(error))
            return
        with self._lock:
            self._arrived(stamp)
            self._assembler.add_pusher(stamp, position[:2])
            self._counts["pusher samples"] += 1

    def _on_pusher_shape(self, msg: SolidPrimitive) -> None:
        try:
            self._radius = cylinder_radius_from_msg(msg)
        except InputError as error:
            self._refuse("pusher shapes", str(error))
            return
        with self._lock:
            self._assembler.set_radius(self._radius)

    def _on_wrench(self, msg: WrenchStamped) -> None:
        try:
            stamp, force = force_from_msg(msg)
        except InputError as error:
            self._refuse("wrenches", str(error))
            return
        with self._lock:
            self._assembler.add_wrench(stamp, force)

    def _on_push_record(self, msg: PushRecordMsg) -> None:
        with self._lock:
            self._assembler.end_push()
            self._counts["push records"] += 1

    def _arrived(self, stamp: float) -> None:
        if stamp < self._assembler.now - _JUMP_BACK:
            self.get_logger().warning(
                f"time went back from {self._assembler.now:.2f} s to {stamp:.2f} s; buffered data dropped, models kept"
            )
            self._assembler.reset()
            self._counts["time jumps"] += 1
        self._received = time.monotonic()
        self._flushed = False

    def _refuse(self, what: str, why: str) -> None:
        self._counts[f"{what} refused"] += 1
        self._last_error = why
        self.get_logger().warning(why, throttle_duration_sec=5.0)

    # ---- the worker

    def _collect(self) -> None:
        """Hand complete pushes, and the push under way, to the worker."""
        with self._lock:
            patience = _HIDDEN if self._assembler.is_awaiting else _SILENCE
            silent = not self._flushed and time.monotonic() - self._received > patience
            pushes = self._assembler.finished(flush=silent)
            self._flushed = self._flushed or silent
        with self._wake:
            self._finished.extend(pushes)
            self._peek_due = True
            self._wake.notify()

    def _work(self) -> None:
        compile_kernels()
        peeked = 0.0
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._closing or self._finished or self._peek_due)
                if self._closing:
                    return
                push = self._finished.popleft() if self._finished else None
                self._peek_due = False
            if push is not None:
                if not push:
                    self._refuse("pushes", "a push is left out: no object was seen before and after it; is it hidden, or perception down?")
                for finished in push:
                    self._solve(finished, finished=True)
            elif time.monotonic() - peeked > self._settings["update_period"]:
                peeked = time.monotonic()
                with self._lock:
                    partial = [record for object_id in self._identifiers if (record := self._assembler.partial(object_id)) is not None]
                for record in partial:
                    self._solve(record, finished=False)

    def _solve(self, record: PushRecord, *, finished: bool) -> None:
        if not observe_push(record).touched:
            self._counts["pushes without contact"] += int(finished)
            return
        identifier = self._identifiers[record.object_id]
        started = time.perf_counter()
        try:
            with self._solving:
                result = identifier.add(record) if finished else identifier.peek(record)
        except (PushIdentError, ArithmeticError, LinAlgError) as error:
            self._refuse("pushes", f"{record.source}: {error}")
            return
        self._solve_time = time.perf_counter() - started
        self._counts["pushes" if finished else "updates during a push"] += 1
        if finished:
            self._sources[record.object_id].append(record.source)
            self.get_logger().info(
                f"object {record.object_id}: push {identifier.n_pushes}, {result.status.name.lower()}, {1e3 * self._solve_time:.0f} ms"
            )
        n_pushes = identifier.n_pushes + (0 if finished else 1)
        self._publish_map(record.object_id, float(record.poses.time[-1]), n_pushes)

    def _publish_map(self, object_id: str, stamp: float, n_pushes: int) -> None:
        identifier = self._identifiers[object_id]
        status = identifier.result.status if identifier.result else None
        msg = map_to_msg(identifier.posterior, object_id, stamp_to_msg(stamp), status, n_pushes)
        maps, clouds, *_ = self._outputs[object_id]
        maps.publish(msg)
        clouds.publish(cloud_to_msg(msg))

    # ---- services

    def _chosen(self, object_id: str) -> str:
        known = sorted(self._identifiers)
        if not object_id and len(known) == 1:
            return known[0]
        if object_id in self._identifiers:
            return object_id
        raise InputError(f"There is no object `{object_id}`; known: {', '.join(known) or 'none, is perception running?'}.")

    def _predict_push(self, request: PredictPush.Request, response: PredictPush.Response) -> PredictPush.Response:
        try:
            with self._lock:
                object_id = self._chosen(request.object_id)
                identifier = self._identifiers[object_id]
                covariance = None
                if request.object_pose.header.frame_id:
                    yawed = PoseWithCovarianceStamped(header=request.object_pose.header)
                    yawed.pose.pose = request.object_pose.pose
                    yawed.pose.covariance = [1e-6 if i % 7 == 0 else 0.0 for i in range(36)]
                    pose = planar_pose_from_msg(yawed)[1]
                elif object_id in self._latest:
                    _, pose, covariance = self._latest[object_id]
                else:
                    raise InputError(f"No pose of object `{object_id}` was seen yet; give `object_pose`.")
                path = pusher_path_from_msg(request.pusher_path, self._radius)
                prediction = predict(identifier.posterior, path, pose, path.time, first_covariance=covariance)
                status = identifier.result.status if identifier.result else None
        except PushIdentError as error:
            response.success, response.message = False, str(error)
            return response
        response.prediction = prediction_to_msg(prediction, object_id, map_status(status))
        response.success, response.message = True, prediction.status.value
        *_, predictions, paths = self._outputs[object_id]
        predictions.publish(response.prediction)
        paths.publish(prediction_path_to_msg(response.prediction))
        return response

    def _save_model(self, request: SaveModel.Request, response: SaveModel.Response) -> SaveModel.Response:
        try:
            with self._lock:
                object_id = self._chosen(request.object_id)
                path = Path(request.path)
                save_model(path, self._identifiers[object_id].posterior, object_id=object_id, sources=self._sources[object_id])
            response.success, response.message = True, f"object {object_id} written to {path}"
        except PushIdentError as error:
            response.success, response.message = False, str(error)
        return response

    def _load_model(self, request: LoadModel.Request, response: LoadModel.Response) -> LoadModel.Response:
        try:
            in_file, posterior = load_model(Path(request.path))
            with self._lock:
                object_id = request.object_id or in_file
                if object_id not in self._outputs:
                    raise InputError(f"There is no object `{object_id}`; known: {', '.join(sorted(self._outputs)) or 'none'}.")
                shape = posterior.parameters.shape
                identifier = self._identifiers.setdefault(object_id, OnlineIdentifier(shape, self._prior))
                self._sources[object_id] = [request.path]
            with self._solving:
                identifier.adopt(posterior)
            self._publish_map(object_id, max(self._assembler.now, 0.0), 0)
            response.success, response.message = True, f"object {object_id} taken from {request.path}"
        except PushIdentError as error:
            response.success, response.message = False, str(error)
        return response

    # ---- health

    def _report(self) -> None:
        with self._lock:
            counts = dict(self._counts)
            objects = {object_id: i.n_pushes for object_id, i in self._identifiers.items()}
        if not self._topics.ids:
            level, text = DiagnosticStatus.WARN, "no objects/<id>/pose is published; is perception (or a bag player) running?"
        elif not objects:
            level, text = DiagnosticStatus.WARN, "poses arrive but no objects/<id>/cells; the publisher must keep them (transient local)"
        elif not counts.get("pusher samples"):
            level, text = DiagnosticStatus.OK, "waiting for a push: nothing on pusher/pose yet"
        else:
            level, text = DiagnosticStatus.OK, f"pushes by object: {objects}"
        status = DiagnosticStatus(level=level, name=self.get_fully_qualified_name(), message=text, hardware_id="push_ident")
        values = {**counts, "last solve [s]": f"{self._solve_time:.3f}", "last error": self._last_error or "none"}
        status.values = [KeyValue(key=str(k), value=str(v)) for k, v in values.items()]
        msg = DiagnosticArray(status=[status])
        msg.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(msg)


def main() -> None:
    """Entry point."""
    sys.exit(run_node(IdentificationNode))


if __name__ == "__main__":
    main()
