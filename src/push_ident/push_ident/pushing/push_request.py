"""Request of a client to the executor, the settings of its execution and of the watch over the arm, and its outcome."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

from push_ident.errors import PlanningError
from push_ident.pushing.motion import ArmPlan, MotionSettings
from push_ident.pushing.push import PushSettings
from push_ident.pushing.steering import PathRequest
from push_ident.pushing.tool_path import ToolPath

PIECES: Final = "pieces"
FOLLOW: Final = "follow_joint_trajectory"


@dataclass(frozen=True, slots=True)
class WatchLimits:
    """Limits that a moving arm is watched by. Those up to `wrench_timeout` are parameters of the executor."""

    arm_timeout: float = 0.1
    """The arm is held this long after the last joint state, by wall time, at the latest [s]."""
    start_tolerance: float = 0.02
    """Largest distance of a joint from its commanded position, at the start of a motion and during it [rad]."""
    tracking_tolerance: float = 0.010
    """Largest distance of the tool from its planned path [m]."""
    tracking_lag: float = 0.2
    """Largest delay of the arm behind the plan [s]."""
    force_limit: float = 60.0
    """Largest horizontal force [N]."""
    motion_horizon: float = 0.08
    """Motion at the planned speed that the arm is given ahead [s]: without news it brakes after that."""
    stamp_commands: bool = False
    """Whether pieces say when they start by the clock of the arm's stamps; else they start on receipt, and transport adds its jitter."""
    free_motions: str = PIECES
    """How the arm gets the parts of a motion above `free_height`: in pieces as the rest, or each as one goal of its controller."""
    free_height: float = 0.09
    """Height of the tip above every object [m]."""
    wrench_timeout: float = 0.5
    """Longest time without a force measurement, where there ever was one [s]."""
    period: float = 0.01
    """Time between two looks at arm, sensors and objects [s]."""
    late_look: float = 0.03
    """A look that comes so long after the previous one was delayed itself [s]."""
    max_absence: float = 0.5
    """Longest time without a look [s]: after it the motion does not go on, the cell may have changed and the path of the tool has a gap."""
    arrival_timeout: float = 1.0
    """Longest time to arrive after the end of the plan [s]."""
    pieces_per_horizon: int = 4
    """Pieces that are sent within `motion_horizon`: three may be lost or late before the arm brakes."""
    acceleration_shares: tuple[float, ...] = (1.0, 0.8, 0.6)
    """Shares of the joints' acceleration limits that are tried for a piece [1]: one cubic takes up to 1.5 times the acceleration of the two
    that it stands for."""
    standstill_lag: float = 0.001
    """Travel of the tool [m] by which an arm at rest is behind its pieces: it has missed some, and would jump to the next one."""
    standstill_travel: float = 3e-4
    """A tool that has moved less [m] within `standstill_time` is at rest, or so slow that it is behind for no other reason."""
    standstill_time: float = 0.03
    """[s]"""
    delay_margin: float = 0.03
    """Delay of the arm beyond its usual one [s]: one more state."""
    takeover_share: float = 0.125
    """Share of the time to a posture for which an arm without an earlier command is watched [1]. A cubic has made 4.3 % of its way then: an
    arm more than 23 start tolerances away has moved by more than one."""

    def patience(self, timeout: float) -> float:
        """Longest silence of another source [s]: `timeout`, or twice that of the arm where it may pause for longer, as a simulated one."""
        return float(max(timeout, 2.0 * self.arm_timeout))


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
    path: PathRequest | ToolPath | None = None
    """Of a push along a path; one with yaws, of a tool that turns, is not corrected and has no corridor."""


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
