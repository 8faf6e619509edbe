"""viewer_node: what is published on its topics ends up in a Rerun recording."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PolygonStamped, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMsg
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from visualization_msgs.msg import MarkerArray

from helpers.node_process import Talker
from helpers.spinning import running
from push_ident.identification.predicting.prediction import predict
from push_ident.identification.predicting.scoring import PushScore, ScoreSummary
from push_ident.identification.results.posterior import prior_posterior
from push_ident.nodes.base.cell_node import LATCHED
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.markers import GoalDrawing, goal_markers_to_msg, refusals_to_msg
from push_ident.nodes.convert.messages import (
    depth_frame_to_msgs,
    planar_pose_to_msg,
    position_to_msg,
    shape_to_msgs,
    stamp_from_msg,
    stamp_to_msg,
    transform_to_msg,
)
from push_ident.nodes.convert.model import map_to_msg, path_to_msg, prediction_to_msg, score_to_msg
from push_ident.nodes.viewer.rerun_scene import RerunScene
from push_ident.nodes.viewer.viewer_node import ViewerNode
from push_ident.perception.refusals import Reason, Refusal
from push_ident.physics.scenario import PushScenario
from push_ident.types import CameraIntrinsics, DepthFrame, PusherPath
from push_ident_msgs.msg import MassFrictionMap, PushPrediction
from push_ident_msgs.msg import PushScore as PushScoreMsg
from push_ident_sim.cell.camera import DepthCamera
from push_ident_sim.cell.sensors import PLAIN, suitable_pose
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import true_model

CORNERS = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]])
EDGE = np.array([[0.1, -0.3], [0.1, 0.3]])
GOAL = GoalDrawing(
    "o1",
    CORNERS,
    "path: 100 mm",
    np.array([[0.0, 0.0], [0.05, 0.0], [0.1, 0.01]]),
    CORNERS + 0.02,
    "push 3",
    EDGE,
    EDGE - 0.1,
    CORNERS - 0.1,
)


class Cell(Talker):
    """Publishes all that a viewer shows of one hammer."""

    def __init__(self) -> None:
        self.domain = own_domain()
        super().__init__(self.domain)
        thing = make_object("hammer", 0)
        camera = DepthCamera(thing, suitable_pose(PLAIN))
        frame = DepthFrame(0.0, camera.render((0.0, 0.0, 0.3), {}), camera.intrinsics)
        self.shape = true_model(thing).shape
        self.posterior = prior_posterior(self.shape)
        self.path = PusherPath(np.array([0.0, 1.0]), np.array([[-0.2, 0.0], [-0.05, 0.0]]), 0.018)
        stamp = stamp_to_msg(1.0)
        cells, outline = shape_to_msgs(self.shape, "o1", stamp)
        image, info = depth_frame_to_msgs(frame, stamp)
        prediction = prediction_to_msg(
            predict(self.posterior, PushScenario(self.path, np.array([0.0, 0.0, 0.3]), np.linspace(0, 1, 5))), "o1", (1, "fine"), push_id=1
        )
        score = score_to_msg(PushScore(1, "push 1", 1.0, 0.002, 0.003, 2.0, 0.009), ScoreSummary(1, 0.002, 0.003, 0.009, 1.0), "o1", 1.0)
        cut = Refusal(Reason.AT_IMAGE_BORDER, "cut by the border", np.array([[0.1, 0.1], [0.2, 0.1], [0.2, 0.2]]), 0.05)
        self._sent = [
            (self.node.create_publisher(kind, topic, qos), msg)
            for kind, topic, qos, msg in (
                (PoseStamped, "depth/camera_pose", LATCHED, transform_to_msg(stamp, suitable_pose(PLAIN))),
                (CameraInfo, "depth/camera_info", qos_profile_sensor_data, info),
                (PoseWithCovarianceStamped, "objects/o1/pose", 10, planar_pose_to_msg(stamp, [0.0, 0.0, 0.3], 1e-6 * np.eye(3))),
                (OccupancyGrid, "objects/o1/cells", LATCHED, cells),
                (PolygonStamped, "objects/o1/outline", LATCHED, outline),
                (MassFrictionMap, "objects/o1/mass_friction_map", LATCHED, map_to_msg(self.posterior, "o1", stamp, None, 0)),
                (PushPrediction, "objects/o1/prediction", LATCHED, prediction),
                (PathMsg, "objects/o1/next_push", LATCHED, path_to_msg(self.path)),
                (PushPrediction, "objects/o1/next_push_prediction", LATCHED, prediction),
                (PushScoreMsg, "objects/o1/push_score", LATCHED, score),
                (MarkerArray, "workspace/refused", LATCHED, refusals_to_msg([cut], stamp)),
                (PoseStamped, "tool/pose", 10, position_to_msg(stamp, [-0.2, 0.0, 0.1])),
                (Image, "depth/image_rect", qos_profile_sensor_data, image),
            )
        ]
        self._goal = self.node.create_publisher(MarkerArray, "push_to_goal/markers", LATCHED)
        self._reported: list[float] = []
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_report, 10)

    def _on_report(self, msg: DiagnosticArray) -> None:
        self._reported.append(stamp_from_msg(msg.header.stamp))

    def pursue_goal(self) -> None:
        self._goal.publish(goal_markers_to_msg(GOAL, stamp_to_msg(1.0)))

    def publish_all(self, at: float) -> None:
        for publisher, msg in self._sent:
            if hasattr(msg, "header"):
                msg.header.stamp = stamp_to_msg(at)
            publisher.publish(msg)
        self.spin(0.01)

    def wait_for_a_round(self) -> None:
        """Until the viewer has drawn what was published: it does one thing after the other, and between two reports all that has come."""
        now = time.time()
        self.until(lambda: sum(at > now for at in self._reported) >= 2)

    def is_heard(self) -> bool:
        return all(publisher.get_subscription_count() > 0 for publisher in (self._goal, *(publisher for publisher, _ in self._sent)))


@pytest.mark.live
def test_everything_that_is_published_is_in_the_recording(tmp_path: Path) -> None:
    file = tmp_path / "view.rrd"
    with Cell() as cell, running(ViewerNode, cell.domain, "output:=file", f"file:={file}"):
        cell.until(cell.is_heard)
        for step in range(6):
            cell.publish_all(1.0 + 0.3 * step)
            time.sleep(0.05)
        cell.wait_for_a_round()  # with a goal the push to make next is not drawn any more
        cell.pursue_goal()
        cell.publish_all(8.0)
        cell.wait_for_a_round()
    rerun = [str(Path(sys.executable).parent / "rerun"), "rrd", "print", str(file)]
    printed = subprocess.run(rerun, capture_output=True, text=True, check=True).stdout
    camera, load, uncertainty = ("camera/depth", "tool"), ("load/o1/cells",), ("uncertainty/o1/cells",)
    objects = ("o1/observed", "refused", "o1/predicted", "o1/next_push/tool", "o1/next_push/end")
    goal = ("outline", "edge", "path", "push/tool", "push/path", "push/corridor", "push/end", "words/1")
    for entity in (
        *(f"/table/{name}" for name in (*camera, *load, *uncertainty)),
        *(f"/table/objects/{name}" for name in (*objects, *(f"goal/{part}" for part in goal))),
        "/error_mm/error",
        "/status",
    ):
        assert entity in printed, f"{entity} was not recorded"


def test_a_camera_that_moves_costs_no_memory(tmp_path: Path) -> None:
    scene, intrinsics = RerunScene(), CameraIntrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    scene.save(str(tmp_path / "scene.rrd"))
    camera_in_table = np.diag([1.0, -1.0, -1.0, 1.0])
    before = 0.0
    for k in range(400):
        scene.set_time(0.1 * k)
        camera_in_table[:3, 3] = 1e-3 * k, 0.0, 1.0
        scene.camera(intrinsics, camera_in_table)
        if k == 100:
            before = resident_megabytes()
    scene.close()
    assert resident_megabytes() - before < 50.0  # with a layout for each pose, 150 MB


def resident_megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
