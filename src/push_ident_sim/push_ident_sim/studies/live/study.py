"""Whether live identification gives the results of the library: played, killed, beside a camera, and for an hour, with real processes."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.live.film import measure_live_latency
from push_ident_sim.studies.live.replay import measure_kills, measure_replay, measure_soak

__all__ = ["STUDY"]

_MEASURES: Final = {
    "replay": measure_replay,
    "kills": measure_kills,
    "latency": measure_live_latency,
    "soak": measure_soak,
}
_MESSAGES: Final = ("poses", "pusher samples", "wrenches")
_IN_TIME: Final = 2.0
"""Longest time for a node to end [s]."""


def _run(case: Case, settings: CaseSettings) -> Json:
    # Ctrl-C ends a worker silently; here it has to stop its processes first.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return _MEASURES[case.variant](case.object_name, case.model)
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, before)
        signal.raise_signal(signal.SIGINT)
        raise
    finally:
        signal.signal(signal.SIGINT, before)


def _summarise(results: Sequence[CaseResult]) -> Json:
    """Values of each variant with the sums that the tables show."""
    summary: Json = {result.case.variant: dict(result.values) for result in results}
    if "kills" in summary:
        kills = summary["kills"]["kills"]
        summary["kills"] |= {
            "n": len(kills),
            "equal": sum(kill["equal"] for kill in kills),
            "same_file": sum(not kill["differing"] for kill in kills),
            "half_written": sum(kill["half_written"] for kill in kills),
            "left_behind": sum(bool(kill["left"]) for kill in kills),
            "most_deviations": max(kill["deviations"] for kill in kills),
            "differing": sorted({name for kill in kills for name in kill["differing"]}),
        }
    return summary


def lost(messages: Json, counts: Json) -> dict[str, int]:
    """Messages of a bag that a node did not process, by kind; negative where it processed one twice."""
    return {name: messages[name] - int(counts.get(name, 0)) for name in _MESSAGES}


def _tables(summary: Json) -> str:
    parts = {"replay": _replay_table, "kills": _kills_table, "latency": _latency_table, "soak": _soak_table}
    return "\n\n".join(table(summary[name]) for name, table in parts.items() if name in summary)


def _replay_table(values: Json) -> str:
    head = ["maps of one bag, against `push-ident identify`", "largest difference of a cell [standard deviations]", "relative"]
    rows = [[label, f"{d['deviations']:.3f}", f"{d['relative']:.1%}"] for label, d in values["differences"].items()]
    parts = [markdown_table(head, rows)]
    messages = values["messages"]
    head = ["messages", "in the bag", *(f"processed, {label.removeprefix('live, ')}" for label in values["runs"])]
    rows = [[name, str(messages[name]), *(run["counts"].get(name, "0") for run in values["runs"].values())] for name in _MESSAGES]
    rows.append(["pushes", str(values["n_pushes"]), *(run["counts"].get("pushes", "0") for run in values["runs"].values())])
    for name in ("frames with an update of their own", "frames processed with the next"):
        key = "updates during a push" if "own" in name else "frames taken together"
        rows.append([name, "–", *(run["counts"].get(key, "0") for run in values["runs"].values())])
    return "\n\n".join([*parts, markdown_table(head, rows)])


def _kills_table(values: Json) -> str:
    rows = [
        ["kills, of these in the middle of a file", f"{values['n']}, {values['half_written']}"],
        ["maps equal to the bit", f"{values['equal']} of {values['n']}"],
        ["state file of equal content", f"{values['same_file']} of {values['n']}"],
        ["largest difference of a cell [standard deviations]", f"{values['most_deviations']:.3g}"],
        ["partial files at the end", str(values["left_behind"])],
        ["values that differ", ", ".join(values["differing"]) or "none"],
    ]
    return markdown_table(["killed, started again, bag played from its start", ""], rows)


def _latency_table(values: Json) -> str:
    pose, image = values["from_pose"], values["from_image"]
    rows = [
        [label, *(f"{1e3 * own[key]:.1f}" for key in ("median_s", "p99_s", "worst_s")), f"{own['with_map']} of {own['frames']}"]
        for label, own in (("pose to map, by an observer", pose), ("image to map, by an observer", image))
    ]
    counts = values["counts"]
    inside = [counts.get(f"update latency, {name} [s]") for name in ("median", "99 %")]
    rows.append(["pose to map, by the node itself", *("–" if v is None else f"{1e3 * float(v):.1f}" for v in inside), "–", "–"])
    head = [f"{values['n_cells']} cells, {values['n_pushes']} pushes", "median [ms]", "99 % [ms]", "worst [ms]", "frames with a map"]
    load = ", ".join(f"{name} {share:.0%}" for name, share in values["load"].items())
    period = f"A frame comes each {1e3 * values['period_s']:.1f} ms."
    return f"{markdown_table(head, rows)}\n\n{period} Load of a core: {load}."


def _soak_table(values: Json) -> str:
    def memory(who: str) -> str:
        series, slope = values[f"{who}_mb"], values[f"{who}_growth_mb_h"]
        grown = "–" if slope is None else f"{slope[0]:.2f} ({slope[1]:.2f} to {slope[2]:.2f})"
        return f"{series[0]:.0f}, {series[-1]:.0f}, {grown}"

    late = values["late_s"]
    missing = lost(values["messages"], values["counts"])
    rows = [
        ["bag time, speed, pushes", f"{values['bag_s']:.0f} s, {values['rate']:g}x, {values['n_pushes']}"],
        ["identification: first, last [MB], growth [MB in an hour of bag time] (95 %)", memory("node")],
        ["player, likewise", memory("player")],
        ["messages in the bag, lost", f"{sum(values['messages'].values())}, {sum(missing.values())}"],
        ["pushes learned", values["counts"].get("pushes", "0")],
        ["most pushes that waited for a solve", str(values["most_waiting"])],
        ["99 % of update latencies, first and last [ms]", f"{1e3 * late[0]:.0f}, {1e3 * late[-1]:.0f}" if late else "–"],
        ["Ctrl-C: exit code, end after [s], traceback", f"{values['exit_code']}, {values['end_s']:.2f}, {_yes(values['traceback'])}"],
    ]
    return markdown_table(["one long bag", ""], rows)


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    shown = [name for name in ("latency", "soak") if name in summary]
    if not shown:
        return {}
    figure, axes = new_figure(len(shown))
    for name, ax in zip(shown, axes, strict=True):
        values = summary[name]
        if name == "latency":
            for key, label, colour in (("from_pose", "pose to map", "gauss_newton"), ("from_image", "image to map", "fast_gradient")):
                delays = 1e3 * np.array(values[key]["all_s"])
                ax.step(delays, np.arange(1, len(delays) + 1) / len(delays), label=label, color=COLOURS[colour])
            ax.axvline(1e3 * values["period_s"], color=COLOURS["truth"], lw=1.0, ls=":")
            ax.set_xlabel("delay [ms]")
            ax.set_ylabel("share of frames")
        else:
            hours = np.array(values["time_s"]) * values["rate"] / 3600.0
            for key, label, colour in (("node_mb", "identification", "gauss_newton"), ("player_mb", "player", "fast_gradient")):
                ax.plot(hours, values[key], label=label, color=COLOURS[colour])
            ax.set_xlabel("bag time [h]")
            ax.set_ylabel("resident memory [MB]")
            ax.set_ylim(bottom=0.0)
        label_below(ax, 2)
    save(figure, folder / "live.png")
    return {"live.png": "Delay of the maps during pushes (dotted: the time between two frames), and memory while a long bag is played."}


STUDY = Experiment(
    name="live",
    place=80,
    title="Identification as a process",
    question=(
        "Does the running node give the results of the library after kills, in time, and over an hour? All nodes are processes "
        "connected by DDS. `replay`: eight pushes with noisy poses, played in real time and as fast as possible, against `push-ident "
        "identify`; the same pushes, learned one by one by the library, are compared as well. `kills`: the node is killed at a random "
        "moment, every other time while it writes its state, and started again; the bag is played from its start. `latency`: twelve "
        "pushes before a rendered camera (30 Hz, 640 x 480), perception and identification on the two cores that also run the camera; "
        "measured from the first frame of a push that changes the map. `soak`: one hour of pushes with the memory measured each 5 s; "
        f"growth is the median slope after the first tenth. A node has to end within {_IN_TIME:.0f} s."
    ),
    variants=tuple(_MEASURES),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "pushing", "perception", "physics", "identification", "bags", "nodes"),
    once=tuple(_MEASURES),
    one_at_a_time=True,
)
