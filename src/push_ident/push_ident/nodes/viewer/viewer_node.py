"""Node `viewer`: observations, maps and predictions of a cell in a Rerun viewer: in a browser, in a window, or in a file."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMsg
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from shape_msgs.msg import SolidPrimitive
from visualization_msgs.msg import MarkerArray

from push_ident.errors import InputError, PushIdentError
from push_ident.geometry.se2 import transform_points
from push_ident.limits import LIMITS, check_coordinates, check_object_id, plain_text
from push_ident.nodes.base.arrivals import StampCheck
from push_ident.nodes.base.cell_node import LATCHED, CellNode, Component, Health
from push_ident.nodes.base.parameters import Parameter, Parameters
from push_ident.nodes.convert.markers import GoalDrawing, goal_markers_from_msg, refusals_from_msg
from push_ident.nodes.convert.messages import (
    depth_frame_from_msgs,
    intrinsics_from_msg,
    planar_pose_of,
    position_from_msg,
    pusher_shape_from_msg,
    stamp_from_msg,
    transform_from_msg,
)
from push_ident.nodes.input.objects import ObjectTopics, TrackedObjects
from push_ident.nodes.viewer.rerun_scene import CellMap, RerunScene
from push_ident.nodes.viewer.settings import VIEWER
from push_ident.perception.frame.view import height_inside, points_in_table
from push_ident.types import DepthFrame, Float64Array
from push_ident_msgs.msg import MassFrictionMap, PushPrediction, PushScore

PARAMETERS: Final = (
    Parameter(
        "output",
        "web",
        "web: serve viewers in browsers; window: a viewer that runs; file",
        choices=("web", "window", "file"),
        read_only=True,
    ),
    Parameter("bind", "127.0.0.1", "Address that both ports listen on; 0.0.0.0: every interface, for everyone there", read_only=True),
    Parameter("web_port", VIEWER.web_port, "of the viewer for browsers", 1, 65535, read_only=True),
    Parameter("grpc_port", VIEWER.grpc_port, "of the data", 1, 65535, read_only=True),
    Parameter("memory", "512MB", "kept for viewers that come later; the oldest goes first", read_only=True),
    Parameter("address", "", "of the window's viewer, as `rerun+http://host:9876/proxy`; empty: on this machine", read_only=True),
    Parameter("file", "", "to write, `*.rrd`", read_only=True),
    Parameter("image_rate", 5.0, "Depth images shown a second", 0.1, 60.0),
    Parameter("pose_rate", 15.0, "Poses shown a second", 0.1, 240.0, read_only=True),
)


class ViewerNode(CellNode):
    """Subscribes and draws; it publishes nothing but its status, and no other node depends on it."""

    def __init__(self, **kwargs: Any) -> None:
        self._shown: tuple[RerunScene, str] | None = None
        super().__init__("viewer_node", PARAMETERS, **kwargs)

    def make_component(self) -> Component:
        """What is shown, in one viewer for the life of the process: Rerun cannot end its servers."""
        if self._shown is None:
            self._shown = _started_scene(self.settings)
            self.get_logger().info(f"shown in {self._shown[1]}")
        return _Viewer(self, *self._shown)

    def close(self) -> None:
        """Write what is still buffered."""
        super().close()
        if self._shown is not None:
            self._shown[0].close()


def _started_scene(values: Parameters) -> tuple[RerunScene, str]:
    """A scene that goes where the parameters want it, and where that is."""
    try:
        scene = RerunScene()
    except ImportError as error:
        raise InputError(f"Rerun is not installed ({error}); run `pip install -r requirements/viewer.txt`.") from None
    output, file, address = values["output"], values["file"], values["address"]
    if output == "file":
        if not file.endswith(".rrd"):
            raise InputError(f"`file` is {file!r}, expected a path that ends with .rrd.")
        scene.save(file)
        return scene, file
    if output == "window":
        scene.connect(address)
        return scene, address or "the viewer on this machine; start it with `rerun`"
    return scene, scene.serve(**{name: values[name] for name in ("bind", "grpc_port", "web_port", "memory")})


class _Viewer(Component):
    def __init__(self, node: CellNode, scene: RerunScene, where: str) -> None:
        self._node, self._settings, self._scene, self._where = node, node.settings, scene, where
        self._stamps = StampCheck()
        group = MutuallyExclusiveCallbackGroup()
        self._objects = TrackedObjects(node, group)
        self._topics = ObjectTopics(node, self._on_new_object)
        self._info: CameraInfo | None = None
        self._camera: Float64Array | None = None
        self._camera_shown: tuple[Any, ...] = ()
        self._radius = 0.0
        self._tops: dict[str, float] = {}
        self._words: dict[str, dict[str, str]] = {}
        self._warnings: dict[str, str] = {}
        self._shown_at: dict[str, float] = {}
        self._drawn: dict[str, float] = {}
        self._now, self._shift = 0.0, 0.0
        self._goal: GoalDrawing | None = None

        self._node.create_subscription(CameraInfo, "depth/camera_info", self._on_info, qos_profile_sensor_data)
        self._node.create_subscription(PoseStamped, "depth/camera_pose", self._on_camera, LATCHED)
        self._node.create_subscription(
            Image, "depth/image_rect", self._on_image, QoSProfile(depth=1, reliability=qos_profile_sensor_data.reliability)
        )
        self._node.create_subscription(MarkerArray, "workspace/refused", self._on_refused, LATCHED)
        self._node.create_subscription(MarkerArray, "push_to_goal/markers", self._on_goal, LATCHED)
        self._node.create_subscription(PoseStamped, "tool/pose", self._on_tool, qos_profile_sensor_data)
        self._node.create_subscription(PoseStamped, "pusher/pose", self._on_tool, qos_profile_sensor_data)
        self._node.create_subscription(SolidPrimitive, "pusher/shape", self._on_tool_shape, LATCHED)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        self._node.create_timer(1.0 / self._settings["pose_rate"], self._draw_objects, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def health(self) -> Health:
        return Health(DiagnosticStatus.OK, f"shown in {self._where}", {"objects": ", ".join(self._objects.ids)})

    # ---- time

    def _at(self, stamp: float) -> None:
        """Set the time of what follows. Where it was set back (a bag that starts again) the viewer's time goes on."""
        if stamp < self._now - VIEWER.jump_back:
            self._shift += self._now - stamp
        self._now = stamp
        self._scene.set_time(stamp + self._shift)

    def _due(self, what: str, rate: float) -> bool:
        last = self._shown_at.get(what, -np.inf)
        if 0 <= self._now + self._shift - last < 1.0 / rate:
            return False
        self._shown_at[what] = self._now + self._shift
        return True

    # ---- camera and tool

    def _on_info(self, msg: CameraInfo) -> None:
        self._info = msg

    def _on_camera(self, msg: PoseStamped) -> None:
        self._camera = transform_from_msg(msg)

    def _on_image(self, msg: Image) -> None:
        stamp = stamp_from_msg(msg.header.stamp)
        self._stamps.check("depth/image_rect", stamp)
        self._at(stamp)
        if self._info is None or self._camera is None or not self._due("image", self._settings["image_rate"]):
            return
        frame = depth_frame_from_msgs(msg, self._info)
        shown = (frame.intrinsics, self._camera.tobytes())
        if shown != self._camera_shown:
            self._camera_shown = shown
            self._scene.camera(intrinsics_from_msg(self._info), self._camera)
        self._scene.depth(frame.depth)
        self._find_tops(frame)

    def _find_tops(self, frame: DepthFrame) -> None:
        """Height of the upper side of objects that have none yet, for drawing their maps onto it."""
        unknown = [object_id for object_id in self._objects.ids if object_id not in self._tops]
        if not unknown or self._camera is None:
            return
        points = points_in_table(frame, self._camera)
        for object_id in unknown:
            try:
                latest = self._objects.get(object_id, VIEWER.max_age)
            except PushIdentError:
                continue
            if (top := height_inside(points, transform_points(latest.pose, latest.shape.outline))) is not None:
                self._tops[object_id] = top

    def _on_refused(self, msg: MarkerArray) -> None:
        self._scene.refused(refusals_from_msg(msg))

    def _on_tool(self, msg: PoseStamped) -> None:
        stamp, position = position_from_msg(msg)
        self._stamps.check("tool", stamp)
        self._at(stamp)
        if self._due("tool", self._settings["pose_rate"]):
            self._scene.tool(position, self._radius)

    def _on_tool_shape(self, msg: SolidPrimitive) -> None:
        self._radius = pusher_shape_from_msg(msg).reach

    # ---- objects

    def _on_new_object(self, object_id: str) -> None:
        for kind, topic, callback in (
            (MassFrictionMap, "mass_friction_map", self._on_map),
            (PushPrediction, "prediction", self._on_prediction),
            (PushPrediction, "next_push_prediction", self._on_next_prediction),
            (PushScore, "push_score", self._on_score),
        ):
            self._node.create_subscription(kind, f"objects/{object_id}/{topic}", callback, LATCHED)
        self._node.create_subscription(PathMsg, f"objects/{object_id}/next_push", lambda msg: self._on_next_push(object_id, msg), LATCHED)

    def _draw_objects(self) -> None:
        for object_id in self._objects.ids:
            try:
                latest = self._objects.get(object_id, VIEWER.max_age)
            except PushIdentError:
                continue
            if latest.stamp != self._drawn.get(object_id):
                self._drawn[object_id] = latest.stamp
                self._at(latest.stamp)
                self._scene.observed(object_id, latest.shape.outline, latest.pose, self._tops.get(object_id, VIEWER.default_height))

    def _on_map(self, msg: MassFrictionMap) -> None:
        check_object_id(msg.object_id)
        LIMITS.CELLS.check(len(msg.x), "Map")
        cells = np.column_stack([msg.x, msg.y])
        centre = np.array([msg.centre_of_friction.x, msg.centre_of_friction.y])
        check_coordinates(np.vstack([cells, centre]), "Map")
        if not (len(cells) == len(msg.mass_friction) == len(msg.mass_friction_std)):
            raise InputError(f"Map has {len(cells)} cells, but {len(msg.mass_friction)} values; expected one for each.")
        self._scene.map(msg.object_id, CellMap(cells, msg.cell_size, np.array(msg.mass_friction), np.array(msg.mass_friction_std), centre))
        words = self._words.setdefault(msg.object_id, {})
        words["pushes"] = f"{msg.n_pushes}, {msg.status_text}"
        words["pusher friction"] = f"{msg.pusher_friction:.2f} ± {msg.pusher_friction_std:.2f}"
        words["total mass"] = (
            f"{msg.total_mass:.2f} ± {msg.total_mass_std:.2f} kg" if msg.total_mass_identifiable else f"{msg.total_mass:.2f} kg assumed"
        )
        words["centre of friction"] = f"{1e3 * centre[0]:.0f}, {1e3 * centre[1]:.0f} mm"
        self._show_words()

    def _outline(self, object_id: str) -> Float64Array | None:
        try:
            return self._objects.get(object_id, np.inf).shape.outline
        except PushIdentError:
            return None

    def _on_prediction(self, msg: PushPrediction) -> None:
        outline = self._outline(msg.object_id)
        LIMITS.POINTS.check(len(msg.poses), "Prediction")
        if outline is not None:
            poses = np.array([planar_pose_of(pose.pose) for pose in msg.poses]).reshape(-1, 3)
            self._scene.predicted(msg.object_id, outline, poses, self._tops.get(msg.object_id, VIEWER.default_height))

    def _on_next_push(self, object_id: str, msg: PathMsg) -> None:
        LIMITS.POINTS.check(len(msg.poses), "Next push")
        path = np.array([[pose.pose.position.x, pose.pose.position.y] for pose in msg.poses]).reshape(-1, 2)
        check_coordinates(path, "Next push")
        if self._goal is not None:
            return  # What would teach most is not what is done.
        self._scene.next_push(object_id, path, self._tops.get(object_id, VIEWER.default_height))

    def _on_next_prediction(self, msg: PushPrediction) -> None:
        outline = self._outline(msg.object_id)
        if outline is not None and msg.poses and self._goal is None:
            end = planar_pose_of(msg.poses[-1].pose)
            self._scene.next_end(msg.object_id, transform_points(end, outline), self._tops.get(msg.object_id, VIEWER.default_height))

    def _on_goal(self, msg: MarkerArray) -> None:
        """Show the goal, and for as long not the push to make next."""
        self._goal = goal_markers_from_msg(msg)
        top = VIEWER.default_height
        if self._goal is not None:
            top = self._tops.get(self._goal.object_id, VIEWER.default_height)
            for object_id in self._objects.ids:
                self._scene.next_push(object_id, np.empty((0, 2)), top)
        self._scene.goal(self._goal, top)
        self._show_words()

    def _on_score(self, msg: PushScore) -> None:
        self._scene.score(msg.cell_error, msg.expected_cell_error, msg.uniform_cell_error)
        words = self._words.setdefault(check_object_id(msg.object_id), {})
        mean, uniform = 1e3 * msg.mean_cell_error, 1e3 * msg.mean_uniform_cell_error
        words["mean cell error of predictions"] = f"{mean:.1f} mm of {msg.n} pushes (equal cells {uniform:.1f} mm)"
        words["within the 90 % region"] = f"{100 * msg.share_within_90:.0f} %"
        self._show_words()
        # The push is over; what is shown was predicted from the middle of it.
        self._scene.predicted(msg.object_id, np.empty((0, 2)), np.empty((0, 3)), VIEWER.default_height)

    # ---- words

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        changed = False
        for status in msg.status:
            name = plain_text(status.name.rsplit("/", 1)[-1])
            text = plain_text(status.message) if status.level != DiagnosticStatus.OK else ""
            if name not in self._warnings and len(self._warnings) >= VIEWER.n_nodes:
                raise InputError(f"Statuses of more than {VIEWER.n_nodes} nodes; that of {name} is not shown.")
            changed |= self._warnings.get(name, "") != text
            self._warnings[name] = text
        if changed:
            self._show_words()

    def _show_words(self) -> None:
        parts = []
        if self._goal is not None:
            parts += [f"## Goal of {self._goal.object_id}", f"{self._goal.words}  ", f"{self._goal.chance}  "]
        for object_id, words in sorted(self._words.items()):
            parts += [f"## {object_id}", *(f"**{key}** {value}  " for key, value in words.items())]
        warnings = [f"**{name}** {text}  " for name, text in sorted(self._warnings.items()) if text]
        if warnings:
            parts += ["## Warnings", *warnings]
        self._scene.status("\n".join(parts))
