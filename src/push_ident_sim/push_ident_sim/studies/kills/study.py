"""Whether the arm stops, and nothing wrong is learned, when a node of the live cell is killed in the middle of a push."""

from __future__ import annotations

import os
import signal
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray

from push_ident.cli.supervisor import NodeCommand, node_commands
from push_ident.nodes.base.network import process_domain
from push_ident.nodes.push_executor.parameters import PARAMETERS
from push_ident.pushing.push import PushCode
from push_ident_msgs.action import ExecutePush
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, markdown_table, millimetres, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.common.live_nodes import NodeProcess
from push_ident_sim.studies.pushing.live_cell import Heard, LiveCell, observed

__all__ = ["STUDY", "measure"]

FloatArray = NDArray[np.float64]

_KILLED: Final = {
    "executor": "push_executor_node",
    "executor stopped": "push_executor_node",
    "perception": "perception_node",
    "identification": "identification_node",
    "diagnosis": "gap_diagnosis_node",
}
"""Node of each variant. `executor stopped` gets SIGSTOP, all others SIGKILL."""
_COMMANDS_ARM: Final = ("executor", "executor stopped")
"""Without the others the arm is still commanded, and its motion is not unasked for."""
_N_KILLS: Final = 4
"""Of a case."""
_UNASKED: Final = 0.1
"""Longest motion at speed that nobody asks for [s]."""
_SHORTEST_BRAKING: Final = 0.02
"""Of the executor, from any speed [s]."""
_PERIOD: Final = 0.01
"""Between two joint states [s]: what a time can be read to."""
_STANDS: Final = 0.02
"""Speed below which a joint is at rest [rad/s]."""
_AFTER: Final = 1.0
"""How long the arm is watched after the kill [s]; the executor loses an object within the same time."""
_DISCOVERY: Final = 1.0
"""Until all of a new node was discovered [s]."""
_PATIENCE: Final = 90.0
"""Longest wait for a node to be ready, or a push to end [s]."""
_DEFAULTS: Final[dict[str, Any]] = {row.name: row.default for row in PARAMETERS}
_LIMITS: Final = np.array(_DEFAULTS["joint_acceleration_limits"])
_SLOW: Final = {"random_speed": [0.06, 0.1], "random_distance": [0.06, 0.1]}
"""Pushes that last long enough for the loss of the object to end them."""
_ON_ITS_WAY: Final = {ExecutePush.Feedback.PHASE_PUSH, ExecutePush.Feedback.PHASE_RECENTRE}


# --- one case


class _Cell:
    """The processes of a cell, one of which is killed and started again."""

    def __init__(self, commands: Sequence[NodeCommand], domain: int, folder: Path) -> None:
        self._commands, self._domain, self._folder = {command.name: command for command in commands}, domain, folder
        self._processes: dict[str, NodeProcess] = {}

    def start(self, name: str) -> None:
        """Start a process, again if it was killed."""
        self._processes[name] = NodeProcess(self._commands[name], self._folder / f"{name}.log", self._domain)

    def start_all(self) -> None:
        """Start every process."""
        for name in self._commands:
            self.start(name)

    def signal(self, name: str, number: int) -> None:
        """Send a signal; one that kills is waited for."""
        process = self._processes.pop(name) if number == signal.SIGKILL else self._processes[name]
        os.kill(process.pid, number)
        if number == signal.SIGKILL:
            process.kill()

    def check(self) -> None:
        """As `Processes`."""
        for process in self._processes.values():
            process.check()

    def close(self) -> None:
        """End all."""
        for process in self._processes.values():
            process.kill()


@contextmanager
def _cell(case: Case, folder: Path) -> Iterator[tuple[_Cell, LiveCell]]:
    domain = process_domain()
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    seen = case.variant == "perception"
    cell: dict[str, object] = {"object": case.object_name, "seed": case.model, "noise_seed": case.model}
    nodes = {"sim_cell_node", "push_executor_node", "identification_node", _KILLED[case.variant]}
    commands = node_commands(
        "sim",
        parameters={
            "sim_cell_node": cell | ({} if seen else {"camera_rate": 0.0, "truth_as_perception": True}),
            # The watchdog of the arm of this machine; that of a simulated one would lose an object after 2 s only.
            "push_executor_node": {"arm_timeout": 0.5, **(_SLOW if seen else {})},
            "identification_node": {"suggest_candidates": 0},
        },
        log_level="warn",
    )
    processes = _Cell([command for command in commands if command.name in nodes], domain, folder)
    with ExitStack() as stack:
        stack.callback(processes.close)
        bench = stack.enter_context(observed(processes, domain))
        processes.start_all()
        bench.await_executor()
        yield processes, bench


def _run(case: Case, settings: CaseSettings) -> Json:
    rng = np.random.default_rng([case.model, zlib.crc32(case.object_name.encode()), tuple(_KILLED).index(case.variant)])
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with tempfile.TemporaryDirectory() as folder, _cell(case, Path(folder)) as (cell, bench):
            health, kills = _Health(bench), []
            for _ in range(_N_KILLS):
                kills.append(_kill(cell, bench, health, case.variant, int(rng.integers(2**31)), float(rng.random())))
                health.whole += kills[-1]["whole"]
            return {"kills": kills, "learning": health.result(bench)}
    finally:
        signal.signal(signal.SIGINT, before)


class _Health:
    """What the nodes say of themselves, and what identification has learned."""

    def __init__(self, bench: LiveCell) -> None:
        self.whole = 0
        """Pushes that were made to their end."""
        self._values: dict[str, str] = {}
        self._heard: dict[str, float] = {}
        bench.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            name = status.name.strip("/").split(":")[0]
            self._heard[name] = time.monotonic()
            if name == "identification_node":
                self._values = {value.key: value.value for value in status.values}

    def await_node(self, bench: LiveCell, name: str) -> None:
        """Until a node that was started just now reports; what was discovered of one that was killed stays for a while."""
        started = time.monotonic()
        bench.wait(lambda: self._heard.get(name, 0.0) > started, _PATIENCE, f"{name} did not report")
        bench.pause(_DISCOVERY)

    def result(self, bench: LiveCell) -> Json:
        """Once the record of the last push was waited for."""
        bench.pause(12.0)
        learned, lost = (int(self._values.get(name, "0")) for name in ("pushes", "pushes without an end record, left out"))
        return {"whole": self.whole, "learned": learned, "unrecorded": lost}


def _kill(cell: _Cell, bench: LiveCell, health: _Health, variant: str, seed: int, share: float) -> Json:
    """Kill the node at a random moment of a push: `share` of the time from lowering the tool to the end of the planned push."""
    name, bench.heard = _KILLED[variant], Heard()
    goal = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, seed=seed)
    dry = bench.result(bench.send(ExecutePush.Goal(mode=goal.mode, seed=seed, dry_run=True)), _PATIENCE)
    if dry.error_code == PushCode.UNREACHABLE:
        bench.reset_object()
    lasts = _DEFAULTS["settle"] + (dry.distance + _DEFAULTS["clearance"]) / max(dry.speed, 0.05)
    phases: list[int] = []
    bench.heard = heard = Heard()
    sent = bench.send(goal, phases.append)
    bench.wait(lambda: _ON_ITS_WAY & set(phases) or sent.has_ended, _PATIENCE, "the push did not begin")
    bench.pause(share * lasts)
    stops = variant == "executor stopped"
    event = time.monotonic()
    cell.signal(name, signal.SIGSTOP if stops else signal.SIGKILL)
    bench.pause(_AFTER + 0.5)
    values = measure(bench, heard, _on_clock_of_arm(heard, event)) | {"share": round(share, 3)}
    if name == "push_executor_node":
        if stops:
            cell.signal(name, signal.SIGCONT)
            values["code"] = int(bench.result(sent, _PATIENCE).error_code)
        else:
            cell.start(name)
            health.await_node(bench, name)
    else:
        values["code"] = int(bench.result(sent, _PATIENCE).error_code)
        cell.start(name)
        health.await_node(bench, name)
    bench.await_executor()
    values["hold_s"] = next((round(at - event, 4) for at, msg in heard.commands if at > event and len(msg.points) == 1), None)
    values["whole"] = sum(record.error_code == 0 for record in heard.records)
    return values


def _on_clock_of_arm(heard: Heard, event: float) -> float:
    """The arm's clock [s] at a wall time [s]: by the state of the least delay near it, as this process may be late itself."""
    return event + max(state[1] - state[0] for state in heard.states if abs(state[0] - event) < 0.5)


def measure(bench: LiveCell, heard: Heard, event: float) -> Json:
    """How the arm stopped after an event at a time of its clock [s], and what moved."""
    stamp = np.array([state[1] for state in heard.states])
    q = np.array([state[2] for state in heard.states])
    at, free = (int(np.searchsorted(stamp, t)) for t in (event, event + _UNASKED))
    speed = np.abs(np.diff(q, axis=0)) / np.diff(stamp)[:, None]
    moving = np.flatnonzero(np.max(speed, axis=1) > _STANDS)
    moving = moving[moving >= at]
    fastest = np.max(speed[max(at - 1, 0) : free + 1], axis=0, initial=0.0)
    tip = np.array([bench.kinematics.forward(q[i])[:3, 3] for i in (at - 1, min(free, len(q) - 1), len(q) - 1)])
    truth = np.array([row for row in heard.truth if row[0] >= event])
    return {
        "still_s": round(float(stamp[moving[-1] + 1] - event), 4) if len(moving) else 0.0,
        "braking_s": round(float(max(np.max(fastest / _LIMITS), _SHORTEST_BRAKING)), 4),
        "speed": round(float(np.max(fastest)), 4),
        "tool_m": _rounded(np.linalg.norm(tip[2] - tip[0])),
        "tool_after_m": _rounded(np.linalg.norm(tip[2] - tip[1])),
        "object_m": _rounded(np.linalg.norm(truth[-1, 1:3] - truth[0, 1:3])) if len(truth) else None,
    }


def _rounded(value: float | np.floating[Any]) -> float:
    """A length [m] to a micrometre."""
    return round(float(value), 6)


# --- all cases


def _summarise(results: Sequence[CaseResult]) -> Json:
    return {
        variant: _row([r.values for r in results if r.case.variant == variant])
        for variant in _KILLED
        if any(r.case.variant == variant for r in results)
    }


def _row(cases: Sequence[Json]) -> Json:
    kills = [kill for case in cases for kill in case["kills"]]
    learning: Counter[str] = Counter()
    for case in cases:
        learning.update(case["learning"])
    return {
        "n": len(kills),
        "stopped": sum(kill["still_s"] <= _UNASKED + kill["braking_s"] + 2 * _PERIOD for kill in kills),
        "kills": [{key: kill[key] for key in ("still_s", "braking_s", "tool_m", "tool_after_m", "object_m", "hold_s")} for kill in kills],
        "codes": dict(Counter(PushCode(kill["code"]).name for kill in kills if "code" in kill)),
        **{key: int(learning[key]) for key in ("whole", "learned", "unrecorded")},
    }


def _tables(summary: Json) -> str:
    return markdown_table(
        (
            "killed",
            "times",
            "of them in motion",
            "stopped within 100 ms and braking",
            "stands after, max [ms]",
            "told to hold after, max [ms]",
            "tool moves, max [mm]",
            "after 100 ms",
            "object",
            "pushes whole",
            "learned",
            "results",
        ),
        [
            (
                variant,
                str(row["n"]),
                str(sum(kill["still_s"] > 0 for kill in row["kills"])),
                *(
                    (f"{row['stopped']} of {row['n']}", f"{1e3 * max(kill['still_s'] for kill in row['kills']):.0f}")
                    if variant in _COMMANDS_ARM
                    else ("–", "goes on")
                ),
                _latest_hold(row["kills"]) if variant == "perception" else "–",
                *(
                    millimetres(max(kill[key] for kill in row["kills"] if kill[key] is not None), 1)
                    for key in ("tool_m", "tool_after_m", "object_m")
                ),
                str(row["whole"]),
                str(row["learned"]),
                ", ".join(f"{name} {n}" for name, n in row["codes"].items()) or "–",
            )
            for variant, row in summary.items()
        ],
    )


def _latest_hold(kills: Sequence[Json]) -> str:
    """The latest command to hold after a kill [ms]; there is none after a kill at the very end of a push."""
    return f"{1e3 * max(kill['hold_s'] or 0.0 for kill in kills):.0f}"


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (stops, moves) = new_figure(2)
    for i, (variant, row) in enumerate((variant, row) for variant, row in summary.items() if variant in _COMMANDS_ARM):
        still = 1e3 * np.array([kill["still_s"] for kill in row["kills"]])
        allowed = 1e3 * np.array([_UNASKED + kill["braking_s"] for kill in row["kills"]])
        colour = list(COLOURS.values())[i % len(COLOURS)]
        stops.scatter(allowed, still, s=14, color=colour, label=variant)
        moves.step(np.sort([1e3 * kill["tool_m"] for kill in row["kills"]]), np.arange(1, len(still) + 1) / len(still), color=colour)
    edge = [100.0, max(stops.get_xlim()[1], 101.0)]
    stops.plot(edge, edge, color=COLOURS["truth"], lw=1.0, ls=":")
    stops.set_xlabel("100 ms and braking [ms]")
    stops.set_ylabel("arm stands after [ms]")
    label_below(stops, 3)
    moves.set_xlabel("motion of the tool after the kill [mm]")
    moves.set_ylabel("share of kills")
    save(figure, folder / "kills.png")
    return {"kills.png": "Time from the kill until the arm stands, beside what is allowed; motion of the tool after the kill."}


STUDY = Experiment(
    name="kills",
    place=115,
    title="Kills",
    question=(
        "Does the arm stop when a node is killed in the middle of a push, and is a push learned that was not made to its end? The "
        "simulated cell and the nodes, each a process, in real time. A node gets SIGKILL, or the executor SIGSTOP, at a random moment "
        "between the lowered tool and the planned end of the push; `whole` counts pushes with a record, `learned` those in the maps. "
        "Without perception the executor holds the arm once poses have been missing for `lost_timeout`; identification and "
        "diagnosis do not command the arm, and the push goes on. The time until the arm stands counts on the clock of the arm; 100 ms "
        "and braking is what the acceleration limits of the joints need from their speed at the kill."
    ),
    variants=tuple(_KILLED),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "pushing", "nodes"),
    fewer=dict.fromkeys(_KILLED, 1),
    one_at_a_time=True,
)
