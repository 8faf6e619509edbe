"""The change of a motion by small forces in its steps: equal to the derivative by effects that are such forces."""

from __future__ import annotations

import numpy as np

from helpers.objects import hammer, random_records
from push_ident.geometry.se2 import rotation
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY, body_of_cells, simulate_body, simulate_body_with_response
from push_ident.physics.tape import N_BODY_PARAMETERS


def test_response_equals_the_derivative_by_effects_with_the_same_law() -> None:
    """A tilt pulls with the weight, an offset displaces the tool: both act in all steps. The camera's scale applies to poses only."""
    model = hammer(1)
    body = body_of_cells(model.shape, model.mass, model.friction)
    effects = {"camera_scale": [0.1], "table_tilt": [0.0, 0.0], "tool_offset": [0.0, 0.0]}
    for record in random_records(model, 3, 4):
        scenario = PushScenario(
            record.pusher, record.poses.pose[0], record.poses.time, force_time=np.linspace(0.05, record.poses.time[-1], 7)
        )
        by_effects = simulate_body(model.shape, body, 0.3, scenario, effects=effects, jacobian=True)
        first = N_BODY_PARAMETERS + len(model.shape.cells) + 1
        motion, response = simulate_body_with_response(model.shape, body, 0.3, scenario, effects=effects)
        assert response is not None
        n_steps = len(response.time)
        weight, offset = np.zeros((n_steps, 3, 2)), np.zeros((n_steps, 2, 2))
        weight[:, [0, 1], [0, 1]] = body.mass * GRAVITY
        offset[:, [0, 1], [0, 1]] = 1.0
        changes = (response(weight), response(np.zeros((n_steps, 3, 2)), offset))
        for kind, expected in enumerate((by_effects.jacobian, by_effects.impulse_jacobian)):
            expected = expected[:, :, first : first + 4]
            assert np.max(np.abs(expected)) > 0.05
            np.testing.assert_allclose(changes[0][kind], expected[:, :, :2], atol=1e-10)
            np.testing.assert_allclose(changes[1][kind], expected[:, :, 2:], atol=1e-8 if kind else 1e-10)
        # Steps are where the motion is.
        turn = rotation(motion.pose[-1, 2])
        centre = motion.pose[-1, :2] / 1.1 + turn @ body.centre
        np.testing.assert_allclose(response.pose[-1, :2], centre, atol=1e-6)
        np.testing.assert_allclose(response.limit.sum(), GRAVITY * model.mass @ model.friction)
