"""Interfaces of the execution of a push to its cell: arm, hand, force sensor, recorder, tracked objects, client and clock.

The node implements these interfaces on ROS; tests implement them in memory, on a clock of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from push_ident.errors import PlanningError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.trajectory import JointTrajectory
from push_ident.types import Float64Array, ObjectShape


@dataclass(frozen=True, slots=True)
class ArmState:
    """One joint state, with the tip from forward kinematics."""

    stamp: float
    """[s]"""
    q: Float64Array
    """[rad], shape (n_joints,), in the order of the kinematics."""
    pose_tip_in_table: Float64Array
    """Homogeneous, shape (4, 4)."""
    received: float
    """`Clock.monotonic` on receipt [s]: the time for a watchdog, whatever the stamps are."""


@dataclass(frozen=True, slots=True)
class TrackedObject:
    """One object with its latest pose."""

    object_id: str
    shape: ObjectShape
    stamp: float
    """Of the pose [s]."""
    pose: Float64Array
    """(x, y, yaw) in the table frame [m, m, rad]."""
    covariance: Float64Array
    """Of the pose, shape (3, 3)."""


class Phase(IntEnum):
    """Phase of a push; the numbers are those of the feedback of action/ExecutePush."""

    PLAN = 0
    APPROACH = 1
    PUSH = 2
    REST = 3
    RETREAT = 4
    RECENTRE = 5


class Clock(Protocol):
    """Time, of the cell and of this process."""

    @property
    def is_simulated(self) -> bool:
        """Whether time of the cell may pass at another pace than wall time, or stop."""

    def now(self) -> float:
        """Time of the cell [s]; simulated where the cell is."""

    def monotonic(self) -> float:
        """Wall time from an arbitrary origin [s]; for timeouts."""

    def sleep(self, seconds: float) -> None:
        """Wait so long, wall time."""


class ControllerGoal(Protocol):
    """A trajectory that the controller of the arm makes by itself, until it has ended or is canceled."""

    @property
    def is_accepted(self) -> bool:
        """Whether the controller has begun it."""

    @property
    def is_over(self) -> bool:
        """Whether it has ended, however."""

    @property
    def fault(self) -> PlanningError | None:
        """Why it ended before its time, by the controller or by somebody else; None while it has not, and after `cancel`."""

    def cancel(self) -> None:
        """Have the controller end it, and hold the arm where that is then."""


class Arm(Protocol):
    """An arm that follows joint trajectories. Methods raise PlanningError ARM_SILENT without joint states or a description."""

    @property
    def planner(self) -> ArmKinematics:
        """Kinematics for planning."""

    @property
    def state(self) -> ArmState | None:
        """Latest state."""

    def fresh_state(self, timeout: float, *, is_late: bool = False) -> ArmState:
        """Latest state, which must be younger than `timeout` [s] by a margin that leaves time to hold the arm.

        `is_late`: this process did not run for a while; states that were received meanwhile get a moment to be processed.
        """

    def next_state(self, timeout: float) -> ArmState:
        """The first state that is received after this call, for an arm at rest."""

    def in_use(self) -> AbstractContextManager[None]:
        """A context in which the planner stays as it is, whatever descriptions of the arm come in."""

    def rivals(self) -> tuple[str, ...]:
        """Other nodes that command the same arm."""

    def stamp_now(self) -> tuple[float, bool]:
        """Present time of the clock of the arm's stamps [s], and whether it is known: the clock may have stopped.

        There must have been a state.
        """

    def take_states(self) -> list[ArmState]:
        """States that were received since the last call, oldest first; the latest of them where there were many."""

    def impossible_state(self, since: float) -> str:
        """Why a state that was received after `since` [s], of `Clock.monotonic`, cannot be true; empty where all can."""

    def send(self, joint_names: tuple[str, ...], piece: JointTrajectory, start: float | None) -> None:
        """Start a trajectory in place of the one under way; for `CommandLink` only, which has checked it.

        Its times count from `start` on the clock of the arm's stamps [s], or from its receipt.
        """

    def check_goals(self) -> None:
        """Raise PlanningError ARM_SILENT where the controller takes no goals."""

    def send_goal(self, joint_names: tuple[str, ...], piece: JointTrajectory, start: float | None) -> ControllerGoal:
        """As `send`, as a goal of the controller, which reports how it ends."""


class Hand(Protocol):
    """The hand that holds the pusher, or is it."""

    def why_no_fist(self) -> str:
        """Why the hand is not a closed fist now; empty when it is one."""

    def close_fist(self, timeout: float, is_over: Callable[[], bool]) -> str:
        """Activate and close the hand; blocks until it is a fist, `timeout` [s] has passed or `is_over` returns true.

        Returns the same as `why_no_fist`.
        """


class ForceSensor(Protocol):
    """Force of the pusher, where it is measured."""

    @property
    def is_there(self) -> bool:
        """Whether the force is measured, or was: then no motion is made without it."""

    @property
    def silence(self) -> float:
        """Wall time since the last measurement that can be trusted [s]; infinite before the first."""

    @property
    def fault(self) -> str:
        """Why the latest measurement cannot be trusted; empty where it can."""

    def take_peak(self) -> float:
        """Largest horizontal force since the last call [N]; infinite where a measurement could not be trusted."""


class Recorder(Protocol):
    """Recorder of the cell, where one runs."""

    @property
    def fault(self) -> str:
        """Why a requested recording fails; empty while it does not, or none was requested."""


class Objects(Protocol):
    """Objects that perception tracks."""

    def get(self, object_id: str, max_age: float) -> TrackedObject:
        """The object, or the only one when `object_id` is empty.

        Raises PlanningError UNKNOWN_OBJECT when there is none, several, or the pose was received more than `max_age` [s] ago.
        """

    def outlines_of_others(self, object_id: str) -> list[Float64Array]:
        """Outlines of all other objects, table frame [m], each of shape (n_vertices, 2)."""


class Client(Protocol):
    """Client that requested the push."""

    @property
    def why_over(self) -> str:
        """Why the push should end; empty while it should go on."""

    def feedback(self, phase: Phase, progress: float) -> None:
        """Report the phase, and the share of the motion that is done."""

    def began(self, push_id: int, start: float) -> None:
        """A push has begun; `start`: when its tool departs [s], clock of the cell. Called again where that changes."""


@dataclass(frozen=True, slots=True)
class ExecutionPorts:
    """All interfaces of the cell."""

    arm: Arm
    hand: Hand
    force: ForceSensor
    recorder: Recorder
    objects: Objects
    clock: Clock
