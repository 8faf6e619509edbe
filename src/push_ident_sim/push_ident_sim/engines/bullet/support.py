"""Effects between table and object, and the wrench that makes Coulomb friction of Bullet's.

Everything is computed from the state at the start of a time step and holds during that step: what the friction, load and mass of each cell
become, and which forces come on top.

For each contact Bullet projects on the friction cone after dividing the slip velocity, axis by axis, by the effective inverse mass D of
the contact along the two axes of the table. A sliding contact so gets the friction -L (v_x/D_x, v_y/D_y)/|...| in place of -L v/|v|.
Where D_x = D_y, in the middle of the object, both are the same; at the ends of a long object the direction has an error of up to
30 degrees.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from push_ident.geometry.se2 import rotation
from push_ident.physics.effect import OnTable
from push_ident.types import Float64Array
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.injected.equations import TableEquations, acts_by_equation
from push_ident_sim.injected.shared import push_height, tether_anchor
from push_ident_sim.objects import SimObject


def cone_friction_correction(
    arms: Float64Array,
    mass: Float64Array,
    cell_size: float,
    limit: Float64Array,
    velocity: Float64Array,
    *,
    anisotropy: Float64Array | None = None,
    lowest_speed: float = 1e-4,
) -> Float64Array:
    """Coulomb friction minus what Bullet applies on sliding cells: (fx, fy) [N] and torque about the frame origin [N m], shape (3,).

    Args:
        arms: cells from the origin of the object frame [m], shape (n_cells, 2), axes of the table.
        mass: [kg], shape (n_cells,).
        cell_size: edge of a cell [m].
        limit: friction force of each cell when it slides [N], shape (n_cells,).
        velocity: (vx, vy, yaw rate) of the object frame [m/s, m/s, rad/s], shape (3,), axes of the table.
        anisotropy: E of a table with grain, where friction is -L (I + E) v/|v|, shape (2, 2), axes of the table; None is 0.
        lowest_speed: slower cells [m/s] are not corrected: Bullet holds them.
    """
    slip = velocity[:2] + velocity[2] * np.column_stack([-arms[:, 1], arms[:, 0]])
    speed = np.hypot(slip[:, 0], slip[:, 1])
    total = mass.sum()
    from_centre = arms - mass @ arms / total
    inertia = mass @ (np.sum(from_centre**2, axis=1) + cell_size**2 / 6.0)
    inverse_mass = 1.0 / total + from_centre[:, ::-1] ** 2 / inertia
    weighted = slip / inverse_mass
    sliding = speed > lowest_speed
    # Both speeds are zero together; such a cell does not count.
    bullet = weighted / np.maximum(np.hypot(weighted[:, 0], weighted[:, 1]), 1e-12)[:, None]
    coulomb = slip / np.maximum(speed, lowest_speed)[:, None]
    if anisotropy is not None:
        coulomb += coulomb @ anisotropy.T
    force = (limit * sliding)[:, None] * (bullet - coulomb)
    return np.array([*force.sum(axis=0), np.sum(arms[:, 0] * force[:, 1] - arms[:, 1] * force[:, 0])])


_MIN_SHARE = 0.05
"""Of its friction, load or mass that a cell keeps under any effect."""


@dataclass(frozen=True, slots=True)
class _CellMotion:
    """The cells at one moment; `table` axes."""

    position: Float64Array
    """[m], shape (n_cells, 2)."""
    slip: Float64Array
    """Velocity on the table [m/s], shape (n_cells, 2)."""
    speed: Float64Array
    """[m/s], shape (n_cells,)."""
    n_pushes: int
    """Pushes that are over."""


def _stribeck(values: Float64Array, cells: _CellMotion) -> Float64Array:
    strength, speed = values
    return np.asarray(1.0 + strength * np.exp(-((cells.speed / speed) ** 2)))


_FRICTION_FACTORS: dict[str, Callable[[Float64Array, _CellMotion], Float64Array]] = {
    "position_dependent_friction": lambda gradient, cells: 1.0 + cells.position @ gradient,
    "speed_dependent_friction": lambda b, cells: 1.0 + b * np.log((cells.speed + 0.01) / 0.11),
    "stribeck_friction": _stribeck,
    "wear": lambda w, cells: np.full(len(cells.speed), 1.0 + w[0] * cells.n_pushes),
}
_ACTING = (
    *_FRICTION_FACTORS,
    "table_anisotropy",
    "base_anisotropy",
    "push_height",
    "tether",
    "moving_contents",
    "compliant_table",
    "viscous_film",
)


@dataclass(frozen=True, slots=True)
class SupportAction:
    """What the engine needs before a time step."""

    friction: Float64Array
    """Friction coefficient of each cell, shape (n_cells,)."""
    mass: Float64Array
    """Of each cell [kg], shape (n_cells,)."""
    load: Float64Array
    """Downward force on each cell in addition to its weight [N], shape (n_cells,)."""
    wrench: Float64Array
    """(fx, fy) [N] and torque about the frame origin [N m] on the object, shape (3,), axes of the table."""


class SupportEffects:
    """The support of one object under `effects`, step by step."""

    def __init__(self, sim_object: SimObject, effects: InjectedEffects, gravity: float) -> None:
        """`gravity` is its component along the table's normal [m/s^2]."""
        self.n_pushes = 0
        """Pushes that are over."""
        self._sim_object = sim_object
        self._effects = effects
        self._gravity = gravity
        self._centre = sim_object.mass @ sim_object.cells / sim_object.mass.sum()
        self._factors = [(law, np.array(effects[name])) for name, law in _FRICTION_FACTORS.items() if name in effects]
        self._grain = [_traceless(*effects[name]) for name in ("table_anisotropy", "base_anisotropy")]
        self._height = push_height(effects, sim_object)
        self._equations = TableEquations(sim_object, effects)
        self.start(np.zeros(3))

    @staticmethod
    def needed(effects: InjectedEffects) -> bool:
        """Whether any effect acts between table and object."""
        return any(name in effects for name in _ACTING) or acts_by_equation(effects, OnTable)

    def start(self, pose: Float64Array) -> None:
        """The object was placed at `pose` (x, y, yaw)."""
        self._anchor = tether_anchor(self._effects, pose[:2] + rotation(pose[2]) @ self._centre)
        self._equations.start()
        self._contents = np.zeros(2)
        self._push_force = np.zeros(2)
        self._shear = np.zeros((len(self._sim_object), 2))

    def advance(self, pose: Float64Array, velocity: Float64Array, push_force: Float64Array, time_step: float) -> SupportAction:
        """The next time step.

        Args:
            pose: (x, y, yaw) of the object frame.
            velocity: (vx, vy, yaw rate) of the object frame [m/s, m/s, rad/s].
            push_force: of the pusher on the object in the last step [N], shape (2,).
            time_step: [s].
        """
        sim_object = self._sim_object
        turn = rotation(pose[2])
        arms = sim_object.cells @ turn.T
        slip = velocity[:2] + velocity[2] * np.column_stack([-arms[:, 1], arms[:, 0]])
        cells = _CellMotion(pose[:2] + arms, slip, np.hypot(slip[:, 0], slip[:, 1]), self.n_pushes)

        friction = sim_object.friction.copy()
        for law, values in self._factors:
            friction *= np.maximum(law(values, cells), _MIN_SHARE)
        mass = self._moved_mass(turn, velocity, time_step)
        load = self._lean(arms, mass, push_force, time_step)
        limit = friction * (mass * self._gravity + load)
        anisotropy = self._grain[0] + turn @ self._grain[1] @ turn.T
        centre = turn @ self._centre
        if self._equations:
            moved = velocity[:2] + velocity[2] * np.array([-centre[1], centre[0]])
            change = self._equations.advance(
                np.array([*(pose[:2] + centre), pose[2]]), np.array([*moved, velocity[2]]), limit, time_step, self.n_pushes
            )
            friction *= change.factor
            limit *= change.factor
            anisotropy += turn @ _traceless(*change.skew) @ turn.T

        if "compliant_table" in self._effects:
            (travel,) = self._effects["compliant_table"]
            force = self._sheared(slip, limit, mass, travel, time_step) @ (np.eye(2) + anisotropy).T
            wrench = _sum(arms, force)
            friction = np.zeros_like(friction)
        else:
            wrench = cone_friction_correction(arms, mass, sim_object.cell_size, limit, velocity, anisotropy=anisotropy)
        if "viscous_film" in self._effects:
            wrench += _sum(arms, -self._effects["viscous_film"][0] / len(sim_object) * slip)
        if "tether" in self._effects:
            wrench += _sum(centre[None], -self._effects["tether"][0] * (pose[:2] + centre - self._anchor)[None])
        if self._equations:
            wrench += _sum(centre[None], change.wrench[None, :2])
            wrench[2] += change.wrench[2]
        return SupportAction(friction, mass, load, wrench)

    def _moved_mass(self, turn: Float64Array, velocity: Float64Array, time_step: float) -> Float64Array:
        """Masses after the contents have slid back against the motion of the object."""
        mass = self._sim_object.mass
        if "moving_contents" not in self._effects:
            return mass
        distance, lag = self._effects["moving_contents"]
        speed = float(np.hypot(*velocity[:2]))
        if speed > 5e-3:  # loose contents stay where they are in a slower object [m/s]
            behind = -distance * (velocity[:2] / speed) @ turn
            self._contents += (1.0 - np.exp(-time_step / lag)) * (behind - self._contents)
        return _tilted(mass, self._sim_object.cells, self._contents)

    def _lean(self, arms: Float64Array, mass: Float64Array, push_force: Float64Array, time_step: float) -> Float64Array:
        """Load that a push above the table moves from the near to the far side."""
        if "push_height" not in self._effects:
            return np.zeros(len(mass))
        leaning_time = 0.02  # [s]: a contact force may last for one time step, a lean does not
        self._push_force += (1.0 - np.exp(-time_step / leaning_time)) * (push_force - self._push_force)
        weight = mass * self._gravity
        return _tilted(weight, arms, self._height / weight.sum() * self._push_force) - weight

    def _sheared(self, slip: Float64Array, limit: Float64Array, mass: Float64Array, travel: float, time_step: float) -> Float64Array:
        """Force of the table's surface on each cell: a spring that follows once it is stretched by `travel`."""
        self._shear += time_step * slip
        length = np.hypot(self._shear[:, 0], self._shear[:, 1])
        self._shear *= np.minimum(1.0, travel / np.maximum(length, 1e-12))[:, None]
        stiffness = limit / travel
        damping = 2.0 * 0.5 * np.sqrt(stiffness * mass)  # half of critical damping
        force = -stiffness[:, None] * self._shear - damping[:, None] * slip
        size = np.hypot(force[:, 0], force[:, 1])
        return np.asarray(force * np.minimum(1.0, limit / np.maximum(size, 1e-12))[:, None])


def _tilted(values: Float64Array, arms: Float64Array, shift: Float64Array) -> Float64Array:
    """`values` on cells at `arms`, changed linearly across them so that their centre moves by `shift`.

    Their sum stays, and none falls below a twentieth.
    """
    from_centre = arms - values @ arms / values.sum()
    spread = (values[:, None] * from_centre).T @ from_centre / values.sum()
    changed = values * np.maximum(1.0 + from_centre @ np.linalg.pinv(spread) @ shift, _MIN_SHARE)
    return np.asarray(changed * (values.sum() / changed.sum()))


def _sum(arms: Float64Array, force: Float64Array) -> Float64Array:
    """Wrench (3,) about the frame origin of a force on each cell."""
    return np.array([*force.sum(axis=0), np.sum(arms[:, 0] * force[:, 1] - arms[:, 1] * force[:, 0])])


def _traceless(e1: float, e2: float) -> Float64Array:
    return np.array([[e1, e2], [e2, -e1]])
