"""The impulse of the pusher: Newton's second law, closed forms, and its derivative against differences of known accuracy."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from helpers.differences import compare_columns
from helpers.random_pushes import ENGINES, Case, random_case, steps_of
from push_ident.errors import InputError
from push_ident.physics.effect_values import EffectValues, effect_values
from push_ident.physics.effects import CAUSES, EFFECTS
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY, BodyParameters, Motion, SimulationSettings, simulate, simulate_body
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape, PusherPath, SolveStatus

ORDER = 3.0


def simulated(case: Case, q: Float64Array, mode: str, effects: EffectValues, *, jacobian: bool = False) -> Motion:
    """A case with other parameters, in the order of `Motion.jacobian`; impulses at times within steps and at the end."""
    n = 8 + len(case.body.limit)
    times = np.r_[case.pusher.time[1:-1] + 0.4 * np.diff(case.pusher.time[1:]), case.pusher.time[-1]]
    return simulate_body(
        case.model.shape,
        BodyParameters(q[3], q[4:6], q[6], q[8:n]),
        q[7],
        PushScenario(case.pusher, q[:3], case.pusher.time, ORDER, times),
        settings=ENGINES[mode],
        effects=effects.with_values(q[n:]),
        jacobian=jacobian,
    )


def compare(case: Case, mode: str, effects: EffectValues) -> tuple[set[str], Float64Array, Float64Array]:
    """What the contact does; relative error of each column of the derivative; relative uncertainty of its differences."""
    body = case.body
    point = np.r_[case.pose, body.mass, body.centre, body.inertia, case.model.pusher_friction, body.limit, effects.values]
    typical = [p.typical for p in effects.parameters]
    scale = np.r_[0.05, 0.05, 1.0, body.mass, 0.05, 0.05, body.inertia, 0.5, np.full(len(body.limit), body.limit.mean()), typical]
    motion = simulated(case, point, mode, effects, jacobian=True)
    assert motion.status is not SolveStatus.SIMULATION_FAILED
    whole = float(np.abs(motion.impulse).max())
    errors, doubts = compare_columns(
        lambda q: simulated(case, q, mode, effects).impulse, motion.impulse_jacobian, point, scale, n_body=8 + len(body.limit), whole=whole
    )
    return {step.kind for step in steps_of(case, case.simulate(ENGINES[mode]))}, errors, doubts


@pytest.mark.parametrize("mode", ENGINES)
def test_derivative_of_the_impulse_equals_differences(mode: str) -> None:
    compared: Counter[str] = Counter()
    worst, doubtful, total = 0.0, 0, 0
    for seed in range(8):
        kinds, errors, doubts = compare(random_case(seed, 9 + seed % 7, seed % 2 == 1, 5), mode, effect_values(None))
        sure = doubts < 1e-6
        doubtful, total = doubtful + int(np.sum(~sure)), total + len(sure)
        worst = max(worst, float(errors[sure].max(initial=0.0)))
        compared.update({kind: int(np.sum(sure)) for kind in kinds})
    print(f"{mode}: {total - doubtful} of {total} columns, error {worst:.1e}, {dict(compared)}")
    assert worst <= 1e-5 and doubtful <= 0.25 * total
    assert all(compared[kind] > 0 for kind in ("sticking", "sliding")), compared


@pytest.mark.parametrize("name", CAUSES)
def test_derivative_with_effects_equals_differences(name: str) -> None:
    values = [parameter.nominal + (0.5 * parameter.typical or 0.0) for parameter in EFFECTS[name].parameters]
    worst, sure_columns = 0.0, 0
    for seed in range(2):
        _, errors, doubts = compare(random_case(seed, 9, False, 5), "circle", effect_values({name: values, "table_tilt": [0.02, 0.01]}))
        sure = doubts < 1e-6
        sure_columns += int(np.sum(sure))
        worst = max(worst, float(errors[sure].max(initial=0.0)))
    assert worst <= 1e-5 and sure_columns >= 20


def plate(friction: float) -> ObjectModel:
    centres = np.array([[x, y] for x in (-0.02, 0.0, 0.02) for y in (-0.02, 0.0, 0.02)])
    outline = 0.03 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return ObjectModel(ObjectShape(CellGrid(centres, 0.02), outline), np.full(9, 0.1), np.full(9, friction), 0.3)


def test_force_of_a_steady_push_through_the_centre_is_the_friction_of_the_object() -> None:
    time = np.array([0.0, 1.0])
    pusher = PusherPath(time, np.array([[-0.05, 0.0], [0.05, 0.0]]), 0.01)
    motion = simulate(plate(0.4), PushScenario(pusher, np.zeros(3), time, force_time=np.array([0.5, 0.8])))
    force = (motion.impulse[1] - motion.impulse[0]) / 0.3
    # At 0.1 m/s the smoothing speed of 1e-4 m/s takes half a millionth of the friction.
    assert force == pytest.approx([0.4 * 0.9 * GRAVITY, 0.0], rel=1e-5, abs=1e-5)


def test_impulse_is_the_gain_of_momentum_and_what_friction_took() -> None:
    time = np.array([0.0, 0.3])
    pusher = PusherPath(time, np.array([[-0.05, 0.004], [0.01, 0.004]]), 0.01)
    fine = SimulationSettings(step=1 / 2000)
    free = simulate(plate(0.0), PushScenario(pusher, np.zeros(3), time, force_time=np.array([0.25])), settings=fine)
    early, late = simulate(plate(0.0), PushScenario(pusher, np.zeros(3), np.array([0.25, 0.26])), settings=fine).pose
    velocity = (late - early)[:2] / 0.01
    assert free.impulse[0] == pytest.approx(0.9 * velocity, rel=1e-3, abs=1e-4)


def test_times_of_impulses_are_checked_and_a_late_one_prolongs_the_push() -> None:
    pusher = PusherPath(np.array([0.0, 0.2]), np.array([[-0.05, 0.0], [-0.03, 0.0]]), 0.01)
    late = simulate(plate(0.3), PushScenario(pusher, np.zeros(3), np.array([0.2]), force_time=np.array([0.1, 0.9])))
    assert late.force_time[-1] > 0.89 and late.impulse.shape == (2, 2) and late.impulse_jacobian.shape == (2, 2, 0)
    with pytest.raises(InputError, match="impulses must be finite and ascend"):
        PushScenario(pusher, np.zeros(3), np.array([0.2]), force_time=np.array([0.2, 0.1]))
