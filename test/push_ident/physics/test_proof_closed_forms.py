"""Motions, forces and derivatives that can be written down, to nine digits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.objects import square
from helpers.random_pushes import DT, examples
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY, BodyParameters, SimulationSettings, body_of_cells, cell_gradient, simulate_body
from push_ident.physics.support import support_friction
from push_ident.types import CellGrid, Float64Array, ObjectShape, PusherPath, SolveStatus

SHARP = {
    "circle": SimulationSettings(step=DT, smoothing_speed=1e-8),
    "pyramid": SimulationSettings(step=DT, friction_cone="pyramid"),
}


def ring(n: int, radius: float) -> Float64Array:
    """n points on a circle, half a division off the x axis, shape (n, 2)."""
    angle = 2 * np.pi * (np.arange(n) + 0.5) / n
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def friction_wrench(twist: Float64Array, arms: Float64Array, limit: Float64Array, eps: float = 1e-10) -> Float64Array:
    """What the table takes from a body that moves with `twist` (fx, fy, torque)."""
    force, stiffness = np.empty(3), np.empty((3, 3))
    support_friction(np.asarray(twist, dtype=np.float64), np.ascontiguousarray(arms.T), limit, eps, True, force, stiffness)
    return force


# A block that slides under a normal force


@pytest.mark.parametrize("cone", SHARP)
def test_sliding_block_loses_mu_times_its_load(cone: str) -> None:
    # Struck to the speed v, then left alone: v1 = v - dt sum(mu_i N_i) / m with N_i = m_i g, x = dt (v + v1). Hence
    # dx/df_i = -dt^2 / m, dx/dm = dt^2 sum(f) / m^2, and by the cells dx/dmu_i = -dt^2 m_i g / m, dx/dm_i = -dt^2 g (mu_i - F / m g) / m.
    shape, speed = square(5, 0.02), 0.27
    rng = np.random.default_rng(0)
    mass, friction = (u + u[::-1] for u in rng.uniform([[0.005], [0.1]], [[0.02], [0.4]], (2, 25)))
    body = body_of_cells(shape, mass, friction)
    assert body.centre == pytest.approx([0.0, 0.0], abs=1e-15)
    path = np.array([[-0.058, 0.0], [-0.058 + speed * DT, 0.0], [-0.1, 0.0]])
    pusher = PusherPath(DT * np.arange(3), path, 0.008)
    motion = simulate_body(shape, body, 0.3, PushScenario(pusher, np.zeros(3), pusher.time), settings=SHARP[cone], jacobian=True)
    load = float(body.limit.sum())
    slower = speed - DT * load / body.mass
    assert motion.pose[:, 0] == pytest.approx([0.0, DT * speed, DT * (speed + slower)], rel=1e-9)
    assert motion.pose[:, 1:] == pytest.approx(0.0, abs=1e-13)
    assert motion.force[0, 0] == pytest.approx(body.mass * speed / DT + load, rel=1e-9)
    assert np.all(motion.force[1] == 0)

    end = motion.jacobian[-1, 0]
    assert end[8:] == pytest.approx(np.full(25, -(DT**2) / body.mass), rel=1e-9)
    assert end[3] == pytest.approx(DT**2 * load / body.mass**2, rel=1e-9)
    by_mass, by_friction = cell_gradient(shape, mass, friction, end)
    assert by_friction == pytest.approx(-(DT**2) * mass * GRAVITY / body.mass, rel=1e-9)
    assert by_mass == pytest.approx(-(DT**2) * GRAVITY * (friction - load / (body.mass * GRAVITY)) / body.mass, rel=1e-9, abs=1e-15)


@examples(40)
@given(st.floats(0.0, 1.5), st.floats(0.1, 1.5), st.floats(0.02, 0.4), st.booleans())
def test_pusher_that_slips_carries_along_at_mu_times_its_normal_speed(
    mu: float, excess: float, normal_speed: float, other_way: bool
) -> None:
    # A body that cannot turn leaves along the edge of the friction cone, (u_t, u_n) = (mu, 1) v_n, whatever its support friction is: the
    # table answers along the motion. Hence du_t/dmu = v_n, nothing by mass or load, and the force is m u / dt + F u / |u|.
    shape, load = square(5, 0.02), 2.3
    body = BodyParameters(0.7, np.zeros(2), 1e12, np.full(25, load / 25))
    sign = -1.0 if other_way else 1.0
    velocity = np.array([sign * (mu + excess) * normal_speed, normal_speed])
    start = np.array([-0.01 * sign, -0.058])
    pusher = PusherPath(DT * np.arange(2), np.array([start, start + DT * velocity]), 0.008)
    motion = simulate_body(shape, body, mu, PushScenario(pusher, np.zeros(3), pusher.time), settings=SHARP["circle"], jacobian=True)
    left = motion.pose[-1, :2] / DT
    along = np.array([sign * mu, 1.0])
    assert left == pytest.approx(normal_speed * along, rel=1e-9, abs=1e-12)
    assert motion.force[0] == pytest.approx((0.7 * normal_speed / DT + load / np.hypot(mu, 1.0)) * along, rel=1e-9, abs=1e-9)
    assert motion.jacobian[-1, :2, 7] / DT == pytest.approx([sign * normal_speed, 0.0], rel=1e-9, abs=1e-9)
    assert motion.jacobian[-1, :, [3, *range(8, 33)]] == pytest.approx(0.0, abs=1e-12)


# The limit surface


@pytest.mark.parametrize("n", [3, 4, 12, 61])
def test_limit_surface_of_a_ring_has_the_axes_of_the_ellipsoid_and_a_known_point_between(n: int) -> None:
    # Along the axes the ellipsoid (F, F, F R) of Howe and Cutkosky is exact. About a point of the ring, half-way between two supports,
    # support i moves against a chord of 2 R sin(a_i), a_i = (2 i + 1) pi / 2 n: force and torque / R are both F / (n sin(pi / 2 n)).
    radius, total = 0.05, 1.7
    arms, limit = ring(n, radius), np.full(n, total / n)
    for angle in np.linspace(0, np.pi, 5):
        along = np.array([np.cos(angle), np.sin(angle), 0.0])
        assert friction_wrench(0.3 * along, arms, limit) == pytest.approx(total * along, rel=1e-12, abs=1e-12)
    assert friction_wrench(np.array([0.0, 0.0, -2.0]), arms, limit) == pytest.approx([0.0, 0.0, -total * radius], rel=1e-12, abs=1e-12)
    between = total / (n * np.sin(np.pi / (2 * n)))
    spin = 2.0
    assert friction_wrench(np.array([0.0, -spin * radius, spin]), arms, limit) == pytest.approx(
        [0.0, -between, between * radius], rel=1e-10, abs=1e-10
    )


@examples(100)
@given(st.integers(0, 2**31), st.integers(1, 60))
def test_limit_surface_is_convex_and_the_motion_normal_to_it(seed: int, n: int) -> None:
    # No other wrench of the surface would take more power from a motion than the one that belongs to it (maximal dissipation), and that
    # power is sum f_i |v_i|.
    rng = np.random.default_rng(seed)
    arms, limit = 0.05 * rng.normal(size=(n, 2)), rng.uniform(0, 1, n)
    twists = rng.normal(size=(20, 3)) * [0.1, 0.1, 2.0]
    wrenches = np.array([friction_wrench(twist, arms, limit) for twist in twists])
    power = np.einsum("ij,ij->i", wrenches, twists)
    speeds = np.hypot(twists[:, :1] - twists[:, 2:] * arms[:, 1], twists[:, 1:2] + twists[:, 2:] * arms[:, 0])
    assert power == pytest.approx(speeds @ limit, rel=1e-9)
    assert np.all(wrenches @ twists.T <= power[None] * (1 + 1e-9))


# The motion cone of a pusher


def ring_pushed_at_its_side(y: float, tilt: float, heading: float) -> tuple[ObjectShape, BodyParameters, PusherPath, Float64Array]:
    """A ring of 12 supports about the origin, and a pointed pusher at (-R, y) on an edge whose inward normal is (sin, -cos) of `tilt`."""
    radius, speed = 0.05, 0.1
    arms = ring(12, radius)
    inward, along = np.array([np.sin(tilt), -np.cos(tilt)]), np.array([np.cos(tilt), np.sin(tilt)])
    point = np.array([-radius, y])
    corners = [(0.3, 0.0), (-0.3, 0.0), (-0.3, 0.5), (0.3, 0.5)]
    outline = np.array([point + a * along + b * inward for a, b in corners])
    shape = ObjectShape(CellGrid(arms, 0.01), outline)
    body = BodyParameters(0.5, np.zeros(2), 1e-3, np.full(12, 0.1))
    velocity = speed * np.array([np.cos(heading), np.sin(heading)])
    return shape, body, PusherPath(DT * np.arange(2), np.array([point, point + DT * velocity]), 0.0), velocity


@pytest.mark.parametrize("mu", [0.1, 0.35, 1.2])
@pytest.mark.parametrize("edge_of_cone", [1.0, -1.0])
def test_pusher_begins_to_slip_at_the_edge_of_its_motion_cone(mu: float, edge_of_cone: float) -> None:
    # Lynch and Mason: the pusher sticks while its velocity lies between those that the edges of the friction cone cause. With one edge of
    # the cone along (0, -1) through (-R, y), the ring turns about (R, 0) (the known point of its limit surface): the contact moves along
    # (-y, -2 R). Outside that heading the force stays on the edge and so does the centre of rotation, (R, 0).
    radius, y = 0.05, 0.06 if edge_of_cone > 0 else 0.15  # so that the ring lies inside of the outline
    tilt = edge_of_cone * np.arctan(mu)
    inward, along = np.array([np.sin(tilt), -np.cos(tilt)]), np.array([np.cos(tilt), np.sin(tilt)])
    limit_heading = np.arctan2(-2 * radius, -y)
    how = SimulationSettings(step=DT, smoothing_speed=1e-9, quasi_static=True)
    # The force is on the edge that lies towards -`edge_of_cone` of the tangent, hence the pusher slips that way.
    for beyond in (-0.05, -1e-2, -1e-4, 1e-4, 1e-2, 0.05):
        heading = limit_heading - edge_of_cone * beyond
        shape, body, pusher, velocity = ring_pushed_at_its_side(y, tilt, heading)
        motion = simulate_body(shape, body, mu, PushScenario(pusher, np.zeros(3), pusher.time), settings=how)
        assert motion.status is SolveStatus.CONVERGED
        twist = motion.pose[-1] / DT
        contact = twist[:2] + twist[2] * np.array([-y, -radius])
        slip = float(along @ (velocity - contact))
        assert inward @ contact == pytest.approx(inward @ velocity, rel=1e-9)
        press, drag = inward @ motion.force[0], along @ motion.force[0]
        if beyond < 0:
            assert abs(slip) < 1e-12
            assert abs(drag) < mu * press
        else:
            spin = inward @ velocity / (inward @ np.array([-y, -2 * radius]))
            assert -edge_of_cone * slip > 1e-6
            assert twist == pytest.approx(spin * np.array([0.0, -radius, 1.0]), rel=1e-9, abs=1e-11)
            between = 1.2 / (12 * np.sin(np.pi / 24))
            assert motion.force[0] == pytest.approx([0.0, -between], rel=1e-9, abs=1e-9)
