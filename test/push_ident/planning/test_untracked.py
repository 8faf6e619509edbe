"""What the occupancy of the workspace shows beside the tracked objects."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.objects import square
from push_ident.errors import InputError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.geometry.workspace_grid import WorkspaceGrid
from push_ident.planning.obstacle import Obstacle
from push_ident.planning.untracked import UntrackedThings
from push_ident.types import Float64Array

SHAPE = square(6, 0.01)
WORKSPACE = (-0.3, 0.3, -0.3, 0.3)
AT = {"o1": np.array([0.1, 0.0, 0.4])}
THING = np.array([[-0.12, -0.03], [-0.08, -0.03], [-0.08, 0.03], [-0.12, 0.03]])


def tracked(poses: dict[str, Float64Array]) -> list[Obstacle]:
    return [Obstacle.of_object(name, SHAPE.outline, pose, np.diag([1e-3, 1e-3, 5e-3]) ** 2) for name, pose in poses.items()]


def grid(*outlines: Float64Array, hidden: Float64Array | None = None) -> WorkspaceGrid:
    cells = np.zeros((160, 200), dtype=np.int8)
    empty = WorkspaceGrid(cells, np.array([-0.2, -0.16, 0.0]), 0.002)
    rows, columns = np.indices(cells.shape)
    points = empty.pose[:2] + empty.size * (np.column_stack([columns.ravel(), rows.ravel()]) + 0.5)
    for outline in outlines:
        cells[(signed_distance(points, outline) <= 0.001).reshape(cells.shape)] = 100
    if hidden is not None:
        cells[(signed_distance(points, hidden) <= 0.0).reshape(cells.shape)] = -1
    return empty


def own(poses: dict[str, Float64Array]) -> Float64Array:
    return transform_points(poses["o1"], SHAPE.outline)


def test_only_what_belongs_to_no_tracked_object_is_an_obstacle_and_its_outline_holds_its_cells() -> None:
    things = UntrackedThings(WORKSPACE)
    assert things.obstacles(tracked(AT)) == []
    things.take(grid(own(AT), THING), AT, tracked(AT))
    (thing,) = things.obstacles(tracked(AT))
    assert "(-0.10, " in thing.name and np.max(signed_distance(THING, thing.outline)) <= 0.0
    assert np.max(signed_distance(thing.outline, THING)) < 0.006
    # A speck is noise; a thing that is tracked from now on is no second obstacle.
    things.take(grid(own(AT), np.array([[0.0, 0.1], [0.01, 0.1], [0.01, 0.11], [0.0, 0.11]])), AT, tracked(AT))
    assert things.obstacles(tracked(AT)) == []
    things.take(grid(own(AT)), {}, [])
    assert len(things.obstacles([])) == 1 and things.obstacles(tracked(AT)) == []


def test_what_the_arm_hides_stays_and_what_is_seen_to_be_gone_goes() -> None:
    things = UntrackedThings(WORKSPACE)
    things.take(grid(THING), AT, tracked(AT))
    things.take(grid(hidden=THING + np.sign(THING - THING.mean(axis=0)) * 0.01), AT, tracked(AT))
    assert len(things.obstacles(tracked(AT))) == 1
    things.take(grid(), AT, tracked(AT))
    assert things.obstacles(tracked(AT)) == []


def test_grid_of_a_moment_at_which_an_object_moved_is_left_out() -> None:
    """It shows the object where it was, or will be."""
    things, moved = UntrackedThings(WORKSPACE), {"o1": np.array([0.02, 0.0, 0.4])}
    things.take(grid(own(AT)), AT, tracked(AT))
    things.take(grid(own(AT)), moved, tracked(moved))
    assert things.obstacles(tracked(moved)) == []
    things.take(grid(own(moved), THING), moved, tracked(moved))
    assert len(things.obstacles(tracked(moved))) == 1


def test_what_is_far_from_the_workspace_does_not_count_and_more_things_than_a_cell_has_are_refused() -> None:
    far = UntrackedThings((0.1, 0.3, -0.3, 0.3))
    far.take(grid(THING), AT, tracked(AT))
    assert far.obstacles(tracked(AT)) == []
    things, wide = UntrackedThings(WORKSPACE), WorkspaceGrid(np.zeros((60, 60), dtype=np.int8), np.array([-0.3, -0.3, 0.0]), 0.02)
    wide.cells[::4, ::4] = 100
    things.take(grid(THING), AT, tracked(AT))
    with pytest.raises(InputError, match="75"):
        things.take(wide, AT, tracked(AT))
    assert len(things.obstacles(tracked(AT))) == 1, "the one before is kept"
