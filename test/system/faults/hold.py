"""Whether and when the arm stood still after a fault, and whether anything moved it again."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from system.faults.monitor import ArmSample, Monitor, until

from push_ident.geometry.kinematics import ArmKinematics
from push_ident_sim.cell.robot import HOME, JOINT_NAMES, robot_description

ARM = ArmKinematics(robot_description(), neutral=HOME)
HORIZON = 0.1
"""Longest motion that the arm may make unasked [s]."""
BRAKING = 5.0
"""Slowest deceleration of a joint that stops [rad/s^2]: the executor's default `max_joint_acceleration`."""
STANDS = 0.02
"""No joint of a standing arm turns faster [rad/s]: four times what a standing arm of the simulated cell shows."""
SAMPLE = 0.02
"""Two joint states at 100 Hz [s]: by so much a time read from them may be late."""
WATCHED = 1.0
"""How long a standing arm is watched, and how long a command may not move it [s]."""
STEP = 0.02
"""A command that goes further from where the arm is moves it [rad]: the executor's start tolerance."""


@dataclass(frozen=True)
class Hold:
    seconds: float
    """From the fault to the standing arm [s], by the arm's own clock."""
    allowed: float
    """[s]"""
    tool_moved: float
    """How far the tool went meanwhile [m]."""
    commands_after: int
    """Motions that were commanded after it stood."""


def measure_hold(monitor: Monitor, since: float, detect: float) -> Hold:
    """Watch the arm until it has stood for a while, and what commands it gets then. Fails where it does not stand.

    Args:
        since: when the fault began [s], `time.monotonic`.
        detect: time to notice it [s].
    """
    until(lambda: _stands(_from(monitor, since)), detect + HORIZON + WATCHED + 3.0, "the arm did not stand")
    samples = _from(monitor, since)
    stands = _stands(samples)
    assert stands is not None
    fastest = max(sample.speed for sample in samples if sample.stamp <= samples[0].stamp + HORIZON)
    allowed = detect + HORIZON + fastest / BRAKING + SAMPLE + monitor.stalls.worst
    time.sleep(max(0.0, stands.received + WATCHED - time.monotonic()))
    after = sum(
        received > stands.received + SAMPLE and _moves(msg, stands)
        for received, msg in list(monitor.commands)
        if msg.points and sorted(msg.joint_names) == sorted(JOINT_NAMES)
    )
    tips = [ARM.forward(sample.q)[:3, 3] for sample in (samples[0], stands)]
    return Hold(stands.stamp - samples[0].stamp, allowed, float(np.linalg.norm(tips[1] - tips[0])), after)


def _from(monitor: Monitor, since: float) -> list[ArmSample]:
    """The last state before `since`, and all after it."""
    states = monitor.states()
    first = max((i for i, sample in enumerate(states) if sample.received <= since), default=0)
    return states[first:]


def _stands(samples: list[ArmSample]) -> ArmSample | None:
    """The first state from which on the arm has stood for half of `WATCHED` at least; None where it did not."""
    moving = [i for i, sample in enumerate(samples) if sample.speed > STANDS]
    first = moving[-1] + 1 if moving else 0
    stood = first < len(samples) and samples[-1].stamp - samples[first].stamp >= 0.5 * WATCHED
    return samples[first] if stood else None


def _moves(msg: object, stands: ArmSample) -> bool:
    order = [list(msg.joint_names).index(name) for name in JOINT_NAMES]  # type: ignore[attr-defined]
    positions = np.array([point.positions for point in msg.points])[:, order]  # type: ignore[attr-defined]
    return bool(np.max(np.abs(positions - stands.q)) > STEP)
