"""Joint states that lie, drawn at random, and what an arm makes of the commands that it gets meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg

from helpers.memory_cell import Cell
from push_ident.nodes.convert.messages import stamp_from_msg
from push_ident.pushing.arm_motion import JointLimits
from push_ident.pushing.trajectory import JointTrajectory
from push_ident.types import Float64Array
from push_ident_sim.cell.trajectory import JointTrajectory as Followed

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


def largest_shares(followed: Followed, since: float, until: float, limits: JointLimits) -> tuple[float, float]:
    """Of the limits of velocity and of acceleration, that an arm reaches on the cubics that it follows between two times [s]."""
    t = followed.time
    if len(t) < 2 or until <= since or followed.velocity is None:
        return 0.0, 0.0
    q, v, span = followed.position, followed.velocity, np.diff(t)[:, None]
    cubic = 2.0 * (q[:-1] - q[1:]) / span**3 + (v[:-1] + v[1:]) / span**2
    square = 3.0 * (q[1:] - q[:-1]) / span**2 - (2.0 * v[:-1] + v[1:]) / span
    reached = (t[1:, None] > since) & (t[:-1, None] < until)
    begin, end = (np.clip(time - t[:-1], 0.0, span[:, 0]) for time in (since, until))
    velocity = acceleration = 0.0
    for share in np.linspace(0.0, 1.0, 5):
        x = (begin + share * (end - begin))[:, None]
        speeds = np.abs(v[:-1] + 2.0 * square * x + 3.0 * cubic * x**2) / limits.velocity
        changes = np.abs(2.0 * square + 6.0 * cubic * x) / limits.acceleration
        velocity = max(velocity, float(np.max(np.where(reached, speeds, 0.0))))
        acceleration = max(acceleration, float(np.max(np.where(reached, changes, 0.0))))
    return velocity, acceleration


def shares_of_commands(commands: list[JointTrajectoryMsg], start: Float64Array, limits: JointLimits) -> tuple[float, float, float]:
    """The same for an arm that stands at `start` [rad] and follows commands from their stamps on.

    The third number is how far a hold ends from the path of the commands before it [rad]: it starts on receipt, which varies.
    """
    followed, last, aside = Followed.hold(start), 0.0, 0.0
    shares = [(0.0, 0.0)]
    for msg in commands:
        order = [list(msg.joint_names).index(name) for name in limits.names]
        times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in msg.points])
        position, velocity = (np.array([getattr(p, name) for p in msg.points])[:, order] for name in ("positions", "velocities"))
        now = stamp_from_msg(msg.header.stamp)
        if not now and len(times) == 1:
            path = np.array([followed.sample(t)[0] for t in np.linspace(last, followed.time[-1], 200)])
            aside = max(aside, float(np.min(np.max(np.abs(path - position[0]), axis=1))))
            shares.append(largest_shares(followed, last, followed.time[-1], limits))
            followed = Followed.hold(position[0])  # the next command finds the arm there
            continue
        now = now or last
        shares.append(largest_shares(followed, last, now, limits))
        followed, last = Followed(times, position, velocity).from_state(now, *followed.sample(now)), now
    shares.append(largest_shares(followed, last, last + 100.0, limits))
    return max(v for v, _ in shares), max(a for _, a in shares), aside


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
