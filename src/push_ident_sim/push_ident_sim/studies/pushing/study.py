"""Whether the real executor makes pushes on the simulated cell as planned, within all limits, and stops them in time."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from push_ident.geometry.kinematics import ArmKinematics
from push_ident.geometry.se2 import wrap_angle
from push_ident.nodes.convert.messages import stamp_from_msg
from push_ident.nodes.push_executor.parameters import PARAMETERS
from push_ident.pushing.pacing import SPLICE
from push_ident.pushing.push import PushCode
from push_ident_msgs.action import ExecutePush
from push_ident_msgs.msg import PushRecord
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, markdown_table, millimetres, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.pushing.live_cell import Heard, LiveCell, live_cell

__all__ = ["STUDY"]

FloatArray = NDArray[np.float64]

_VARIANTS: Final = ("pushes", "cancel", "silence")
_N_PUSHES: Final = 6
_N_STOPS: Final = 3
"""Of a case."""
_MOVED: Final = (0.001, np.radians(0.5))
"""An object that moved by more was touched: shift [m], turn [rad]."""
_MAX_LAG: Final = 0.5
"""Largest delay of the arm behind its commands [s]."""
_STANDS: Final = 0.01
"""Speed below which a joint is at rest [rad/s]."""
_PAUSE: Final = 1.0
"""Longest time between two pieces of one motion [s]."""
_NO_MORE: Final = 0.4
"""Time after a hold without any command [s]."""
_SETTLED: Final = 0.2
"""Time for the executor to receive joint states again [s]."""
_DEFAULTS: Final[dict[str, Any]] = {row.name: row.default for row in PARAMETERS}
_WITHIN: Final = 0.1
"""Longest time to the hold [s]."""


# --- one case


def _run(case: Case, settings: CaseSettings) -> Json:
    seeds = np.random.default_rng([case.model, zlib.crc32(case.object_name.encode()), _VARIANTS.index(case.variant)])
    cell = {"object": case.object_name, "seed": case.model, "noise_seed": case.model}
    if case.variant == "pushes":
        with live_cell(cell, {}, relay=False) as bench:
            return {"pushes": [push for _ in range(_N_PUSHES) for push in _make_push(bench, int(seeds.integers(2**31)))]}
    # A timeout as on the real arm, shorter than that for simulated ones.
    executor = {"arm_timeout": _DEFAULTS["arm_timeout"]} if case.variant == "silence" else {}
    with live_cell(cell, executor, relay=True) as bench:
        stops = [_make_stop(bench, case.variant, int(seeds.integers(2**31)), float(seeds.uniform(0.0, 0.3))) for _ in range(_N_STOPS)]
        return {"stops": stops}


def _random_push(bench: LiveCell, seed: int) -> ExecutePush.Goal:
    """A feasible random push of the object where it lies; without one, the object is put back to the middle."""
    goal = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, seed=seed)
    dry = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, seed=seed, dry_run=True)
    if bench.result(bench.send(dry)).error_code == PushCode.UNREACHABLE:
        bench.reset_object()
    return goal


def _make_push(bench: LiveCell, seed: int) -> list[Json]:
    """Measures of the requested push and, where the object was near the edge, of the earlier one that brought it back."""
    goal = _random_push(bench, seed)
    bench.heard = heard = Heard()
    result = bench.result(bench.send(goal))
    n_expected = (result.push_id > 0) + (result.recentre_push_id > 0)
    bench.wait(lambda: len(heard.records) >= n_expected, 5.0, "the record of a push did not come")
    motions = joined(heard.commands)
    if not heard.records:
        return [{"code": int(result.error_code), "text": result.error_text, "purpose": int(PushRecord.PURPOSE_REQUESTED), "made": False}]
    ends = [received for received, _ in motions[1:]] + [np.inf]
    return [
        measure(bench.kinematics, heard, record, received, command, end)
        for record, (received, command), end in zip(heard.records, motions, ends, strict=False)
    ]


def joined(commands: Sequence[tuple[float, JointTrajectory]]) -> list[tuple[float, JointTrajectory]]:
    """The motions that pieces of them add up to: receipt of the first piece [s], and what was commanded, its time from then.

    Each piece counts until the next one takes over; a hold, which is one point, or a pause ends a motion.
    """
    motions: list[list[tuple[float, JointTrajectory]]] = []
    is_over = True
    for received, msg in commands:
        if len(msg.points) == 1:
            is_over = True
            continue
        if is_over or received - motions[-1][-1][0] > _PAUSE:
            motions.append([])
        is_over = False
        motions[-1].append((received, msg))
    return [(pieces[0][0], _join(pieces)) for pieces in motions]


def _join(pieces: Sequence[tuple[float, JointTrajectory]]) -> JointTrajectory:
    first, msg = pieces[0]
    whole = JointTrajectory(joint_names=msg.joint_names)
    start = _start(first, msg)
    nexts = [_start(received, piece) for received, piece in pieces[1:]] + [np.inf]
    for (received, piece), following in zip(pieces, nexts, strict=True):
        for point in piece.points:
            ahead = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
            if _start(received, piece) + ahead < following + SPLICE - 1e-6:
                moment = _start(received, piece) + ahead - start
                seconds, rest = divmod(moment, 1.0)
                joined_point = JointTrajectoryPoint(positions=point.positions, velocities=point.velocities)
                joined_point.time_from_start.sec, joined_point.time_from_start.nanosec = int(seconds), int(1e9 * rest)
                whole.points.append(joined_point)
    return whole


def _start(received: float, piece: JointTrajectory) -> float:
    """Of a piece [s], by its stamp or, without one, its receipt."""
    return stamp_from_msg(piece.header.stamp) or received


def measure(kinematics: ArmKinematics, heard: Heard, record: PushRecord, received: float, command: JointTrajectory, end: float) -> Json:
    """One push, from the messages between its command, received at `received` [s], and the next at `end`."""
    states = [state for state in heard.states if received <= state[0] < end]
    stamp = np.array([state[1] for state in states])
    q, velocity = (np.array([state[i] for state in states]) for i in (2, 3))
    tip = np.array([kinematics.forward(row)[:3, 3] for row in q])
    start, stop, over = (stamp_from_msg(t) for t in (record.start, record.stop, record.end))
    pushing = (stamp >= start) & (stamp <= stop)
    lowered = (stamp >= start) & (stamp <= over)
    time, commanded = _commanded(kinematics, command)
    path: Json = dict.fromkeys(("cross_rms_m", "cross_max_m", "late_rms_m", "late_max_m", "lag_s", "tool"))
    if pushing.any():
        cross = _distance_to_path(tip[pushing], commanded)
        lag, late = _lag(stamp[pushing], tip[pushing], time + stamp[0], commanded)
        path = {
            "cross_rms_m": _rounded(np.sqrt(np.mean(cross**2))),
            "cross_max_m": _rounded(cross.max()),
            "late_rms_m": _rounded(np.sqrt(np.mean(late**2))),
            "late_max_m": _rounded(late.max()),
            "lag_s": round(lag, 4),
            "tool": [[round(float(v), 4) for v in tip[pushing][i, :2]] for i in (0, -1)],
        }
    truth = np.array([row for row in heard.truth if start - 0.1 <= row[0] <= over + 0.1])
    shift = float(np.linalg.norm(truth[-1, 1:3] - truth[0, 1:3]))
    turn = abs(float(wrap_angle(truth[-1, 3] - truth[0, 3])))
    fastest = np.minimum(kinematics.velocity_limit, _DEFAULTS["max_joint_velocity"])
    outside = np.maximum(kinematics.position_lower - q, q - kinematics.position_upper)
    x_min, x_max, y_min, y_max = _DEFAULTS["workspace"]
    x, y = tip[lowered, 0], tip[lowered, 1]
    beyond = np.max([x_min - x, x - x_max, y_min - y, y - y_max]) if lowered.any() else 0.0
    forces = [force for at, force in heard.forces if start <= at <= over]
    return {
        "code": int(record.error_code),
        "text": record.error_text,
        "purpose": int(record.purpose),
        "made": True,
        "moved": bool(shift > _MOVED[0] or turn > _MOVED[1]),
        "shift_m": round(shift, 5),
        "turn_rad": round(turn, 5),
        "contact_recorded": bool(stamp_from_msg(record.contact) > 0.0),
        "joint_margin_rad": round(float(-outside.max()), 4),
        "velocity_share": round(float(np.max(np.abs(velocity) / fastest)), 4),
        "beyond_workspace_m": _rounded(beyond) if lowered.any() else None,
        "lowest_tip_m": _rounded(tip[:, 2].min()),
        "peak_force_n": round(max(forces), 2) if forces else None,
        "speed": round(record.speed, 4),
        "real_time_factor": round(float((stamp[-1] - stamp[0]) / (states[-1][0] - states[0][0])), 3),
        **path,
    }


def _commanded(kinematics: ArmKinematics, command: JointTrajectory) -> tuple[FloatArray, FloatArray]:
    """Times from the start [s], shape (n,), and tips [m], shape (n, 3), of a command."""
    time = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in command.points])
    return time, np.array([kinematics.forward(list(p.positions))[:3, 3] for p in command.points])


def _distance_to_path(points: FloatArray, path: FloatArray) -> FloatArray:
    """Distance of each of `points` (n, 3) to the polyline `path` (m, 3) [m]."""
    edge = np.diff(path, axis=0)
    from_start = points[:, None] - path[None, :-1]
    share = np.clip(np.sum(from_start * edge, axis=2) / np.maximum(np.sum(edge * edge, axis=1), 1e-300), 0.0, 1.0)
    return np.asarray(np.linalg.norm(from_start - share[..., None] * edge, axis=2).min(axis=1))


def _lag(stamp: FloatArray, tip: FloatArray, time: FloatArray, path: FloatArray) -> tuple[float, FloatArray]:
    """The constant delay [s] that explains the motion best, and the distances of the tip from its delayed command [m]."""

    def distances(lag: float) -> FloatArray:
        at_time = np.stack([np.interp(stamp - lag, time, path[:, axis]) for axis in range(3)], axis=1)
        return np.asarray(np.linalg.norm(tip - at_time, axis=1))

    lags = np.arange(-0.05, _MAX_LAG, 0.001)
    best = float(lags[int(np.argmin([np.sum(distances(lag) ** 2) for lag in lags]))])
    return best, distances(best)


def _make_stop(bench: LiveCell, kind: str, seed: int, delay: float) -> Json:
    """Begin a push and, `delay` [s] after the tool has been lowered, cancel it or stop the arm's joint states."""
    phases: list[int] = []
    goal = _random_push(bench, seed)
    bench.heard = heard = Heard()
    sent = bench.send(goal, phases.append)
    moving = {ExecutePush.Feedback.PHASE_PUSH, ExecutePush.Feedback.PHASE_RECENTRE}
    bench.wait(lambda: moving & set(phases) or sent.has_ended, 60.0, "the push did not begin")
    bench.pause(delay)
    n_before = len(heard.commands)
    if kind == "cancel":
        event = bench.cancel(sent)
    else:
        bench.relaying = False
        event = bench.last_relayed
    result = bench.result(sent)
    expected = PushCode.CANCELED if kind == "cancel" else PushCode.ARM_SILENT
    bench.pause(_NO_MORE)
    bench.relaying = True
    bench.pause(_SETTLED)
    later = heard.commands[n_before:]
    first = next((i for i, (_, msg) in enumerate(later) if len(msg.points) == 1), len(later))
    holds = later[first:]
    if result.error_code != expected or not holds or holds[0][0] < event:
        return {"kind": kind, "spurious": True, "code": int(result.error_code), "text": result.error_text}
    held = holds[0][0]
    still = next((s[0] for s in heard.states if s[0] > held and np.max(np.abs(s[3])) < _STANDS), None)
    return {
        "kind": kind,
        "spurious": False,
        "hold_s": round(held - event, 4),
        "still_s": None if still is None else round(still - event, 4),
        "commands_after": len(holds) - 1,
        "is_hold": len(holds[0][1].points) == 1,
    }


def _rounded(value: float) -> float:
    """A length [m] to a micrometre."""
    return round(float(value), 6)


# --- all cases


def _summarise(results: Sequence[CaseResult]) -> Json:
    pushes = [(r.case.object_name, push) for r in results for push in r.values.get("pushes", ())]
    stops = [stop for r in results for stop in r.values.get("stops", ())]
    names = sorted({name for name, _ in pushes})
    kinds = sorted({stop["kind"] for stop in stops})
    return {
        "objects": {name: _row([push for n, push in pushes if n == name]) for name in names},
        "all": _row([push for _, push in pushes]),
        "refused": [push["text"] for _, push in pushes if not push["made"]],
        "codes": dict(Counter(PushCode(push["code"]).name for _, push in pushes if push["made"])),
        "stops": {kind: _stop_row([stop for stop in stops if stop["kind"] == kind]) for kind in kinds},
        "tools": [push["tool"] for _, push in pushes if push["made"] and push["tool"] is not None],
        "cross_max_m": [push["cross_max_m"] for _, push in pushes if push["made"] and push["cross_max_m"] is not None],
        "late_max_m": [push["late_max_m"] for _, push in pushes if push["made"] and push["late_max_m"] is not None],
    }


def _row(pushes: Sequence[Json]) -> Json:
    made = [push for push in pushes if push["made"]]
    requested = [push for push in made if push["purpose"] == PushRecord.PURPOSE_REQUESTED]
    if not made:
        return {"asked": 0, "refused": len(pushes)}

    def worst(key: str, of: Any = max) -> float:
        return float(of(push[key] for push in made if push[key] is not None))

    def rms(key: str) -> float:
        return _rounded(np.sqrt(np.mean([push[key] ** 2 for push in made if push[key] is not None])))

    return {
        "asked": len(requested),
        "refused": len(pushes) - len(made),
        "recentred": len(made) - len(requested),
        "contact": sum(push["moved"] for push in made),
        "succeeded": sum(push["code"] == PushCode.NONE for push in made),
        "cross_rms_m": rms("cross_rms_m"),
        "cross_max_m": worst("cross_max_m"),
        "late_rms_m": rms("late_rms_m"),
        "late_max_m": worst("late_max_m"),
        "lag_s": round(float(np.median([push["lag_s"] for push in made if push["lag_s"] is not None])), 4),
        "joint_margin_rad": worst("joint_margin_rad", min),
        "velocity_share": worst("velocity_share"),
        "beyond_workspace_m": worst("beyond_workspace_m"),
        "lowest_tip_m": worst("lowest_tip_m", min),
        "peak_force_n": worst("peak_force_n"),
        "real_time_factor": round(float(np.median([push["real_time_factor"] for push in made])), 2),
    }


def _stop_row(stops: Sequence[Json]) -> Json:
    valid = [stop for stop in stops if not stop["spurious"]]
    return {
        "made": len(stops),
        "valid": len(valid),
        "spurious": dict(Counter(PushCode(stop["code"]).name for stop in stops if stop["spurious"])),
        "hold_s": sorted(stop["hold_s"] for stop in valid),
        "still_s": sorted(stop["still_s"] for stop in valid if stop["still_s"] is not None),
        "within": sum(stop["hold_s"] <= _WITHIN for stop in valid),
        "commands_after": sum(stop["commands_after"] for stop in valid),
        "not_a_hold": sum(not stop["is_hold"] for stop in valid),
    }


def _tables(summary: Json) -> str:
    parts = []
    rows = {**summary["objects"], "all": summary["all"]}
    if summary["all"]["asked"]:
        parts.append(
            "Deviation of the measured tool, from lowering to the stop of the push: from the commanded path, and from the commanded place "
            "to be at that time less a constant lag.\n\n"
            + markdown_table(
                ("object", "pushes", "re-centred", "object moved", "to path RMS [mm]", "max", "at time RMS [mm]", "max", "lag [ms]"),
                [
                    (
                        name,
                        str(row["asked"]),
                        str(row["recentred"]),
                        f"{100 * row['contact'] / (row['asked'] + row['recentred']):.1f} %",
                        *(millimetres(row[key], 3) for key in ("cross_rms_m", "cross_max_m", "late_rms_m", "late_max_m")),
                        f"{1e3 * row['lag_s']:.0f}",
                    )
                    for name, row in rows.items()
                    if row["asked"]
                ],
            )
        )
        everything = summary["all"]
        parts.append(
            markdown_table(
                ("limit, worst of all pushes", "measured", "limit"),
                [
                    ("distance to a joint's limit [rad]", f"{everything['joint_margin_rad']:.3f}", "> 0"),
                    ("joint velocity, share of its limit", f"{everything['velocity_share']:.2f}", "1"),
                    ("tool beyond the workspace [mm]", millimetres(max(everything["beyond_workspace_m"], 0.0)), "0"),
                    ("lowest tip above the table [mm]", millimetres(everything["lowest_tip_m"]), "> 0"),
                    ("force [N]", f"{everything['peak_force_n']:.1f}", f"{_DEFAULTS['force_limit']:.0f}"),
                ],
            )
        )
        codes = ", ".join(f"{name} {count}" for name, count in summary["codes"].items())
        parts.append(
            f"Results: {codes}; refused before any motion: {len(summary['refused'])}. "
            f"Simulated seconds per second: {everything['real_time_factor']:.2f}."
        )
    if summary["stops"]:
        parts.append(
            markdown_table(
                ("stop", "made", "hold median [ms]", "95 %", "max", "within 100 ms", "standing max [ms]", "commands after", "not valid"),
                [
                    (
                        kind,
                        str(row["made"]),
                        *_quantiles(row["hold_s"]),
                        f"{row['within']} of {row['valid']}",
                        f"{1e3 * max(row['still_s'], default=float('nan')):.0f}",
                        str(row["commands_after"]),
                        ", ".join(f"{name} {n}" for name, n in row["spurious"].items()) or "0",
                    )
                    for kind, row in summary["stops"].items()
                ],
            )
        )
    return "\n\n".join(parts)


def _quantiles(seconds: Sequence[float]) -> tuple[str, str, str]:
    if not seconds:
        return "–", "–", "–"
    return (f"{1e3 * np.median(seconds):.0f}", f"{1e3 * np.quantile(seconds, 0.95):.0f}", f"{1e3 * max(seconds):.0f}")


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (table, deviation, holds) = new_figure(3)
    for (x0, y0), (x1, y1) in summary["tools"]:
        table.annotate("", (y1, x1), (y0, x0), arrowprops={"arrowstyle": "->", "color": COLOURS["gauss_newton"], "lw": 0.6, "alpha": 0.6})
    x_min, x_max, y_min, y_max = _DEFAULTS["workspace"]
    table.plot([y_min, y_max, y_max, y_min, y_min], [x_min, x_min, x_max, x_max, x_min], color=COLOURS["truth"], lw=1.0)
    table.set_aspect("equal")
    table.set_xlabel("y [m]")
    table.set_ylabel("x [m]")
    table.set_title("tool during the pushes, and the workspace", fontsize=10)
    for key, label in (("cross_max_m", "to the path"), ("late_max_m", "at its time, lag removed")):
        values = np.sort(summary[key]) * 1e3
        if len(values):
            colour = COLOURS["gauss_newton" if key == "cross_max_m" else "fast_gradient"]
            deviation.step(values, np.arange(1, len(values) + 1) / len(values), label=label, color=colour)
    deviation.axvline(1.0, color=COLOURS["truth"], lw=1.0, ls=":")
    deviation.set_xlabel("largest deviation of a push [mm]")
    deviation.set_ylabel("share of pushes")
    label_below(deviation, 2)
    for kind, row in summary["stops"].items():
        if row["hold_s"]:
            holds.step(1e3 * np.array(row["hold_s"]), np.arange(1, len(row["hold_s"]) + 1) / len(row["hold_s"]), label=kind)
    holds.axvline(1e3 * _WITHIN, color=COLOURS["truth"], lw=1.0, ls=":")
    holds.set_xlabel("time to the hold command [ms]")
    holds.set_ylabel("share of stops")
    if summary["stops"]:
        label_below(holds, 2)
    save(figure, folder / "pushing.png")
    return {"pushing.png": "Path of the tool in all pushes; largest deviation of each; time from cancel or silence to the hold."}


STUDY = Experiment(
    name="pushing",
    place=110,
    title="Pushing",
    question=(
        "Does the arm push as planned, within all limits, and does it stop in time? The executor node drives the simulated cell, each "
        "a process, in real time. The object is reported at its true pose with 0.5 mm and 0.3 degrees of noise, since perception is "
        f"measured elsewhere. `pushes`: {_N_PUSHES} random pushes a case. `cancel` and `silence`: {_N_STOPS} pushes a case that are "
        "canceled, or during which the arm's joint states stop; the time counts from the request, or from the last joint state that "
        "the executor received, to the receipt of the command to hold."
    ),
    variants=_VARIANTS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "pushing", "nodes"),
    fewer={"cancel": 3, "silence": 3},
)
