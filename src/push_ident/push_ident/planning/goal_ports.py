"""Interfaces of pushing to a goal: requests, progress, and the protocols of the cell that a node or a test implements."""

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
from push_ident.planning.goal import Goal, GoalCode, Target
from push_ident.planning.obstacle import Obstacle
from push_ident.planning.path_goal import PathGoal
from push_ident.planning.path_steps import PathStep
from push_ident.planning.planner import GoalPush
from push_ident.pushing.ports import TrackedObject
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.pushing.tool_path import ToolPath
from push_ident.types import Float64Array

T_co = TypeVar("T_co", covariant=True)


class GoalState(IntEnum):
    """Present step; the numbers are those of the feedback of action/PushToGoal."""

    OBSERVE = 0
    EXPLORE = 1
    PLAN = 2
    PUSH = 3
    LEARN = 4


class Wish(Enum):
    """Wish of the client of a goal."""

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
    """Timeouts (wall time) and numbers of attempts. Those up to `max_refusals` are parameters of the node."""

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
    unknown_patience: float = 3.0
    """Longest time until an object counts as unknown [s]: messages may be delayed on a busy machine or just after the start."""
    blur_patience: float = 3.0
    """Longest time for poses to become certain enough for the tolerances [s]: 90 frames at 30 Hz; a tracker at rest has settled by then."""
    hold_timeout: float = 0.7
    """Longest time for the executor to answer that it holds the arm [s]; it does so within 50 ms, and a node that ends has 1.8 s in all."""
    poll: float = 0.01
    """Time between two looks at what is under way [s]: a fifth of the 50 ms within which a cancellation must be answered."""
    feedback_period: float = 0.1
    """Longest time between two reports of progress [s]."""


@dataclass(frozen=True, slots=True)
class KnownModel:
    """Model of an object from identification."""

    posterior: ModelPosterior
    stamp: float
    """Newest pose of the latest push that was learned or refused [s], clock of the poses; 0: none."""
    n_pushes: int
    """Pushes in the estimate."""
    is_known: bool
    """Whether a push was learned or a model loaded."""


@dataclass(frozen=True, slots=True)
class PushReport:
    """Outcome of a requested push."""

    code: PushCode
    text: str = ""
    n_made: int = 0
    """Pushes that were begun for it: 0 where nothing moved, 2 where the object was pushed towards the middle first."""
    stamp: float = -np.inf
    """Start of the push [s], clock of the poses; -inf: not reported."""


class PushUnderWay(Protocol):
    """A requested push."""

    def report(self) -> PushReport | None:
        """Outcome; None while it is under way. An executor that no longer answers is reported as ARM_SILENT."""

    def cancel(self) -> None:
        """Let the arm hold. Returns at once; may be called again."""


class UnderWay(Protocol[T_co]):
    """A computation under way."""

    def result(self) -> T_co | None:
        """Result; None while it is computed. Raises the exceptions of the computation."""


class GoalPorts(Protocol):
    """The cell, as pushing to a goal needs it."""

    def now(self) -> float:
        """Monotonic wall time [s]."""

    def sleep(self, seconds: float) -> None:
        """Let time pass [s]."""

    def observe(self, object_id: str, max_age: float, after: float) -> TrackedObject | None:
        """The object, or the only one where the id is empty, if its latest pose was received less than `max_age` [s] ago and not before
        `after`, monotonic [s]; else None."""

    def why_unseen(self, object_id: str) -> str:
        """One line: why `observe` gives nothing."""

    def obstacles(self, object_id: str) -> list[Obstacle]:
        """What must not be touched: the other objects, and what is on the table beside the tracked ones."""

    def model(self, object_id: str) -> KnownModel | None:
        """Model of an object from identification; None before the first message."""

    def pushed_at(self, object_id: str) -> float:
        """Start of the latest push of an object that succeeded, from any client [s], clock of the poses; -inf: none is known."""

    def push_settings(self) -> PushSettings | None:
        """Limits of pushes and the pusher; None before the executor has published its pusher."""

    def known_edges(self) -> Sequence[TableEdge]:
        """The edges of the table, table frame; none where they are not known."""

    def begin_target(
        self, model: KnownModel, observed: TrackedObject, goal: EdgeGoal, edges: Sequence[TableEdge], chosen: Target | None
    ) -> UnderWay[Target]:
        """Begin to choose a pose at one of the edges; returns at once. `chosen`: keep that pose, and judge it by the new model."""

    def begin_plan(
        self, model: KnownModel, observed: TrackedObject, target: Target, obstacles: list[Float64Array], failed: list[PushPlan2D]
    ) -> UnderWay[GoalPush]:
        """Begin to plan beside outlines, table frame, each of shape (n_vertices, 2); returns at once."""

    def begin_random(self, model: KnownModel, observed: TrackedObject, obstacles: list[Float64Array], seed: int) -> UnderWay[PushPlan2D]:
        """Begin to choose a random push beside outlines, which may raise PlanningError; returns at once."""

    def begin_push(self, object_id: str, push: PushPlan2D | ToolPath | int) -> PushUnderWay:
        """Request a push, one along a path with yaws, or a random one of a seed; returns at once."""

    def wish(self) -> Wish:
        """Wish of the client."""


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
    """The cell, as pushing along a path needs it."""

    def begin_step(
        self,
        model: KnownModel,
        observed: TrackedObject,
        path: PathGoal,
        done: float,
        obstacles: list[Float64Array],
        failed: list[PushPlan2D],
        *,
        steers: bool,
    ) -> UnderWay[PathStep]:
        """Begin to plan the next push; returns at once. Arguments as of `PathSteps.plan`."""

    def begin_steered(self, observed: TrackedObject, step: PathStep, path: PathGoal) -> SteeredUnderWay:
        """Request a push along a path, and correct it; returns at once."""


@dataclass(slots=True)
class GoalProgress:
    """Progress of a goal."""

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
    """Target of the object; None before it is chosen."""
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
    """Deviation from the plan that was handled, for the log; empty: nothing new."""


@dataclass(frozen=True, slots=True)
class GoalOutcome:
    """Outcome of a goal."""

    code: GoalCode
    text: str
    """Reason and remedy; empty at the goal."""
    progress: GoalProgress
