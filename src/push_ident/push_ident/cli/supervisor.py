"""Starts the node processes, shows what they say and stops them together: `ros2 launch` for machines that have none."""

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
"""[s] that a process has to stop by itself after SIGINT; a node of this project takes at most 1.8 s."""
_KILL_AFTER: Final = 1.0
"""[s] from SIGTERM to SIGKILL."""

_SIM_NODES: Final = ("sim_cell_node",)
"""Nodes of the package push_ident_sim; the others are of push_ident."""
_NODES: Final[Mapping[Kind, tuple[str, ...]]] = {
    "sim": ("sim_cell_node", "perception_node", "push_executor_node", "identification_node", "gap_diagnosis_node"),
    "replay": ("perception_node", "identification_node", "bag_player_node"),
    "arm": ("perception_node", "push_executor_node", "identification_node", "gap_diagnosis_node"),
}
_SIM_PATIENCE: Final = 1.0
"""Silence or lag of a simulated arm that is taken for a fault [s]."""
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
    """Ending with exit code 0 is its normal course and stops nothing, as for a bag that was played."""


@dataclass(frozen=True, slots=True)
class NodeExit:
    """A process that ended without having been asked to."""

    name: str
    code: int
    """Exit code; -N when signal N ended it."""
    tail: tuple[str, ...]
    """The last lines it wrote, standard output and error as they came."""

    def __str__(self) -> str:
        how = f"was ended by {signal.Signals(-self.code).name}" if self.code < 0 else f"ended with exit code {self.code}"
        return "\n".join([f"{self.name} {how}" + ("; its last lines:" if self.tail else ""), *(f"  {line}" for line in self.tail)])


class Supervisor:
    """Runs processes until one of them dies or all are stopped.

    As a context manager, of the main thread, it starts them on entry and stops them on exit, whatever happens in between; SIGTERM and
    SIGHUP end the context as Ctrl-C does, by `SystemExit`.
    Each process leads a group of its own: a Ctrl-C at the terminal reaches only this one, which then stops the others in order.

    Args:
        commands: What to run; names must differ.
        log_dir: Folder for one `<name>.log` per process; None keeps none.
        console: Where their lines go, each behind the name of its process; None shows nothing.
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
        """The first process that died, None while all is well."""
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
                raise SupervisorError(f"{name} still runs after {timeout:g} s; allow more time or see why in its log")
            time.sleep(_POLL_PERIOD)
        return code

    def stop(self) -> list[str]:
        """Stop everything: SIGINT, 2 s later SIGTERM, 1 s later SIGKILL. Returns only when nothing runs any more.

        An exception in between, a second Ctrl-C say, ends them at once.

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
            console.print(Text(f"did not stop within {_TERMINATE_AFTER:g} s and had to be ended: {', '.join(stubborn)}", style="yellow"))
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
    """One process in a group of its own, with a thread that passes its lines on."""

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
        """How it ended, once it did."""
        self._reader.join(timeout=0.5)  # for the last lines
        return NodeExit(self.command.name, self._popen.returncode, tuple(self._tail))

    def runs(self) -> bool:
        """Whether the process or a child that it left behind is there."""
        self._popen.poll()
        return self._reach(0)

    def signal(self, number: signal.Signals) -> bool:
        """Send a signal to all of the group; whether anybody was there."""
        return self.runs() and self._reach(number)

    def _reach(self, number: int) -> bool:
        if not self._gone:  # afterwards its number may be another's
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
    """A list that fills with the numbers of the signals that ask this process to stop."""
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
    """Path of a configuration file that a package installed.

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
    params_files: Mapping[str, Path] | None = None,
    parameters: Mapping[str, Mapping[str, object]] | None = None,
    remappings: Mapping[str, str] | None = None,
    log_level: str = "info",
) -> list[NodeCommand]:
    """The processes of one kind of cell, as the launch files start them.

    Args:
        kind: `sim`: simulated cell and all nodes; `replay`: a bag through perception and identification; `arm`: the nodes beside a
            real arm.
        bag: What to play; for `replay` only, and needed there.
        record: Bag to write; None records nothing.
        perception: Whether `replay` runs perception; without it the bag must hold object poses.
        view: Whether to start the viewer for browsers.
        params_files: Parameter file per package (`push_ident`, `push_ident_sim`), default the installed ones.
        parameters: Node name to parameters that win over the file.
        remappings: Topic of the bag contract to the cell's own, for all nodes.
        log_level: ROS log level of all nodes.

    Raises:
        InputError: `bag` and `kind` do not go together, or `parameters` names a node that is not started.
        SupervisorError: A parameter file is missing.
    """
    if kind not in _NODES:
        raise InputError(f"kind is {kind!r}, expected one of {', '.join(_NODES)}")
    if (bag is not None) != (kind == "replay"):
        raise InputError(f"bag is {bag}, expected {'the path of a bag' if kind == 'replay' else 'none'} for kind `{kind}`")
    files = dict(params_files or {})
    own = {name: dict(values) for name, values in (parameters or {}).items()}
    names = [name for name in _NODES[kind] if perception or kind != "replay" or name != "perception_node"]
    if record is not None:
        names.append("bag_recorder_node")
        own.setdefault("bag_recorder_node", {})["bag"] = str(record.resolve())
    if view:
        names.append("viewer_node")
    unknown = sorted(set(own) - set(names))
    if unknown:
        raise InputError(f"parameters are given for {', '.join(unknown)}, expected nodes of `{kind}`: {', '.join(names)}")
    if bag is not None:
        own.setdefault("bag_player_node", {})["bag"] = str(bag.resolve())
    for name in names:
        if kind != "arm" and name not in _CLOCKS:
            own.setdefault(name, {}).setdefault("use_sim_time", True)
    if kind == "sim":
        # A simulator may pause for longer than an arm; the watchdogs of the real one stay as tight as they are.
        for watchdog in ("arm_timeout", "tracking_lag"):
            own.setdefault("push_executor_node", {}).setdefault(watchdog, _SIM_PATIENCE)
    ros = [part for topic, to in (remappings or {}).items() for part in ("-r", f"{topic}:={to}")]

    commands = []
    for name in names:
        simulated = name in _SIM_NODES
        package, file, program = (
            ("push_ident_sim", "sim.yaml", "push_ident_sim") if simulated else ("push_ident", "push_ident.yaml", "push_ident.nodes")
        )
        arguments = ["--params-file", str(files.get(package) or config_file(package, file))]
        # JSON is YAML: text stays text, however much it looks like a number.
        arguments += [part for key, value in own.get(name, {}).items() for part in ("-p", f"{key}:={json.dumps(value)}")]
        arguments += [*ros, "--log-level", log_level]
        argv = (sys.executable, "-m", program, name, "--ros-args", *arguments)
        commands.append(NodeCommand(name, argv, may_end=name == "bag_player_node"))
    return commands
