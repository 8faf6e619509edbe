"""viewer_node: what is published on its topics ends up in a Rerun recording."""

from __future__ import annotations

import subprocess
import sys
from copy import deepcopy
from pathlib import Path

import numpy as np
import psutil
import pytest

from helpers.fuzzing.right import right_messages
from helpers.node_process import Talker
from helpers.spinning import running
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.messages import stamp_to_msg
from push_ident.nodes.viewer.rerun_scene import RerunScene
from push_ident.nodes.viewer.viewer_node import ViewerNode
from push_ident.types import CameraIntrinsics

OF_THE_OBJECT = ("pose", "cells", "outline", "mass_friction_map", "prediction", "next_push", "next_push_prediction", "push_score")
SHOWN = (*(f"objects/o1/{name}" for name in OF_THE_OBJECT), "depth/camera_pose", "depth/camera_info", "workspace/refused", "tool/pose")
"""Topics of what is shown, beside the images and the goal."""
ENTITIES = {
    "table": ("camera/depth", "tool", "load/o1/cells", "uncertainty/o1/cells"),
    "table/objects": ("o1/observed", "refused", "o1/predicted", "o1/next_push/tool", "o1/next_push/end"),
    "table/objects/goal": ("outline", "edge", "path", "push/tool", "push/path", "push/corridor", "push/end", "words/1"),
    "error_mm": ("error",),
}


@pytest.mark.live
def test_everything_that_is_published_is_in_the_recording(tmp_path: Path) -> None:
    file, domain, now = tmp_path / "view.rrd", own_domain(), [1.0]

    def publish(*topics: str) -> None:
        now[0] += 0.3
        for topic in topics:
            msg = deepcopy(right_messages()[topic])
            if hasattr(msg, "header"):
                msg.header.stamp = stamp_to_msg(now[0])
            talker.publish(type(msg), topic, msg)

    with Talker(domain) as talker, running(ViewerNode, domain, "output:=file", f"file:={file}"):
        talker.until(lambda: talker.values("viewer").get("objects"), lambda: publish(*SHOWN, "depth/image_rect"))
        # With a goal the push to make next is not drawn any more.
        for topics in ((*SHOWN, "depth/image_rect"), ("push_to_goal/markers", *SHOWN, "depth/image_rect")):
            for _ in range(2):  # between two reports all that has come is drawn
                talker.forget()
                talker.until(lambda: talker.values("viewer"), lambda topics=topics: publish(*topics))  # type: ignore[misc]
    rerun = [str(Path(sys.executable).parent / "rerun"), "rrd", "print", str(file)]
    printed = subprocess.run(rerun, capture_output=True, text=True, check=True).stdout
    wanted = [f"/{root}/{name}" for root, names in ENTITIES.items() for name in names]
    assert [entity for entity in (*wanted, "/status") if entity not in printed] == []


def test_a_camera_that_moves_costs_no_memory(tmp_path: Path) -> None:
    scene, intrinsics = RerunScene(), CameraIntrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    scene.save(str(tmp_path / "scene.rrd"))
    camera_in_table = np.diag([1.0, -1.0, -1.0, 1.0])
    process, before = psutil.Process(), 0.0
    for k in range(400):
        scene.set_time(0.1 * k)
        camera_in_table[:3, 3] = 1e-3 * k, 0.0, 1.0
        scene.camera(intrinsics, camera_in_table)
        if k == 100:
            before = process.memory_info().rss
    scene.close()
    assert process.memory_info().rss - before < 50e6  # with a layout for each pose, 150 MB
