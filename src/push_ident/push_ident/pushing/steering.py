"""Corrections of a push along a path under way: their checks, and the timeout after which the tool stops without them.

A refused correction changes nothing: the last accepted one continues. It is within the corridor and ends at rest, so it is safe without
further messages, and the next frame brings another. The tool stops only when no accepted correction arrives within the timeout.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.outline import signed_distance
from push_ident.pushing.motion import PathPlan
from push_ident.pushing.pacing import SPLICE
from push_ident.pushing.push import PushCode, PushSettings
from push_ident.pushing.tool_path import Corridor, ToolPath, stopping
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class CorrectionLimits:
    """Which corrections are accepted."""

    delay: float = SPLICE + 0.01
    """Time from now to where a motion may change [s]: the arm has pieces up to the splice, and the next one is sent within 10 ms."""
    jump: float = 0.01
    """Largest distance of the beginning of a path from the tool [m]: twice what a tool at 0.25 m/s travels in 20 ms."""
    duration: float = 10.0
    """Longest correction [s]: planning its motion takes 8 ms for as long, and the next piece of the arm waits meanwhile."""
    timeout: tuple[float, float] = (0.05, 5.0)
    """Range of the timeout of corrections [s]: a camera of 20 frames a second, and longer than any frame takes."""
    rounding: float = 1e-6
    """Excess of a position that is rounding [m]."""
    speed_rounding: float = 1.02
    """Ratio of speeds that is rounding of times [1]."""


_LIMITS: Final = CorrectionLimits()


class CorrectionFault(Enum):
    """Why a correction is refused."""

    FOREIGN = "is of another push"
    UNWANTED = "is not taken by this push, which was sent without a timeout of corrections, or has been told to stop"
    OLDER = "is not newer than the one before"
    LATE = "comes too late"
    MALFORMED = "is no path"
    LONG = "lasts too long"
    JUMP = "begins elsewhere than the tool is"
    CORRIDOR = "leaves the corridor"
    WORKSPACE = "leaves the workspace"
    SPEED = "is too fast"
    OBSTACLE = "comes too near to another object"
    JOINTS = "is too much for the joints"


def path_from_start(path: ToolPath) -> ToolPath:
    """The same path; raises InputError unless its times are those from the start of the push."""
    if abs(float(path.time[0])) > 1e-6:
        raise InputError(f"tool_path begins at {path.time[0]:.3f} s, expected 0.")
    return path


@dataclass(frozen=True, slots=True)
class PathRequest:
    """A push along a path, as a client requests it.

    Raises InputError: a path out of its corridor, or a timeout that is neither 0 nor between 0.05 and 5 s.
    """

    path: ToolPath
    """Lowered at the first point, which has the time 0, and in contact at the second."""
    corridor: Corridor
    correction_timeout: float = 0.0
    """Longest time without a correction [s]; 0: none are taken."""

    def __post_init__(self) -> None:
        path_from_start(self.path)
        if (excess := float(np.max(self.corridor.excess(self.path.dense())))) > _LIMITS.rounding:
            raise InputError(f"tool_path leaves its corridor by {1e3 * excess:.1f} mm; widen the corridor, or lead it along the path.")
        least, largest = _LIMITS.timeout
        if not (self.correction_timeout == 0.0 or least <= self.correction_timeout <= largest):
            raise InputError(
                f"correction_timeout is {self.correction_timeout} s, expected {least} to {largest} s, or 0 for a push "
                "that is not corrected."
            )


@dataclass(frozen=True, slots=True)
class ToolCorrection:
    """A correction as received, not yet checked."""

    push_id: int
    stamp: float
    """When its path begins [s], clock of the cell."""
    stop: bool
    """The tool stops; no path is needed."""
    time: Float64Array
    """From the stamp on [s], shape (n,)."""
    position: Float64Array
    """Axis of the tool [m], shape (n, 2), table frame."""


class Steering:
    """Corrections of one push along a path. They may arrive in another thread.

    Args:
        settings: limits of the tool.
        obstacles: gives the outlines of the other objects, table frame [m], each of shape (n_vertices, 2).
        timeout: longest time without a correction, after the contact and by wall time [s].
    """

    def __init__(
        self, request: PathRequest, settings: PushSettings, obstacles: Callable[[], Sequence[Float64Array]], timeout: float
    ) -> None:
        self._request, self._settings, self._obstacles, self._timeout = request, settings, obstacles, timeout
        self._lock = threading.Lock()
        self._pending: ToolCorrection | None = None
        self._latest = -np.inf
        self._heard = np.inf
        self._push_id = 0
        self._plan: PathPlan | None = None
        self._offset = self._now = 0.0
        self._is_stopping = False
        self.n_made = 0
        """Number of corrections that were applied."""
        self.refused: Counter[CorrectionFault] = Counter()
        """Number of refused corrections by fault."""

    def begin(self, push_id: int, plan: PathPlan) -> None:
        """The push begins."""
        with self._lock:
            self._push_id, self._plan = push_id, plan

    def offer(self, correction: ToolCorrection) -> None:
        """Take a correction, or refuse and count it. Raises InputError: it is refused; why."""
        with self._lock:
            if correction.stop and self._is_stopping and correction.push_id == self._push_id:
                return  # sent again in case it was lost
            self._check(correction)
            self._pending, self._latest = correction, correction.stamp
            self._is_stopping = self._is_stopping or correction.stop

    def look(self, elapsed: float, time: float, wall: float, change: Callable[[PathPlan], bool]) -> PathPlan:
        """The plan from now on.

        Args:
            elapsed: time of the plan that the arm has reached [s].
            time: the time then, clock of the cell [s].
            wall: the present, wall time [s].
            change: leads the arm on by another plan; false where it is too late for it.

        Raises PlanningError: CORRECTION where promised corrections do not come.
        """
        with self._lock:
            plan = self._plan
            assert plan is not None, "it has begun"
            self._offset, self._now = elapsed - plan.departure - time, time
            if elapsed < plan.contact or not self._timeout:
                self._heard = wall
            silence = wall - self._heard
            if silence > self._timeout and not self._is_stopping and elapsed < plan.stop:
                raise PlanningError(PushCode.CORRECTION, self._silent(silence))
            correction, self._pending = self._pending, None
            if correction is None:
                return plan
            try:
                changed = plan.corrected(*self._motion(plan, correction))
            except PlanningError as error:
                self._count(CorrectionFault.JOINTS, str(error))
            else:
                if change(changed):
                    self._plan, self._heard, self.n_made = changed, wall, self.n_made + 1
                    return changed
                self._count(CorrectionFault.LATE, "planning it took longer than the arm to where it would have begun to act")
            if correction.stop:
                self._pending = correction  # no newer one will come
            return plan

    # ---- parts, called with the lock

    def _silent(self, silence: float) -> str:
        refused = ", ".join(f"{n} {fault.name}" for fault, n in self.refused.most_common())
        return (
            f"no usable correction for {silence:.2f} s, limit {self._timeout:.2f} s ({self.n_made} made; refused: {refused or 'none'}); "
            "are camera and goal_pushing_node running?"
        )

    def _motion(self, plan: PathPlan, correction: ToolCorrection) -> tuple[ToolPath, float]:
        """Path from the departure on, and when it begins to act [s]."""
        begin = self._now + self._offset + _LIMITS.delay
        if not correction.stop:
            return ToolPath(correction.stamp + self._offset + correction.time, correction.position), begin
        return stopping(plan.tool, begin, plan.acceleration), begin

    def _count(self, fault: CorrectionFault, detail: str) -> InputError:
        self.refused[fault] += 1
        return InputError(f"the correction {fault.value}: {detail} ({self.refused[fault]} such so far in push {self._push_id}).")

    def _check(self, correction: ToolCorrection) -> None:
        if correction.push_id != self._push_id or not self._push_id:
            raise self._count(CorrectionFault.FOREIGN, f"push_id is {correction.push_id}, expected {self._push_id}")
        if self._is_stopping or not self._timeout:
            raise self._count(CorrectionFault.UNWANTED, "it changes nothing")
        if not np.isfinite(correction.stamp) or correction.stamp <= self._latest:
            raise self._count(CorrectionFault.OLDER, f"its stamp is {correction.stamp:.3f} s, expected more than {self._latest:.3f} s")
        # Behind by the timeout and ahead of the cell's time by as much: clocks that are not set.
        if abs(self._now - correction.stamp) > self._timeout:
            raise self._count(
                CorrectionFault.LATE,
                f"its stamp is {self._now - correction.stamp:.3f} s old, limit {self._timeout:.2f} s; are the clocks the same?",
            )
        if not correction.stop:
            self._check_path(correction)

    def _check_path(self, correction: ToolCorrection) -> None:
        try:
            path = ToolPath(correction.time, correction.position)
        except InputError as error:
            raise self._count(CorrectionFault.MALFORMED, str(error)) from None
        if (duration := float(path.time[-1] - path.time[0])) > _LIMITS.duration:
            raise self._count(CorrectionFault.LONG, f"{duration:.1f} s, limit {_LIMITS.duration:.0f} s")
        plan, begin = self._plan, correction.stamp + self._offset
        assert plan is not None, "it has begun"
        now = np.array([np.interp(begin, plan.tool.time, column) for column in plan.tool.position.T])
        if (jump := float(np.linalg.norm(path.position[0] - now))) > _LIMITS.jump:
            raise self._count(CorrectionFault.JUMP, f"{1e3 * jump:.1f} mm away, limit {1e3 * _LIMITS.jump:.0f} mm")
        points = path.dense()
        if (excess := float(np.max(self._request.corridor.excess(points)))) > _LIMITS.rounding:
            raise self._count(CorrectionFault.CORRIDOR, f"by {1e3 * excess:.1f} mm")
        if (excess := self._settings.excess(points)) > _LIMITS.rounding:
            raise self._count(CorrectionFault.WORKSPACE, f"by {1e3 * excess:.1f} mm")
        if path.speed > _LIMITS.speed_rounding * plan.speed:
            raise self._count(CorrectionFault.SPEED, f"{path.speed:.3f} m/s, limit {plan.speed:.3f} m/s")
        for outline in self._obstacles():
            gap = float(np.min(signed_distance(points, outline))) - self._settings.pusher_radius
            if gap < 0.0:
                raise self._count(CorrectionFault.OBSTACLE, f"it would touch it by {-1e3 * gap:.1f} mm")
