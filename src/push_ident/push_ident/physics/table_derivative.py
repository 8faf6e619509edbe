"""Exact derivative of the effects between table and cells in one step, by the complex step (compiled)."""

from __future__ import annotations

import numpy as np

from push_ident.physics.active_effects import N_FIXED_INPUTS, N_SUMS, ActiveEffects
from push_ident.physics.effect import STEP_OF_INPUT, equation
from push_ident.physics.kernel import kernel
from push_ident.physics.step_geometry import StepGeometry
from push_ident.physics.support import cell_friction
from push_ident.physics.table import EVERY_INPUT, TableScratch, body_of, load_of
from push_ident.physics.table_laws import all_loads, all_planes, all_pulls, all_skews
from push_ident.types import Float64Array

__all__ = ["table_sensitivity"]


@equation
def _weigh_forces(effects: ActiveEffects, arms: Float64Array, scratch: TableScratch) -> None:
    """Friction of each cell per factor of each effect that loads it, at the factors of all others; for planes, its moments suffice."""
    factors, force = scratch.factors, scratch.force
    for place in effects.loading:
        weighted, moments = scratch.weighted[place], scratch.moments[place]
        for i in range(arms.shape[1]):
            rest = 1.0
            for other in effects.loading:
                rest *= factors[other, i] if other != place else 1.0
            if rest * factors[place, i] < 0.0:
                rest = 0.0
            for j in range(3):
                weighted[j, i] = rest * force[j, i]
        for j in range(3):
            even = x = y = 0.0
            for i in range(arms.shape[1]):
                even += weighted[j, i]
                x += weighted[j, i] * arms[0, i]
                y += weighted[j, i] * arms[1, i]
            moments[j, 0], moments[j, 1], moments[j, 2] = even, x, y


@kernel
def table_sensitivity(
    effects: ActiveEffects,
    twist: Float64Array,
    geometry: StepGeometry,
    limit: Float64Array,
    skew: Float64Array,
    eps: float,
    scratch: TableScratch,
    seeds: Float64Array,
) -> None:
    """Derivative of the impulse on the object that the effects change, by all inputs, at the twist after the step.

    Kept whole: its parts share all arrays of the scratch, and it runs once a step.

    Args:
        effects: the active effects.
        twist: after the step, object axes, shape (3,).
        geometry: the object.
        limit: friction limit of each cell without effects [N], shape (n_cells,).
        skew: (a, b) in this step, shape (2,).
        eps: smoothing speed [m/s].
        scratch: as `table_action` left it.
        seeds: filled in the columns of a step's block that belong to inputs [N s, N s, N m s], shape (3, n_columns).
    """
    centre, arms, dt = geometry.centre, geometry.arms, geometry.dt
    inputs, turned, factor, force = scratch.inputs, scratch.turned, scratch.factor, scratch.force
    n_values = effects.values.shape[0]
    n_inputs = N_FIXED_INPUTS + effects.n_memory + n_values
    along_a, along_b = np.zeros(3), np.zeros(3)
    cell_friction(twist, arms, limit, skew, eps, force)
    if effects.skews:
        unit = np.zeros((3, arms.shape[1]))
        for which in range(2):
            # Contribution of E = [[1, 0], [0, -1]] or [[0, 1], [1, 0]].
            direction = np.zeros(2)
            direction[which] = 1.0
            cell_friction(twist, arms, limit, direction, eps, unit)
            total = along_a if which == 0 else along_b
            for i in range(arms.shape[1]):
                for j in range(3):
                    total[j] += factor[i] * unit[j, i]
        cell_friction(twist, arms, limit, np.zeros(2), eps, unit)
        for i in range(arms.shape[1]):
            for j in range(3):
                along_a[j] -= factor[i] * unit[j, i]
                along_b[j] -= factor[i] * unit[j, i]
    if effects.loads:
        _weigh_forces(effects, arms, scratch)
    unit_inputs = scratch.unit
    unit_inputs[:] = inputs
    unit_inputs[n_inputs - n_values : n_inputs] = 0.0
    body, _, _ = body_of(effects, inputs, centre)
    turned[:] = inputs
    for k in range(n_inputs + N_SUMS if effects.shifts else n_inputs):
        column = 3 + k if k < N_FIXED_INPUTS else 5 + k
        is_sum = k >= n_inputs
        if k >= n_inputs - n_values and not is_sum:
            if not effects.on_table[k - (n_inputs - n_values)]:
                continue
            if effects.pulled[k - (n_inputs - n_values)]:
                unit_inputs[k] = 1.0
                fx, fy, torque = all_pulls(effects.places, unit_inputs, body)
                unit_inputs[k] = 0.0
                seeds[0, column] = dt * (body.cos * fx + body.sin * fy)
                seeds[1, column] = dt * (body.cos * fy - body.sin * fx)
                seeds[2, column] = dt * torque
                continue
        turned[k] += STEP_OF_INPUT * 1j
        turned_body, dx, dy = body_of(effects, turned, centre)
        a = b = gx = gy = gt = 0.0
        if effects.skews and not is_sum:
            skew_a, skew_b = all_skews(effects.places, turned, turned_body)
            a, b = skew_a.imag, skew_b.imag
        if effects.pulls and not is_sum:
            pull_x, pull_y, pull_torque = all_pulls(effects.places, turned, turned_body)
            gx = (turned_body.cos * pull_x + turned_body.sin * pull_y).imag
            gy = (turned_body.cos * pull_y - turned_body.sin * pull_x).imag
            gt = pull_torque.imag
        if effects.loads:
            if effects.planes:
                load = load_of(effects, turned, dx, dy)
                all_planes(effects.places, turned, EVERY_INPUT if is_sum else k, turned_body, load, dx, dy, scratch.d_planes)
            if effects.uneven and not is_sum:
                all_loads(effects.places, turned, k, turned_body, arms, dx, dy, scratch.d_factors)
            for place in effects.loading:
                if effects.is_plane[place]:
                    d_plane, moments = scratch.d_planes[place], scratch.moments[place]
                    for j in range(3):
                        gx -= d_plane[j].imag * moments[0, j]
                        gy -= d_plane[j].imag * moments[1, j]
                        gt -= d_plane[j].imag * moments[2, j]
                elif not is_sum:
                    d_factor, weighted = scratch.d_factors[place], scratch.weighted[place]
                    for i in range(arms.shape[1]):
                        gx -= d_factor[i].imag * weighted[0, i]
                        gy -= d_factor[i].imag * weighted[1, i]
                        gt -= d_factor[i].imag * weighted[2, i]
        turned[k] = inputs[k]
        gx -= a * along_a[0] + b * along_b[0]
        gy -= a * along_a[1] + b * along_b[1]
        gt -= a * along_a[2] + b * along_b[2]
        scale = dt / STEP_OF_INPUT
        seeds[0, column], seeds[1, column], seeds[2, column] = scale * gx, scale * gy, scale * gt
