"""What must be true after every fault, whatever it was."""

from __future__ import annotations

import json
import time

import numpy as np
from system.faults.cell import IDENTIFICATION, Cell
from system.faults.hold import ARM
from system.faults.process import TRACEBACK
from trajectory_msgs.msg import JointTrajectory

from helpers.memory_cell import largest_shares
from push_ident.nodes.convert.messages import stamp_from_msg
from push_ident.pushing.motion import MotionSettings, joint_limits
from push_ident.types import Float64Array
from push_ident_sim.cell.robot import HOME
from push_ident_sim.cell.trajectory import JointTrajectory as Followed

LIMITS = joint_limits(ARM, MotionSettings(home=HOME))
"""That the executor is given."""
ROUNDING = 0.01
"""Of velocities and accelerations, as a share of their limits."""
SETTLED = 60.0
"""Longest wait for the model to contain the pushes that were acknowledged [s]."""
LEAST = -1e-9
"""A covariance has no eigenvalue below this share of its largest one: what rounding leaves."""
NOT_NEGATIVE = ("mass", "mass_std", "friction", "friction_std", "mass_friction_std")


def learned_pushes(cell: Cell) -> int | None:
    """Pushes in the model of identification; None where it does not run or has no object yet."""
    if IDENTIFICATION not in cell.processes or not cell.processes[IDENTIFICATION].runs:
        return None
    path = cell.folder / "model.json"
    try:
        refusal = cell.save_model(path)
    except AssertionError:
        return None
    return None if refusal else len(json.loads(path.read_text(encoding="utf-8"))["sources"])


def violations(cell: Cell, learned_before: int, stood_at: Float64Array | None) -> list[str]:
    """In words; empty where there is none.

    Args:
        learned_before: pushes in the model before the fault.
        stood_at: where the arm stood before the fault [rad]; None: others command it as well.
    """
    found = [f"{name} ended by itself" for name, process in cell.processes.items() if not process.runs]
    found += [f"a traceback in the log of {name}" for name, process in cell.processes.items() if TRACEBACK in process.output]
    return found + _commands(cell, stood_at) + _messages(cell) + _learned(cell, learned_before) + _model(cell)


def _commands(cell: Cell, stood_at: Float64Array | None) -> list[str]:
    """No command of the executor makes an arm that follows it exceed a limit."""
    commands = [msg for _, msg in cell.monitor.commands]
    # Without stamps (`stamp_commands`) an arm begins each command on receipt, a time that others do not know to a millisecond.
    if stood_at is None or not any(stamp_from_msg(msg.header.stamp) for msg in commands):
        return []
    velocity, acceleration = _shares(commands, stood_at)
    kept = max(velocity, acceleration) <= 1.0 + ROUNDING
    return [] if kept else [f"commands reach {velocity:.0%} of a limit of velocity and {acceleration:.0%} of one of acceleration"]


def _shares(commands: list[JointTrajectory], start: Float64Array) -> tuple[float, float]:
    """Of the limits, that an arm reaches which stands at `start` [rad] and follows commands from their stamps on."""
    followed, last, shares = Followed.hold(start), 0.0, [(0.0, 0.0)]
    for msg in commands:
        order = [list(msg.joint_names).index(name) for name in LIMITS.names]
        times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in msg.points])
        position, velocity = (np.array([getattr(p, name) for p in msg.points])[:, order] for name in ("positions", "velocities"))
        now = stamp_from_msg(msg.header.stamp)
        if not now and len(times) == 1:  # a hold starts on receipt, which varies
            shares.append(largest_shares(followed, last, followed.time[-1], LIMITS))
            followed = Followed.hold(position[0])  # the next command finds the arm there
            continue
        now = now or last
        shares.append(largest_shares(followed, last, now, LIMITS))
        followed, last = Followed(times, position, velocity).from_state(now, *followed.sample(now)), now
    shares.append(largest_shares(followed, last, last + 100.0, LIMITS))
    return max(v for v, _ in shares), max(a for _, a in shares)


def _messages(cell: Cell) -> list[str]:
    found = set()
    for _, msg in list(cell.monitor.maps):
        for name in NOT_NEGATIVE:
            values = np.array(getattr(msg, name))
            if not (np.isfinite(values).all() and (values >= 0).all()):
                found.add(f"a map has {name} that is negative or not finite")
    for _, prediction in list(cell.monitor.predictions):
        if not all(_is_covariance(np.array(pose.covariance).reshape(6, 6)) for pose in prediction.poses):
            found.add("a prediction has a covariance that is not positive semi-definite")
    return sorted(found)


def _learned(cell: Cell, before: int) -> list[str]:
    """Pushes that were acknowledged stay; a push that was not whole is not learned."""
    whole = sum(record.error_code == 0 for _, record in list(cell.monitor.records))
    deadline = time.monotonic() + SETTLED
    if IDENTIFICATION not in cell.processes:
        return []
    while (now := learned_pushes(cell)) is not None and now < before + whole and time.monotonic() < deadline:
        time.sleep(0.3)
    if now is None:
        return ["identification did not answer save_model"]
    if now < before:
        return [f"the model has {now} pushes, before the fault it had {before}"]
    return [f"{now - before} pushes were learned and {whole} were whole"] if now - before > whole else []


def _model(cell: Cell) -> list[str]:
    path = cell.folder / "model.json"
    if not path.exists():
        return []
    content = json.loads(path.read_text(encoding="utf-8"))
    found = []
    if min(content["mass"]) < 0 or not np.isfinite(content["mass"]).all():
        found.append("the model has a mass that is negative or not finite")
    if not _is_covariance(np.array(content["covariance"])):
        found.append("the covariance of the model is not positive semi-definite")
    return found


def _is_covariance(matrix: Float64Array) -> bool:
    if not np.isfinite(matrix).all():
        return False
    values = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))
    return bool(values[0] >= LEAST * max(1.0, values[-1]))
