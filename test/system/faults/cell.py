"""A live cell: nodes in processes of their own on a ROS domain of their own, a proxy between them and a monitor beside them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from geometry_msgs.msg import Point
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from system.faults.monitor import Goal, Monitor, until
from system.faults.process import Process
from system.faults.proxy import OBJECT, OBJECT_POSE, Proxy, source_of

from helpers.spinning import spinning
from push_ident.cli.supervisor import NodeCommand, node_commands
from push_ident.nodes.base.network import own_domain
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.srv import SaveModel

SIM_CELL, EXECUTOR, IDENTIFICATION, RECORDER = "sim_cell_node", "push_executor_node", "identification_node", "bag_recorder_node"
STARTUP = 60.0
"""Longest wait for a cell that can plan a push [s]."""
PLANNED = 3.0
"""Longest wait for the plan of a push [s]; after that it is requested again."""
TRIES = 3
"""A push that fails before its fault is injected is requested so many times."""
PUSH = 60.0
"""Longest push [s]."""
MOVING, STILL = 0.02, 0.01
"""A joint that turns faster makes a moving arm; no joint of a standing arm does [rad/s]."""


@dataclass(frozen=True, eq=False)
class CellPlan:
    """Which nodes a cell has, and which topics pass the proxy."""

    nodes: tuple[str, ...]
    through: tuple[str, ...]
    parameters: Mapping[str, Mapping[str, object]] = field(default_factory=dict)


# Poses come from the simulated world, without a camera.
WITHOUT_CAMERA: dict[str, object] = {"camera_rate": 0.0, "truth_as_perception": True}
QUICK: dict[str, object] = {
    "home_posture": [0.5, 1.0, 0.0, -1.92, 0.0, 0.22, 0.0],  # near the object: no camera is in the way
    "arm_timeout": 0.5,  # a shared machine stalls for longer than the 0.1 s of a real cell; the fault of the silent arm sets that
    "tracking_lag": 0.5,
    "settle": 0.2,
    "rest": 0.4,
    "free_speed": 0.5,
}
"""Of the executor: quick moves between pushes. What a push itself may do is as by default."""
ARM_CELL = CellPlan(
    (SIM_CELL, EXECUTOR, IDENTIFICATION),
    ("joint_states", "pusher/wrench", "/clock", "robot_description", OBJECT_POSE, "push_record", "pusher/pose"),
    {SIM_CELL: WITHOUT_CAMERA, EXECUTOR: QUICK},
)
BARE_CELL = CellPlan((SIM_CELL,), ("joint_states",), {SIM_CELL: WITHOUT_CAMERA})
"""An arm without its executor."""


class Cell:
    """A running cell. Made by `live_cell`."""

    def __init__(self, plan: CellPlan, folder: Path, domain: int, monitor: Monitor) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.plan, self.folder, self.domain, self.monitor = plan, folder, domain, monitor
        self.state_folder = folder / "state"
        """Of identification."""
        self.proxy = Proxy(monitor, plan.through)
        self.processes: dict[str, Process] = {}
        """By name of the node."""
        for command in self._commands():
            self.add(command)

    def _commands(self) -> Iterator[NodeCommand]:
        parameters = {name: dict(self.plan.parameters.get(name, {})) for name in self.plan.nodes}
        if IDENTIFICATION in parameters:
            parameters[IDENTIFICATION]["state_directory"] = str(self.state_folder)
        publishers = {"push_record": EXECUTOR, "pusher/pose": EXECUTOR}
        for command in node_commands("sim", parameters=parameters):
            if command.name in self.plan.nodes:
                published = [topic for topic in self.plan.through if publishers.get(topic, SIM_CELL) == command.name]
                remapped = [part for topic in published for part in ("-r", f"{topic}:={source_of(topic)}")]
                yield NodeCommand(command.name, (*command.argv, *remapped), is_node=True)

    def add(self, command: NodeCommand) -> Process:
        process = self.processes[command.name] = Process(command, self.folder / f"{command.name}.log", self.domain)
        return process

    @contextmanager
    def with_process(self, command: NodeCommand) -> Iterator[Process]:
        try:
            yield self.add(command)
        finally:
            self.processes.pop(command.name).interrupt()

    @contextmanager
    def with_recorder(self, bag: Path, **parameters: object) -> Iterator[Process]:
        commands = node_commands("sim", record=bag, parameters={RECORDER: {"depth": False, **parameters}})
        with self.with_process(next(command for command in commands if command.name == RECORDER)) as recorder:
            until(lambda: self.monitor.reports_of(RECORDER), 20.0, "the recorder reports nothing")
            time.sleep(1.5)
            yield recorder

    # ---- pushes

    def goal(self, side: int = 1, *, distance: float = 0.05, speed: float = 0.15) -> ExecutePush.Goal:
        """A push against the long side of the object, from the side of positive (1) or negative (-1) y of its frame."""
        return ExecutePush.Goal(
            mode=ExecutePush.Goal.MODE_CONTACT,
            object_id=OBJECT,
            frame_id=f"object_{OBJECT}",
            contact_point=Point(x=0.0, y=0.1 * side),
            direction=-1.5708 * side,
            distance=distance,
            speed=speed,
        )

    def begin(self, goal: ExecutePush.Goal | None = None, *, after: float = 0.1) -> Goal:
        """Request a push and return `after` seconds of the motion that follows the settled tool.

        One that ends before, as on a machine that stalls, is requested again.
        """
        for _ in range(TRIES):
            sent = self.monitor.send(goal or self.goal())
            if self._pushes(sent):
                time.sleep(after)
                return sent
            self.reset_object()
        raise AssertionError(f"the push ended before its motion: {self.end(sent).error_text or 'no error'}")

    def _pushes(self, sent: Goal) -> bool:
        """Wait until the arm pushes; False where the push ended before."""
        settled = False

        def reached() -> bool:
            nonlocal settled
            if sent.result is not None:
                return True
            if ExecutePush.Feedback.PHASE_PUSH not in sent.phases[-1:]:
                return False
            settled = settled or not self.is_moving(STILL)
            return settled and self.is_moving()

        until(reached, PUSH, "no arm that pushes")
        return sent.result is None

    def end(self, sent: Goal, patience: float = PUSH) -> ExecutePush.Result:
        until(lambda: sent.result is not None, patience, "the push did not end")
        assert sent.result is not None
        return sent.result

    def push(self, goal: ExecutePush.Goal | None = None) -> ExecutePush.Result:
        return self.end(self.monitor.send(goal or self.goal()))

    def whole_push(self, goal: ExecutePush.Goal | None = None) -> None:
        """A push that is made to its end, at the latest at the third time."""
        for _ in range(TRIES):
            result = self.push(goal)
            if result.error_code == 0:
                return
            self.reset_object()
        raise AssertionError(f"no push was made to its end: {result.error_text}")

    def reset_object(self) -> None:
        """Put the object back to the middle; where the arm is beside it, it stays: the next push goes up first."""
        self.monitor.call(Trigger, f"{SIM_CELL}/reset", Trigger.Request())

    def is_moving(self, speed: float = MOVING) -> bool:
        """Whether a joint turns faster than `speed` [rad/s]."""
        latest = self.monitor.latest_state()
        return latest is not None and latest.speed > speed

    # ---- nodes

    def recover(self) -> None:
        """Everything passes again, what ended runs again, the object lies in the middle, and a push can be planned."""
        self.proxy.clear()
        self.monitor.withdraw()
        for process in self.processes.values():
            process.start()
        self.await_ready()
        self.reset_object()

    def await_ready(self) -> None:
        if EXECUTOR not in self.plan.nodes:
            until(self.monitor.latest_state, STARTUP, "no joint states came")
            return
        goal, deadline, text = self.goal(), time.monotonic() + STARTUP, ""
        goal.dry_run = True
        while time.monotonic() < deadline:
            for name, process in self.processes.items():
                assert process.runs, f"{name} ended: {' / '.join(process.output.splitlines()[-2:])}"
            try:
                result = self.end(self.monitor.send(goal, PLANNED), PLANNED)
            except AssertionError as error:  # the goal went to an executor that was killed
                text = str(error)
                continue
            if result.error_code == 0:
                return
            text = result.error_text
            time.sleep(0.3)
        raise AssertionError(f"no push can be planned after {STARTUP:.0f} s: {text}")

    @contextmanager
    def with_parameter(self, node: str, name: str, value: object, usual: object) -> Iterator[None]:
        """A parameter of a running node has another value for a while."""
        for present in (value, usual):
            request = SetParameters.Request(parameters=[Parameter(name, value=present).to_parameter_msg()])
            (answer,) = self.monitor.call(SetParameters, f"{node}/set_parameters", request).results
            assert answer.successful, answer.reason
            if present is value:
                yield

    def save_model(self, path: Path) -> str:
        answer = self.monitor.call(SaveModel, "save_model", SaveModel.Request(path=str(path)))
        return "" if answer.success else str(answer.message)


@contextmanager
def live_cell(plan: CellPlan, folder: Path) -> Iterator[Cell]:
    """A cell that can push."""
    domain = own_domain()
    with spinning(Monitor, domain) as monitor:
        cell = Cell(plan, folder, domain, monitor)
        try:
            cell.await_ready()
            yield cell
        finally:
            for process in cell.processes.values():
                process.interrupt(patience=3.0)
            cell.proxy.close()
            monitor.stalls.__exit__()
