"""Request of a client to the executor, the settings of its execution, and its outcome."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

from push_ident.errors import PlanningError
from push_ident.pushing.motion import ArmPlan, MotionSettings
from push_ident.pushing.push import PushSettings
from push_ident.pushing.steering import PathRequest
from push_ident.pushing.watch_limits import WatchLimits

__all__ = ["ExecutionSettings", "Mode", "PushOutcome", "PushRequest"]


class Mode(IntEnum):
    """How a push is chosen; the numbers are those of the goal of action/ExecutePush."""

    CONTACT = 0
    RANDOM = 1
    RECENTRE = 2
    PATH = 3


@dataclass(frozen=True, slots=True)
class PushRequest:
    """A push as a client requests it; see action/ExecutePush."""

    mode: int
    object_id: str = ""
    frame_id: str = ""
    """Of contact point and direction: the table frame (also if empty), or the frame of the object."""
    contact_point: tuple[float, float] = (0.0, 0.0)
    """[m]"""
    direction: float = 0.0
    """[rad]"""
    distance: float = 0.0
    """[m]; 0: the default."""
    speed: float = 0.0
    """[m/s]; 0: the default."""
    seed: int = 0
    """Of a random push."""
    dry_run: bool = False
    """Plan only."""
    path: PathRequest | None = None
    """Of a push along a path."""


@dataclass(frozen=True, slots=True)
class ExecutionSettings:
    """Settings of the execution. Fields up to `min_object_turn`, and those of the parts, are parameters of the executor."""

    push: PushSettings
    motion: MotionSettings
    limits: WatchLimits = field(default_factory=WatchLimits)
    recentre: bool = True
    """Whether an object near the edge is first pushed towards the middle, where the request allows it."""
    push_distance: float = 0.06
    """Where a request gives none [m]."""
    push_speed: float = 0.15
    """Where a request gives none [m/s]."""
    pose_timeout: float = 1.0
    """Oldest object pose, by time of receipt, that a push may start from [s]."""
    lost_timeout: float = 3.0
    """An object whose last pose was received longer ago during a push is lost [s]: an arm that pushes from the side of the camera hides it
    for the better part of the push."""
    min_object_shift: float = 0.002
    """Smaller shifts of the object count as no contact [m]."""
    min_object_turn: float = 0.0175
    """Smaller turns of the object count as no contact [rad]."""
    n_plans: int = 20
    """Pushes that are planned, random or recentring ones, before the request is refused as unreachable."""
    feedback_period: float = 0.1
    """Longest time between two reports to the client [s]."""
    standstill_time: float = 0.15
    """Time that an arm needs to come to rest once it is held [s]."""
    clearance_deviations: float = 3.0
    """Standard deviations of the object's position that `clearance` must cover, where the tool comes down [1]: 1 in 370 is beyond."""
    workspace_drift: float = 0.002
    """Largest further motion outward of an object that was outside the workspace at the start [m]."""


@dataclass(slots=True)
class PushOutcome:
    """Outcome of a request."""

    plan: ArmPlan | None = None
    push_id: int = 0
    """0: nothing moved."""
    recentre_push_id: int = 0
    """Of the recentring push before it; 0: none."""
    object_id: str = ""
    """Object that is pushed."""
    n_corrections: int = 0
    """Corrections of a push along a path that were applied."""
    n_refused: int = 0
    """Corrections that were refused."""
    error: PlanningError | None = None
