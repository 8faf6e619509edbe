"""What a client requests of the executor, by which settings it is carried out, and what became of it."""

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
    """Numbers of the execution. Fields, and those of the parts, are parameters of the executor."""

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


@dataclass(slots=True)
class PushOutcome:
    """What became of a request."""

    plan: ArmPlan | None = None
    push_id: int = 0
    """0: nothing moved."""
    recentre_push_id: int = 0
    """Of the recentring push before it; 0: none."""
    object_id: str = ""
    """That is pushed."""
    n_corrections: int = 0
    """That were made of a push along a path."""
    n_refused: int = 0
    """And that were refused."""
    error: PlanningError | None = None
