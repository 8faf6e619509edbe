"""Whatever joint states say, the arm is never told to turn faster, or to accelerate more, than its limits allow."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from helpers.memory_cell import CONTACT, SETTINGS, Bench, Cell, largest_shares
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.arm_motion import JointLimits
from push_ident.pushing.command_link import stand_at
from push_ident.pushing.motion import joint_limits
from push_ident.pushing.push_request import FOLLOW
from push_ident.pushing.trajectory import JointTrajectory
from push_ident.types import Float64Array

State = tuple[float, Float64Array]
"""Stamp [s] and joint positions [rad]."""
STREAMS = int(os.environ.get("STREAMS", "24"))
"""Random streams of states; `make states STREAMS=10000` for more."""
SEED = int(os.environ.get("SEED", "1"))
ROUNDING = 2e-3
STATES = 300
"""Of a push, up to its rest."""


class Corruption:
    """One kind of lie about the states of a stream, at any time, for one state or for ever, from a thousandth of a radian to 3."""

    def __init__(self, rng: np.random.Generator, kinds: Sequence[str], n_joints: int) -> None:
        self.kind, self.rng = str(rng.choice(kinds)), rng
        self.first, self.n = int(rng.integers(-STATES // 4, STATES)), int(rng.choice([1, 2, 4, 8, 30, 100, 100_000]))
        self.size = float(rng.choice([-1, 1]) * np.exp(rng.uniform(math.log(1e-3), math.log(3.0))))
        """[rad], for `stamps` and `late` [s], for `scale` 1."""
        self.joints = rng.choice(n_joints, 2, replace=False)
        self.aside = self.size * np.eye(n_joints)[self.joints[0]]
        self.kept: State | None = None
        self.waiting: list[State] = []

    def __repr__(self) -> str:
        return f"{self.kind} of {self.size:g} at joints {self.joints} in {self.n} states from {self.first} on"

    def __call__(self, number: int, stamp: float, q: Float64Array) -> list[State]:
        """What is reported in place of a true state; `number` counts them."""
        if not self.first <= number < self.first + self.n:
            return [*self.released(len(self.waiting)), (stamp, q)]
        self.kept = self.kept or (stamp, q)
        if self.kind in POSITIONS:
            return [(stamp, POSITIONS[self.kind](self, number - self.first, q))]
        if self.kind in ("late", "reorder"):
            self.waiting.append((stamp, q))
        return OTHERS[self.kind](self, stamp, q)

    def released(self, n: int) -> list[State]:
        states, self.waiting = self.waiting[:n], self.waiting[n:]
        return states


POSITIONS: dict[str, Callable[[Corruption, int, Float64Array], Float64Array]] = {
    "offset": lambda lie, age, q: q + lie.aside,
    "swap": lambda lie, age, q: q + (q[lie.joints[::-1]] - q[lie.joints]) @ np.eye(len(q))[lie.joints],
    "spike": lambda lie, age, q: q + lie.aside * (lie.rng.random() < 0.3),
    "freeze": lambda lie, age, q: lie.kept[1],
    "scale": lambda lie, age, q: q * (1.0 + lie.size),
    "drift": lambda lie, age, q: q + lie.aside * age / 50,
    "noise": lambda lie, age, q: q + lie.size * lie.rng.normal(size=len(q)),
}
OTHERS: dict[str, Callable[[Corruption, float, Float64Array], list[State]]] = {
    "drop": lambda lie, stamp, q: [],
    "repeat": lambda lie, stamp, q: [lie.kept],
    "stamps": lambda lie, stamp, q: [(stamp + lie.size, q)],
    "late": lambda lie, stamp, q: lie.released(int(len(lie.waiting) > abs(lie.size) / 0.01)),
    "reorder": lambda lie, stamp, q: sorted(lie.released(4), key=lambda state: lie.rng.random()) if len(lie.waiting) == 4 else [],
}


def corrupting(corruptions: list[Corruption]) -> Callable[[float, Float64Array], list[State]]:
    """For `Cell.corrupt`: all of them, one after the other."""
    numbers = count()

    def corrupt(stamp: float, q: Float64Array) -> list[State]:
        number, states = next(numbers), [(stamp, q)]
        for corruption in corruptions:
            states = [lie for state in states for lie in corruption(number, *state)]
        return states

    return corrupt


class ArmTruth:
    """What an arm in memory really does with its commands, at every moment: largest share of a limit of velocity and of acceleration."""

    def __init__(self, cell: Cell, limits: JointLimits) -> None:
        self._cell, self._limits = cell, limits
        self._inner = cell.follow
        self.velocity = self.acceleration = 0.0
        self._since = cell.time
        cell.follow = self._follow  # type: ignore[method-assign]

    def _follow(self, piece: JointTrajectory) -> None:
        self.look()
        self._inner(piece)

    def look(self) -> None:
        """Up to now; at the end, too."""
        velocity, acceleration = largest_shares(self._cell.followed, self._since, self._cell.time, self._limits)
        self.velocity, self.acceleration = max(self.velocity, velocity), max(self.acceleration, acceleration)
        self._since = self._cell.time


GOALS = replace(SETTINGS, limits=replace(SETTINGS.limits, free_motions=FOLLOW))


@pytest.mark.parametrize("stream", range(STREAMS))
def test_no_stream_of_states_makes_the_arm_exceed_a_limit(kinematics: ArmKinematics, stream: int) -> None:
    rng = np.random.default_rng([SEED, stream])
    bench = Bench(kinematics)
    bench.cell.is_simulated = bool(rng.random() < 0.3)
    truth = ArmTruth(bench.cell, joint_limits(kinematics, SETTINGS.motion))
    # The time of a simulated cell is what its stamps say; that of a real one passes whatever they say.
    kinds = [*POSITIONS, "drop"] if bench.cell.is_simulated else [*POSITIONS, *OTHERS]
    corruptions = [Corruption(rng, kinds, kinematics.n_joints) for _ in range(rng.integers(1, 4))]
    bench.cell.corrupt = corrupting(corruptions)
    for _ in range(1 + (rng.random() < 0.25)):
        outcome = bench.push(CONTACT, GOALS if stream % 4 == 3 else SETTINGS)
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
