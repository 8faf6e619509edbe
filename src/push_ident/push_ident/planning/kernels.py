"""The kernels of planning, compiled ahead."""

from __future__ import annotations

import numpy as np

from push_ident.physics.batch import BatchModel, BatchPush, rollouts
from push_ident.physics.body import BodyParameters
from push_ident.physics.effect_values import NO_EFFECTS, effect_values
from push_ident.physics.effects import CAUSES
from push_ident.physics.overhang import TableEdge
from push_ident.types import CellGrid, ObjectShape, PusherPath

__all__ = ["compile_planning"]


def compile_planning() -> None:
    """Compile the kernels of batched rollouts, without and with effects, on the table and at its edge, or load them: no plan waits."""
    square = np.array([[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]])
    shape = ObjectShape(CellGrid(np.zeros((1, 2)), 0.02), square)
    body = BodyParameters(0.1, np.zeros(2), 1e-5, np.array([0.3]))
    path = PusherPath(np.array([0.0, 0.1]), np.array([[-0.02, 0.0], [0.0, 0.0]]), 0.005)
    pushes = [BatchPush(path, np.zeros(3), np.array([0.1]))]
    # One effect stands for all: they share the kernel.
    for effects in (NO_EFFECTS, effect_values(CAUSES[:1])):
        for edge in (None, TableEdge(np.array([1.0, 0.0]), 1.0)):
            model = BatchModel(body, 0.3, weight=np.ones(1), effects=effects)
            rollouts(shape, [model], pushes, step=0.01, n_threads=1, edge=edge)
