"""Start the node processes, show their output and stop them together: a replacement for `ros2 launch`."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, TracebackType
from typing import IO, Any, Final, Literal

from rich.console import Console
from rich.text import Text

from push_ident.errors import InputError, PushIdentError

__all__ = ["Kind", "NodeCommand", "NodeExit", "Supervisor", "SupervisorError", "config_file", "node_commands"]

Kind = Literal["sim", "replay", "arm"]

_COLOURS: Final = ("cyan", "green", "magenta", "yellow", "blue", "bright_red")
_TAIL_LINES: Final = 12
_POLL_PERIOD: Final = 0.05
_TERMINATE_AFTER: Final = 2.0
"""Time from SIGINT to SIGTERM [s]; a node of this project stops within 1.8 s."""
_KILL_AFTER: Final = 1.0
"""Time from SIGTERM to SIGKILL [s]."""

_SIM_NODES: Final = ("sim_cell_node",)
"""Nodes of the package push_ident_sim; the others belong to push_ident."""
_NODES: Final[Mapping[Kind, tuple[str, ...]]] = {
    "sim": ("sim_cell_node", "perception_node", "push_executor_node", "identification_node", "gap_diagnosis_node"),
    "replay": ("perception_node", "identification_node", "bag_player_node"),
    "arm": ("perception_node", "push_executor_node", "identification_node", "gap_diagnosis_node"),
}
_SIM_PATIENCE: Final = 1.0
"""Silence or lag of a simulated arm that counts as a fault [s]."""
_CLOCKS: Final = ("sim_cell_node", "bag_player_node")
"""Nodes that publish /clock themselves."""


class SupervisorError(PushIdentError):
    """A process could not be started, or a node did not end as expected."""


@dataclass(frozen=True, slots=True)
class NodeCommand:
    """One process to run."""

    name: str
    argv: tuple[str, ...]
    may_end: bool = False
    """Whether it may end with exit code 0 without stopping the others, as the player of a bag does."""


@dataclass(frozen=True, slots=True)
class NodeExit:
    """A process that ended unexpectedly."""

    name: str
    code: int
    """Exit code; -N if signal N ended it."""
    tail: tuple[str, ...]
    """Its last lines of standard output and error, in order."""

    def __str__(self) -> str:
        how = f"was ended by {signal.Signals(-self.code).name}" if self.code < 0 else f"ended with exit code {self.code}"
        return "\n".join([f"{self.name} {how}" + ("; its last lines:" if self.tail else ""), *(f"  {line}" for line in self.tail)])


class Supervisor:
    """Runs processes until one of them dies or all are stopped.

    As a context manager, of the main thread, it starts them on entry and stops them on exit, also after an exception; SIGTERM and
    SIGHUP end the context as Ctrl-C does, by `SystemExit`.
    Each process leads a group of its own: a Ctrl-C at the terminal reaches only this one, which then stops the others in order.

    Args:
        commands: The processes; their names must differ.
        log_dir: Folder for one `<name>.log` per process; None keeps none.
        console: Output of their lines, each with the name of its process; None shows nothing.
    """

    def __init__(self, commands: Sequence[NodeCommand], *, log_dir: Path | None = None, console: Console | None = None) -> None:
        names = [command.name for command in commands]
        if not names or len(set(names)) != len(names):
            raise InputError(f"process names are {names}, expected at least one and all different; rename or drop some")
        self._commands = tuple(commands)
        self._log_dir = log_dir
        self._console = console
        self._processes: dict[str, _Process] = {}
        self._handlers: dict[signal.Signals, Any] = {}

    def start(self) -> None:
        """Start all processes.

        Raises:
            SupervisorError: One cannot be started; those started before are stopped again.
        """
        if self._log_dir is not None:
            self._log_dir.mkdir(parents=True, exist_ok=True)
        width = max(len(command.name) for command in self._commands)
        for command, colour in zip(self._commands, _cycle(_COLOURS), strict=False):
            log = None if self._log_dir is None else self._log_dir / f"{command.name}.log"
            prefix = Text(f"{command.name:<{width}} | ", style=colour)
            try:
                self._processes[command.name] = _Process(command, log, self._console, prefix)
            except BaseException as error:
                self.stop()
                if not isinstance(error, OSError):
                    raise
                raise SupervisorError(f"{command.name} cannot be started: {error}; the command was `{shlex.join(command.argv)}`") from error

    def poll(self) -> NodeExit | None:
        """The first process that died, None if there is none."""
        for process in self._processes.values():
            code = process.poll()
            if code is not None and not (code == 0 and process.command.may_end):
                return process.exit()
        return None

    def check(self) -> None:
        """Raise `SupervisorError`, with the last lines of the process, when one died."""
        dead = self.poll()
        if dead is not None:
            raise SupervisorError(str(dead))

    def exit_code(self, name: str) -> int | None:
        """Exit code of one process, None while it runs."""
        return self._processes[name].poll()

    def wait_for(self, name: str, timeout: float) -> int:
        """Wait for one process to end by itself; its exit code.

        Raises:
            SupervisorError: Another one died, or `timeout` [s] passed.
        """
        deadline = time.monotonic() + timeout
        while (code := self.exit_code(name)) is None:
            self.check()
            if time.monotonic() > deadline:
                raise SupervisorError(f"{name} still runs after {timeout:g} s; allow more time or look into its log")
            time.sleep(_POLL_PERIOD)
        return code

    def stop(self) -> list[str]:
        """Stop all processes: SIGINT, 2 s later SIGTERM, 1 s later SIGKILL. Returns when no process runs any more.

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
        for process in processes:
            process.close()
        return stubborn

    @staticmethod
    def _stop_in_steps(processes: Sequence[_Process]) -> list[str]:
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
        console = self._console or Console(stderr=True)
        with _stop_requests() as requested:
            try:
                self.start()
                while not requested and (dead := self.poll()) is None and self._any_runs():
                    time.sleep(_POLL_PERIOD)
            except SupervisorError as error:
                console.print(Text(str(error), style="bold red"))
                return 1
            stubborn = self.stop()
        if stubborn:
            console.print(Text(f"did not stop within {_TERMINATE_AFTER:g} s and were terminated: {', '.join(stubborn)}", style="yellow"))
        if not requested and dead is not None:
            console.print(Text(str(dead), style="bold red"))
            return 1
        return 0

    def _any_runs(self) -> bool:
        return any(process.poll() is None for process in self._processes.values())

    def __enter__(self) -> Supervisor:
        self._handlers = {number: signal.signal(number, _leave) for number in (signal.SIGTERM, signal.SIGHUP)}
        try:
            self.start()
        except BaseException:
            self._restore_handlers()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self.stop()
        finally:
            self._restore_handlers()

    def _restore_handlers(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)


class _Process:
    """One process in a group of its own, with a thread that forwards its lines."""

    def __init__(self, command: NodeCommand, log: Path | None, console: Console | None, prefix: Text) -> None:
        self.command = command
        self._tail: deque[str] = deque(maxlen=_TAIL_LINES)
        self._gone = False
        self._popen = subprocess.Popen(
            command.argv,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            text=True,
            errors="replace",
            start_new_session=True,
        )
        assert self._popen.stdout is not None
        arguments = (self._popen.stdout, log, console, prefix)
        self._reader = threading.Thread(target=self._read, args=arguments, name=f"output of {command.name}", daemon=True)
        self._reader.start()

    def _read(self, output: IO[str], log: Path | None, console: Console | None, prefix: Text) -> None:
        with output, open(log or os.devnull, "w", encoding="utf-8") as file:
            for line in output:
                text = line.rstrip("\n")
                self._tail.append(text)
                file.write(line)
                file.flush()
                if console is not None:
                    console.print(Text.assemble(prefix, Text.from_ansi(text)), soft_wrap=True)

    def poll(self) -> int | None:
        return self._popen.poll()

    def exit(self) -> NodeExit:
        """How the process ended, after it did."""
        self._reader.join(timeout=0.5)  # for the last lines
        return NodeExit(self.command.name, self._popen.returncode, tuple(self._tail))

    def runs(self) -> bool:
        """Whether the process or one of its children runs."""
        self._popen.poll()
        return self._reach(0)

    def signal(self, number: signal.Signals) -> bool:
        """Send a signal to the whole group; whether it had a running process."""
        return self.runs() and self._reach(number)

    def _reach(self, number: int) -> bool:
        if not self._gone:  # afterwards the number may belong to another group
            try:
                os.killpg(self._popen.pid, number)
            except ProcessLookupError:
                self._gone = True
        return not self._gone

    def close(self) -> None:
        self._popen.wait()
        self._reader.join(timeout=0.5)


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


@contextmanager
def _stop_requests() -> Iterator[list[int]]:
    """A list that collects the stop signals that this process receives."""
    received: list[int] = []

    def on_signal(number: int, frame: FrameType | None) -> None:
        received.append(number)

    previous = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _cycle(values: Sequence[str]) -> Iterator[str]:
    while True:
        yield from values


def config_file(package: str, name: str) -> Path:
    """Path of an installed configuration file of a package.

    Raises:
        SupervisorError: The package is not built, or has no such file.
    """
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
    log_level: str = "info",
) -> list[NodeCommand]:
    """The processes of one kind of cell, as the launch files start them.

    Args:
        kind: `sim`: simulated cell and all nodes; `replay`: a bag through perception and identification; `arm`: the nodes beside a
            real arm.
        bag: Bag to play; required for `replay`, not allowed otherwise.
        record: Bag to write; None records nothing.
        perception: Whether `replay` runs perception; without it the bag must have object poses.
        view: Whether to start the viewer for browsers.
        parameters: Parameters by name of the node; they override the installed parameter files.
        log_level: ROS log level of all nodes.

    Raises:
        InputError: `bag` and `kind` contradict each other, or `parameters` names a node that is not started.
        SupervisorError: A parameter file is missing.
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
    return [_node_command(name, _defaults_of(name, kind) | own.get(name, {}), log_level) for name in names]


def _defaults_of(name: str, kind: Kind) -> dict[str, object]:
    """Parameters of a node that depend on the kind of the cell."""
    clock: dict[str, object] = {"use_sim_time": True} if kind != "arm" and name not in _CLOCKS else {}
    # A simulator may pause for longer than an arm; the watchdogs of a real arm keep their limits.
    simulated: dict[str, object] = {}
    if kind == "sim" and name == "push_executor_node":
        simulated = {"arm_timeout": _SIM_PATIENCE, "tracking_lag": _SIM_PATIENCE, "stamp_commands": True}
    return clock | simulated


def _node_command(name: str, parameters: Mapping[str, object], log_level: str) -> NodeCommand:
    """The process of one node."""
    if name in _SIM_NODES:
        package, file, program = "push_ident_sim", "sim.yaml", "push_ident_sim"
    else:
        package, file, program = "push_ident", "push_ident.yaml", "push_ident.nodes"
    arguments = ["--params-file", str(config_file(package, file))]
    # JSON is YAML: text stays text even if it looks like a number.
    arguments += [part for key, value in parameters.items() for part in ("-p", f"{key}:={json.dumps(value)}")]
    argv = (sys.executable, "-m", program, name, "--ros-args", *arguments, "--log-level", log_level)
    return NodeCommand(name, argv, may_end=name == "bag_player_node")
