"""Pacing of a motion: a dead man's switch made of short pieces.

The arm never has the whole motion. It gets pieces of it, each in place of the one before: a short time at the planned speed, then braking
to a halt on the path. While pieces arrive in time the arm moves as planned. When none arrives, for any reason, it stops soon on the checked
path; when they arrive again it speeds up and goes on from there.

With path time s along the plan q(s) and the rate r = ds/dt between 0 and 1, the joints move as

    dq/dt = q'(s) r,    d2q/dt2 = q''(s) r^2 + q'(s) dr/dt.

Braking takes the least dr/dt that keeps every joint within its acceleration limit. At r <= 1 there always is one, as the plan itself keeps
the limits (Bobrow, Dubowsky & Gibson 1985, for the fastest motion along a path).
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.pushing.trajectory import SAMPLE_PERIOD, JointTrajectory
from push_ident.types import Float64Array

SPLICE: Final = 0.03
"""First point of a piece after its start [s]. The arm reaches it by a cubic from its own present state, which smooths what transport
adds: a piece that is 1 ms late shifts the path by 1 ms, over this time rather than at once."""


@dataclass(frozen=True, slots=True)
class Ramps:
    """How quickly an arm changes its rate along a plan."""

    step: float = SAMPLE_PERIOD
    """Time step of speeding up and braking [s]. The arm gets a point for each, so that its cubics are those of the schedule."""
    speed_up: float = 0.1
    """Shortest time from standstill to the planned speed [s]."""
    brake: float = 0.02
    """Shortest time from the planned speed to standstill [s]."""
    shortest_piece: float = 0.01
    """[s]: an arm takes no point in no time."""


_RAMPS: Final = Ramps()


class PathPacing:
    """Path time of a motion under way, and the pieces that the arm gets of it.

    Args:
        trajectory: the plan, at rest at both ends.
        acceleration_limit: of every joint [rad/s^2], shape (n_joints,).
        horizon: time at speed that a piece contains [s].
        started: when the motion starts [s].

    All times are those of the arm's clock [s]; `now` must not decrease from call to call.
    """

    def __init__(self, trajectory: JointTrajectory, acceleration_limit: Float64Array, horizon: float, started: float) -> None:
        self._plan, self._limit, self._horizon = trajectory, acceleration_limit, horizon
        self.duration = trajectory.duration
        """Of the plan [s]."""
        self.started = started
        """[s]"""
        self._times: list[float] = trajectory.time.tolist()
        self._bend = trajectory.acceleration
        # The schedule that the arm has, from the start to the halt of the latest piece: knots of time, path time and rate.
        self._t, self._s, self._r = [started], [0.0], [1.0]
        self._before, self._share = (self._t, self._s, self._r), 1.0

    # ---- where the arm is

    def path_time(self, time: float) -> float:
        """Path time [s] that the arm has at `time` by the pieces it got; 0 before the start."""
        return self._at(time)[0]

    def time_of(self, path_time: float) -> float:
        """When the arm reaches a path time [s] by the pieces it got; infinite where they end before it."""
        i = bisect_left(self._s, path_time - 1e-9)
        if i == len(self._s):
            return math.inf
        if i == 0:
            return self._t[0]
        t, s, r = self._t[i - 1], self._s[i - 1], self._r[i - 1]
        ahead, slope = path_time - s, (self._r[i] - r) / (self._t[i] - t)
        # The root of ahead = r x + slope x^2 / 2 in a form that holds for slope 0.
        return t + 2.0 * ahead / max(r + math.sqrt(max(r * r + 2.0 * slope * ahead, 0.0)), 1e-9)

    @property
    def reaches(self) -> float:
        """Path time at which the latest piece ends [s]."""
        return self._s[-1]

    @property
    def ends(self) -> float:
        """When it ends [s]."""
        return self._t[-1]

    @property
    def is_complete(self) -> bool:
        """Whether the latest piece leads to the end of the plan."""
        return self._s[-1] >= self.duration

    def change(self, trajectory: JointTrajectory) -> None:
        """Another plan, the same up to where the arm will be when the next piece begins to act, at least."""
        self._plan, self.duration = trajectory, trajectory.duration
        self._times, self._bend = trajectory.time.tolist(), trajectory.acceleration

    # ---- what the arm gets

    def piece(self, now: float, splice: float = SPLICE, share: float = 1.0, to: float | None = None) -> JointTrajectory:
        """The next piece, in place of the one before. Its times count from `now`; it begins `splice` [s] later and ends at rest.

        Made late, it goes on from where the arm has braked to. It speeds up and brakes with a `share` of what the joints allow. `to`: the
        path time [s] that it goes to at speed, where that is not a horizon ahead.
        """
        self._share = share
        self._before = self._t[:], self._s[:], self._r[:]
        s, r = self._cut(now)
        self._speed_up(now + self._horizon if to is None else math.inf, self.duration if to is None else to, s, r)
        self._brake()
        end = max(self._t[-1] - now, splice, _RAMPS.shortest_piece)
        knots = np.array(self._t[bisect_right(self._t, now + splice) :]) - now
        times = np.concatenate([[splice], knots, [end]])
        times = times[np.append(np.diff(times) > 0.5 * _RAMPS.step, True)]
        if len(times) == 1:  # that is how an arm is held
            times = np.array([0.5 * end, end])
        s_r = np.array([self._at(now + t) for t in times])
        position, velocity = self._plan.follow(s_r[:, 0])
        velocity *= s_r[:, 1:]
        velocity[-1] = 0.0
        return JointTrajectory(times, position, velocity)

    def halt(self, now: float, share: float = 1.0) -> JointTrajectory:
        """The last piece: one point, at which the arm stands as soon as a `share` of the acceleration limits allows; on the path.

        The rate falls evenly, as it does on the cubic to one point.
        """
        self._before, self._share = (self._t[:], self._s[:], self._r[:]), share
        self._cut(now)
        slope = self._brake()
        self._cut(now)
        self._brake(slope)
        time = max(self._t[-1] - now, _RAMPS.shortest_piece)
        position, _ = self._plan.follow(np.array([self._s[-1]]))
        return JointTrajectory(np.array([time]), position, np.zeros_like(position))

    def take_back(self) -> None:
        """The arm did not get the latest piece: it makes what it had before."""
        self._t, self._s, self._r = self._before

    # ---- the schedule

    def _at(self, time: float) -> tuple[float, float]:
        """Path time and rate."""
        i = bisect_right(self._t, time) - 1
        if i < 0:
            return 0.0, 0.0
        if i == len(self._t) - 1:
            return self._s[-1], 0.0 if time > self._t[-1] else self._r[-1]
        span, after = self._t[i + 1] - self._t[i], time - self._t[i]
        slope = (self._r[i + 1] - self._r[i]) / span
        return min(self._s[i] + after * (self._r[i] + 0.5 * slope * after), self._s[i + 1]), self._r[i] + slope * after

    def _cut(self, now: float) -> tuple[float, float]:
        """Forget what was planned after `now`; path time and rate there."""
        now = max(now, self._t[0])
        s, r = self._at(now)
        n_kept = bisect_left(self._t, now)
        del self._t[n_kept:], self._s[n_kept:], self._r[n_kept:]
        self._add(now, s, r)
        return s, r

    def _add(self, t: float, s: float, r: float) -> None:
        self._t.append(t)
        self._s.append(s)
        self._r.append(r)

    def _speed_up(self, until: float, to: float, s: float, r: float) -> None:
        """Up to the planned speed and on, to the time `until` or the path time `to`."""
        t = self._t[-1]
        while r < 1.0 and t < until - 1e-9 and s < to:
            step = min(_RAMPS.step, until - t)
            rate = min(r + step * min(1.0 / _RAMPS.speed_up, self._allowed(s, r, 1.0)), 1.0)
            t, s, r = t + step, s + 0.5 * step * (r + rate), rate
            self._add(t, s, r)
        end = s + min(until - t, to - s)
        first, last = bisect_right(self._times, s + 0.5 * _RAMPS.step), bisect_left(self._times, end - 0.5 * _RAMPS.step)
        for knot in (*self._times[first:last], end) if r >= 1.0 and end - s > 1e-9 else ():
            self._add(t + knot - s, knot, r)
        self._end_at_duration()

    def _brake(self, evenly: float = math.inf) -> float:
        """To a halt, at a rate that falls by `evenly` at most; the least by which it fell [1/s]."""
        t, s, r, least = self._t[-1], self._s[-1], self._r[-1], math.inf
        while r > 0.0 and s < self.duration:
            slope = min(self._allowed(s, r, -1.0), evenly)
            least = min(least, slope)
            step = _RAMPS.step if slope * _RAMPS.step < r else r / slope
            rate = r - step * slope if step == _RAMPS.step else 0.0
            t, s, r = t + step, s + 0.5 * step * (r + rate), rate
            self._add(t, s, r)
        self._end_at_duration()
        return least

    def _end_at_duration(self) -> None:
        """The plan ends at rest, whatever the rate."""
        if self._s[-1] >= self.duration - 1e-9:
            self._s[-1] = self.duration

    def _allowed(self, s: float, r: float, sign: float) -> float:
        """Largest change of the rate, up (`sign` 1) or down (-1), that the accelerations of the joints allow [1/s]."""
        i = min(bisect_right(self._times, s) - 1, len(self._bend) - 1)
        speed, bend = self._plan.velocity[i : i + 2], self._bend[i : i + 2]
        along = sign * r * r * np.sign(speed[0] + speed[1]) * bend
        slopes = np.maximum(self._limit - np.max(along, axis=0, initial=0.0), 0.0) / np.maximum(np.max(np.abs(speed), axis=0), 1e-9)
        return float(min(self._share * np.min(slopes), 1.0 / _RAMPS.brake))
