"""What the nodes of a cell take of a processor, and how late they are, with each executor of rclpy that they can run in."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.cli.supervisor import Supervisor, node_commands
from push_ident.errors import PushIdentError
from push_ident.nodes.base.network import own_domain
from push_ident_sim.studies.common.study import Benchmark, Json, Piece, Settings, Target
from push_ident_sim.studies.common.tables import markdown_table

_EXECUTORS: Final = {"wait sets": "wait_sets", "events": "events"}
"""Names, and values of the variable that chooses one."""
_STARTED: Final = 10.0
"""After the first object, before anything is measured: nodes load and compile at their start [s]."""
_STAMPS: Final = {"pose of an object": ("depth/camera_info", "pose"), "pose of the tool": ("joint_states", "tool/pose")}
"""Delays: the topic of the measurement, and that of what is made of it, with the same stamp."""


class _Probe:
    """Hears when a measurement is published and when what is made of it, both in this process."""

    def __init__(self, client: Any, object_id: str) -> None:
        from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import CameraInfo, JointState

        kinds = (CameraInfo, PoseWithCovarianceStamped), (JointState, PoseStamped)
        self.delays: dict[str, list[float]] = defaultdict(list)
        for (name, (source, result)), (source_type, result_type) in zip(_STAMPS.items(), kinds, strict=True):
            measured: dict[tuple[int, int], float] = {}
            result = f"objects/{object_id}/pose" if result == "pose" else result
            client.node.create_subscription(source_type, source, _noting(measured), qos_profile_sensor_data)
            client.node.create_subscription(result_type, result, self._taking(name, measured), qos_profile_sensor_data)

    def _taking(self, name: str, measured: dict[tuple[int, int], float]) -> Any:
        def take(msg: Any) -> None:
            if (at := measured.pop(_key(msg), None)) is not None:
                self.delays[name].append(time.monotonic() - at)

        return take


def _noting(measured: dict[tuple[int, int], float]) -> Any:
    def note(msg: Any) -> None:
        measured[_key(msg)] = time.monotonic()
        if len(measured) > 1000:
            del measured[next(iter(measured))]

    return note


def _key(msg: Any) -> tuple[int, int]:
    return msg.header.stamp.sec, msg.header.stamp.nanosec


def _pieces(settings: Settings) -> list[Piece]:
    n_rounds, rest, n_pushes = (1, 3.0, 1) if settings.quick else (3, 20.0, 3)
    return [Piece("the simulated cell", _measure, (n_rounds, rest, n_pushes, settings.seed))]


def _measure(n_rounds: int, rest: float, n_pushes: int, seed: int) -> Json:
    """Shares and delays of all rounds; the executors take turns."""
    rounds: dict[str, list[Json]] = {name: [] for name in _EXECUTORS}
    for number in range(n_rounds):
        for name in _EXECUTORS:
            rounds[name].append(_run(_EXECUTORS[name], rest, n_pushes, seed + number))
    return {"executors": {name: _median(runs) for name, runs in rounds.items()}, "rounds": n_rounds, "pushes": n_pushes, "rest_s": rest}


def _run(executor: str, rest: float, n_pushes: int, seed: int) -> Json:
    os.environ["ROS_DOMAIN_ID"] = str(own_domain())
    os.environ["PUSH_IDENT_EXECUTOR"] = executor
    nodes = node_commands("sim", parameters={"sim_cell_node": {"seed": seed}})
    with Supervisor(nodes) as supervisor:
        from push_ident.nodes.client.cell_client import CellClient
        from push_ident_msgs.action import ExecutePush

        pids = {command.name: supervisor.pid(command.name) for command in nodes}
        with CellClient(check=supervisor.check) as client:
            object_id = client.wait_for_object()
            time.sleep(_STARTED)
            probe = _Probe(client, object_id)
            with _shares(pids) as at_rest:
                time.sleep(rest)
            with _shares(pids) as pushing:
                for push in range(n_pushes):
                    goal = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, object_id=object_id, seed=seed * n_pushes + push)
                    result = client.execute_push(goal)
                    if result.error_code != ExecutePush.Result.NONE:
                        raise PushIdentError(f"push {push} was not made: {result.error_text}")
            return {"at rest": at_rest, "pushing": pushing, "delays": {name: _late(delays) for name, delays in probe.delays.items()}}


@contextmanager
def _shares(pids: Mapping[str, int]) -> Iterator[dict[str, float]]:
    """Filled at the end: the share of one processor that each process took meanwhile."""
    shares: dict[str, float] = {}
    before, start = {name: _processor(pid) for name, pid in pids.items()}, time.monotonic()
    yield shares
    seconds = time.monotonic() - start
    shares.update({name: (_processor(pid) - before[name]) / seconds for name, pid in pids.items()})


def _processor(pid: int) -> float:
    """Processor time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _late(delays: list[float]) -> Json:
    return {"n": len(delays), "median_s": float(np.median(delays)), "p99_s": float(np.quantile(delays, 0.99))}


def _median(runs: list[Json]) -> Json:
    """The median of each number over the rounds."""
    first = runs[0]
    return {
        key: _median([run[key] for run in runs]) if isinstance(first[key], dict) else float(np.median([r[key] for r in runs]))
        for key in first
    }


def _targets(summary: Json) -> list[Target]:
    rows = summary["rows"][0]["executors"]
    sums = {name: sum(row["at rest"].values()) for name, row in rows.items()}
    return [
        Target(
            "processor share of all nodes at rest, executor of events over wait sets",
            "< 1",
            f"{sums['events'] / sums['wait sets']:.2f}",
            sums["events"] < sums["wait sets"],
        )
    ]


def _tables(summary: Json) -> str:
    row = summary["rows"][0]
    runs = row["executors"]
    shares = [
        [node, *(f"{runs[name][when][node]:.1%}" for when in ("at rest", "pushing") for name in runs)]
        for node in next(iter(runs.values()))["at rest"]
    ]
    delays = [
        [what, *(f"{1e3 * runs[name]['delays'][what][key]:.1f}" for key in ("median_s", "p99_s") for name in runs)] for what in _STAMPS
    ]
    heads = [f"{when}, {name}" for when in ("at rest", "pushing") for name in runs]
    lates = [f"{when}, {name} [ms]" for when in ("median", "99 %") for name in runs]
    return markdown_table(["node", *heads], shares) + "\n\n" + markdown_table(["delay", *lates], delays)


STUDY = Benchmark(
    name="nodes",
    title="Nodes of a cell",
    question=(
        "The simulated cell with all its nodes, at rest and during random pushes: the share of one processor that each node takes, and the "
        "delay from a measurement (a depth image, joint states) to the pose that is made of it, both as another process hears them. In "
        "each round one run with each executor, in turn; medians of the rounds. Nodes with several threads have the same executor in both."
    ),
    pieces=_pieces,
    summarise=lambda results: {"rows": list(results)},
    targets=_targets,
    tables=_tables,
)
