"""Whatever joint states say, the arm is never told to turn faster, or to accelerate more, than its limits allow."""

from __future__ import annotations

import os

import numpy as np
import pytest

from helpers.corrupted_states import POSITIONS, TIMES, ArmTruth, Corruption, corrupting
from helpers.memory_cell import CONTACT, SETTINGS, Bench
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.command_link import stand_at
from push_ident.pushing.motion import joint_limits

STREAMS = int(os.environ.get("STREAMS", "24"))
"""Random streams of states; `make states STREAMS=10000` for more."""
SEED = int(os.environ.get("SEED", "1"))
ROUNDING = 2e-3
STATES = 300
"""Of a push, up to its rest."""


@pytest.mark.parametrize("stream", range(STREAMS))
def test_no_stream_of_states_makes_the_arm_exceed_a_limit(kinematics: ArmKinematics, stream: int) -> None:
    rng = np.random.default_rng([SEED, stream])
    bench = Bench(kinematics)
    bench.cell.is_simulated = bool(rng.random() < 0.3)
    truth = ArmTruth(bench.cell, joint_limits(kinematics, SETTINGS.motion))
    # The time of a simulated cell is what its stamps say; that of a real one passes whatever they say.
    kinds = POSITIONS if bench.cell.is_simulated else POSITIONS + TIMES
    corruptions = [Corruption.draw(rng, kinds, STATES, kinematics.n_joints) for _ in range(rng.integers(1, 4))]
    bench.cell.corrupt = corrupting(corruptions)
    for _ in range(1 + (rng.random() < 0.25)):
        outcome = bench.push(CONTACT)
        bench.cell.sleep(0.5)
    truth.look()
    assert max(truth.velocity, truth.acceleration) <= 1.0 + ROUNDING, f"{bench.cell.is_simulated} {corruptions}: {outcome.error}"
    assert outcome.error is None or str(outcome.error)


def test_a_step_of_a_hundredth_of_a_radian_within_a_piece_would_be_noticed(kinematics: ArmKinematics) -> None:
    bench = Bench(kinematics)
    truth = ArmTruth(bench.cell, joint_limits(kinematics, SETTINGS.motion))
    bench.cell.send(kinematics.joint_names, stand_at(bench.cell.q, 0.03), None)
    bench.cell.sleep(0.1)
    bench.cell.send(kinematics.joint_names, stand_at(bench.cell.q + 0.01, 0.03), None)
    bench.cell.sleep(0.1)
    truth.look()
    assert truth.acceleration == pytest.approx(6.0 * 0.01 / 0.03**2 / 10.0, rel=0.01)
