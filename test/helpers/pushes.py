"""Outlines, an arm at rest and limits of pushes, for the tests of planning."""

from __future__ import annotations

import numpy as np

from push_ident.pushing.motion import MotionSettings
from push_ident.pushing.push import PushSettings
from push_ident.types import CellGrid, ObjectShape
from push_ident_sim.cell.robot import HOME

SETTINGS = PushSettings(workspace=(-0.2, 0.2, -0.25, 0.25))
PARKED = (1.4, *HOME[1:])  # turned aside, out of the camera's view
MOTION = MotionSettings(home=PARKED)
BAR = np.array([[-0.08, -0.02], [0.08, -0.02], [0.08, 0.02], [-0.08, 0.02]])
# A slot 26 mm wide, too narrow for the pusher of 36 mm.
SLOTTED = np.array(
    [[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [0.013, 0.05], [0.013, -0.02], [-0.013, -0.02], [-0.013, 0.05], [-0.05, 0.05]]
)


def shape_of(outline: np.ndarray) -> ObjectShape:
    return ObjectShape(CellGrid(np.zeros((1, 2)), 0.01), outline)
