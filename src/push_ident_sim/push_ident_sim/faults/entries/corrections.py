"""Faults of the corrections of a push along a path."""

from __future__ import annotations

import time
from typing import Final

import numpy as np

from push_ident.geometry.kinematics import ArmKinematics
from push_ident.geometry.outline import signed_distance
from push_ident.nodes.convert.tool_path import correction_to_msg, path_goal
from push_ident.pushing.corridor import Corridor
from push_ident.pushing.push import PushCode
from push_ident.pushing.steering import PathRequest, ToolCorrection
from push_ident.pushing.tool_path import ToolPath
from push_ident.types import Float64Array
from push_ident_sim.cell.robot import HOME, robot_description
from push_ident_sim.faults.fault import Fault, Trial
from push_ident_sim.faults.harness.cell import ARM_CELL
from push_ident_sim.faults.harness.topics import OBJECT
from push_ident_sim.objects import make_object

__all__ = ["FAULTS"]

_SPEED: Final = 0.05
"""Of the tool [m/s]."""
_TIMEOUT: Final = 0.5
"""That is given to corrections [s]; the executor of this cell allows no less than twice its `arm_timeout`, 1 s."""
_PATIENCE: Final = 1.0
_RADIUS: Final = 0.018
"""Default of `pusher_radius` of the executor [m]."""
_PERIOD: Final = 1.0 / 30.0
"""Of corrections [s]."""
_N_CORRECTIONS: Final = 20
_STILL: Final = 0.02
"""No joint of a standing arm turns faster [rad/s]."""
_BRAKING: Final = 0.2
"""Motion that the arm is given ahead, and its braking [s]."""


def _path() -> PathRequest:
    """Against the long side of the object in the middle, from positive y, for 12 cm."""
    outline = make_object().outline
    height = np.linspace(0.2, 0.0, 2001)
    gap = signed_distance(np.column_stack([np.zeros_like(height), height]), outline) - _RADIUS
    touch = float(height[int(np.argmax(gap <= 0.0))])
    y = np.array([touch + 0.03, touch, touch - 0.12])
    place = np.column_stack([np.zeros(3), y])
    return PathRequest(ToolPath(np.array([0.0, 0.03, 0.15]) / _SPEED, place), Corridor(place, 0.03), _TIMEOUT)


def _correct(trial: Trial, tip: Float64Array, stamp: float, push_id: int) -> float:
    """Straight on from where the tool is."""
    time_ = np.array([0.0, 1.5 * _PATIENCE])  # longer than the executor waits for the next one
    position = tip + np.outer(time_, [0.0, -_SPEED])
    message = correction_to_msg(ToolCorrection(push_id, stamp, False, time_, position))
    return trial.cell.monitor.publish("push_correction", message)


def _corrections_stop(trial: Trial) -> None:
    cell, kinematics = trial.cell, ArmKinematics(robot_description(), neutral=HOME)
    sent = cell.begin(path_goal(OBJECT, _path()), after=0.03 / _SPEED)
    since = time.monotonic()
    for number in range(_N_CORRECTIONS):
        state = cell.monitor.states()[-1]
        tip = kinematics.forward(state.q)[:2, 3]
        push_id = sent.push_id
        # Every fifth one is of another push: refused, and the one before goes on.
        since = _correct(trial, tip, state.stamp, push_id + 9 if number % 5 == 4 else push_id)
        time.sleep(_PERIOD)
    result = cell.end(sent)
    stood = next((s.received - since for s in cell.monitor.states(since) if float(abs(s.velocity).max()) < _STILL), np.inf)
    allowed = _PATIENCE + _PERIOD + _BRAKING + cell.monitor.stall
    trial.expect(stood <= allowed, f"the arm stood {stood:.2f} s after the last correction, allowed are {allowed:.2f} s")
    trial.expect(result.error_code == PushCode.CORRECTION, f"the push ended with {result.error_code} ({result.error_text})")
    trial.expect("FOREIGN" in result.error_text, f"the refusals are not named: {result.error_text}")
    trial.expect(result.corrections > 5, f"{result.corrections} corrections were made, expected most of {_N_CORRECTIONS}")
    trial.note = f"{result.corrections} made, {result.corrections_refused} refused, then none: stopped, and home"
    trial.lost = "the push under way"


FAULTS = (
    Fault(
        number=61,
        name="corrections-stop",
        what="the corrections of a push along a path stop in the middle of it, some before were of another push",
        holds="the watch over promised corrections; the last path that was usable",
        expected="foreign ones refused and counted; stopped within the timeout, then home",
        run=_corrections_stop,
        cell=ARM_CELL,
        fast=True,
    ),
)
