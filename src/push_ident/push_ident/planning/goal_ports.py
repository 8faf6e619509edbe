"""What pushing to a goal asks of a cell, and what it says of itself: values, and protocols that the node or a test fulfils."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import Protocol, TypeVar

import numpy as np

from push_ident.errors import InputError
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.physics.overhang import TableEdge
from push_ident.planning.edge_goal import EdgeGoal
from push_ident.planning.goal import Goal
from push_ident.planning.goal_code import GoalCode
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_steps import PathStep
from push_ident.planning.planner import GoalPush
from push_ident.planning.target import Target
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.types import Float64Array

__all__ = [
    "GoalOutcome",
    "GoalPorts",
    "GoalProgress",
    "GoalRequest",
    "GoalState",
    "KnownModel",
    "PathPorts",
    "PushReport",
    "PushUnderWay",
    "SessionLimits",
    "SteeredUnderWay",
    "UnderWay",
    "Wish",
]

T_co = TypeVar("T_co", covariant=True)


class GoalState(IntEnum):
    """What is under way; the numbers are those of the feedback of action/PushToGoal."""

    OBSERVE = 0
    EXPLORE = 1
    PLAN = 2
    PUSH = 3
    LEARN = 4


class Wish(Enum):
    """What the client of a goal wants."""

    GO_ON = "go on"
    FINISH = "end after the push under way"
    HOLD = "hold the arm and end"


@dataclass(frozen=True, slots=True)
class GoalRequest:
    """A goal as a client requests it.

    Raises:
        InputError: a limit that is not positive.
    """

    object_id: str
    """Empty: the only object."""
    goal: Goal | EdgeGoal | PathGoal
    time_limit: float = 300.0
    """Wall time [s]."""
    max_pushes: int = 15
    """Exploring ones included."""
    explore: int = 0
    """Random pushes before the first one to the goal."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.time_limit) and self.time_limit > 0):
            raise InputError(f"time_limit is {self.time_limit}, expected a positive number of seconds.")
        if self.max_pushes < 1 or not 0 <= self.explore <= self.max_pushes:
            raise InputError(
                f"explore is {self.explore} and max_pushes {self.max_pushes}, expected 0 <= explore <= max_pushes, at least 1."
            )


@dataclass(frozen=True, slots=True)
class SessionLimits:
    """How long is waited for what, and how often is tried again. Wall time."""

    pose_timeout: float = 1.0
    """Oldest pose, by time of receipt, that counts as present [s]; as of the executor."""
    object_patience: float = 10.0
    """For the object to come into view again, before the first push and after each [s]: the arm hides it until it is home."""
    learn_timeout: float = 30.0
    """For identification to learn a push [s]; then what was known counts. Three times its `max_solve_time` of 10 s: on a machine with four
    processes for each core, solves took 13 to 23 s."""
    max_refusals: int = 8
    """Pushes in a row that may be refused or miss before the goal is given up. Each is another contact; 8 of the 12 that the planner
    judges last."""


@dataclass(frozen=True, slots=True)
class KnownModel:
    """What identification knows of the object."""

    posterior: ModelPosterior
    stamp: float
    """Newest pose of the latest push that was learned or refused [s], clock of the poses; 0: none."""
    n_pushes: int
    """Pushes in the estimate."""
    is_known: bool
    """Whether a push was learned or a model loaded."""


@dataclass(frozen=True, slots=True)
class PushReport:
    """What became of a push that the executor was asked for."""

    code: PushCode
    text: str = ""
    n_made: int = 0
    """Pushes that were begun for it: 0 where nothing moved, 2 where the object was pushed towards the middle first."""
    stamp: float = -np.inf
    """Start of the push [s], clock of the poses; -inf: not reported."""


class PushUnderWay(Protocol):
    """A push that was asked for."""

    def report(self) -> PushReport | None:
        """What became of it; None while it is under way. An executor that does not answer any more is reported as ARM_SILENT."""

    def cancel(self) -> None:
        """Let the arm hold. Returns at once; may be called again."""


class UnderWay(Protocol[T_co]):
    """Something that is being computed."""

    def result(self) -> T_co | None:
        """What came of it; None while it is being computed. Raises what the computation raised."""


class GoalPorts(Protocol):
    """What pushing to a goal needs of a cell."""

    def now(self) -> float:
        """Monotonic wall time [s]."""

    def sleep(self, seconds: float) -> None:
        """Let time pass [s]."""

    def observe(self, object_id: str, max_age: float, after: float) -> TrackedObject | None:
        """The object, or the only one where the id is empty, if its latest pose was received less than `max_age` [s] ago and not before
        `after`, monotonic [s]; else None."""

    def why_unseen(self, object_id: str) -> str:
        """One line: why `observe` gives nothing."""

    def obstacles(self, object_id: str) -> list[Float64Array]:
        """Outlines of the other objects, table frame [m], each of shape (n_vertices, 2)."""

    def model(self, object_id: str) -> KnownModel | None:
        """What identification knows of an object; None before it has said so."""

    def pushed_at(self, object_id: str) -> float:
        """Start of the latest push of an object that succeeded, whoever asked for it [s], clock of the poses; -inf: none is known of."""

    def push_settings(self) -> PushSettings | None:
        """Limits of pushes and the pusher; None before the executor has said what it pushes with."""

    def known_edges(self) -> Sequence[TableEdge]:
        """The edges of the table, table frame; none where they are not known."""

    def begin_target(
        self, model: KnownModel, seen: TrackedObject, goal: EdgeGoal, edges: Sequence[TableEdge], chosen: Target | None
    ) -> UnderWay[Target]:
        """Begin to choose where an object shall be at one of the edges; returns at once. `chosen`: it stays where it was, as known now."""

    def begin_plan(
        self, model: KnownModel, seen: TrackedObject, target: Target, obstacles: list[Float64Array], failed: list[PushPlan2D]
    ) -> UnderWay[GoalPush]:
        """Begin to plan; returns at once."""

    def begin_push(self, object_id: str, push: PushPlan2D | int) -> PushUnderWay:
        """Ask for a push, or for a random one of a seed; returns at once."""

    def wish(self) -> Wish:
        """What the client wants."""


class SteeredUnderWay(PushUnderWay, Protocol):
    """A push along a path that is corrected while it is made."""

    @property
    def done(self) -> float:
        """Length of path that is behind, as far as is known [m]."""

    @property
    def n_corrections(self) -> int:
        """That were sent."""

    @property
    def tool(self) -> Float64Array | None:
        """Axis of the tool as it was corrected last [m], shape (n, 2), table frame; None before a correction."""


class PathPorts(GoalPorts, Protocol):
    """What pushing along a path needs beside that."""

    def begin_step(
        self,
        model: KnownModel,
        seen: TrackedObject,
        path: PathGoal,
        done: float,
        obstacles: list[Float64Array],
        failed: list[PushPlan2D],
        *,
        steers: bool,
    ) -> UnderWay[PathStep]:
        """Begin to plan the next push; returns at once. Arguments as of `PathSteps.plan`."""

    def begin_steered(self, seen: TrackedObject, step: PathStep, path: PathGoal) -> SteeredUnderWay:
        """Ask for a push along a path, and correct it; returns at once."""


@dataclass(slots=True)
class GoalProgress:
    """How far it is."""

    state: GoalState = GoalState.OBSERVE
    object_id: str = ""
    """Of the object; empty before it was observed."""
    pushes: int = 0
    """Made, exploring ones included."""
    observed: int = 0
    """Those among them after which the object was observed."""
    pose: Float64Array = field(default_factory=lambda: np.full(3, np.nan))
    """As last observed, table frame, shape (3,)."""
    target: Target | None = None
    """Where the object shall be; None before that was chosen."""
    overhang: float = float("nan")
    """Of the outline beyond the edge, as last observed [m]; NaN where not known."""
    margin: float = float("nan")
    """Expected distance of the centre of mass from the border of its support, as last observed [m]; NaN where not known."""
    error: Float64Array = field(default_factory=lambda: np.full(2, np.nan))
    """Distance [m] and angle [rad] to the goal as last observed, shape (2,)."""
    path: PathGoal | None = None
    """That is followed; None without one."""
    step: PathStep | None = None
    """Of the latest push along it; None before it, and where it explores."""
    tool: Float64Array | None = None
    """Axis of the tool from now on, in a push under way that was corrected [m], shape (n, 2), table frame; None before a correction."""
    done: float = float("nan")
    """Share of the path that is behind [1]; NaN without a path."""
    rms: Float64Array = field(default_factory=lambda: np.full(2, np.nan))
    """Root mean square of distance [m] and angle [rad] from the path, as observed during the pushes, shape (2,)."""
    corrections: int = 0
    """That were sent for pushes under way."""
    chance: float = 0.0
    """Of being within the tolerances, as last observed [1]."""
    plan: GoalPush | None = None
    """Of the latest push; None where it explores."""
    elapsed: float = 0.0
    """Since the start [s]."""
    note: str = ""
    """What went otherwise than planned and was coped with, for the log; empty: nothing new."""


@dataclass(frozen=True, slots=True)
class GoalOutcome:
    """How it ended."""

    code: GoalCode
    text: str
    """What happened and what would help; empty at the goal."""
    progress: GoalProgress
