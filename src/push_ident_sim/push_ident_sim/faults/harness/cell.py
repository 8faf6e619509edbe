"""A live cell: the suite's nodes in processes of their own on a ROS domain of their own, a proxy between them and a monitor beside them."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from geometry_msgs.msg import Point
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue, SetParametersResult
from rcl_interfaces.srv import SetParameters
from std_srvs.srv import Trigger

from push_ident.cli.supervisor import NodeCommand, node_commands
from push_ident.errors import PushIdentError
from push_ident.nodes.base.network import own_domain
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.srv import SaveModel
from push_ident_sim.faults.harness.monitor import Goal, Monitor, until
from push_ident_sim.faults.harness.process import Process
from push_ident_sim.faults.harness.proxy import Proxy, source_of
from push_ident_sim.faults.harness.topics import OBJECT, SEEN, TOPICS, qos_of

__all__ = ["ARM_CELL", "CAMERA_CELL", "Cell", "CellPlan", "live_cell"]

_STARTUP: Final = 60.0
"""Longest wait for a cell that can plan a push [s]."""
_ANSWER: Final = 3.0
"""Longest wait for the plan of a push [s]; after that it is requested again."""
_TRIES: Final = 3
"""A push that fails before its fault is injected is requested so many times."""
_SAID: Final = 6
"""Of what the executor said in vain, the most frequent so many are reported."""
_PUSH: Final = 60.0
"""Longest push [s]."""
_MOVING: Final = 0.05
"""A joint that turns faster makes a moving arm [rad/s]."""
_STILL: Final = 0.01
"""No joint of a standing arm turns faster [rad/s]."""
_EXECUTOR: Final[dict[str, object]] = {
    "home_posture": [0.5, 1.0, 0.0, -1.92, 0.0, 0.22, 0.0],  # near the object: no camera is in the way
    "arm_timeout": 0.5,  # a shared machine stalls for longer than the 0.1 s of a real cell; the fault of the silent arm sets that
    "tracking_lag": 0.5,
    "settle": 0.2,
    "rest": 0.4,
    "free_speed": 0.5,
}
"""Of the executor: quick moves between pushes. What a push itself may do is as by default."""


@dataclass(frozen=True, slots=True, eq=False)
class CellPlan:
    """Which nodes a cell has, and which topics pass the proxy."""

    name: str
    nodes: tuple[str, ...]
    through: tuple[str, ...]
    """Topics of the simulated cell that pass the proxy."""
    parameters: Mapping[str, Mapping[str, object]] = field(default_factory=dict)


OBJECT_POSE: Final = f"objects/{OBJECT}/pose"
ARM_CELL: Final = CellPlan(
    "arm",
    ("sim_cell_node", "push_executor_node", "identification_node"),
    ("joint_states", "pusher/wrench", "/clock", "robot_description", OBJECT_POSE, "push_record", "pusher/pose"),
    {"sim_cell_node": {"camera_rate": 0.0, "truth_as_perception": True}, "push_executor_node": _EXECUTOR},
)
"""Poses come from the simulated world, without a camera."""
CAMERA_CELL: Final = CellPlan(
    "camera",
    ("sim_cell_node", "perception_node", "push_executor_node"),
    ("joint_states", "depth/image_rect", "depth/camera_info"),
    {"push_executor_node": {"arm_timeout": 0.5, "tracking_lag": 0.5}},
)
"""Poses come from perception of the rendered depth images."""


class Cell:
    """A running cell. Made by `live_cell`.

    Attributes:
        processes: by name of the node.
        monitor: what the nodes publish.
        proxy: between them.
        folder: of logs and of files of the nodes.
    """

    def __init__(self, plan: CellPlan, folder: Path, domain: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.plan, self.folder, self.domain = plan, folder, domain
        self.state_folder = folder / "state"
        self.monitor = Monitor(domain)
        self.proxy = Proxy(self.monitor.node, plan.through)
        self.proxy.watch("joint_states", self.monitor.on_state)
        self.processes: dict[str, Process] = {}
        self._watched: dict[str, list[tuple[float, Any]]] = {}
        for command in self._commands():
            self.add(command)

    def _commands(self) -> list[NodeCommand]:
        parameters = {name: dict(self.plan.parameters.get(name, {})) for name in self.plan.nodes}
        if "identification_node" in parameters:
            parameters["identification_node"].setdefault("state_directory", str(self.state_folder))
        chosen = [c for c in node_commands("sim", parameters=parameters, log_level="info") if c.name in self.plan.nodes]
        publishers = {"push_record": "push_executor_node", "pusher/pose": "push_executor_node"}
        remapped = []
        for command in chosen:
            own = [topic for topic in self.plan.through if publishers.get(topic, "sim_cell_node") == command.name]
            rules = [part for topic in own for part in ("-r", f"{topic}:={source_of(topic)}")]
            remapped.append(NodeCommand(command.name, (*command.argv, *rules)))
        return remapped

    def add(self, command: NodeCommand) -> Process:
        """Start one more process in the cell."""
        log = self.folder / f"{command.name}.log"
        process = Process(command, log, {"ROS_DOMAIN_ID": str(self.domain)})
        self.processes[command.name] = process
        return process

    def remove(self, name: str) -> None:
        """Stop a process that was added."""
        self.processes.pop(name).interrupt()

    def watch(self, topic: str) -> list[tuple[float, Any]]:
        """Messages of a topic of `TOPICS` from now on, each with its time of receipt [s]; the list grows."""
        if topic not in self._watched:
            kept = self._watched[topic] = []
            self.monitor.node.create_subscription(
                TOPICS[topic].kind, topic, lambda msg: kept.append((time.monotonic(), msg)), qos_of(topic)
            )
        del self._watched[topic][:]
        return self._watched[topic]

    def watch_poses(self) -> list[tuple[float, Any]]:
        """The same of the poses of the first object that the camera sees."""
        return self.watch(f"objects/{SEEN}/pose")

    # ---- pushes

    def goal(self, side: int = 1, *, distance: float = 0.05, speed: float = 0.15) -> ExecutePush.Goal:
        """A push against the long side of the object, from the side of positive (1) or negative (-1) y of its frame."""
        point = Point(x=0.0, y=0.1 * side)
        return ExecutePush.Goal(
            mode=ExecutePush.Goal.MODE_CONTACT,
            object_id=OBJECT,  # others may be seen too
            frame_id=f"object_{OBJECT}",
            contact_point=point,
            direction=-1.5708 * side,
            distance=distance,
            speed=speed,
        )

    def begin(self, goal: ExecutePush.Goal | None = None, *, phase: int = ExecutePush.Feedback.PHASE_PUSH, after: float = 0.1) -> Goal:
        """Request a push and return `after` seconds of motion in `phase`; in that of the push, of the motion after the tool has settled.

        A push that ends before, as on a machine that stalls, is requested again.

        Raises:
            PushIdentError: It ended before each time.
        """
        for left in reversed(range(_TRIES)):
            sent = self.monitor.send(goal or self.goal())
            if self._reaches(sent, phase):
                time.sleep(after)
                return sent
            if left == 0:
                raise PushIdentError(f"the push ended before phase {phase}: {self.end(sent).error_text or 'no error'}")
            self.reset_object()
        raise AssertionError

    def _reaches(self, sent: Goal, phase: int) -> bool:
        """Wait until the arm moves in `phase`; False where the push ended before."""
        settled = phase != ExecutePush.Feedback.PHASE_PUSH

        def reached() -> bool:
            nonlocal settled
            if sent.result is not None:
                return True
            if not sent.phases or sent.phases[-1][1] != phase:
                return False
            settled = settled or not self.is_moving(_STILL)
            return settled and self.is_moving()

        until(reached, _PUSH, f"no arm that moves in phase {phase}")
        return sent.result is None

    def end(self, sent: Goal, patience: float = _PUSH) -> ExecutePush.Result:
        """Result of a push."""
        until(lambda: sent.result is not None, patience, "the push did not end")
        result = sent.result
        assert result is not None
        return result

    def push(self, goal: ExecutePush.Goal | None = None) -> ExecutePush.Result:
        """One whole push."""
        return self.end(self.monitor.send(goal or self.goal()))

    def whole_push(self, goal: ExecutePush.Goal | None = None) -> None:
        """A push that is made to its end, at the latest at the third time. Raises PushIdentError where it is not."""
        for _ in range(_TRIES):
            result = self.push(goal)
            if result.error_code == 0:
                return
            self.reset_object()
        raise PushIdentError(f"no push was made to its end: {result.error_text}")

    def reset_object(self) -> None:
        """Put the object back to the middle; where the arm is beside it, it stays: the next push goes up first."""
        self.monitor.call(Trigger, "sim_cell_node/reset", Trigger.Request())

    def is_moving(self, speed: float = _MOVING) -> bool:
        """Whether a joint turns faster than `speed` [rad/s], by the latest joint state."""
        latest = self.monitor.states(self.monitor.last_state)
        return bool(latest) and float(abs(latest[-1].velocity).max()) > speed

    # ---- the way back to a cell that can push

    def recover(self) -> None:
        """Everything passes again, what ended runs again, the object lies in the middle, and a push can be planned.

        Raises:
            PushIdentError: It cannot.
        """
        self.proxy.clear()
        self.monitor.withdraw()
        for process in self.processes.values():
            process.start()
        self.await_ready()
        self.reset_object()

    def await_ready(self) -> None:
        """Until the executor can plan a push; in a cell without one, until the arm reports."""
        if "push_executor_node" in self.plan.nodes:
            self.await_executor()
        else:
            until(lambda: self.monitor.last_state > 0.0, _STARTUP, "no joint states came")

    def await_executor(self) -> None:
        """Until the executor can plan a push."""
        goal = self.goal() if OBJECT_POSE in self.plan.through else ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM)
        goal.dry_run = True
        deadline, said = time.monotonic() + _STARTUP, Counter[str]()
        while time.monotonic() < deadline:
            for process in self.processes.values():
                if not process.runs:
                    raise PushIdentError(f"{process.name} ended: {' / '.join(process.output.splitlines()[-2:])}")
            try:
                result = self.end(self.monitor.send(goal, _ANSWER), _ANSWER)
            except PushIdentError as error:  # the goal went to an executor that was killed
                said[str(error)] += 1
                continue
            if result.error_code == 0:
                return
            said[result.error_text] += 1
            time.sleep(0.3)
        raise PushIdentError(f"no push can be planned after {_STARTUP:.0f} s: {_in_short(said)}{self._lost_ports()}")

    def _lost_ports(self) -> str:
        """Which processes still hold ports of shared memory that somebody removed: what is sent there reaches nobody."""
        pids = {"this process": os.getpid()} | {process.name: process.pid for process in self.processes.values()}
        found = {name: n for name, pid in pids.items() if (n := _n_lost_ports(pid))}
        return "".join(f"; {name} holds {n} deleted ports of shared memory" for name, n in found.items())

    def set_parameter(self, node: str, name: str, value: float | int | bool | str) -> SetParametersResult:
        """Set a parameter of a running node."""
        answer = self.monitor.call(SetParameters, f"{node}/set_parameters", SetParameters.Request(parameters=[_parameter(name, value)]))
        return answer.results[0]

    def save_model(self, path: Path) -> str:
        """Let identification write its model; empty, or why not."""
        answer = self.monitor.call(SaveModel, "save_model", SaveModel.Request(path=str(path)))
        return "" if answer.success else str(answer.message)

    def close(self) -> None:
        """Stop all processes, then the monitor."""
        for process in self.processes.values():
            process.interrupt(patience=3.0)
        self.proxy.close()
        self.monitor.close()


def _in_short(said: Counter[str]) -> str:
    """Different texts, each with how often it came."""
    texts = [f"{text} ({n} times)" for text, n in said.most_common(_SAID)]
    return "; ".join(texts) + (f"; {len(said) - _SAID} others" if len(said) > _SAID else "")


def _n_lost_ports(pid: int) -> int:
    """Mappings of removed files of Fast DDS's ports; 0 where the process has ended or the system does not tell."""
    try:
        lines = Path(f"/proc/{pid}/maps").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return 0
    return sum("fastrtps_port" in line and "(deleted)" in line for line in lines)


def _parameter(name: str, value: float | int | bool | str) -> Parameter:
    kinds = {bool: ("BOOL", "bool"), int: ("INTEGER", "integer"), float: ("DOUBLE", "double"), str: ("STRING", "string")}
    number, field_name = kinds[type(value)]
    return Parameter(name=name, value=ParameterValue(type=getattr(ParameterType, f"PARAMETER_{number}"), **{f"{field_name}_value": value}))


@contextmanager
def live_cell(plan: CellPlan, folder: Path) -> Iterator[Cell]:
    """A cell that can push.

    Raises:
        PushIdentError: It does not start.
    """
    domain = int(os.environ.get("ROS_DOMAIN_ID") or own_domain())
    cell = Cell(plan, folder, domain)
    try:
        cell.await_ready()
        yield cell
    finally:
        cell.close()
