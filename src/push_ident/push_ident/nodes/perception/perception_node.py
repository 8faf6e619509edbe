"""Node `perception`: depth images to shapes and poses of objects, and the occupancy of the workspace."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PolygonStamped, Pose, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, qos_policy_name_from_kind, qos_profile_sensor_data
from sensor_msgs.msg import JointState
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import Float32MultiArray, String
from visualization_msgs.msg import MarkerArray

from push_ident.bags.contract import Role
from push_ident.errors import ModelFileError, PerceptionError, PushIdentError
from push_ident.files import write_whole
from push_ident.geometry.arm_shape import ArmShape
from push_ident.geometry.frames import CAMERA_FRAME, object_frame
from push_ident.limits import LIMITS
from push_ident.nodes.base.arrivals import StampCheck
from push_ident.nodes.base.cell_node import LATCHED, CellNode, Component, Health
from push_ident.nodes.base.frames import MovingFrames, StaticFrames
from push_ident.nodes.base.parameters import Parameter, description_in
from push_ident.nodes.base.settings import NODE
from push_ident.nodes.convert.markers import refusals_to_msg
from push_ident.nodes.convert.messages import (
    camera_accuracy_to_msg,
    joints_from_msg,
    occupancy_to_msg,
    outline_std_to_msg,
    planar_pose_to_msg,
    position_from_msg,
    pusher_shape_from_msg,
    shape_to_msgs,
    transform_to_msg,
)
from push_ident.nodes.input.depth_pairs import EVERY_POSE, DepthInput
from push_ident.nodes.perception.extrinsics import Extrinsics, FromMark, FromParameters, FromTf, mark_of, pose_rows
from push_ident.nodes.perception.object_memory import ObjectMemory
from push_ident.nodes.perception.parameters import IMAGE_TIMES, PARAMETERS, names_of_further_cameras, perception_settings
from push_ident.perception.frame.robot import RobotHistory, RobotPart
from push_ident.perception.observation import Observation, ObservedObject
from push_ident.perception.pipeline import Perception
from push_ident.perception.refusals import Refusal, Removal
from push_ident.survey.parameter_file import pose_lines
from push_ident.types import CameraAccuracy, DepthFrame, Float64Array


@dataclass(slots=True)
class _Camera:
    """One camera: its images, and its pose as soon as that is known."""

    extrinsics: Extrinsics
    input: DepthInput
    pose: Float64Array | None = None
    frame: str = CAMERA_FRAME
    """Name of its optical frame."""


class _CameraPublisher:
    """Publishes the pose of the main camera, its frame and its accuracy, each when it changes."""

    def __init__(self, node: CellNode, frames: StaticFrames | None) -> None:
        self._frames = frames
        self._pose = node.create_publisher(PoseStamped, "depth/camera_pose", LATCHED)
        self._accuracy = node.create_publisher(PoseWithCovarianceStamped, Role.CAMERA_ACCURACY.value.name, LATCHED)
        self._published: tuple[Float64Array | None, CameraAccuracy | None] = (None, None)

    def publish(self, perception: Perception, stamp: Time, frame: str) -> None:
        """Publish what differs from what was published last; `frame`: name of the optical frame."""
        pose, accuracy = self._published
        if perception.camera_in_table is not pose:
            self._pose.publish(transform_to_msg(stamp, perception.camera_in_table))
            if self._frames is not None:
                self._frames.place(stamp, frame, perception.camera_in_table)
        if perception.settings.camera_accuracy != accuracy:
            self._accuracy.publish(camera_accuracy_to_msg(perception.settings.camera_accuracy, stamp))
        self._published = perception.camera_in_table, perception.settings.camera_accuracy


class OlderImages:
    """Whether an image older than the latest one means that time went back, as when a bag starts again, or a second camera driver.

    Args:
        publishers: number of nodes that publish the images now.
        clock: receive time [s].
    """

    def __init__(self, publishers: Callable[[], int], clock: Callable[[], float] = time.monotonic) -> None:
        self._publishers, self._clock = publishers, clock
        self._several_at = -math.inf

    def check(self, age: float) -> None:
        """Raise PerceptionError for an image `age` [s] older than the latest, where several nodes publish images or have just done so."""
        n = self._publishers()
        if n > 1:
            self._several_at = self._clock()
            raise PerceptionError(f"{n} nodes publish images, and this one is {age:.3f} s older than the latest; stop all but one")
        if self._clock() - self._several_at < IMAGE_TIMES.queued:
            raise PerceptionError(f"this image is {age:.3f} s older than the latest: of a node that has just stopped")


class PerceptionNode(CellNode):
    """Converts, calls `Perception`, publishes; faults are counted and reported in /diagnostics."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("perception_node", PARAMETERS, further=_rows_of_further_cameras, check=perception_settings, **kwargs)

    def make_component(self) -> Component:
        """Cameras, and what masks the robot."""
        return _Perception(self)


def _rows_of_further_cameras(values: dict[str, Any]) -> Iterator[Parameter]:
    for name in names_of_further_cameras(values):
        yield from pose_rows(name)


class _Perception(Component):
    def __init__(self, node: CellNode) -> None:
        self._node, self._configured = node, node.settings
        self._stamps = StampCheck()
        self._pose_qos: QoSProfile | int = EVERY_POSE if self._configured["every_image"] else 10
        self._perception: Perception | None = None
        self._memory = ObjectMemory(self._configured["state_directory"])
        self._calibrated: list[str] = []
        self._robot = RobotHistory(float(self._configured["tool_radius"]), float(self._configured["tool_length"]))
        self._counter: Counter[str] = Counter()
        self._last_error = ""
        self._last_observation: Observation | None = None
        self._notes: dict[str, str] = {}
        self._wall = Clock(clock_type=ClockType.STEADY_TIME)
        self._started_at = self._diagnosed_at = self._wall.now()
        self._frames_diagnosed = 0
        self._latencies: list[float] = []
        self._last_stamp = -np.inf
        self._older = OlderImages(lambda: node.count_publishers(self._main.input.image_topic))

        self._object_publishers: dict[str, tuple[Publisher, ...]] = {}
        self._moving_frames = MovingFrames(node) if self._configured["publish_tf"] else None
        # Where tf has the cameras, others broadcast them.
        broadcasts_cameras = self._configured["publish_tf"] and self._configured["extrinsics"] != "tf"
        self._static_frames = StaticFrames(node) if broadcasts_cameras else None
        self._camera_publisher = _CameraPublisher(self._node, self._static_frames)
        self._occupancy_publisher = self._node.create_publisher(OccupancyGrid, "workspace/occupancy", LATCHED)
        self._refused_publisher = self._node.create_publisher(MarkerArray, "workspace/refused", LATCHED)
        self._refused: tuple[Refusal, ...] = ()
        self._add_cameras()
        self._node.create_subscription(PoseStamped, "tool/pose", self._on_tool, qos_profile_sensor_data)
        self._node.create_subscription(JointState, "joint_states", self._on_joints, qos_profile_sensor_data)
        description = self._configured["robot_description_file"]
        if description:
            self._robot.arm_shape = ArmShape(description_in(description), self._configured["link_radius"])
        for kind, topic, callback in (
            (SolidPrimitive, "pusher/shape", self._on_tool_shape),
            *(() if description else ((String, "robot_description", self._on_description),)),
        ):
            name = self._node.resolve_topic_name(topic)
            events = SubscriptionEventCallbacks(incompatible_qos=lambda info, name=name: self._on_incompatible(name, info))
            self._node.create_subscription(kind, topic, callback, LATCHED, event_callbacks=events)

    def reconfigure(self, changed: dict[str, Any]) -> None:
        if self._perception is not None:
            self._perception.settings = perception_settings(self._configured.as_dict())
        self._robot.tool_radius = float(changed.get("tool_radius", self._robot.tool_radius))
        self._robot.tool_length = float(changed.get("tool_length", self._robot.tool_length))

    def resume(self) -> None:
        self._started_at = self._diagnosed_at = self._wall.now()

    def _on_tool(self, msg: PoseStamped) -> None:
        with self._taking("tool_pose_refused", "tool/pose"):
            stamp, position = position_from_msg(msg)
            self._stamps.check("tool/pose", stamp)
            self._robot.add_tool(stamp, position)

    def _on_tool_shape(self, msg: SolidPrimitive) -> None:
        with self._taking("tool_shape_refused", "pusher/shape"):
            self._robot.tool_radius = pusher_shape_from_msg(msg).reach
            self._robot.tool_length = float(msg.dimensions[SolidPrimitive.CYLINDER_HEIGHT])

    def _on_description(self, msg: String) -> None:
        with self._taking("description_refused", "robot_description"):
            LIMITS.DESCRIPTION.check(len(msg.data), "Robot description")
            self._robot.arm_shape = ArmShape(msg.data, self._configured["link_radius"])

    def _on_joints(self, msg: JointState) -> None:
        with self._taking("joint_states_refused", "joint_states"):
            stamp, position = joints_from_msg(msg)
            self._stamps.check("joint_states", stamp)
            self._robot.add_joints(stamp, list(position), np.array(list(position.values())))

    @contextmanager
    def _taking(self, kind: str, topic: str) -> Iterator[None]:
        try:
            yield
        except PushIdentError as error:
            self._refuse(kind, self._node.resolve_topic_name(topic), str(error))

    def _on_incompatible(self, topic: str, info: QoSRequestedIncompatibleQoSInfo) -> None:
        policy = qos_policy_name_from_kind(info.last_policy_kind)
        self._refuse("incompatible_qos", topic, f"a publisher offers an incompatible {policy}; it must be reliable and transient local")

    def _add_cameras(self) -> None:
        values = self._configured.as_dict()
        mark = mark_of(values) if values["extrinsics"] == "calibrate" else None
        tf = FromTf(self._node) if values["extrinsics"] == "tf" else None

        def extrinsics_of(name: str) -> Extrinsics:
            if mark is not None:
                return FromMark(mark, values["calibration_frames"])
            return tf if tf is not None else FromParameters(values, f"{name}." if name else "")

        def input_of(name: str, on_frame: Callable[[DepthFrame, Time], None], refuse: Callable[[str, str], None]) -> DepthInput:
            return DepthInput(
                self._node,
                f"{name}/" if name else "",
                max_skew=lambda: self._configured["max_skew"],
                on_frame=on_frame,
                refuse=refuse,
                every_image=values["every_image"],
            )

        self._main = _Camera(extrinsics_of(""), input_of("", self._on_frame, self._refuse_frame))
        self._further = {
            name: _Camera(extrinsics_of(name), input_of(name, partial(self._on_further_frame, name), partial(self._leave_out, name)))
            for name in names_of_further_cameras(values)
        }

    def _on_frame(self, frame: DepthFrame, stamp: Time) -> None:
        self._stamps.check(self._main.input.image_topic, frame.stamp)
        try:
            if self._perception is None and not self._begin(frame):
                return
            assert self._perception is not None
            if frame.stamp < self._last_stamp:
                self._older.check(self._last_stamp - frame.stamp)
                self._restart(frame.stamp)
                self._perception.reset()
                self._remember()
            self._last_stamp = frame.stamp
            followed: list[str] = []
            observation = self._perception.observe(
                frame, self._robot_at(frame.stamp), lambda objects: followed.extend(self._publish_poses(objects, stamp))
            )
        except PerceptionError as error:
            self._refuse_frame("frames_without_result", str(error))
            return
        self._counter["frames"] += 1
        self._publish(observation, stamp, followed)

    def _begin(self, frame: DepthFrame) -> bool:
        """Start perception as soon as the pose of the camera is known; until then each frame tries again."""
        try:
            self._main.pose = self._main.extrinsics.find(frame)
        except PerceptionError as error:
            self._refuse_frame(self._main.extrinsics.refusal, str(error))
        self._notes["calibration"] = self._main.extrinsics.progress
        if self._main.pose is None:
            return False
        self._main.frame = frame.frame_id or CAMERA_FRAME
        self._report_calibration("", self._main)
        self._perception = Perception(self._main.pose, perception_settings(self._configured.as_dict()))
        self._remember()
        return True

    def _remember(self) -> None:
        """Look for the objects of an earlier run."""
        assert self._perception is not None
        try:
            objects = self._memory.load()
        except ModelFileError as error:
            self._refuse("state_refused", "state_directory", str(error))
            return
        self._perception.remember(objects)
        if objects:
            self._node.get_logger().info(f"Looks for {', '.join(objects)} of an earlier run.")

    def _keep(self, observation: Observation) -> None:
        """Keep shapes that are new or better, and poses, for the next run."""
        assert self._perception is not None
        try:
            for object_id in observation.new_shapes | observation.refined:
                self._memory.keep(object_id, self._perception.known(object_id), anew=object_id in observation.refined)
            for known in observation.objects:
                if known.pose is not None:
                    self._memory.keep_pose(known.object_id, known.pose)
        except ModelFileError as error:
            self._refuse("state_not_written", "state_directory", str(error))

    def _on_further_frame(self, name: str, frame: DepthFrame, stamp: Time) -> None:
        camera = self._further[name]
        if camera.pose is None:
            try:
                camera.pose = camera.extrinsics.find(frame)
            except PerceptionError as error:
                self._leave_out(name, camera.extrinsics.refusal, str(error))
            self._notes[f"calibration_{name}"] = camera.extrinsics.progress
            if camera.pose is None:
                return
            if self._static_frames is not None and frame.frame_id:
                self._static_frames.place(stamp, frame.frame_id, camera.pose)
            self._report_calibration(name, camera)
        self._counter[f"{name}_frames"] += 1
        if self._perception is not None:
            self._perception.add_further_view(name, frame, camera.pose, self._robot_at(frame.stamp))

    def _leave_out(self, name: str, kind: str, why: str) -> None:
        """Report the fault of a further camera; perception continues without it."""
        self._counter[f"{name}_{kind}"] += 1
        self._notes[f"camera_{name}"] = why
        self._node.guard.refuse(f"camera {name}", why)

    def _report_calibration(self, name: str, camera: _Camera) -> None:
        """Report extrinsics that were calibrated from the mark, and write those of all cameras so far to a parameter file."""
        calibration = camera.extrinsics.calibration if isinstance(camera.extrinsics, FromMark) else None
        if calibration is None:
            return
        self._calibrated += pose_lines(calibration.camera_in_table, f"{name}." if name else "")
        note = self._notes[f"extrinsics_{name}" if name else "extrinsics"] = (
            f"calibrated from {calibration.n_frames} frames: outline of the mark {calibration.outline_residual * 1e3:.2f} mm, "
            f"its height {calibration.height_error * 1e3:+.2f} mm, noise of the table {calibration.plane_noise * 1e3:.2f} mm"
        )
        self._node.get_logger().info(f"Extrinsics {name} {note}. {' '.join(self._calibrated[-2:])}")
        if self._configured["calibration_file"]:
            # For every node that has these parameters: perception, recorder, simulated cell.
            text = "/**:\n  ros__parameters:\n" + "".join(f"    {line}\n" for line in self._calibrated)
            try:
                write_whole(Path(self._configured["calibration_file"]), text, "the calibration")
            except PushIdentError as error:
                self._refuse("calibration_not_written", "calibration_file", str(error))

    def _robot_at(self, stamp: float) -> tuple[RobotPart, ...]:
        """Tool, hand and arm where they were at `stamp`; notes say what is missing or stale."""
        tool_age, joints_age = self._robot.tool_age(stamp), self._robot.joints_age(stamp)
        if tool_age is None:
            self._notes["tool"] = f"nothing on {self._node.resolve_topic_name('tool/pose')}: the tool is not masked by its pose"
        else:
            self._notes["tool"] = f"tool pose is {tool_age:.2f} s older than the image" if tool_age > IMAGE_TIMES.stale else ""
        present = {"robot_description": self._robot.arm_shape is not None, "joint_states": joints_age is not None}
        missing = [self._node.resolve_topic_name(topic) for topic, there in present.items() if not there]
        if missing or joints_age is None:
            self._notes["arm"] = f"nothing on {' and '.join(missing)}: the links of the arm are not masked"
        else:
            self._notes["arm"] = f"joint states are {joints_age:.2f} s older than the image" if joints_age > IMAGE_TIMES.stale else ""
            if unknown := self._robot.unknown_joints:
                self._notes["arm"] = f"no state of {', '.join(unknown)}: the links behind them are not masked"
        reach = self._configured["max_object_height"] + self._configured["mask_margin"]
        return self._robot.tool_at(stamp, self._configured["hand_radius"]) + self._robot.arm_at(stamp, reach)

    def _publish_poses(self, objects: Iterable[ObservedObject], stamp: Time) -> list[str]:
        """Publish what has a pose; the ids of those."""
        tracked: dict[str, Pose] = {}
        for known in objects:
            if known.pose is not None and known.covariance is not None:
                msg = planar_pose_to_msg(stamp, known.pose, known.covariance)
                self._publishers_of(known.object_id)[0].publish(msg)
                tracked[known.object_id] = msg.pose.pose
        if tracked:
            if self._moving_frames is not None:
                self._moving_frames.broadcast(stamp, {object_frame(object_id): pose for object_id, pose in tracked.items()})
            self._counter["poses"] += len(tracked)
            self._latencies.append(self._main.input.silence)
        return list(tracked)

    def _publish(self, observation: Observation, stamp: Time, followed: list[str]) -> None:
        for removal in observation.removed:
            self._give_up(removal)
        for object_id, shape in observation.new_shapes.items():
            self._node.get_logger().info(f"Object {object_id}: {len(shape.cells)} cells of {shape.cells.size * 1e3:.1f} mm.")
        for object_id, doubt in observation.doubts.items():
            self._notes[f"contact_{object_id}"] = doubt
            self._node.get_logger().warning(f"Object {object_id}: {doubt}.")
        for object_id in observation.refined:
            self._counter["outlines_refined"] += 1
            self._notes[f"outline_{object_id}"] = ""
            self._node.get_logger().info(f"Object {object_id}: its outline is better known from several rests.")
        for object_id, why in observation.not_refined.items():
            self._counter["outlines_not_refined"] += 1
            note = self._notes[f"outline_{object_id}"] = f"stays as it was: {why}"
            self._node.get_logger().warning(f"Object {object_id}: its outline {note}")
        for object_id, shape in (observation.new_shapes | observation.refined).items():
            _, cells_publisher, outline_publisher, std_publisher = self._publishers_of(object_id)
            cells, outline = shape_to_msgs(shape, object_id, stamp)
            cells_publisher.publish(cells)
            std_publisher.publish(outline_std_to_msg(shape))
            outline_publisher.publish(outline)
        if observation.new_shapes:
            self._note_views(observation.further_views)
        self._publish_poses((known for known in observation.objects if known.object_id not in followed), stamp)
        if self._perception is not None:
            self._camera_publisher.publish(self._perception, stamp, self._main.frame)
        if observation.occupancy is not None:
            grid = observation.occupancy
            self._occupancy_publisher.publish(occupancy_to_msg(grid.occupancy, grid.resolution, grid.origin, stamp))
        if observation.refused is not self._refused:
            if observation.refused or self._refused:
                self._refused_publisher.publish(refusals_to_msg(observation.refused, stamp))
            self._refused = observation.refused
        self._last_observation = observation
        self._keep(observation)

    def _note_views(self, why_left_out: dict[str, str]) -> None:
        """Count which further cameras helped with the shape of a new object, and report why others did not."""
        for name in self._further:
            why = why_left_out.get(name, "none of its frames came before the object was taken in")
            if why:
                self._leave_out(name, "views_left_out", why)
            else:
                self._counter[f"{name}_views_used"] += 1
                self._notes[f"camera_{name}"] = ""

    def _restart(self, stamp: float) -> None:
        """Time went back, as when a bag starts again: `Perception` forgets all objects, and so do the topics."""
        self._counter["restarts"] += 1
        self._node.get_logger().warning(f"Time went back to {stamp:.3f} s; all objects are looked for anew.")
        self._forget_objects()

    def _publishers_of(self, object_id: str) -> tuple[Publisher, ...]:
        if object_id not in self._object_publishers:
            self._object_publishers[object_id] = (
                self._node.create_publisher(PoseWithCovarianceStamped, f"objects/{object_id}/pose", self._pose_qos),
                self._node.create_publisher(OccupancyGrid, f"objects/{object_id}/cells", LATCHED),
                self._node.create_publisher(PolygonStamped, f"objects/{object_id}/outline", LATCHED),
                self._node.create_publisher(Float32MultiArray, f"objects/{object_id}/outline_std", LATCHED),
            )
            if self._configured["every_image"]:
                # The source waits meanwhile: the first poses belong to the first push.
                _await_subscription(self._object_publishers[object_id][0])
        return self._object_publishers[object_id]

    def _give_up(self, removal: Removal) -> None:
        """An object that came apart is no longer published, nor looked for after a restart."""
        note = self._notes[f"object_{removal.object_id}"] = f"given up: {removal.reason.value}"
        self._counter["given_up"] += 1
        self._node.get_logger().warning(f"Object {removal.object_id} {note}.")
        for publisher in self._object_publishers.pop(removal.object_id, ()):
            self._node.destroy_publisher(publisher)
        try:
            self._memory.forget(removal.object_id)
        except ModelFileError as error:
            self._refuse("state_not_written", "state_directory", str(error))

    def _forget_objects(self) -> None:
        for publishers in self._object_publishers.values():
            for publisher in publishers:
                self._node.destroy_publisher(publisher)
        self._object_publishers.clear()

    def _refuse_frame(self, kind: str, why: str) -> None:
        self._refuse(kind, self._main.input.image_topic, why)

    def _refuse(self, kind: str, source: str, why: str) -> None:
        self._counter[kind] += 1
        self._last_error = f"{source}: {why}"
        self._node.guard.refuse(source, why)

    def health(self) -> Health:
        now = self._wall.now()
        elapsed = (now - self._diagnosed_at).nanoseconds * 1e-9
        rate = (self._counter["frames"] - self._frames_diagnosed) / max(elapsed, 1e-3)
        silent = self._main.input.silence > IMAGE_TIMES.silence
        for name, camera in self._further.items():
            if camera.input.silence > IMAGE_TIMES.silence:
                self._counter[f"{name}_silent"] += 1
                self._notes[f"camera_{name}"] = self._silence_of(camera)
                self._node.get_logger().warning(f"camera {name}: {self._silence_of(camera)}", throttle_duration_sec=NODE.log_period)
        why = self._why_no_pose(silent, rate)
        # Nodes of a cell that starts wait for each other: until then the status is enough.
        if (silent or rate == 0) and self._waited() > NODE.listener_wait:
            self._node.get_logger().warning(why, throttle_duration_sec=NODE.log_period)
        values: dict[str, Any] = {
            "rate_hz": f"{rate:.1f}",
            "images": self._main.input.n_images,
            **self._counter,
            "last_error": self._last_error,
            "why_no_pose": why,
        }
        if self._latencies:
            values["latency_ms"] = f"{1e3 * float(np.median(self._latencies)):.1f} median, {1e3 * max(self._latencies):.1f} worst"
            self._latencies.clear()
        if self._last_observation is not None:
            values |= {f"stage_{name}": count for name, count in self._last_observation.counts.items()}
            values |= {f"object_{known.object_id}": known.status.value for known in self._last_observation.objects}
        values |= {f"note_{name}": note for name, note in self._notes.items() if note}
        lost, taken, delay = self._main.input.arrivals.since_last()
        values |= {"images_lost": self._main.input.arrivals.n_lost, "image_delay_ms": f"{1e3 * delay:.1f} worst"}
        if lost and not (silent or rate == 0):
            shed = f"{lost} of {lost + taken} images were left out in {elapsed:.1f} s: the camera is faster than perception"
            why = f"{why}; {shed}" if why else shed
        level = DiagnosticStatus.ERROR if silent or rate == 0 else DiagnosticStatus.WARN if why else DiagnosticStatus.OK
        self._diagnosed_at, self._frames_diagnosed = now, self._counter["frames"]
        return Health(level, why or "poses are published", values)

    def _why_no_pose(self, silent: bool, rate: float) -> str:
        if self._node.get_parameter("use_sim_time").value and self._node.get_clock().now().nanoseconds == 0:
            return f"use_sim_time is set but nothing comes on /clock ({self._node.count_publishers('/clock')} publishers)"
        if silent:
            return self._silence_of(self._main)
        waited, source = self._waited(), self._configured["extrinsics"]
        if self._perception is None and source != "parameters" and waited > self._configured["extrinsics_timeout"]:
            return f"still no extrinsics ({source}) after {waited:.0f} s: {self._last_error}"
        if rate == 0 or self._last_observation is None:
            return self._last_error or f"none of {self._main.input.n_images} depth images has been processed yet"
        return self._last_observation.why_no_pose()

    def _waited(self) -> float:
        """Since the node was activated [s], wall time."""
        return float((self._wall.now() - self._started_at).nanoseconds * 1e-9)

    def _silence_of(self, camera: _Camera) -> str:
        topic = camera.input.image_topic
        return f"no depth image on {topic} ({self._node.count_publishers(topic)} publishers) for over {IMAGE_TIMES.silence:.0f} s"


def _await_subscription(publisher: Publisher) -> None:
    """Wait until a publisher has one, at most `NodeSettings.listener_wait`."""
    deadline = time.monotonic() + NODE.listener_wait
    while publisher.get_subscription_count() == 0 and time.monotonic() < deadline:
        time.sleep(0.02)
