"""Faults of processes: killed, stopped, starved, or told by a service to be in another state."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

import numpy as np
import psutil
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState

from push_ident.cli.supervisor import NodeCommand, node_commands
from push_ident.errors import PushIdentError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident.nodes.base.network import own_domain
from push_ident.pushing.push import PushCode
from push_ident_sim.cell.robot import HOME, robot_description
from push_ident_sim.faults.fault import Fault, Impossible, Trial
from push_ident_sim.faults.harness.cell import ARM_CELL, OBJECT_POSE, Cell, CellPlan
from push_ident_sim.faults.harness.monitor import until
from push_ident_sim.faults.harness.oracles import learned_pushes
from push_ident_sim.faults.harness.process import TRACEBACK, Process
from push_ident_sim.faults.harness.topics import OBJECT

__all__ = ["FAULTS"]

_EXECUTOR, _IDENTIFICATION = "push_executor_node", "identification_node"
_CLI: Final = (sys.executable, "-m", "push_ident.cli")
_DELAYS: Final = (0.2, 0.5, 1.0, 2.0)
"""After the start of a process [s]: while it imports, while it makes its node, and later. Before that the interpreter itself starts, some
0.15 s in which no code of ours runs; the children of `push-ident up` are out of reach of a Ctrl-C at the terminal."""
_QUIET_END: Final = 2.0
"""Longest time from Ctrl-C to the end of a process [s]."""
_BUSY: Final = 1.0
"""Granted where several processes load at once on few cores [s]."""
_UP_END: Final = 4.0
"""The same of `push-ident up`, which ends its nodes first [s]."""
_OF_A_MAP: Final = ("mass", "friction", "mass_friction", "mass_friction_std")
_N_TRANSITIONS: Final = 30
_CGROUP: Final = Path("/sys/fs/cgroup/memory/push_ident_faults")
_LOWERED: Final = 0.02
"""A tip that moves below this pushes [m]; `push_height` is 0.012."""
_PUSH_BEGINS: Final = 30.0
"""Longest time from the start of a client to its push [s]."""
_SPARE: Final = 2
"""What a node may allocate beyond what it has [MiB]."""


def _identification_killed(trial: Trial) -> None:
    cell = trial.cell
    cell.whole_push()
    until(lambda: (learned_pushes(cell) or 0) > trial.learned, 15.0, "the push before the fault was not learned")
    sent = cell.begin(cell.goal(-1))
    cell.processes[_IDENTIFICATION].kill()
    trial.wait(0.2)  # for maps that were under way
    since = time.monotonic()
    result = cell.end(sent)
    trial.expect(result.error_code == 0, f"the push under way ended with {result.error_code} {result.error_text}")
    before = [msg for received, msg in cell.monitor.maps if received < since]
    cell.processes[_IDENTIFICATION].start()
    until(lambda: cell.monitor.maps[-1][0] > since, 20.0, "no map came after the restart")
    after = next(msg for received, msg in cell.monitor.maps if received > since)
    equal = [all(np.array_equal(getattr(msg, name), getattr(after, name)) for name in _OF_A_MAP) for msg in before]
    trial.expect(any(equal), "the map after the restart is none of those before")
    trial.note = f"{learned_pushes(cell)} pushes in the model, its map equal to the last bit"
    trial.lost = "the push under way (of identification only)"


def _stop_at_once(trial: Trial) -> None:
    """Ctrl-C in the first moments of every node, and of `push-ident up`."""
    domain = str(own_domain())
    commands = list(node_commands("sim"))
    commands.append(NodeCommand("up", (*_CLI, "up", "sim")))
    worst = 0.0
    for command in commands:
        for delay in _DELAYS:
            process = Process(command, trial.folder / f"{command.name}-{delay}.log", {"ROS_DOMAIN_ID": domain})
            time.sleep(delay)
            code, took = process.interrupt(patience=6.0)
            worst = max(worst, took)
            name = f"{command.name}, Ctrl-C after {delay} s"
            trial.expect(code == 0, f"{name}: exit code {code}, expected 0")
            trial.expect(took < (_QUIET_END if command.name != "up" else _UP_END), f"{name}: it ended after {took:.1f} s")
            trial.expect(TRACEBACK not in process.output, f"{name}: a traceback")
    trial.note = f"{len(commands) * len(_DELAYS)} starts; the slowest ended after {worst:.1f} s"


_N_MOMENTS: Final = 200
_LATEST: Final = 3.0
"""Ctrl-C comes at a random moment up to this after the start of a node [s]."""
_AT_ONCE: Final = 4
"""Nodes started side by side: most of the time is waiting."""


def _stop_any_moment(trial: Trial) -> None:
    """Ctrl-C and SIGTERM at random moments of the nodes."""
    commands, rng, domain = node_commands("sim"), random.Random(0), str(own_domain())
    plans = [
        (i, commands[i % len(commands)], rng.uniform(0.0, _LATEST), rng.choice([signal.SIGINT, signal.SIGTERM])) for i in range(_N_MOMENTS)
    ]

    def once(plan: tuple[int, NodeCommand, float, signal.Signals]) -> tuple[str, int | None, float, bool]:
        number, command, delay, how = plan
        process = Process(command, trial.folder / f"{number}-{command.name}.log", {"ROS_DOMAIN_ID": domain})
        time.sleep(delay)
        asked = process.signal(how)
        code = process.wait(6.0)
        took = time.monotonic() - asked
        process.kill()
        return f"{command.name}, {how.name} after {delay:.2f} s", code, took, TRACEBACK in process.output

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        ends = list(pool.map(once, plans))
    for name, code, took, traceback in ends:
        trial.expect(code == 0, f"{name}: exit code {code}, expected 0")
        trial.expect(took < _QUIET_END + _BUSY, f"{name}: it ended after {took:.1f} s")
        trial.expect(not traceback, f"{name}: a traceback")
    trial.note = f"{len(ends)} starts; the slowest ended after {max(took for _, _, took, _ in ends):.1f} s"


def _supervisor_killed(trial: Trial) -> None:
    """`push-ident up arm` beside an arm that is not its child is killed in the middle of a push."""
    cell = trial.cell
    up = cell.add(NodeCommand("up", (*_CLI, "up", "arm")))
    children: list[psutil.Process] = []
    try:
        sent = None
        deadline = time.monotonic() + 60.0
        while sent is None:
            try:
                sent = cell.begin()
            except PushIdentError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.3)
        children = psutil.Process(up.pid).children(recursive=True)
        os.kill(up.pid, signal.SIGKILL)
        since = time.monotonic()
        trial.expect_hold(since)
        gone, alive = psutil.wait_procs(children, timeout=3.0)
        names = [" ".join(process.cmdline())[-60:] for process in alive]
        trial.expect(not alive, f"{len(alive)} of {len(children)} children go on: {names}")
        trial.note, trial.lost = f"{len(gone)} children ended", "the push under way"
    finally:
        for process in children:
            if process.is_running():
                process.kill()
        cell.processes.pop("up").kill()


def _state_of(cell: Cell, node: str) -> int:
    return int(cell.monitor.call(GetState, f"{node}/get_state", GetState.Request()).current_state.id)


def _ask(cell: Cell, node: str, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return bool(cell.monitor.call(ChangeState, f"{node}/change_state", request, patience=5.0).success)


_ALLOWED: Final = {
    Transition.TRANSITION_CONFIGURE: (State.PRIMARY_STATE_UNCONFIGURED, State.PRIMARY_STATE_INACTIVE),
    Transition.TRANSITION_CLEANUP: (State.PRIMARY_STATE_INACTIVE, State.PRIMARY_STATE_UNCONFIGURED),
    Transition.TRANSITION_ACTIVATE: (State.PRIMARY_STATE_INACTIVE, State.PRIMARY_STATE_ACTIVE),
    Transition.TRANSITION_DEACTIVATE: (State.PRIMARY_STATE_ACTIVE, State.PRIMARY_STATE_INACTIVE),
}
"""From which state to which; any other request is to be answered with no success."""
_NEVER: Final = (0, 9, 42, 99, 255)
"""Numbers of no transition, and of those that nobody may request."""


def _transitions(trial: Trial) -> None:
    """Transitions in any order, impossible ones too, of every node."""
    cell, rng = trial.cell, random.Random(0)
    for node in cell.plan.nodes:
        state = _state_of(cell, node)
        for _ in range(_N_TRANSITIONS):
            transition = rng.choice([*_ALLOWED, *_ALLOWED, *_NEVER])
            source, target = _ALLOWED.get(transition, (None, None))
            success = _ask(cell, node, transition)
            trial.expect(success == (state == source), f"{node}: transition {transition} in state {state} gave success {success}")
            state = target if success and target is not None else state
            found = _state_of(cell, node)
            trial.expect(found == state, f"{node} is in state {found}, expected {state}")
            state = found
        for transition, (source, target) in _ALLOWED.items():
            if state == source and transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
                trial.expect(_ask(cell, node, transition), f"{node} cannot be brought back by transition {transition}")
                state = target
    cell.await_executor()
    cell.whole_push()
    trial.note = f"{_N_TRANSITIONS} requests to each of {len(cell.plan.nodes)} nodes"


def _shut_down(trial: Trial) -> None:
    """Every node is shut down by its service, asked once more, and ended by Ctrl-C."""
    cell = trial.cell
    for node in cell.plan.nodes:
        if node == "sim_cell_node":
            continue  # the others need it; it has the same base
        trial.expect(_ask(cell, node, Transition.TRANSITION_ACTIVE_SHUTDOWN), f"{node} refuses to shut down")
        trial.expect(_state_of(cell, node) == State.PRIMARY_STATE_FINALIZED, f"{node} is not finalized")
        trial.expect(not _ask(cell, node, Transition.TRANSITION_CONFIGURE), f"{node} configures after it was shut down")
        code, took = cell.processes[node].interrupt()
        trial.expect(code == 0 and took < _QUIET_END, f"{node} ended with {code} after {took:.1f} s")
    cell.recover()
    trial.note = "answered, finalized, then ended by Ctrl-C"


def _deactivated(trial: Trial) -> None:
    cell = trial.cell
    sent = cell.begin()
    since = time.monotonic()
    trial.expect(_ask(cell, _EXECUTOR, Transition.TRANSITION_DEACTIVATE), "the executor refuses to be deactivated")
    trial.expect_hold(since)
    result = cell.end(sent)
    trial.expect(result.error_code != 0, "the push was reported as made")
    trial.expect(_ask(cell, _EXECUTOR, Transition.TRANSITION_ACTIVATE), "the executor cannot be activated again")
    trial.note, trial.lost = result.error_text, "the push under way"


def _spin_forever() -> None:
    while True:
        pass


def _processor_taken(trial: Trial) -> None:
    """Two busy processes for each core, during a push."""
    cell = trial.cell
    # `fork`: these processes import nothing.
    hogs = [multiprocessing.get_context("fork").Process(target=_spin_forever, daemon=True) for _ in range(2 * (os.cpu_count() or 1))]
    for hog in hogs:
        hog.start()
    try:
        result = cell.push()
    finally:
        for hog in hogs:
            hog.kill()
    trial.wait(0.5)
    trial.expect(not cell.is_moving(), "the arm still moves")
    codes = (PushCode.NONE, PushCode.ARM_SILENT, PushCode.TRACKING, PushCode.OBJECT_LOST, PushCode.FORCE)
    trial.expect(result.error_code in codes, f"the push ended with {result.error_code} {result.error_text}")
    trial.note = (result.error_text or "the push was made") + f"; the suite waited up to {1e3 * cell.monitor.stall:.0f} ms for a core"
    trial.lost = "the push under way" if result.error_code else "nothing"


def _memory_taken(trial: Trial) -> None:
    """Identification may not allocate any more in the middle of a push; the kernel ends it, as any process without memory."""
    cell = trial.cell
    try:
        _CGROUP.mkdir(exist_ok=True)
    except OSError as error:
        raise Impossible(f"a limit of memory needs a writable {_CGROUP.parent}: {error.strerror}") from None
    process = cell.processes[_IDENTIFICATION]
    cell.whole_push()
    until(lambda: (learned_pushes(cell) or 0) > trial.learned, 15.0, "the push before the fault was not learned")
    sent = cell.begin(cell.goal(-1))
    (_CGROUP / "cgroup.procs").write_text(str(process.pid))
    (_CGROUP / "memory.limit_in_bytes").write_text(f"{_SPARE}M")
    result = cell.end(sent)
    codes = (PushCode.NONE, PushCode.ARM_SILENT, PushCode.TRACKING)  # the kernel's search for memory stalls the machine
    trial.expect(result.error_code in codes, f"the push ended with {result.error_code} {result.error_text}")
    trial.wait(1.0)
    ended = not process.runs
    process.kill()
    time.sleep(0.2)
    _CGROUP.rmdir()
    process.start()
    until(lambda: learned_pushes(cell) is not None, 30.0, "identification does not come back")
    trial.note = "the kernel ended it; started again, it has its pushes" if ended else "it kept within the limit"
    trial.lost = "the push under way (of identification only)"


UP_CELL: Final = CellPlan(
    "supervised",
    ("sim_cell_node",),
    ("joint_states",),
    {"sim_cell_node": {"camera_rate": 0.0, "truth_as_perception": True}},
)
"""An arm without its executor."""


def _pushing_client(cell: Cell) -> Process:
    """`push-ident push` whose push has begun: the lowered tool goes on."""
    arguments = ("push", "--at", "0.0,0.1", "--direction", "-1.5708", "--in-object", "--object", OBJECT)
    client, arm = cell.add(NodeCommand("client", (*_CLI, *arguments))), ArmKinematics(robot_description(), neutral=HOME)

    def is_pushing() -> bool:
        latest = cell.monitor.states(cell.monitor.last_state)
        return bool(latest) and arm.forward(latest[-1].q)[2, 3] < _LOWERED and cell.is_moving()

    until(lambda: not is_pushing(), 5.0, "the arm moves by itself")
    until(is_pushing, _PUSH_BEGINS, "the push of the client did not begin")
    return client


def _client_killed(trial: Trial) -> None:
    cell = trial.cell
    try:
        since = _pushing_client(cell).kill()
        trial.expect_hold(since)
    finally:
        cell.remove("client")
    trial.lost = "the push under way"


def _client_interrupted_after_a_wrong_pose(trial: Trial) -> None:
    cell = trial.cell
    try:
        client = _pushing_client(cell)
        wrong = PoseWithCovarianceStamped()
        wrong.header.frame_id = "no_such_frame"
        cell.monitor.publish(OBJECT_POSE, wrong)
        trial.wait(0.2)
        since = client.signal(signal.SIGINT)
        trial.expect_hold(since)
        client.wait(5.0)
        trial.expect(not client.runs, "the client goes on 5 s after Ctrl-C")
        trial.expect(TRACEBACK not in client.output, "the client wrote a traceback")
        trial.note = client.output.strip().splitlines()[-1][-100:] if client.output.strip() else ""
    finally:
        cell.remove("client")
    trial.lost = "the push under way"


FAULTS: Final = (
    Fault(
        number=21,
        name="identification-killed",
        what="SIGKILL to identification in the middle of a push, then started again",
        holds="a checkpoint after every push, replaced as a whole",
        expected="resumes with an equal map; the executor does not notice",
        run=_identification_killed,
        cell=ARM_CELL,
    ),
    Fault(
        number=47,
        name="interrupt-at-start",
        what=f"Ctrl-C {len(_DELAYS)} times in the first {_DELAYS[-1]} s of each node and of `push-ident up`",
        holds="the signal handler is set before anything is loaded",
        expected="exit 0 within 2 s, no traceback",
        run=_stop_at_once,
    ),
    Fault(
        number=59,
        name="interrupt-any-moment",
        what=f"Ctrl-C or SIGTERM at {_N_MOMENTS} random moments of the first {_LATEST:.0f} s of nodes",
        holds="signals are blocked until the node can handle them",
        expected="exit 0 within 2 s, no traceback",
        run=_stop_any_moment,
    ),
    Fault(
        number=29,
        name="transitions",
        what=f"{_N_TRANSITIONS} lifecycle transitions by service in any order, impossible ones too, to each node",
        holds="the base of all nodes",
        expected="each answered; the node lives and works afterwards",
        run=_transitions,
        cell=ARM_CELL,
    ),
    Fault(
        number=48,
        name="shut-down-by-service",
        what="each node is shut down by its service and asked to configure again",
        holds="the base of all nodes",
        expected="answered; ends on Ctrl-C with 0",
        run=_shut_down,
        cell=ARM_CELL,
    ),
    Fault(
        number=49,
        name="executor-deactivated",
        what="the executor is deactivated in the middle of a push",
        holds="deactivation holds the arm first",
        expected="held at once; can be activated again",
        run=_deactivated,
        cell=ARM_CELL,
        within=0.0,
    ),
    Fault(
        number=30,
        name="supervisor-killed",
        what="SIGKILL to `push-ident up arm` in the middle of a push",
        holds="children that watch their parent",
        expected="the arm stands; all children end within 3 s",
        run=_supervisor_killed,
        cell=UP_CELL,
        within=0.5,
    ),
    Fault(
        number=70,
        name="client-killed",
        what="SIGKILL to `push-ident push` in the middle of its push",
        holds="signs of life that a client promises",
        expected="CANCELED; held within the client's time-out",
        run=_client_killed,
        cell=ARM_CELL,
        within=1.2,
    ),
    Fault(
        number=71,
        name="client-interrupted",
        what="a pose of the object in a wrong frame while `push-ident push` runs, then Ctrl-C",
        holds="the guard around every callback of a client; a cancellation from its main thread",
        expected="held at once; the client ends without a traceback",
        run=_client_interrupted_after_a_wrong_pose,
        cell=ARM_CELL,
        within=0.1,
    ),
    Fault(
        number=50,
        name="processor-taken",
        what="two busy processes for each core during a push",
        holds="the watch over the moving arm",
        expected="the push is made, or aborted and held",
        run=_processor_taken,
        cell=ARM_CELL,
    ),
    Fault(
        number=51,
        name="memory-taken",
        what="identification may not allocate memory in the middle of a push",
        holds="processes of their own; the checkpoint",
        expected="the push is made, or aborted and held; nothing that was acknowledged is lost",
        run=_memory_taken,
        cell=ARM_CELL,
    ),
)
