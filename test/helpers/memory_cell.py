"""A cell in memory with a clock of its own: arm, hand, sensors and a box, on which pushes are executed."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext, suppress

import numpy as np

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points
from push_ident.pushing.arm_clock import ArmClock
from push_ident.pushing.arm_motion import JointLimits
from push_ident.pushing.executed_push import ExecutedPush
from push_ident.pushing.execution import PushExecution
from push_ident.pushing.motion import MotionSettings
from push_ident.pushing.ports import ArmState, ExecutionPorts, Phase, TrackedObject
from push_ident.pushing.push import PushCode, PushSettings
from push_ident.pushing.push_request import ExecutionSettings, Mode, PushOutcome, PushRequest, WatchLimits
from push_ident.pushing.state_intake import StateCheck, StateIntake
from push_ident.pushing.trajectory import JointTrajectory
from push_ident.types import Float64Array, ObjectShape
from push_ident_sim.cell.robot import HOME
from push_ident_sim.cell.trajectory import JointTrajectory as Followed

RADIUS = 0.018
BOX = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
SHAPE = ObjectShape(cells_in_outline(BOX, 0.01), BOX)
PARKED = (0.5, *HOME[1:])
SETTINGS = ExecutionSettings(
    push=PushSettings(workspace=(-0.1, 0.2, -0.25, 0.25), pusher_radius=RADIUS),
    motion=MotionSettings(home=PARKED, free_speed=0.5, settle=0.2, rest=0.4),
    limits=WatchLimits(force_limit=30.0),
    lost_timeout=0.4,
)
CONTACT = PushRequest(Mode.CONTACT, "box", contact_point=(0.0, -0.01), direction=math.pi / 2, distance=0.05, speed=0.1)


class Goal:
    """A goal of the controller of a `Cell`, as that of joint_trajectory_controller: a later trajectory takes its place, and ends it."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self.is_accepted = True
        self.is_over = False
        self.fault: PlanningError | None = None
        self.canceled_at = math.inf

    def cancel(self) -> None:
        self.canceled_at, self.is_over = self._cell.time, True
        self._cell.followed = Followed.hold(self._cell.q)  # where it is, at once


class Cell:
    """An arm that follows every trajectory exactly, and a box that the tool carries along while it overlaps: all ports in one.

    `events` are called at each step of 10 ms with the cell; they play the faults.
    """

    is_simulated = False
    is_there = True

    def __init__(self, kinematics: ArmKinematics) -> None:
        self.planner = kinematics
        self.time = 100.0
        self.q = np.array(PARKED)
        self.box = np.array([0.0, 0.02, 0.3])
        self.tip = kinematics.forward(self.q)[:3, 3]
        self.followed = Followed.hold(self.q)
        self.pieces: list[JointTrajectory] = []
        self.holds: list[Float64Array] = []
        self.goals: list[tuple[float, JointTrajectory, Goal]] = []
        self.ends_goals = True
        speed = np.minimum(kinematics.velocity_limit, 5.0)
        self.intake = StateIntake(StateCheck(kinematics.position_lower, kinematics.position_upper, speed), kinematics.forward)
        self.clock = ArmClock()
        self.corrupt: Callable[[float, Float64Array], list[tuple[float, Float64Array]]] = lambda stamp, q: [(stamp, q)]
        """What is reported of stamp [s] and joints [rad] of a state: none, one or more of them."""
        self.events: list[Callable[[Cell], None]] = []
        self.is_silent = self.is_hidden = self.is_box_fixed = self.is_deaf = False
        self.offset = np.zeros(7)
        self.delay = 0.0
        self.on_the_way: list[tuple[float, JointTrajectory]] = []
        self.force, self.felt = 1.0, 100.0
        self.hand_text = self.fault = ""
        self.rivals_found: tuple[str, ...] = ()
        self.pose_received = 100.0
        self.pose = self.box.copy()
        self.pose_std = np.zeros(3)
        self.pose_offset = np.zeros(3)
        self.rng = np.random.default_rng(0)
        self.step()

    # ---- the world

    def step(self) -> None:
        self.time += 0.01
        for event in self.events:
            event(self)
        while self.on_the_way and self.on_the_way[0][0] <= self.time:
            self.follow(self.on_the_way.pop(0)[1])
        if self.pieces:
            self.q = self.followed.sample(self.time)[0]
        if self.goals and self.ends_goals and self.time > self.followed.time[-1] + 0.02:
            self.goals[-1][2].is_over = True
        before, self.tip = self.tip, self.planner.forward(self.q)[:3, 3]
        touches = self.tip[2] < 0.05 and signed_distance(self.tip[None, :2], transform_points(self.box, BOX))[0] < RADIUS
        if touches and not self.is_box_fixed:
            self.box[:2] += self.tip[:2] - before[:2]
        if not self.is_silent:
            for stamp, q in self.corrupt(self.time, self.q + self.offset):
                with suppress(InputError):
                    if self.intake.take(self.time, stamp, q) is not None:
                        self.clock.observe(self.time, stamp)
        if not self.is_hidden:
            self.pose, self.pose_received = self.box + self.pose_offset + self.pose_std * self.rng.normal(size=3), self.time

    # ---- clock

    def now(self) -> float:
        return self.time

    monotonic = now

    def sleep(self, seconds: float) -> None:
        end = self.time + seconds - 1e-9
        while self.time < end:
            self.step()

    # ---- arm

    @property
    def state(self) -> ArmState | None:
        return self.intake.latest

    def fresh_state(self, timeout: float, *, is_late: bool = False) -> ArmState:
        if self.state is None or self.time - self.state.received > timeout - 0.03:
            raise PlanningError(PushCode.ARM_SILENT, "no joint states.")
        return self.state

    def next_state(self, timeout: float) -> ArmState:
        self.step()
        return self.fresh_state(timeout)

    def rivals(self) -> tuple[str, ...]:
        return self.rivals_found

    def stamp_now(self) -> tuple[float, bool]:
        return self.clock.at(self.time)

    def in_use(self) -> nullcontext[None]:
        return nullcontext()

    def take_states(self) -> list[ArmState]:
        return self.intake.take_waiting()

    def impossible_state(self, since: float) -> str:
        return self.intake.impossible(since)

    def send(self, joint_names: tuple[str, ...], piece: JointTrajectory, start: float | None) -> None:
        if len(piece.time) == 1:
            self.holds.append(piece.position[-1])
        if self.delay > 0.0:
            self.on_the_way.append((self.time + self.delay - 1e-9, piece))
        elif not self.is_deaf:
            self.follow(piece)

    def check_goals(self) -> None:
        pass

    def send_goal(self, joint_names: tuple[str, ...], piece: JointTrajectory, start: float | None) -> Goal:
        goal = Goal(self)
        self.goals.append((self.time, piece, goal))
        self.send(joint_names, piece, start)
        return goal

    def follow(self, piece: JointTrajectory) -> None:
        state = self.followed.sample(self.time) if self.pieces else (self.q, np.zeros(7))
        self.followed = Followed(piece.time, piece.position, piece.velocity).from_state(self.time, *state)
        self.pieces.append(piece)

    # ---- hand, force, recorder

    def why_no_fist(self) -> str:
        return self.hand_text

    def close_fist(self, timeout: float, is_over: Callable[[], bool]) -> str:
        self.sleep(0.5)
        self.hand_text = ""
        return ""

    @property
    def silence(self) -> float:
        return self.time - self.felt if self.felt < math.inf else 0.0

    def take_peak(self) -> float:
        return self.force

    # ---- objects

    def get(self, object_id: str, max_age: float) -> TrackedObject:
        if object_id not in ("", "box"):
            raise PlanningError(PushCode.UNKNOWN_OBJECT, f"no object `{object_id}`.")
        if self.time - self.pose_received > max_age:
            raise PlanningError(PushCode.UNKNOWN_OBJECT, "the pose is too old.")
        return TrackedObject("box", SHAPE, self.pose_received, self.pose, np.diag(self.pose_std**2))

    def outlines_of_others(self, object_id: str) -> list[Float64Array]:
        return []


class Client:
    def __init__(self) -> None:
        self.is_cancel_requested = False
        self.phases: list[Phase] = []
        self.progress: list[float] = []
        self.begun: list[tuple[int, float]] = []

    @property
    def why_over(self) -> str:
        return "canceled on request" if self.is_cancel_requested else ""

    def feedback(self, phase: Phase, progress: float) -> None:
        self.phases.append(phase)
        self.progress.append(progress)

    def began(self, push_id: int, start: float) -> None:
        self.begun.append((push_id, start))


class Bench:
    """An execution on a cell, with what it reported."""

    def __init__(self, kinematics: ArmKinematics) -> None:
        self.cell = cell = Cell(kinematics)
        cell.felt = math.inf  # the force is measured all the time
        self.pushes: list[ExecutedPush] = []
        self.warnings: list[str] = []
        self.client = Client()
        ports = ExecutionPorts(cell, cell, cell, cell, cell, cell)
        self.execution = PushExecution(ports, on_push=self.pushes.append, on_warning=self.warnings.append)

    def push(self, request: PushRequest = CONTACT, settings: ExecutionSettings = SETTINGS) -> PushOutcome:
        return self.execution.execute(request, settings, self.client)

    def when_pushing(self, action: Callable[[Cell], None]) -> None:
        """Do something at every step while the tool is lowered, from the first such step on."""
        began = []

        def event(cell: Cell) -> None:
            if self.execution.is_pushing or began:
                began.append(True)
                action(cell)

        self.cell.events.append(event)


def largest_shares(followed: Followed, since: float, until: float, limits: JointLimits) -> tuple[float, float]:
    """Of the limits of velocity and of acceleration, that an arm reaches on the cubics that it follows between two times [s]."""
    t = followed.time
    if len(t) < 2 or until <= since or followed.velocity is None:
        return 0.0, 0.0
    q, v, span = followed.position, followed.velocity, np.diff(t)[:, None]
    cubic = 2.0 * (q[:-1] - q[1:]) / span**3 + (v[:-1] + v[1:]) / span**2
    square = 3.0 * (q[1:] - q[:-1]) / span**2 - (2.0 * v[:-1] + v[1:]) / span
    reached = (t[1:, None] > since) & (t[:-1, None] < until)
    begin, end = (np.clip(time - t[:-1], 0.0, span[:, 0]) for time in (since, until))
    velocity = acceleration = 0.0
    for share in np.linspace(0.0, 1.0, 5):
        x = (begin + share * (end - begin))[:, None]
        speeds = np.abs(v[:-1] + 2.0 * square * x + 3.0 * cubic * x**2) / limits.velocity
        changes = np.abs(2.0 * square + 6.0 * cubic * x) / limits.acceleration
        velocity = max(velocity, float(np.max(np.where(reached, speeds, 0.0))))
        acceleration = max(acceleration, float(np.max(np.where(reached, changes, 0.0))))
    return velocity, acceleration


def code_of(outcome: PushOutcome) -> int:
    return PushCode.NONE if outcome.error is None else outcome.error.code
