"""What the execution of a push needs from its surroundings: arm, hand, force sensor, recorder, tracked objects, client and clock.

The node implements these interfaces on ROS; tests implement them in memory, on a clock of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from push_ident.geometry.kinematics import ArmKinematics
from push_ident.pushing.motion import ArmMotion
from push_ident.pushing.trajectory import JointTrajectory
from push_ident.types import Float64Array, ObjectShape

__all__ = [
    "Arm",
    "ArmState",
    "Client",
    "Clock",
    "ExecutionPorts",
    "ForceSensor",
    "Hand",
    "MotionLink",
    "Objects",
    "Phase",
    "Recorder",
    "TrackedObject",
]


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
    """`Clock.monotonic` on receipt [s]: what a watchdog must look at, whatever the stamps are."""


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

    def now(self) -> float:
        """Time of the cell [s]; simulated where the cell is."""
        ...

    def monotonic(self) -> float:
        """Wall time from an arbitrary origin [s]; for timeouts."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait so long, wall time."""
        ...


class Arm(Protocol):
    """An arm that follows joint trajectories. Methods raise PlanningError ARM_SILENT without joint states or a description."""

    @property
    def planner(self) -> ArmKinematics:
        """Kinematics for planning."""
        ...

    @property
    def state(self) -> ArmState | None:
        """Latest state."""
        ...

    def fresh_state(self, timeout: float, *, is_late: bool = False) -> ArmState:
        """Latest state, which must be younger than `timeout` [s] by a margin that leaves time to hold the arm.

        `is_late`: this process did not run for a while; states that were received meanwhile get a moment to be processed.
        """
        ...

    def next_state(self, timeout: float) -> ArmState:
        """The first state that is received after this call, for an arm at rest."""
        ...

    def in_use(self) -> AbstractContextManager[None]:
        """A context in which the planner stays as it is, whatever descriptions of the arm come in."""
        ...

    def rivals(self) -> tuple[str, ...]:
        """Other nodes that command the same arm."""
        ...

    def stamp_now(self) -> float:
        """What the clock of the arm's stamps shows now [s]; there must have been a state."""
        ...

    def open(self, motion: ArmMotion) -> MotionLink:
        """The only way to move the arm: pieces of `motion`, until it is held."""
        ...


class MotionLink(Protocol):
    """Sends pieces of one motion to the arm; nothing moves it any more once it was held."""

    def move(self, piece: JointTrajectory, start: float | None) -> None:
        """Start a piece in place of the one under way. Raises PlanningError after `hold`.

        Its times count from `start` on the clock of the arm's stamps [s], or from its receipt.
        """
        ...

    def hold(self, piece: JointTrajectory) -> None:
        """End the motion with a piece of one point, at which the arm stands."""
        ...


class Hand(Protocol):
    """The hand that holds the pusher, or is it."""

    def why_no_fist(self) -> str:
        """Why the hand is not a closed fist now; empty when it is one."""
        ...

    def close_fist(self, timeout: float, is_over: Callable[[], bool]) -> str:
        """Activate and close the hand; blocks until it is a fist, `timeout` [s] has passed or `is_over` returns true.

        Returns the same as `why_no_fist`.
        """
        ...


class ForceSensor(Protocol):
    """Force of the pusher, where it is measured."""

    @property
    def silence(self) -> float:
        """Wall time since the last measurement [s]; infinite before the first."""
        ...

    def take_peak(self) -> float:
        """Largest horizontal force since the last call [N]."""
        ...


class Recorder(Protocol):
    """Recorder of the cell, where one runs."""

    @property
    def fault(self) -> str:
        """Why it cannot write; empty while it can, or where none runs."""
        ...


class Objects(Protocol):
    """Objects that perception tracks."""

    def get(self, object_id: str, max_age: float) -> TrackedObject:
        """The object, or the only one when `object_id` is empty.

        Raises PlanningError UNKNOWN_OBJECT when there is none, several, or the pose was received more than `max_age` [s] ago.
        """
        ...

    def outlines_of_others(self, object_id: str) -> list[Float64Array]:
        """Outlines of all other objects, table frame [m], each of shape (n_vertices, 2)."""
        ...


class Client(Protocol):
    """Who requested the push."""

    @property
    def is_cancel_requested(self) -> bool:
        """Whether the push should end."""
        ...

    def feedback(self, phase: Phase, progress: float) -> None:
        """Report the phase, and the share of the motion that is done."""
        ...

    def began(self, push_id: int, start: float) -> None:
        """A push has begun; `start`: when its tool departs [s], clock of the cell. Called again where that changes."""
        ...


@dataclass(frozen=True, slots=True)
class ExecutionPorts:
    """All of them that belong to the cell."""

    arm: Arm
    hand: Hand
    force: ForceSensor
    recorder: Recorder
    objects: Objects
    clock: Clock
