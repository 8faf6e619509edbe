"""A plate in Newton: a rigid body on a foot under each cell, pushed by a ball, and derivatives of its poses by Newton's tape.

Newton computes in single precision, and its contact points and normals are constants on the tape.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from push_ident.geometry.se2 import quaternion_of_yaw
from push_ident.physics.support import GRAVITY
from push_ident.types import Float64Array, ObjectModel, PusherPath

_STEP: Final = 5e-4
"""Time step [s]."""
_SEARCH: Final = 4
"""Steps from one search for contacts to the next; with one, derivatives are no better."""
_SINK: Final = 1e-4
"""By which the plate sinks into the table at rest [m]: its feet are springs."""
_STIFFNESS: Final = 2e4
"""Of the contact with the ball [N/m]."""
_VISCOUS: Final = 0.9
"""Gain of friction by speed, of mass by step [1]: explicit steps are stable below 2, and with a larger gain the plate creeps less."""
_LOW: Final = 2e-3
"""Radius of a foot, and height of the ball [m]: no push tilts the plate."""


class NewtonPlate:
    """A rectangular plate for pushes of up to `seconds`. The launches of one push are recorded, and replayed for each.

    `model` gives outline, cells and mass; every foot bears the same weight. Raises ImportError where Newton is not installed.
    """

    def __init__(self, model: ObjectModel, radius: float, seconds: float) -> None:
        import warp as wp

        wp.config.quiet = True
        import newton

        self._wp, self._n_cells = wp, len(model.mass)
        n_steps = math.ceil(seconds / _STEP / _SEARCH) * _SEARCH
        self._plate = _build(newton, wp, model, radius)
        solver = newton.solvers.SolverSemiImplicit(self._plate, angular_damping=0.0)
        pipeline, control = newton.CollisionPipeline(self._plate, broad_phase="explicit"), self._plate.control()
        self._states = [self._plate.state() for _ in range(n_steps + 1)]
        # The tape goes back over all of them.
        contacts = [pipeline.contacts() for _ in range(n_steps // _SEARCH)]
        self._places = wp.zeros(n_steps, dtype=wp.transform)
        self._speeds = wp.zeros(n_steps, dtype=wp.spatial_vector)
        self._tape = wp.Tape()
        with wp.ScopedCapture() as capture, self._tape:
            for k, state in enumerate(self._states[:-1]):
                state.clear_forces()
                wp.copy(state.body_q, self._places, dest_offset=1, src_offset=k, count=1)
                wp.copy(state.body_qd, self._speeds, dest_offset=1, src_offset=k, count=1)
                if k % _SEARCH == 0:
                    pipeline.collide(state, contacts[k // _SEARCH])
                solver.step(state, self._states[k + 1], control, contacts[k // _SEARCH], _STEP)
        self._forward = capture.graph
        with wp.ScopedCapture() as capture:
            self._tape.backward()
        self._backward = capture.graph
        self._frames, self._seen = np.zeros(0, dtype=np.intp), np.zeros((0, 7))

    def simulate(self, friction: Float64Array, start: Float64Array, path: PusherPath, times: Float64Array) -> Float64Array:
        """Poses of a push.

        Args:
            friction: of each cell, then of the pusher [1], shape (n_cells + 1,).
            start: pose of the plate at rest (x, y, yaw), shape (3,).
            path: of the ball.
            times: of the poses, on the clock of the path [s], shape (n,).

        Returns:
            (x, y, yaw), shape (n, 3).
        """
        n_steps = len(self._states) - 1
        ticks = path.time[0] + _STEP * np.arange(n_steps + 1)
        ways = np.column_stack([np.interp(ticks, path.time, path.position[:, axis]) for axis in (0, 1)])
        places, speeds = np.zeros((n_steps, 7), dtype=np.float32), np.zeros((n_steps, 6), dtype=np.float32)
        places[:, :2], places[:, 2], places[:, 6] = ways[:-1], _LOW, 1.0
        speeds[:, :2] = np.diff(ways, axis=0) / _STEP
        self._places.assign(places)
        self._speeds.assign(speeds)
        # Newton takes the mean of the coefficients of two shapes; table and outline have none.
        coefficients = np.zeros(self._plate.shape_count, dtype=np.float32)
        coefficients[: self._n_cells + 1] = 2.0 * friction
        self._plate.shape_material_mu.assign(coefficients)
        first = np.array([[*start[:2], -_SINK, *quaternion_of_yaw(start[2])], places[0]], dtype=np.float32)
        self._states[0].body_q.assign(first)
        self._states[0].body_qd.zero_()
        self._wp.capture_launch(self._forward)
        self._frames = np.clip(np.rint((times - path.time[0]) / _STEP).astype(np.intp), 0, n_steps)
        self._seen = np.array([self._states[k].body_q.numpy()[0] for k in self._frames], dtype=np.float64)
        yaw = 2.0 * np.arctan2(self._seen[:, 5], self._seen[:, 6])
        return np.column_stack([self._seen[:, :2], np.unwrap(np.r_[start[2], yaw])[1:]])

    def gradient(self, by_pose: Float64Array) -> Float64Array:
        """Derivatives by the friction of each cell and of the pusher, shape (n_cells + 1,), of a loss of the poses of the last simulation,
        whose derivatives by these are `by_pose`, shape (n, 3)."""
        self._tape.zero()
        seeds: dict[int, Float64Array] = {}
        for k, q, (x, y, yaw) in zip(self._frames.tolist(), self._seen, by_pose, strict=True):
            seeds.setdefault(k, np.zeros((2, 7)))[0] += [x, y, 0.0, 0.0, 0.0, 2.0 * yaw * q[6], -2.0 * yaw * q[5]]
        for k, seed in seeds.items():
            self._states[k].body_q.grad.assign(seed.astype(np.float32))
        self._wp.capture_launch(self._backward)
        gradient: Float64Array = self._plate.shape_material_mu.grad.numpy()[: self._n_cells + 1].astype(np.float64)
        return 2.0 * gradient


def _build(newton: Any, wp: Any, model: ObjectModel, radius: float) -> Any:
    """Plate and ball; the feet are the first shapes, then the ball."""
    builder = newton.ModelBuilder(gravity=wp.vec3(0.0, 0.0, -GRAVITY))
    config, total, n = newton.ModelBuilder.ShapeConfig, model.total_mass, len(model.mass)
    foot, springs = total / n, total * GRAVITY / n / _SINK
    of_feet = config(density=0.0, ke=springs, kd=2.0 * math.sqrt(springs * foot), kf=_VISCOUS * foot / _STEP, collision_group=1)
    damping = 2.0 * math.sqrt(_STIFFNESS * total)
    of_sides = config(density=0.0, ke=_STIFFNESS, kd=damping, kf=_VISCOUS * total / _STEP, collision_group=2)
    centres = model.shape.cells.centres
    centre = model.mass @ centres / total
    about = float(model.mass @ (np.sum((centres - centre) ** 2, axis=1) + model.shape.cells.areas / 6))
    inertia = wp.mat33(np.diag([about / 2, about / 2, about]))
    plate = builder.add_link(mass=total, com=wp.vec3(*centre, 0.0), inertia=inertia, lock_inertia=True)
    ball = builder.add_link(mass=1.0, inertia=wp.mat33(np.eye(3)), lock_inertia=True, is_kinematic=True)
    for x, y in centres:
        builder.add_shape_sphere(plate, xform=wp.transform(wp.vec3(x, y, _LOW)), radius=_LOW, cfg=of_feet)
    builder.add_shape_sphere(ball, radius=radius, cfg=of_sides)
    low, high = model.shape.outline.min(axis=0), model.shape.outline.max(axis=0)
    middle, (half_x, half_y) = wp.vec3(*((low + high) / 2), _LOW), (high - low) / 2
    builder.add_shape_box(plate, xform=wp.transform(middle), hx=half_x, hy=half_y, hz=_LOW / 2, cfg=of_sides)
    builder.add_ground_plane(cfg=of_feet)
    return builder.finalize(requires_grad=True, skip_validation_joints=True)
