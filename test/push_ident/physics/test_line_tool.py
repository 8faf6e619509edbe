"""Tools that touch an object at two places, two fingers or a plate with round ends: laws of each step, and closed forms."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls

from helpers.random_pushes import DT, ENGINES, Case, fixed_seeds, line_tool_case, mirrored, moved, steps_of
from push_ident.errors import InputError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.physics.batch import BatchModel, BatchPush, rollouts
from push_ident.physics.contact_rows import RECOVERY_SPEED
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, body_of_cells, simulate
from push_ident.types import Float64Array, ObjectModel, ObjectShape, PusherPath, SolveStatus

LINE = np.array([[0.0, 0.012], [0.0, -0.012]])
RADIUS = 0.003
TOOLS = {"plate": {"polygon": LINE}, "fingers": {"fingers": LINE}}


def block(pusher_friction: float = 0.4, friction: float = 0.3) -> ObjectModel:
    outline = np.array([[-0.03, -0.025], [0.03, -0.025], [0.03, 0.025], [-0.03, 0.025]])
    shape = ObjectShape(cells_in_outline(outline, 0.006), outline)
    n_cells = len(shape.cells)
    return ObjectModel(shape, np.full(n_cells, 0.5 / n_cells), np.full(n_cells, friction), pusher_friction)


def cross(a: Float64Array, b: Float64Array) -> Float64Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def wrenches_of_contacts(case: Case, pose: Float64Array, n: int, twist: Float64Array, contacts: Float64Array) -> tuple[list[Float64Array], str]:
    """What the contacts can exert, as generators of a cone of wrenches about the origin of the table, and what the fingers do.

    Contacts that part exert nothing; one that slides, a force on the edge of its cone against the slip; one that sticks, any in its cone.
    """
    path, mu = case.pusher, case.model.pusher_friction
    turn = np.array([[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]])
    going, spin = (path.position[n + 1] - path.position[n]) / DT, (path.yaw[n + 1] - path.yaw[n]) / DT
    centre = transform_points(pose, case.body.centre[None])[0]
    pressing = []
    for contact in contacts[:2]:
        normal, point = turn @ contact[1:3], transform_points(pose, contact[3:5][None])[0]
        tool = going + spin * np.array([-(point - path.position[n])[1], (point - path.position[n])[0]])
        own = twist[:2] + twist[2] * np.array([-(point - centre)[1], (point - centre)[0]])
        closing, most = float(normal @ (own - tool)), max(contact[0] / DT, -RECOVERY_SPEED)
        assert closing <= most + 1e-9
        if closing > most - 1e-9:
            pressing.append((normal, point, own - tool, abs(most)))
    # Of four conditions of fingers that stick, three are met exactly; the closing of the gaps leaves some slip to the fourth.
    slowest = 1e-9 + (2.0 * sum(most for *_, most in pressing) if len(pressing) == 2 else 0.0)
    cone, does = [], []
    for normal, point, relative, _ in pressing:
        tangent = np.array([-normal[1], normal[0]])
        slip = float(tangent @ relative)
        drags = (-mu, mu) if abs(slip) < slowest else (-np.sign(slip) * mu,)
        does.append("sticks" if len(drags) == 2 else "slides")
        for drag in drags:
            force = -normal + drag * tangent
            cone.append(np.array([*force, cross(point, force)]))
    return cone, " and ".join(sorted(does))


@pytest.mark.parametrize("mode", ["circle", "quasi-static"])
@pytest.mark.parametrize(("tool", "on_corner"), [("plate", False), ("fingers", False), ("fingers", True)])
def test_forces_of_both_contacts_lie_in_their_cones_and_balance_every_step(tool: str, on_corner: bool, mode: str) -> None:
    count = Counter[str]()
    for seed in fixed_seeds(60):
        case = line_tool_case(seed, tool, 12, on_corner=on_corner)
        motion = case.simulate(ENGINES[mode])
        assert motion.status is SolveStatus.CONVERGED
        body = case.body
        inertia = np.zeros(3) if mode == "quasi-static" else np.array([body.mass, body.mass, body.inertia])
        for n, step in enumerate(steps_of(case, motion)):
            if not step.force.any():
                continue
            cells = step.twist[:2] + step.twist[2] * np.column_stack([-step.arms[:, 1], step.arms[:, 0]])
            friction = DT * body.limit[:, None] * cells / np.sqrt(np.sum(cells**2, axis=1, keepdims=True) + 1e-8)
            impulse = inertia * (step.twist - step.old) + [*friction.sum(axis=0), cross(step.arms, friction).sum()]
            assert impulse[:2] == pytest.approx(DT * step.force, abs=1e-8 * np.abs(impulse).max())
            # About the origin of the table.
            impulse[2] += cross(step.centre, impulse[:2])
            cone, does = wrenches_of_contacts(case, motion.pose[n], n, step.twist, step.contacts)
            unit = np.array([1.0, 1.0, 30.0])
            _, rest = nnls((np.array(cone) * unit).T, impulse * unit)
            assert rest <= 1e-6 * np.linalg.norm(impulse * unit), (seed, n, does)
            count[does] += 1
    print(dict(count))
    for does in ("sticks", "slides", "sticks and sticks", "slides and slides", *(["slides and sticks"] if on_corner else [])):
        assert count[does] >= 5, count
