"""Start the node processes, show their output, start them again where they die, and stop them together: as `ros2 launch` does."""

from __future__ import annotations

import json
import os
import shlex
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import Final, Literal

from rich.console import Console
from rich.text import Text

from push_ident.cli.overrides import Overrides
from push_ident.cli.processes import LAST_LINES, Backoff, NodeCommand, NodeExit, NodeProcess, RestartPolicy
from push_ident.errors import InputError, PushIdentError
from push_ident.limits import printable
from push_ident.nodes.base.lifetime import LIFETIME, stopping_in_order

Kind = Literal["sim", "replay", "arm"]

_COLOURS: Final = ("cyan", "green", "magenta", "yellow", "blue", "bright_red")
_POLL_PERIOD: Final = 0.05
_TERMINATE_AFTER: Final = 5.0
"""Time from SIGINT to SIGTERM [s]; a node of this project stops within 1.8 s, on a loaded machine seconds later."""
_KILL_AFTER: Final = 1.0
"""Time from SIGTERM to SIGKILL [s]."""

_SIM_NODES: Final = ("sim_cell_node", "sim_hand_node")
"""Nodes of the package push_ident_sim; the others belong to push_ident."""
_NODES: Final[Mapping[Kind, tuple[str, ...]]] = {
    "sim": ("sim_cell_node", "perception_node", "push_executor_node", "identification_node", "gap_diagnosis_node", "goal_pushing_node"),
    "replay": ("perception_node", "identification_node", "bag_player_node"),
    "arm": ("perception_node", "push_executor_node", "identification_node", "gap_diagnosis_node", "goal_pushing_node"),
}
_PACED: Final[Mapping[str, dict[str, object]]] = {
    "bag_player_node": {"follower": "perception_node"},
    "perception_node": {"every_image": True},
    "identification_node": {"source": "bag_player_node"},
}
"""Parameters of a replay: the bag waits for the nodes, so that nothing is lost at any speed and any load."""
_NO_OVERRIDES: Final = Overrides()
_CLOCKS: Final = ("sim_cell_node", "bag_player_node")
"""Nodes that publish /clock themselves."""


class SupervisorError(PushIdentError):
    """A process could not be started, or a node did not end as expected."""


class Supervisor:
    """Runs processes until one of them dies or all are stopped.

    As a context manager, of the main thread, it starts them on entry and stops them on exit, also after an exception; SIGTERM and
    SIGHUP end the context as Ctrl-C does, by `SystemExit`.
    Each process leads a group of its own: a Ctrl-C at the terminal reaches only this one, which then stops the others in order.
    Each node has the reading end of a pipe, its lifeline: where this process is killed, all nodes end by themselves.

    Args:
        commands: The processes; their names must differ.
        log_dir: Folder for one `<name>.log` per process; None keeps none.
        console: Output of their lines, each with the name of its process; None shows nothing.
        restart: How a process that died is started again, in `poll`; None: its death is final.
    """

    def __init__(
        self,
        commands: Sequence[NodeCommand],
        *,
        log_dir: Path | None = None,
        console: Console | None = None,
        restart: RestartPolicy | None = None,
    ) -> None:
        names = [command.name for command in commands]
        if not names or len(set(names)) != len(names):
            raise InputError(f"process names are {names}, expected at least one and all different; rename or drop some")
        self._commands = tuple(commands)
        self._log_dir = log_dir
        self._console = console
        self._processes: dict[str, NodeProcess] = {}
        self._stopping = ExitStack()
        self._lifeline: tuple[int, int] | None = None
        self._backoffs = {name: Backoff(restart) for name in names} if restart is not None else {}
        self._due: dict[str, float] = {}
        self.deaths: list[NodeExit] = []
        """Of processes that were, or will be, started again."""

    def start(self) -> None:
        """Start all processes. Raises SupervisorError: One cannot be started; those started before are stopped again."""
        if self._log_dir is not None:
            self._log_dir.mkdir(parents=True, exist_ok=True)
            for command in self._commands:
                (self._log_dir / f"{command.name}.log").unlink(missing_ok=True)
        LIFETIME.patience = _TERMINATE_AFTER + 2 * _KILL_AFTER + LAST_LINES * len(self._commands)
        self._lifeline = os.pipe()  # of which only the reading end is inherited
        for command in self._commands:
            try:
                self._start(command)
            except BaseException:
                self.stop()
                raise

    def _start(self, command: NodeCommand) -> None:
        assert self._lifeline is not None, "start() makes it"
        width = max(len(command.name) for command in self._commands)
        colour = _COLOURS[self._commands.index(command) % len(_COLOURS)]
        log = None if self._log_dir is None else self._log_dir / f"{command.name}.log"
        prefix = Text(f"{command.name:<{width}} | ", style=colour)
        try:
            self._processes[command.name] = NodeProcess(command, self._lifeline[0], log, self._console, prefix)
        except OSError as error:
            raise SupervisorError(f"{command.name} cannot be started: {error}; the command was `{shlex.join(command.argv)}`") from error

    def poll(self) -> NodeExit | None:
        """The first process that died for good, None if there is none.

        With a restart policy this is also where processes are started again; to be called several times a second.
        """
        for name, process in list(self._processes.items()):
            code = process.poll()
            if code is None or (code == 0 and process.command.may_end):
                continue
            if name not in self._due:
                death = process.exit()
                if not self._plan_restart(process, death):
                    return death
            elif time.monotonic() >= self._due[name]:
                del self._due[name]
                self._start(process.command)
        return None

    def _plan_restart(self, process: NodeProcess, death: NodeExit) -> bool:
        """Whether a process that died will be started again; one that could not start (exit code 1, `nodes.base.run`) will not."""
        name = death.name
        if name not in self._backoffs:
            return False
        first = not any(earlier.name == name for earlier in self.deaths)
        pause = None if first and death.code == 1 else self._backoffs[name].pause(process.lived)
        if pause is None:
            return False
        process.signal(signal.SIGKILL)  # what it has started
        process.close()
        self.deaths.append(death)
        self._due[name] = time.monotonic() + pause
        process.say(f"{death.how}; it is started again in {pause:g} s")
        return True

    def check(self) -> None:
        """Raise `SupervisorError`, with the last lines of the process, when one died."""
        dead = self.poll()
        if dead is not None:
            raise SupervisorError(str(dead))

    def pid(self, name: str) -> int:
        """Number of one process, the latest one of that name."""
        return self._processes[name].pid

    def exit_code(self, name: str) -> int | None:
        """Exit code of one process, None while it runs."""
        return self._processes[name].poll()

    def stop(self) -> list[str]:
        """Stop all processes: SIGINT, 5 s later SIGTERM, 1 s later SIGKILL. Returns when no process runs any more.

        An exception in between, such as a second Ctrl-C, ends them at once.

        Returns:
            Names of the processes that did not stop on SIGINT.
        """
        processes = list(self._processes.values())
        try:
            stubborn = self._stop_in_steps(processes)
        except BaseException:
            for process in processes:
                process.signal(signal.SIGKILL)
            raise
        finally:
            self._cut_lifeline()
        for process in processes:
            process.close()
        return stubborn

    def _cut_lifeline(self) -> None:
        for end in self._lifeline or ():
            os.close(end)
        self._lifeline = None

    @staticmethod
    def _stop_in_steps(processes: Sequence[NodeProcess]) -> list[str]:
        stubborn: list[str] = []
        for number, patience in ((signal.SIGINT, _TERMINATE_AFTER), (signal.SIGTERM, _KILL_AFTER), (signal.SIGKILL, _KILL_AFTER)):
            for process in processes:
                if process.signal(number) and number == signal.SIGTERM:
                    stubborn.append(process.command.name)
            deadline = time.monotonic() + patience
            while any(process.runs() for process in processes) and time.monotonic() < deadline:
                time.sleep(_POLL_PERIOD)
        return stubborn

    def run(self) -> int:
        """Start, show the output until a process dies or the user stops (Ctrl-C, SIGTERM, SIGHUP), then stop all.

        Returns:
            0 when the user stopped it, 1 when a process died or could not be started; its name and last lines are shown.
        """
        console, dead = self._console or Console(stderr=True), None
        with _stop_requests() as requested:
            try:
                self.start()
                while not requested:
                    any_runs = self._any_runs()  # asked first: `poll` then sees what ends in between
                    if (dead := self.poll()) is not None or not (any_runs or self._due):
                        break
                    time.sleep(_POLL_PERIOD)
            except SupervisorError as error:
                console.print(Text(printable(str(error)), style="bold red"))
                return 1
            stubborn = self.stop()
        if stubborn:
            console.print(Text(f"did not stop within {_TERMINATE_AFTER:g} s and were terminated: {', '.join(stubborn)}", style="yellow"))
        if not requested and dead is not None:
            console.print(Text(printable(str(dead)), style="bold red"))
            return 1
        return 0

    def _any_runs(self) -> bool:
        return bool(self._due) or any(process.poll() is None for process in self._processes.values())

    def __enter__(self) -> Supervisor:
        with ExitStack() as stopping:
            stopping.enter_context(stopping_in_order())
            self.start()
            self._stopping = stopping.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with self._stopping:
            self.stop()


@contextmanager
def _stop_requests() -> Iterator[list[int]]:
    received: list[int] = []

    def on_signal(number: int, frame: FrameType | None) -> None:
        received.append(number)

    previous = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def config_file(package: str, name: str) -> Path:
    """Path of an installed configuration file of a package. Raises SupervisorError: The package is not built, or has no such file."""
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

    try:
        path = Path(get_package_share_directory(package)) / "config" / name
    except PackageNotFoundError:
        raise SupervisorError(f"the package {package} is not built; run `make setup`") from None
    if not path.is_file():
        raise SupervisorError(f"{path} is missing; run `make setup`")
    return path


def node_commands(
    kind: Kind,
    *,
    bag: Path | None = None,
    record: Path | None = None,
    perception: bool = True,
    view: bool = False,
    parameters: Mapping[str, Mapping[str, object]] | None = None,
    overrides: Overrides = _NO_OVERRIDES,
) -> list[NodeCommand]:
    """The processes of one kind of cell, as the launch files start them.

    `sim`: simulated cell and all nodes; `replay`: a `bag` through perception and identification; `arm`: the nodes beside a real arm.
    `record` is a bag to write. Without `perception` a replay needs object poses. `view` adds the viewer for browsers. `parameters`, by name
    of the node, override the installed parameter files; `overrides` are parameter files and remappings of the user, for all nodes.

    Raises InputError where `bag` and `kind` contradict each other, or `parameters` names a node that is not started, SupervisorError where
    a parameter file is missing.
    """
    if kind not in _NODES:
        raise InputError(f"kind is {kind!r}, expected one of {', '.join(_NODES)}")
    if (bag is not None) != (kind == "replay"):
        raise InputError(f"bag is {bag}, expected {'the path of a bag' if kind == 'replay' else 'none'} for kind `{kind}`")
    names = [name for name in _NODES[kind] if perception or kind != "replay" or name != "perception_node"]
    names += [name for name, wanted in (("bag_recorder_node", record is not None), ("viewer_node", view)) if wanted]
    own = {name: dict(values) for name, values in (parameters or {}).items()}
    if record is not None:
        own.setdefault("bag_recorder_node", {})["bag"] = str(record.resolve())
    if bag is not None:
        own.setdefault("bag_player_node", {})["bag"] = str(bag.resolve())
    unknown = sorted(set(own) - set(names))
    if unknown:
        raise InputError(f"parameters are given for {', '.join(unknown)}, expected nodes of `{kind}`: {', '.join(names)}")
    return [node_command(name, _defaults_of(name, kind) | own.get(name, {}), overrides) for name in names]


def _defaults_of(name: str, kind: Kind) -> dict[str, object]:
    """Parameters of a node that depend on the kind of the cell."""
    clock: dict[str, object] = {"use_sim_time": True} if kind != "arm" and name not in _CLOCKS else {}
    # A simulator may pause for longer than an arm, up to 1 s; the watchdogs of a real arm keep their limits.
    simulated: dict[str, object] = {}
    if kind == "sim" and name == "push_executor_node":
        simulated = {"arm_timeout": 1.0, "tracking_lag": 1.0, "stamp_commands": True}
    return clock | simulated | (_PACED.get(name, {}) if kind == "replay" else {})


def node_names(kind: Kind) -> tuple[str, ...]:
    """Every node that a kind of cell can have."""
    return (*_NODES[kind], "bag_recorder_node", "viewer_node")


def node_command(name: str, parameters: Mapping[str, object], overrides: Overrides = _NO_OVERRIDES) -> NodeCommand:
    """The process of one node, with its parameters, in its own enclave of SROS 2 (`security/policy.xml`)."""
    if name in _SIM_NODES:
        package, file, program = "push_ident_sim", "sim.yaml", "push_ident_sim"
    else:
        package, file, program = "push_ident", "push_ident.yaml", "push_ident.nodes"
    arguments = ["--params-file", str(config_file(package, file))]
    # JSON is YAML: text stays text even if it looks like a number.
    arguments += [part for key, value in parameters.items() for part in ("-p", f"{key}:={json.dumps(value)}")]
    arguments += overrides.arguments()
    argv = (sys.executable, "-m", program, name, "--ros-args", *arguments, "--enclave", f"/push_ident/{name}", "--log-level", "info")
    return NodeCommand(name, argv, may_end=name == "bag_player_node", is_node=True)
