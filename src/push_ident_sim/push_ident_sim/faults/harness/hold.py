"""Whether and when the arm stood still after a fault, and whether anything moved it again."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident_sim.cell.robot import JOINT_NAMES
from push_ident_sim.faults.harness.monitor import ArmSample, Monitor

__all__ = ["BRAKING", "HORIZON", "Hold", "measure_hold"]

HORIZON: Final = 0.1
"""Longest motion that the arm may make unasked [s]."""
BRAKING: Final = 5.0
"""Slowest deceleration of a joint that stops [rad/s^2]: the executor's default `max_joint_acceleration`."""
_STILL: Final = 0.02
"""No joint of a standing arm turns faster [rad/s]: four times what a standing arm of the simulated cell shows."""
_SAMPLE: Final = 0.02
"""Two joint states at 100 Hz [s]: by so much a time read from them may be late."""
_WATCHED: Final = 1.0
"""How long a standing arm is watched, and how long a command may not move it [s]."""
_STEP: Final = 0.02
"""A command that goes further from where the arm is moves it [rad]: the executor's start tolerance."""


@dataclass(frozen=True, slots=True)
class Hold:
    """How the arm stopped."""

    seconds: float | None
    """From the fault to the standing arm [s], by the arm's own clock; None: it did not stand."""
    allowed: float
    """[s]"""
    commands_after: int
    """Motions that were commanded after it stood."""
    moved: float
    """Joint motion from the fault to the stop, of the joint that turned most [rad]."""
    faults: list[str]
    """Why this is no hold; empty where it is one."""


def measure_hold(monitor: Monitor, since: float, detect: float) -> Hold:
    """Watch the arm until it has stood for a while, at most the time allowed and some seconds more.

    Args:
        since: when the fault began [s], `time.monotonic`.
        detect: time the suite may need to notice it [s].
    """
    patience = since + detect + HORIZON + 1.0 + _WATCHED + 2.0
    stands = None
    while stands is None and time.monotonic() < patience:
        time.sleep(0.1)
        stands = _stand(_from(monitor.states(), since))
    samples = _from(monitor.states(), since)
    if not samples:
        return Hold(None, 0.0, 0, 0.0, ["no joint states came after the fault"])
    speed = float(max(abs(sample.velocity).max() for sample in samples if sample.stamp <= samples[0].stamp + HORIZON))
    allowed = detect + HORIZON + speed / BRAKING + _SAMPLE + monitor.stall
    if stands is None:
        return Hold(
            None, allowed, 0, _moved(samples), [f"the arm still moved {samples[-1].stamp - samples[0].stamp:.1f} s after the fault"]
        )
    seconds = stands.stamp - samples[0].stamp
    time.sleep(max(0.0, stands.received + _WATCHED - time.monotonic()))
    after = _moving_commands(monitor, stands)
    faults = [] if seconds <= allowed else [f"the arm stood {1e3 * seconds:.0f} ms after the fault, allowed are {1e3 * allowed:.0f} ms"]
    if after:
        faults.append(f"{after} motions were commanded after the hold")
    return Hold(seconds, allowed, after, _moved([s for s in samples if s.stamp <= stands.stamp]), faults)


def _from(states: list[ArmSample], since: float) -> list[ArmSample]:
    """The last state before `since`, and all after it."""
    first = max((i for i, sample in enumerate(states) if sample.received <= since), default=0)
    return states[first:]


def _stand(samples: list[ArmSample]) -> ArmSample | None:
    """The first state from which on the arm stood, for `_WATCHED` at least; None where it did not."""
    if not samples:
        return None
    moving = [i for i, sample in enumerate(samples) if float(abs(sample.velocity).max()) > _STILL]
    first = moving[-1] + 1 if moving else 0
    if first >= len(samples) or samples[-1].stamp - samples[first].stamp < 0.5 * _WATCHED:
        return None
    return samples[first]


def _moved(samples: list[ArmSample]) -> float:
    return float(np.max(np.abs(samples[-1].q - samples[0].q))) if samples else 0.0


def _moving_commands(monitor: Monitor, stands: ArmSample) -> int:
    """Commands received after the arm stood that would move it."""
    after = 0
    for received, msg in list(monitor.commands):
        if received <= stands.received + _SAMPLE or not msg.points or sorted(msg.joint_names) != sorted(JOINT_NAMES):
            continue
        order = [list(msg.joint_names).index(name) for name in JOINT_NAMES]
        positions = np.array([point.positions for point in msg.points])[:, order]
        after += bool(np.max(np.abs(positions - stands.q)) > _STEP)
    return after
