"""A recording of six pushes as tables, for the importers."""

from __future__ import annotations

from pathlib import Path

import pytest

from helpers.objects import hammer, random_records
from helpers.recordings import table_file, tracked_rows
from push_ident.bags.importers import TrackedPoses
from push_ident.types import Float64Array, PushRecord


@pytest.fixture(scope="package")
def pushed() -> list[PushRecord]:
    return random_records(hammer(3), 6, 3, noise=0.2)


@pytest.fixture(scope="package")
def rows(pushed: list[PushRecord]) -> tuple[Float64Array, Float64Array]:
    """Of the object's poses and of the pusher, as `tracked_rows` gives them; not to be changed."""
    return tracked_rows(pushed)


@pytest.fixture
def tables(tmp_path: Path, pushed: list[PushRecord], rows: tuple[Float64Array, Float64Array]) -> TrackedPoses:
    return TrackedPoses(
        poses=table_file(tmp_path / "poses.csv", "time,x,y,yaw", rows[0]),
        pusher=table_file(tmp_path / "pusher.csv", "time,x,y,push", rows[1]),
        outline=table_file(tmp_path / "outline.csv", "x,y", pushed[0].shape.outline),
        radius=0.008,
        position_std=2e-4,
        yaw_std=2e-3,
        cell_size=0.011,
    )
