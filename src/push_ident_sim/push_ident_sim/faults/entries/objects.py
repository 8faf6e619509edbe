"""Faults of the object and of what is seen of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from geometry_msgs.msg import Point

from push_ident.pushing.push import PushCode
from push_ident_msgs.msg import MassFrictionMap
from push_ident_sim.faults.fault import Fault, Trial
from push_ident_sim.faults.harness.cell import ARM_CELL
from push_ident_sim.faults.harness.oracles import learned_pushes
from push_ident_sim.faults.harness.proxy import changed, drop
from push_ident_sim.faults.harness.topics import OBJECT

__all__ = ["FAULTS"]

_POSE: Final = f"objects/{OBJECT}/pose"
_ASIDE: Final = 0.2
"""Where the object seems to be, from where it is [m]: the tool comes down more than its width away."""


_CONFIDENT: Final = 0.2
"""Relative standard deviation of a cell below which a map claims to know it; that of the prior is about 1."""


def _displaced(dx: float, dy: float) -> Callable[[Any], Any]:
    def change(msg: Any) -> Any:
        msg.pose.pose.position.x += dx
        msg.pose.pose.position.y += dy
        return msg

    return change


def _missed(trial: Trial) -> None:
    cell = trial.cell
    before = learned_pushes(cell)
    cell.proxy.set(_POSE, changed(_POSE, _displaced(0.0, _ASIDE)))
    trial.wait(0.5)
    goal = cell.goal(-1)
    # In the frame of the table: given in that of the object, the executor would first bring it back from the edge.
    goal.frame_id, goal.contact_point = "table", Point(x=-0.08, y=_ASIDE - 0.02)
    result = cell.push(goal)
    trial.expect(result.error_code == PushCode.NO_CONTACT, f"the push ended with {result.error_code} {result.error_text}")
    trial.wait(1.5)
    trial.expect(learned_pushes(cell) == before, "the model has changed")
    trial.note = result.error_text


def _lost_in_push(trial: Trial, rule: Any) -> None:
    cell = trial.cell
    sent = cell.begin()
    cell.proxy.set(_POSE, rule)
    result = cell.end(sent)
    trial.expect(result.error_code == PushCode.OBJECT_LOST, f"the push ended with {result.error_code} {result.error_text}")

    def is_reported() -> bool:
        return any(record.error_code == PushCode.OBJECT_LOST for _, record in cell.monitor.records)

    trial.expect_soon(is_reported, 2.0, "no push_record reports it")
    trial.wait(0.5)
    trial.expect(not cell.is_moving(), "the arm still moves")
    trial.note, trial.lost = result.error_text, "the push under way"


def _unexplained(trial: Trial) -> None:
    """Poses jump about by centimetres and claim a tenth of a millimetre."""
    cell = trial.cell
    rng = np.random.default_rng(0)

    def jump(msg: Any) -> Any:
        msg.pose.covariance = (np.eye(6) * 1e-8).ravel()
        return _displaced(*rng.normal(0.0, 0.03, 2))(msg)

    sent = cell.begin()
    cell.proxy.set(_POSE, changed(_POSE, jump))
    cell.end(sent)
    trial.wait(3.0)
    last = cell.monitor.maps[-1][1] if cell.monitor.maps else None
    if last is not None:
        spread = float(np.median(np.array(last.mass_friction_std) / np.array(last.mass_friction)))
        confident = last.status == MassFrictionMap.STATUS_OK and spread < _CONFIDENT
        trial.expect(not confident, f"the map is reported as {last.status_text!r} with deviations of {100 * spread:.0f} %")
        trial.note = f"status of the map: {last.status_text}, deviations of {100 * spread:.0f} %"
    trial.lost = "the push under way"


FAULTS: Final = (
    Fault(
        number=18,
        name="push-misses",
        what=f"poses {1e2 * _ASIDE:.0f} cm beside the object: the push touches nothing",
        holds="the executor compares the poses before and after",
        expected="NO_CONTACT; the map does not change",
        run=_missed,
        cell=ARM_CELL,
    ),
    Fault(
        number=19,
        name="object-lost",
        what="poses stop in the middle of a push",
        holds="the watch over the object, lost_timeout 3 s",
        expected="OBJECT_LOST; stop, retreat on a checked path; the record says so",
        run=lambda trial: _lost_in_push(trial, drop),
        cell=ARM_CELL,
    ),
    Fault(
        number=38,
        name="object-leaves",
        what="the object seems to be 0.5 m away in the middle of a push",
        holds="the limits of the workspace",
        expected="OBJECT_LOST; stop and retreat",
        run=lambda trial: _lost_in_push(trial, changed(_POSE, _displaced(0.5, 0.0))),
        cell=ARM_CELL,
        fast=True,
    ),
    Fault(
        number=23,
        name="poses-that-jump",
        what="poses that jump by 3 cm and claim 0.1 mm, during a whole push",
        holds="the status of the fit",
        expected="refused, or a status that is not success; never confident numbers",
        run=_unexplained,
        cell=ARM_CELL,
    ),
)
