"""bag_player_node as a real process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from push_ident.bags.writer import BagWriter
from push_ident.nodes.base.network import own_domain

pytestmark = pytest.mark.live

DECADES = 1e9
"""[s]"""


def test_time_without_messages_that_no_recording_has_is_not_waited_for(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for stamp in (1.0, 1.1, 1.2, DECADES, DECADES + 0.1):
            writer.write_pusher(stamp, [0.0, 0.0])
    parameters = [f"bag:={tmp_path / 'bag'}", "wait:=0.0", "listeners:=0"]
    process = subprocess.run(
        [sys.executable, "-m", "push_ident.nodes", "bag_player_node", "--ros-args", *(a for p in parameters for a in ("-p", p))],
        env=os.environ | {"ROS_DOMAIN_ID": str(own_domain())},
        capture_output=True,
        text=True,
        timeout=180.0,
    )
    assert process.returncode == 0, process.stderr
    assert "played 5 messages" in process.stderr and "hours; that is skipped" in process.stderr
