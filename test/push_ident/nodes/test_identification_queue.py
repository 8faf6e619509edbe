"""What waits for identification is counted by what it is: pushes, and better outlines."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PolygonStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.context import Context
from std_msgs.msg import Float32MultiArray

from helpers.executor_cell import Stalls
from helpers.node_process import Talker
from helpers.spinning import running
from push_ident.geometry.outline import cells_in_outline
from push_ident.identification.online.session import ObjectSession
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import outline_std_to_msg, planar_pose_to_msg, shape_to_msgs
from push_ident.nodes.identification import identification_node
from push_ident.nodes.identification.identification_node import IdentificationNode
from push_ident.nodes.identification.work import Kind, WorkQueue
from push_ident.types import ObjectShape
from push_ident_msgs.srv import LoadModel, SaveModel

BOX = np.array([(-0.05, -0.04), (0.05, -0.04), (0.05, 0.04), (-0.05, 0.04)])


def test_work_is_done_in_its_order_but_only_the_latest_outline_of_an_object() -> None:
    queue, done, left = WorkQueue(), [], []
    assert queue.first() is None
    for name, i in (("o1", 0), ("o1", 1), ("o1", 2), ("o2", 3), ("", 4), ("o2", 5), ("o2", 6)):
        queue.put(Kind.OUTLINE if name else Kind.PUSH, lambda i=i: done.append(i), instead_of=name)  # type: ignore[misc]
    while (work := queue.first()) is not None:
        work()
        left.append((queue.n_waiting(Kind.OUTLINE), queue.n_waiting(Kind.PUSH)))  # what is under way included
        queue.first_is_done()
    assert done == [0, 2, 3, 4, 6]  # the first one may have begun
    assert left == [(4, 1), (3, 1), (2, 1), (1, 1), (1, 0)] and queue.n_waiting(Kind.OUTLINE) == 0


@pytest.mark.live
def test_node_that_loads_its_kernels_is_closed_without_waiting_for_them(monkeypatch: pytest.MonkeyPatch) -> None:
    may_load, context = threading.Event(), Context()
    monkeypatch.setattr(identification_node, "compile_kernels", lambda **options: may_load.wait(60.0))
    rclpy.init(context=context, domain_id=own_domain())
    node = IdentificationNode(context=context)
    try:
        with Stalls() as stalls:
            asked = time.monotonic()
            node.close()
            took = time.monotonic() - asked
        assert took < 0.8 + 4.0 * stalls.worst
    finally:
        may_load.set()
        node.destroy_node()
        context.try_shutdown()


@pytest.mark.live
def test_a_better_outline_is_no_push_that_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fit with it is held up, so that the status of the node is seen meanwhile."""
    domain, may_go_on, refine = own_domain(), threading.Event(), ObjectSession.refine_shape

    def held_up(session: ObjectSession, shape: ObjectShape) -> bool:
        assert session.is_new or may_go_on.wait(300.0)
        return refine(session, shape)

    monkeypatch.setattr(ObjectSession, "refine_shape", held_up)
    with running(IdentificationNode, domain), Talker(domain) as talker:

        def say(outline: np.ndarray) -> None:
            shape = ObjectShape(cells_in_outline(BOX, 0.01), outline, np.full(len(outline), 0.001))
            cells, border = shape_to_msgs(shape, "o1", Time())
            talker.publish(OccupancyGrid, "objects/o1/cells", cells)
            talker.publish(Float32MultiArray, "objects/o1/outline_std", outline_std_to_msg(shape))
            talker.publish(PolygonStamped, "objects/o1/outline", border)

        def waiting() -> tuple[str | None, str | None]:
            return talker.values().get("pushes waiting"), talker.values().get("outlines waiting")

        pose = planar_pose_to_msg(Time(sec=1), np.zeros(3), 1e-6 * np.eye(3))
        try:
            talker.publish(PoseWithCovarianceStamped, "objects/o1/pose", pose)
            say(BOX)
            talker.until(lambda: talker.values().get("shapes"))
            # A model makes the object known, as a push does.
            path = str(tmp_path / "model.json")
            save, load = (talker.node.create_client(kind, name) for kind, name in ((SaveModel, "save_model"), (LoadModel, "load_model")))
            assert talker.ask(save, SaveModel.Request(object_id="o1", path=path)).success
            answer = talker.ask(load, LoadModel.Request(object_id="o1", path=path))
            assert answer.success, answer.message
            say(1.01 * BOX)
            talker.until(lambda: waiting()[1] not in (None, "0"))
            assert waiting()[0] == "0"
            may_go_on.set()
            talker.until(lambda: waiting() == ("0", "0"), timeout=300.0)  # kernels may have to be compiled first
        finally:
            may_go_on.set()
