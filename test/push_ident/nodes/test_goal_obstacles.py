"""goal_pushing_node with another object and with something that nobody tracks: what it refuses, and the push that it plans beside them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient
from shape_msgs.msg import SolidPrimitive
from visualization_msgs.msg import MarkerArray

from helpers.node_process import Talker
from helpers.objects import square
from helpers.spinning import running
from push_ident.errors import InputError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import quaternion_of_yaw, transform_points
from push_ident.identification.results.posterior import prior_posterior
from push_ident.nodes.base.cell_node import LATCHED
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.markers import GoalDrawing, goal_markers_from_msg
from push_ident.nodes.convert.messages import occupancy_to_msg, planar_pose_to_msg, shape_to_msgs, workspace_from_msg
from push_ident.nodes.convert.model import posterior_to_msg
from push_ident.nodes.goal_pushing.goal_pushing_node import GoalPushingNode
from push_ident.nodes.input.occupancy import TOPIC
from push_ident.planning.goal import GoalCode
from push_ident.planning.keep_out import distance_between
from push_ident.types import Float64Array
from push_ident_msgs.action import PushToGoal
from push_ident_msgs.msg import ModelPosterior

RADIUS = 0.008
SHAPE = square(6, 0.01)
OBJECT, OTHER = np.array([-0.12, 0.0, 0.0]), np.array([0.0, 0.0, 0.0])
THING = (0.08, 0.12)
"""Where something stands that nobody tracks: the middle of a square of 4 cm [m]."""
COVARIANCE = np.diag([1e-6, 1e-6, 1e-5])


def occupancy() -> OccupancyGrid:
    """The objects and the thing as perception shows them."""
    cells, size, low = np.zeros((250, 250), dtype=np.int8), 0.002, np.array([-0.25, -0.25])
    rows, columns = np.indices(cells.shape)
    points = low + size * np.column_stack([columns.ravel() + 0.5, rows.ravel() + 0.5])
    corners = np.array([[-0.02, -0.02], [0.02, -0.02], [0.02, 0.02], [-0.02, 0.02]])
    for outline in (*(transform_points(pose, SHAPE.outline) for pose in (OBJECT, OTHER)), corners + THING):
        cells[(signed_distance(points, outline) < size).reshape(cells.shape)] = 100
    return occupancy_to_msg(cells, size, low, Time(sec=100))


@dataclass
class Cell:
    """Perception and identification of two objects, without an arm, and a client of the action."""

    talker: Talker
    drawings: list[GoalDrawing] = field(default_factory=list)
    n_poses: int = 0

    def __post_init__(self) -> None:
        talker, stamp = self.talker, Time(sec=100)
        self.client = ActionClient(talker.node, PushToGoal, "push_to_goal")
        talker.node.create_subscription(MarkerArray, "push_to_goal/markers", self._on_markers, LATCHED)
        talker.publish(SolidPrimitive, "pusher/shape", SolidPrimitive(type=SolidPrimitive.CYLINDER, dimensions=[0.1, RADIUS]))
        for name in ("o1", "o2"):
            for part, msg in zip(("cells", "outline"), shape_to_msgs(SHAPE, name, stamp), strict=True):
                talker.publish(type(msg), f"objects/{name}/{part}", msg)
        talker.publish(ModelPosterior, "objects/o1/model", posterior_to_msg(prior_posterior(SHAPE), "o1", stamp, n_pushes=3, is_known=True))

    def _on_markers(self, msg: MarkerArray) -> None:
        drawing = goal_markers_from_msg(msg)
        if drawing is not None:
            self.drawings.append(drawing)

    def poses(self) -> None:
        """What the camera sees at the next frame."""
        self.n_poses += 1
        stamp = Time(sec=100 + self.n_poses // 10, nanosec=10**8 * (self.n_poses % 10))
        for name, pose in (("o1", OBJECT), ("o2", OTHER)):
            self.talker.publish(PoseWithCovarianceStamped, f"objects/{name}/pose", planar_pose_to_msg(stamp, pose, COVARIANCE))

    def result(self, pose: tuple[float, float, float]) -> PushToGoal.Result:
        goal = PushToGoal.Goal(object_id="o1", max_pushes=1)
        goal.goal.pose.position.x, goal.goal.pose.position.y = pose[:2]
        turn = goal.goal.pose.orientation
        turn.x, turn.y, turn.z, turn.w = (float(value) for value in quaternion_of_yaw(pose[2]))
        sent: Any = self.client.send_goal_async(goal)
        self.talker.until(sent.done, self.poses)
        ended = sent.result().get_result_async()
        self.talker.until(ended.done, self.poses)
        return ended.result().result


@pytest.fixture(scope="module")
def cell() -> Iterator[Cell]:
    domain = own_domain()
    with running(GoalPushingNode, domain, "workspace:=[-0.25, 0.25, -0.25, 0.25]", n_threads=7), Talker(domain) as talker:
        cell = Cell(talker)
        talker.until(lambda: talker.values("goal_pushing").get("objects") == "o1, o2" and cell.client.server_is_ready(), cell.poses)
        yield cell


@pytest.mark.live
def test_goal_on_another_object_or_on_an_untracked_thing_is_refused_by_name_and_a_push_keeps_clear_of_both(cell: Cell) -> None:
    result = cell.result((0.02, 0.01, 0.5))
    assert result.error_code == GoalCode.UNREACHABLE and "would overlap `o2`" in result.error_text and result.pushes == 0
    # Not before the grid is known; then the thing is named, and neither object is taken for one.
    for wrong in (OccupancyGrid(), occupancy_to_msg(np.zeros((2, 2), dtype=np.int8), float("nan"), (0.0, 0.0), Time(sec=1))):
        cell.talker.publish(OccupancyGrid, TOPIC, wrong)
    cell.talker.publish(OccupancyGrid, TOPIC, occupancy())
    cell.talker.publish(OccupancyGrid, TOPIC, occupancy())
    result = cell.result((*THING, 0.0))
    assert result.error_code == GoalCode.UNREACHABLE and result.error_text.count("something at (0.08, 0.12) m") == 1, result.error_text
    # On the other side of `o2`: there is no arm, but the push that is planned is shown.
    cell.drawings.clear()
    result = cell.result((0.15, 0.0, 0.0))
    assert result.error_code == GoalCode.ARM_SILENT, result.error_text
    cell.talker.until(lambda: any(drawing.tool is not None for drawing in cell.drawings))
    drawing = next(drawing for drawing in cell.drawings if drawing.tool is not None)
    other = transform_points(OTHER, SHAPE.outline)
    assert drawing.end is not None and distance_between(drawing.end, other) > 0.0
    assert np.min(signed_distance(drawing.tool, other)) > RADIUS


def test_occupancy_of_the_workspace_is_read_as_it_was_written() -> None:
    cells: Float64Array = np.random.default_rng(0).integers(-1, 101, (7, 5)).astype(np.float64)
    grid = workspace_from_msg(occupancy_to_msg(cells.astype(np.int8), 0.01, (-0.1, 0.2), Time(sec=1)))
    np.testing.assert_array_equal(grid.cells, cells)
    np.testing.assert_allclose([*grid.pose, grid.size], [-0.1, 0.2, 0.0, 0.01], rtol=1e-6)
    for change in ({"width": 6}, {"resolution": 0.0}, {"resolution": float("inf")}, {"height": 0, "width": 0}):
        msg = occupancy_to_msg(cells.astype(np.int8), 0.01, (-0.1, 0.2), Time(sec=1))
        for name, value in change.items():
            setattr(msg.info, name, value)
        with pytest.raises(InputError):
            workspace_from_msg(msg)
    with pytest.raises(InputError):
        workspace_from_msg(occupancy_to_msg(cells.astype(np.int8), 0.01, (0.0, 0.0), Time(sec=1), frame_id="camera"))
