"""The difference between Coulomb's law and Bullet's cone friction, as a wrench that corrects it.

For each contact Bullet projects on the friction cone after dividing the slip velocity, axis by axis, by the effective inverse mass D of
the contact along the two axes of the table. A sliding contact so gets the friction -L (v_x/D_x, v_y/D_y)/|...| in place of -L v/|v|.
Where D_x = D_y, in the middle of the object, both are the same; at the ends of a long object the direction has an error of up to
30 degrees.
"""

from __future__ import annotations

import numpy as np

from push_ident.types import Float64Array


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
