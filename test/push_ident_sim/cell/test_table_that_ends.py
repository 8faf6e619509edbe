"""The simulated cell with a table that ends near the object: it stands over the edge, or it falls."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.sim_objects import CAMERA
from push_ident.errors import InputError
from push_ident_sim.cell.camera import DepthCamera
from push_ident_sim.cell.world import CellWorld, WorldConfig
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import make_object

END = 0.1
BOUNDS = (-0.8, END, -0.7, 0.7)
AWAY = (9.0, 9.0, 0.0)


def test_object_stands_over_the_end_of_its_table_or_falls_out_of_view() -> None:
    sim_object = make_object("toolbox", 1)
    centre = sim_object.mass @ sim_object.cells / sim_object.mass.sum()
    world = CellWorld(sim_object, WorldConfig(table=BOUNDS), pose=(END - 0.03 - centre[0], 0.0, 0.0))
    camera = DepthCamera(sim_object, CAMERA)
    whole = camera.render(AWAY, {})
    camera.set_table(BOUNDS)
    empty = camera.render(AWAY, {})
    beyond = np.isfinite(whole) & np.isnan(empty)
    assert beyond.any() and np.isfinite(empty).any(), "beside the table no surface is"
    try:
        for _ in range(60):
            world.step()
        assert not world.has_fallen and world.cell_loads().sum() == pytest.approx(9.81 * sim_object.mass.sum(), rel=0.05)
        np.testing.assert_allclose(world.object_pose(), [END - 0.03 - centre[0], 0.0, 0.0], atol=2e-3)
        assert np.isfinite(camera.render(world.object_transform(), {})[beyond]).any(), "what overhangs is seen"
        world.place_object((END + 0.012 - centre[0], 0.0, 0.0))
        fallen = []
        for _ in range(480):
            world.step()
            fallen.append(world.has_fallen)
        assert all(fallen[fallen.index(True) :]), "it tumbles, and stays fallen"
        seen = camera.render(world.object_transform(), {})
        np.testing.assert_array_equal(seen[np.isfinite(empty)], empty[np.isfinite(empty)], "nothing is left on the table")
    finally:
        world.close()
    with pytest.raises(InputError, match="table_tilt"):
        WorldConfig(table=BOUNDS, effects=InjectedEffects.of({"table_tilt": [0.01, 0.0]}))
