"""Time steps that the noise demands, and the scheme that resolves events."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from helpers.objects import square, uniform
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.outline import polygon_area, polygon_centroid
from push_ident.physics.accuracy import SHARE, choose_steps, step_error
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.types import Float64Array, ObjectModel, ObjectShape, PusherPath

RADIUS = 0.00475
"""Of the pusher [m]."""
FINE = SimulationSettings(step=1 / 30720, resolve_events=True)
NOISE = {"1 mm": np.diag([1e-3, 1e-3, 0.01]) ** 2, "0.1 mm": np.diag([1e-4, 1e-4, 1e-3]) ** 2}


_ANGLE = np.arange(48) * 2 * np.pi / 48
OUTLINES = (
    np.array([[-0.045, -0.045], [0.045, -0.045], [0.045, 0.045], [-0.045, 0.045]]),
    np.array([[0.0, 0.0], [0.12, 0.0], [0.0, 0.12]]),
    np.column_stack([0.0525 * np.cos(_ANGLE), 0.065 * np.sin(_ANGLE)]),
    np.array([[0.0, 0.0], [0.12, 0.0], [0.12, 0.05], [0.05, 0.05], [0.05, 0.12], [0.0, 0.12]]),
)


class _Push:
    """A random push of a random object at a speed [m/s]; `ramp` [s] is the time in which the pusher speeds up and brakes."""

    def __init__(self, seed: int, speed: float, ramp: float) -> None:
        rng = np.random.default_rng(seed)
        outline = OUTLINES[seed % len(OUTLINES)] - np.array(polygon_centroid(OUTLINES[seed % len(OUTLINES)]))
        shape = ObjectShape(cells_in_outline(outline, np.sqrt(polygon_area(outline) / 60)), outline)
        weight = np.exp(shape.cells.centres @ rng.normal(size=2) * 10)
        coefficient = rng.choice([0.05, 0.1, 0.2, 0.5, 0.8])
        mass = rng.uniform(0.3, 1.5) * weight / weight.sum()
        self.model = ObjectModel(shape, mass, np.full(len(mass), coefficient), rng.uniform(0.1, 0.5))
        length, gap = rng.uniform(0.02, 0.08), rng.uniform(0.006, 0.01)
        edge = int(rng.integers(len(outline)))
        along = outline[(edge + 1) % len(outline)] - outline[edge]
        normal = np.array([along[1], -along[0]]) / np.linalg.norm(along)
        turn = rng.uniform(-0.7, 0.7)
        heading = -np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ normal
        start = outline[edge] + rng.uniform(0.1, 0.9) * along + normal * RADIUS - gap * heading
        duration, coast = (length + gap) / speed + ramp, 0.05 + 1.5 * speed / (9.81 * coefficient)
        time = np.r_[0.0, 0.1037, 0.1037 + duration, 0.1037 + duration + coast]
        travel = np.r_[0.0, 0.0, length + gap, length + gap]
        if ramp > 0:
            time = np.arange(0.0, time[-1], 1 / 250)
            t = np.clip(time - 0.1037, 0.0, duration)
            travel = np.where(t < ramp, 0.5 * speed * t**2 / ramp, speed * (t - 0.5 * ramp))
            travel = np.where(t > duration - ramp, length + gap - 0.5 * speed * (duration - t) ** 2 / ramp, travel)
        self.scenario = PushScenario(PusherPath(time, start + travel[:, None] * heading, RADIUS), np.zeros(3), time[-1:])

    def end(self, settings: SimulationSettings) -> Float64Array:
        return simulate(self.model, self.scenario, settings=settings).pose[-1]


@pytest.mark.parametrize("ramp", [0.0, 0.05])
@pytest.mark.parametrize("speed", [0.05, 0.2, 0.5])
def test_halving_the_chosen_steps_moves_the_end_by_less_than_a_tenth_of_the_noise(speed: float, ramp: float) -> None:
    pushes = [_Push(seed, speed, ramp) for seed in range(8)]
    ends = [cache(push.end) for push in pushes]
    for noise, covariance in NOISE.items():
        whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        choices = [choose_steps(end, SimulationSettings(), covariance, p.scenario.duration) for p, end in zip(pushes, ends, strict=True)]
        effects = [choice.error for choice in choices]
        errors = [np.linalg.norm(whitening @ (end(choice.settings) - end(FINE))) for end, choice in zip(ends, choices, strict=True)]
        if noise == "0.1 mm" and speed == 0.5:  # here the number of steps is bounded
            assert max(effects) < 0.6
            continue
        # Where poses are known to 0.1 mm, one push in eight may come near a kink of its motion.
        assert sum(effect >= SHARE for effect in effects) <= (1 if noise == "0.1 mm" else 0), effects
        # The error itself is twice the effect of halving at first order.
        assert np.median(errors) < 2 * SHARE and np.quantile(errors, 0.8) < 0.3, errors


def test_released_object_coasts_as_far_as_friction_allows() -> None:
    """Pushed through its centre: v^2 / (2 mu g) after the pusher stops."""
    speed, mu, stop = 0.3, 0.2, -0.06 + 0.2011 * 0.3
    pusher = PusherPath(np.array([0.0, 0.2011, 0.6]), np.array([[-0.06, 0.0], [stop, 0.0], [stop, 0.0]]), RADIUS)
    exact, scenario = stop + RADIUS + 0.045 + speed**2 / (2 * mu * 9.81), PushScenario(pusher, np.zeros(3), pusher.time[-1:])
    equal, resolved = (
        abs(
            simulate(
                uniform(square(), friction=mu, pusher_friction=0.0), scenario, settings=SimulationSettings(resolve_events=resolve)
            ).pose[-1, 0]
            - exact
        )
        for resolve in (False, True)
    )
    assert resolved < 2e-5 and equal > 10 * resolved


def test_steps_that_were_given_are_kept() -> None:
    given = SimulationSettings(step=1 / 100)
    choice = choose_steps(lambda settings: pytest.fail("simulated"), given, NOISE["1 mm"], 1.0)
    assert (choice.settings, choice.level) == (given, 0)


def test_push_without_a_limit_keeps_its_first_steps_and_a_large_error() -> None:
    rng = np.random.default_rng(0)
    jump = lambda settings: rng.normal(size=3)  # noqa: E731
    choice = choose_steps(jump, SimulationSettings(), NOISE["1 mm"], 1.0)
    assert choice.level == 0 and choice.error >= SHARE
    assert step_error(jump, choice.settings, NOISE["1 mm"]) >= SHARE
