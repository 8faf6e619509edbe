"""Whatever joint states say, the arm is never told to turn faster, or to accelerate more, than its limits allow."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from helpers.memory_cell import CONTACT, SETTINGS, Bench, Cell, largest_shares
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.arm_motion import JointLimits
from push_ident.pushing.command_link import stand_at
from push_ident.pushing.motion import joint_limits
from push_ident.pushing.trajectory import JointTrajectory
from push_ident.types import Float64Array

State = tuple[float, Float64Array]
"""Stamp [s] and joint positions [rad]."""

POSITIONS = ("offset", "swap", "spike", "freeze", "scale", "drift", "noise", "drop")
"""Kinds that leave the time as it is."""
TIMES = ("repeat", "reorder", "late", "stamps")


@dataclass
class Corruption:
    """One kind of lie, from a state of the stream on, for a number of states."""

    kind: str
    first: int
    n: int
    size: float
    """[rad], for `stamps` and `late` [s], for `scale` 1."""
    joints: tuple[int, int]
    rng: np.random.Generator = field(repr=False)
    _kept: State | None = field(default=None, repr=False)
    _waiting: list[State] = field(default_factory=list, repr=False)

    @classmethod
    def draw(cls, rng: np.random.Generator, kinds: tuple[str, ...], n_states: int, n_joints: int) -> Corruption:
        """One of these kinds, at any time, for one state or for ever, from a thousandth of a radian to 3."""
        a, b = rng.choice(n_joints, 2, replace=False)
        n = int(rng.choice([1, 2, 4, 8, 30, 100, 100_000]))
        size = float(rng.choice([-1, 1]) * np.exp(rng.uniform(math.log(1e-3), math.log(3.0))))
        return cls(str(rng.choice(kinds)), int(rng.integers(-n_states // 4, n_states)), n, size, (int(a), int(b)), rng)

    def __call__(self, number: int, stamp: float, q: Float64Array) -> list[State]:
        """What is reported in place of a true state; `number` counts them."""
        if not self.first <= number < self.first + self.n:
            held, self._waiting = self._waiting, []
            return [*held, (stamp, q)]
        i, j = self.joints
        lie = q.copy()
        if self.kind == "offset":
            lie[i] += self.size
        elif self.kind == "swap":
            lie[[i, j]] = lie[[j, i]]
        elif self.kind == "spike":
            lie[i] += self.size * (self.rng.random() < 0.3)
        elif self.kind == "scale":
            lie *= 1.0 + self.size
        elif self.kind == "drift":
            lie[i] += self.size * (number - self.first) / 50
        elif self.kind == "noise":
            lie += self.size * self.rng.normal(size=len(q))
        elif self.kind == "stamps":
            return [(stamp + self.size, q)]
        elif self.kind == "drop":
            return []
        else:
            return self._in_time(stamp, q)
        return [(stamp, lie)]

    def _in_time(self, stamp: float, q: Float64Array) -> list[State]:
        if self.kind in ("freeze", "repeat"):
            self._kept = self._kept or (stamp, q)
            return [(stamp, self._kept[1]) if self.kind == "freeze" else self._kept]
        self._waiting.append((stamp, q))
        if self.kind == "late":
            is_due = len(self._waiting) > abs(self.size) / 0.01
            return [self._waiting.pop(0)] if is_due else []
        if len(self._waiting) < 4:
            return []
        shuffled, self._waiting = [self._waiting[k] for k in self.rng.permutation(4)], []
        return shuffled


def corrupting(corruptions: list[Corruption]) -> Callable[[float, Float64Array], list[State]]:
    """For `Cell.corrupt`: all of them, one after the other."""
    number = -1

    def corrupt(stamp: float, q: Float64Array) -> list[State]:
        nonlocal number
        number += 1
        states = [(stamp, q)]
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
