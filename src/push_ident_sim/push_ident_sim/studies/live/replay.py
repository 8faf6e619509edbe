"""A bag through the live nodes: the same maps as offline at any speed, after any kill, and over an hour."""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from push_ident.bags.contract import Role, role_of
from push_ident.bags.raw import raw_messages
from push_ident.bags.records import write_records
from push_ident.errors import PushIdentError
from push_ident.identification.identify import identify
from push_ident.identification.online.session import ObjectSession, SessionOptions
from push_ident.identification.online.state_file import load_state
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.nodes.base.network import own_domain
from push_ident.offline.loading import load_pushes
from push_ident.types import PushRecord
from push_ident_sim.objects import OBJECT_NAMES, make_object
from push_ident_sim.recordings.recording import RecordingSettings, record_pushes
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, make_pushes, observe_motion, true_model
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.live_nodes import (
    IDENTIFICATION,
    PLAYER,
    NodeProcess,
    Observer,
    commands,
    observer,
    resident_memory,
    until,
)

__all__ = ["difference", "differing", "growth", "measure_kills", "measure_replay", "measure_soak"]

FloatArray = NDArray[np.float64]

_N_PUSHES: Final = 8
_N_KILLS: Final = 20
_KILL_RATE: Final = 4.0
_STARTUP: Final = 60.0
"""Longest wait for the first report of a node [s]."""
_STILL: Final = 12
"""Number of reports without change, one a second, after which nothing more is expected."""
_COUNTED: Final = {Role.POSE: "poses", Role.PUSHER: "pusher samples", Role.WRENCH: "wrenches"}
"""Names of the messages in the counters of identification."""
_HANDLED: Final = ("pushes", "pushes known already", "pushes without contact", "pushes refused")
_SOAK_SECONDS: Final = 3600.0
"""Of bag time."""
_SOAK_RATE: Final = 5.0
_SOAK_MOTIONS: Final = 40
"""Number of different pushes; they are repeated with other noise."""
_SAMPLING: Final = 5.0
"""Period at which the memory is measured [s]."""
_WARM_UP: Final = 0.1
"""Share of a soak that does not count for the growth."""


# --- replay equals live


def measure_replay(object_name: str, model: int) -> Json:
    """Maps of one bag, played in real time and at full speed, against those of the library; and what happened to its messages."""
    with tempfile.TemporaryDirectory(prefix="push_ident_live_") as name:
        folder = Path(name)
        bag = _recorded(folder, object_name, model)
        records = load_pushes([bag]).records
        whole = identify(records).posterior
        session = ObjectSession(object_name, records[0].shape, SessionOptions())
        for record in records:
            session.finish(record)
        posteriors = {"push by push": session.posterior}
        runs: Json = {}
        for rate in (1.0, 0.0):
            label = f"live, {rate:g}x" if rate else "live, full speed"
            state, runs[label] = _played(bag, folder / label, object_name, rate, len(records))
            posteriors[label] = load_state(state).state.posterior
        return {
            "messages": _messages(bag),
            "n_pushes": len(records),
            "n_cells": len(records[0].shape.cells),
            "runs": runs,
            "differences": {label: difference(posterior, whole) for label, posterior in posteriors.items()},
            "to_push_by_push": {
                label: difference(posterior, session.posterior) for label, posterior in posteriors.items() if label != "push by push"
            },
        }


def difference(one: ModelPosterior, other: ModelPosterior) -> Json:
    """Largest of the cells' mass times friction: in standard deviations of `other`, and relative; and whether all is equal to the bit."""
    maps = [p.model.mass * p.model.friction for p in (one, other)]
    change = np.abs(maps[0] - maps[1])
    return {
        "deviations": float(f"{np.max(change / other.mass_friction_std):.3g}"),
        "relative": float(f"{np.max(change / maps[1]):.3g}"),
        "equal": bool(np.array_equal(one.z, other.z) and np.array_equal(one.covariance, other.covariance)),
    }


def _recorded(folder: Path, object_name: str, model: int) -> Path:
    bag = folder / "bag"
    record_pushes(bag, RecordingSettings(object_name, model, n_pushes=_N_PUSHES))
    return bag


def _messages(bag: Path) -> dict[str, int]:
    counts = Counter(found.role for m in raw_messages(bag) if (found := role_of(m.topic)) is not None)
    return {name: counts[role] for role, name in _COUNTED.items()}


def _played(bag: Path, folder: Path, object_id: str, rate: float, n_pushes: int) -> tuple[Path, Json]:
    """State file after the bag was played to the end, and what identification counted."""
    folder.mkdir(parents=True, exist_ok=True)
    domain = own_domain()
    both = commands(bag, {IDENTIFICATION: {"state_directory": str(folder)}, PLAYER: _playing(rate)})
    with observer(domain, object_id) as observed, NodeProcess(both[IDENTIFICATION], folder / "node.log", domain) as node:
        until(lambda: observed.reported, _STARTUP, "identification reported nothing", node)
        with NodeProcess(both[PLAYER], folder / "player.log", domain) as player:
            until(lambda: not player.runs, 3600.0, "the bag was not played to its end", node, player)
        _settle(observed, node, n_pushes)
        counts = dict(observed.counts)
        node.interrupt()
    state = folder / f"{object_id}.state.json"
    if not state.exists():
        raise PushIdentError(f"Identification kept no state of {object_id}; it wrote: {' / '.join(node.output.splitlines()[-3:])}")
    return state, {"counts": counts}


def _playing(rate: float) -> dict[str, object]:
    # The observer subscribes to the poses as well: the player must still wait for identification.
    return {"rate": rate, "listeners": 2, "wait": _STARTUP}


def _settle(observed: Observer, node: NodeProcess, n_pushes: int) -> None:
    """Wait until all pushes are processed, or nothing changes any more."""
    still, last, reported = 0, None, observed.reported
    while still < _STILL:
        until(lambda reported=reported: observed.reported > reported, 30.0, "identification stopped reporting", node)  # type: ignore[misc]
        reported = observed.reported
        handled = [observed.count(name) for name in (*_HANDLED, "pushes waiting")]
        if sum(handled[:-1]) >= n_pushes and handled[-1] == 0:
            return
        still, last = (still + 1 if handled == last else 0), handled


# --- kills


def measure_kills(object_name: str, model: int, n_kills: int = _N_KILLS) -> Json:
    """Kill the node at random moments, and in the middle of writing; start it again and play the bag from its start."""
    rng = np.random.default_rng([model, OBJECT_NAMES.index(object_name), 9])
    with tempfile.TemporaryDirectory(prefix="push_ident_live_") as name:
        folder = Path(name)
        bag = _recorded(folder, object_name, model)
        records = load_pushes([bag]).records
        lived, _ = _played(bag, folder / "lived", object_name, _KILL_RATE, len(records))
        stamps = [m.stamp_ns for m in raw_messages(bag)]
        lasts = 1e-9 * (stamps[-1] - stamps[0]) / _KILL_RATE + 1.0
        kills = []
        for number in range(n_kills):
            own = folder / f"kill-{number}"
            # Writing is rare: every other kill waits for the next one.
            kill = _kill(bag, own, object_name, float(rng.uniform(0.0, lasts)), in_writing=number % 2 == 1)
            state, _ = _played(bag, own, object_name, _KILL_RATE, len(records))
            posteriors = [load_state(path).state.posterior for path in (state, lived)]
            kills.append(
                kill
                | difference(posteriors[0], posteriors[1])
                | {"differing": differing(_read(state), _read(lived)), "left": sorted(p.name for p in own.glob("*.part"))}
            )
        return {"n_pushes": len(records), "rate": _KILL_RATE, "kills": kills}


def _kill(bag: Path, folder: Path, object_id: str, moment: float, *, in_writing: bool) -> Json:
    """Play into a node and kill it, `moment` [s] after the player began, or at the first writing from then on."""
    folder.mkdir(parents=True)
    domain = own_domain()
    both = commands(bag, {IDENTIFICATION: {"state_directory": str(folder)}, PLAYER: _playing(_KILL_RATE)})
    state = folder / f"{object_id}.state.json"
    partial = state.with_name(state.name + ".part")
    with observer(domain, object_id) as observed, NodeProcess(both[IDENTIFICATION], folder / "node.log", domain) as node:
        until(lambda: observed.reported, _STARTUP, "identification reported nothing", node)
        with NodeProcess(both[PLAYER], folder / "player.log", domain) as player:
            until(lambda: observed.pose_at, _STARTUP, "no pose was played", node, player)
            began = time.monotonic()
            time.sleep(moment)
            while in_writing and player.runs and not partial.exists():
                pass
            node.kill()
            after = time.monotonic() - began
    return {
        "after_s": round(after, 3),
        "half_written": partial.exists(),
        "pushes_kept": load_state(state).state.n_pushes if state.exists() else 0,
    }


def differing(one: Any, other: Any, path: str = "") -> list[str]:
    """Names of the values in which two JSON contents differ, down to the fields of objects."""
    if isinstance(one, dict) and isinstance(other, dict):
        return [p for key in sorted(one | other) for p in differing(one.get(key), other.get(key), f"{path}.{key}".lstrip("."))]
    # Text, since NaN equals nothing.
    return [] if json.dumps(one) == json.dumps(other) else [path]


def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


# --- one hour


def measure_soak(object_name: str, model: int) -> Json:
    """An hour of bag time: memory, losses, latency, and the end.

    `PUSH_IDENT_SOAK_SECONDS` and `PUSH_IDENT_SOAK_RATE` in the environment make it shorter or faster.
    """
    wanted = float(os.environ.get("PUSH_IDENT_SOAK_SECONDS", _SOAK_SECONDS))
    rate = float(os.environ.get("PUSH_IDENT_SOAK_RATE", _SOAK_RATE))
    domain = own_domain()
    with tempfile.TemporaryDirectory(prefix="push_ident_live_") as name:
        folder = Path(name)
        bag = folder / "bag"
        seconds, n_pushes = _long_bag(bag, object_name, model, wanted)
        parameters: dict[str, dict[str, object]] = {IDENTIFICATION: {"state_directory": str(folder)}, PLAYER: _playing(rate)}
        both = commands(bag, parameters)
        rows: list[tuple[float, ...]] = []
        with observer(domain, object_name) as observed, NodeProcess(both[IDENTIFICATION], folder / "node.log", domain) as node:
            until(lambda: observed.reported, _STARTUP, "identification reported nothing", node)
            with NodeProcess(both[PLAYER], folder / "player.log", domain) as player:
                until(lambda: observed.pose_at, _STARTUP, "no pose was played", node, player)
                began = time.monotonic()
                while player.runs:
                    node.check()
                    try:
                        memory = resident_memory(node.pid), resident_memory(player.pid)
                    except (OSError, IndexError):
                        break  # The player has just ended.
                    late = float(observed.counts.get("update latency, 99 % [s]", "nan"))
                    rows.append((time.monotonic() - began, *memory, late, observed.count("pushes waiting")))
                    time.sleep(_SAMPLING)
                player.check()
                played_in = time.monotonic() - began
            _settle(observed, node, n_pushes)
            counts = dict(observed.counts)
            code, end = node.interrupt()
            output = node.output
        return _soaked(np.array(rows), rate) | {
            "bag_s": round(seconds, 1),
            "rate": rate,
            "wall_s": round(played_in, 1),
            "n_pushes": n_pushes,
            "messages": _messages(bag),
            "counts": counts,
            "exit_code": code,
            "end_s": round(end, 2),
            "traceback": "Traceback" in output,
        }


def _long_bag(bag: Path, object_name: str, model: int, seconds: float) -> tuple[float, int]:
    """Write a bag of at least so many seconds; how many it has, and how many pushes."""
    thing, noise = make_object(object_name, model), CameraNoise(force_std=0.05)
    settings = TruthSettings(n_train=_SOAK_MOTIONS, n_test=0)
    own = [model, OBJECT_NAMES.index(object_name)]
    motions, shape = make_pushes(thing, own, settings), true_model(thing).shape
    records: list[PushRecord] = []
    start, radius = 0.0, settings.pushes.pusher_radius
    while start < seconds:
        number = len(records)
        observed = observe_motion(motions[number % len(motions)], radius, noise, np.random.default_rng([*own, number, 10]))
        records.append(PushRecord(object_name, shape, *observed))
        # The pause that `write_records` makes.
        start += float(observed[1].time[-1]) + 2.0
    write_records(bag, records)
    return start, len(records)


def _soaked(rows: FloatArray, rate: float) -> Json:
    wall, node, player, late, waiting = rows.T
    known = np.flatnonzero(np.isfinite(late))
    return {
        "time_s": [round(float(t), 1) for t in wall],
        "node_mb": [round(float(m), 2) for m in node],
        "player_mb": [round(float(m), 2) for m in player],
        "late_s": [round(float(s), 4) for s in late[known]],
        "most_waiting": int(waiting.max()),
        "node_growth_mb_h": growth(wall * rate, node),
        "player_growth_mb_h": growth(wall * rate, player),
    }


def growth(time_s: Sequence[float] | FloatArray, megabytes: Sequence[float] | FloatArray) -> list[float] | None:
    """Growth [MB/h] after the warm-up, with the bounds of its 95 % interval: median of the slopes between all samples; None for too few."""
    time, memory = np.asarray(time_s) / 3600.0, np.asarray(megabytes)
    used = time >= _WARM_UP * time[-1]
    if used.sum() < 3:
        return None
    from scipy.stats import theilslopes  # its import takes half a second

    slope, _, low, high = theilslopes(memory[used], time[used])
    return [round(float(v), 3) for v in (slope, low, high)]
