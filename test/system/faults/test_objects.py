"""Faults of the object, of its path, and of what is written while it is pushed."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point
from system.faults.cell import IDENTIFICATION
from system.faults.oracles import learned_pushes
from system.faults.proxy import OBJECT_POSE, drop
from system.faults.suite import Trial, fault

from push_ident.bags.reader import read_bag
from push_ident.pushing.push import PushCode
from push_ident_msgs.msg import MassFrictionMap

ASIDE = 0.2
"""Where the object seems to be, from where it is [m]: the tool comes down more than its width away."""
CONFIDENT = 0.2
"""Relative standard deviation of a cell below which a map claims to know it; that of the prior is about 1."""
DISK, LEAST_FREE = 24, 8
"""Size of the small disk, and `min_free_mib` of the recorder [MiB]."""


@fault(18, f"poses {1e2 * ASIDE:.0f} cm beside the object: the push touches nothing", "NO_CONTACT; the map does not change")
def test_push_misses(trial: Trial) -> None:
    cell = trial.cell

    def displace(msg: Any) -> None:
        msg.pose.pose.position.y += ASIDE

    cell.proxy.change(OBJECT_POSE, displace)
    time.sleep(0.5)
    goal = cell.goal(-1)
    # In the frame of the table: given in that of the object, the executor would first bring it back from the edge.
    goal.frame_id, goal.contact_point = "table", Point(x=-0.08, y=ASIDE - 0.02)
    trial.expect_code(cell.push(goal), PushCode.NO_CONTACT)
    time.sleep(1.5)
    assert learned_pushes(cell) == trial.learned, "the model has changed"


@fault(19, "poses stop during a push", "OBJECT_LOST; stop, retreat on a checked path; the record says so")
def test_object_lost(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin(cell.goal(distance=0.12, speed=0.02))
    since = cell.proxy.set(OBJECT_POSE, drop)
    trial.expect_code(cell.end(sent), PushCode.OBJECT_LOST)
    cell_records = cell.monitor.records
    assert [record.error_code for received, record in cell_records if received > since] == [PushCode.OBJECT_LOST]
    time.sleep(0.5)
    assert not cell.is_moving(), "the arm still moves"


@fault(
    23, "poses that jump by 3 cm and claim 0.1 mm, during a whole push", "refused, or a status that is not success; never confident numbers"
)
def test_poses_that_jump(trial: Trial) -> None:
    cell, rng = trial.cell, np.random.default_rng(0)

    def jump(msg: Any) -> None:
        msg.pose.covariance = (np.eye(6) * 1e-8).ravel()
        dx, dy = rng.normal(0.0, 0.03, 2)
        msg.pose.pose.position.x += dx
        msg.pose.pose.position.y += dy

    sent = cell.begin()
    cell.proxy.change(OBJECT_POSE, jump)
    cell.end(sent)
    time.sleep(3.0)
    for _, msg in cell.monitor.maps:
        spread = float(np.median(np.array(msg.mass_friction_std) / np.array(msg.mass_friction)))
        trial.note = f"status of the map: {msg.status_text}, deviations of {100 * spread:.0f} %"
        assert msg.status != MassFrictionMap.STATUS_OK or spread > CONFIDENT, trial.note


# ---- disks


@contextmanager
def mounted(folder: Path, *ways: tuple[str, ...]) -> Iterator[Path]:
    """A folder under one mount or more, one after the other. Skips the test without the right to mount."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    try:
        for arguments in ways:
            done = subprocess.run(["mount", *arguments, str(folder)], check=False, capture_output=True, text=True)
            if done.returncode:
                pytest.skip(f"a disk of its own needs the right to mount: {done.stderr.strip()}; run it as root")
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False, capture_output=True)


# the recorder looks twice a second
@fault(
    22, "the disk fills up while a push is recorded", "RECORDING; held; the bag is closed readable; the next push is refused", within=0.5
)
def test_disk_full(trial: Trial) -> None:
    cell = trial.cell
    with mounted(trial.folder / "disk", ("-t", "tmpfs", "-o", f"size={DISK}m", "tmpfs")) as disk:
        with cell.with_recorder(disk / "bag", min_free_mib=LEAST_FREE):
            sent = cell.begin(after=0.0)
            since = time.monotonic()
            (disk / "ballast").write_bytes(bytes((DISK - LEAST_FREE + 2) << 20))
            result = cell.end(sent)
            trial.expect_hold(since)
            trial.expect_code(result, PushCode.RECORDING)
            trial.expect_code(cell.push(), PushCode.RECORDING)
        trial.note = f"{len(read_bag(disk / 'bag').pusher.time)} poses of the pusher in the bag"


@fault(53, "the folder of the checkpoints is mounted read-only during a push", "refused and named; the model in memory is kept")
def test_state_read_only(trial: Trial) -> None:
    cell = trial.cell
    since, folder = time.monotonic(), cell.state_folder
    with mounted(folder, ("--bind", str(folder)), ("-o", "remount,ro,bind")):
        cell.whole_push()
        trial.expect_report(IDENTIFICATION, "cannot write", since=since)
    cell.whole_push(cell.goal(-1))
    trial.expect_learned(2)
