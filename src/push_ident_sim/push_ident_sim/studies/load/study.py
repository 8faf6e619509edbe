"""Where each stage sheds load, how it says so, and whether the arm is ever the one that waits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.nodes.base.settings import NODE
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.load import stages
from push_ident_sim.studies.load.arm import CASES, measure_arm
from push_ident_sim.studies.load.bench import SLOW_WRITE

__all__ = ["STUDY"]

_DOMAIN: Final = 82
_STAGES: Final = {"camera": stages.measure_camera, "streams": stages.measure_streams, "recorder": stages.measure_recorder}
_VARIANTS: Final = (*_STAGES, *(f"arm-{case}" for case in CASES))
_COLOURS: Final = ("gauss_newton", "fast_gradient", "autograd")


def _run(case: Case, settings: CaseSettings) -> Json:
    folder, variant = settings.truth_folder.parent / "load", case.variant
    domain = _DOMAIN + _VARIANTS.index(variant)
    if variant in _STAGES:
        return _STAGES[variant](folder, domain)
    return measure_arm(folder, domain, variant.removeprefix("arm-"))


def _summarise(results: Sequence[CaseResult]) -> Json:
    return {result.case.variant: dict(result.values) for result in results}


def _ms(delay: Json) -> str:
    if not delay["n"]:
        return "–"
    return " / ".join(f"{1e3 * delay[key]:.0f}" for key in ("median_s", "p99_s", "worst_s"))


def _share(lost: int, taken: int) -> str:
    return f"{lost / max(lost + taken, 1):.0%}"


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def _tables(summary: Json) -> str:
    tables = {"camera": _camera_table, "streams": _streams_table, "recorder": _recorder_table}
    parts = [table(summary[name]["rows"]) for name, table in tables.items() if name in summary]
    arm = [summary[f"arm-{case}"] for case in CASES if f"arm-{case}" in summary]
    return "\n\n".join([*parts, *([_arm_table(arm)] if arm else [])])


def _camera_table(rows: Sequence[Json]) -> str:
    head = ["objects", "camera [Hz]", "published [Hz]", "images left out", "tracked", "image to pose, median / 99 % / worst [ms]"]
    shown = [
        [
            str(r["n_objects"]),
            f"{r['rate_hz']:.0f}",
            f"{r['sent_hz']:.0f}",
            _share(r["lost"], r["taken"]),
            f"{r['tracked']:.1f}",
            _ms(r["delay"]),
            f"{r['cpu']['perception_node']:.0%}",
            f"{r['memory_mb']['perception_node']:.0f}",
            _yes(r["warned"]),
        ]
        for r in rows
    ]
    return markdown_table([*head, "load of a core", "memory [MB]", "said so"], shown)


def _streams_table(rows: Sequence[Json]) -> str:
    head = ["objects, poses at 1 kHz", "messages", "lost", "frames taken together", "pose to map, median / 99 % / worst [ms]"]
    shown = [
        [
            str(r["n_objects"]),
            str(r["sent"]),
            str(r["lost"]),
            f"{r['together']} of {r['together'] + r['updates']}",
            _ms(r["delay"]),
            f"{r['cpu']['identification_node']:.0%}",
            f"{r['memory_mb']['identification_node']:.0f}",
            _yes(r["warned"]),
        ]
        for r in rows
    ]
    return markdown_table([*head, "load of a core", "memory [MB]", "loss reported"], shown)


def _recorder_table(rows: Sequence[Json]) -> str:
    head = ["recorder, disk", "written", "lost", "load of a core", "memory [MB]", "said so"]
    shown = [
        [r["disk"], r["left_out"], "–", "–", "–", "–"]
        if "left_out" in r
        else [
            r["disk"],
            str(r["written"]),
            str(sum(r["lost"].values())),
            f"{r['cpu']['bag_recorder_node']:.0%}",
            f"{r['memory_mb']['bag_recorder_node']:.0f}",
            _yes(r["warned"]),
        ]
        for r in rows
    ]
    return markdown_table(head, shown)


def _arm_table(cases: Sequence[Json]) -> str:
    head = [
        "cell",
        "between two commands, median / 99 % / worst [ms]",
        "cancel to standing arm [ms]",
        "not held",
        "longest stall of the observer [ms]",
    ]
    shown = [
        [CASES[c["case"]], _ms(c["period"]), _ms(c["hold"]), str(c["not_held"]), f"{1e3 * c['stall_s']:.0f}", f"{c['load']:.0f}"]
        for c in cases
    ]
    return markdown_table([*head, "load of the machine"], shown)


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (left, middle, right) = new_figure(3)
    rows: Sequence[Any] = summary.get("camera", {}).get("rows", [])
    for n, name in zip(stages.N_OBJECTS, _COLOURS, strict=True):
        own = [r for r in rows if r["n_objects"] == n]
        rate, colour = [r["rate_hz"] for r in own], COLOURS[name]
        left.plot(rate, [100.0 * r["lost"] / max(r["lost"] + r["taken"], 1) for r in own], "o-", color=colour, label=f"{n} in view")
        middle.plot(rate, [1e3 * (r["delay"]["median_s"] or np.nan) for r in own], "o-", color=colour, label=f"{n}, median")
        middle.plot(rate, [1e3 * (r["delay"]["p99_s"] or np.nan) for r in own], "o:", color=colour, label=f"{n}, 99 %")
    left.set_ylabel("images left out [%]")
    left.set_ylim(-2, 100)
    middle.set_ylabel("image to pose [ms]")
    middle.set_ylim(bottom=0)
    for ax in (left, middle):
        ax.set_xlabel("camera [Hz]")
        ax.set_xticks(stages.CAMERA_RATES)
        label_below(ax, 3)
    for (case, label), name in zip(CASES.items(), _COLOURS, strict=True):
        gaps = 1e3 * np.sort(summary.get(f"arm-{case}", {}).get("gaps_s", []))
        if len(gaps):
            right.step(gaps, 1.0 - np.arange(len(gaps)) / len(gaps), color=COLOURS[name], label=label)
    right.axvline(100.0, color=COLOURS["truth"], lw=1.0, ls=":")
    right.set(xlabel="time between two commands to the arm [ms]", ylabel="share of commands later than this", yscale="log")
    label_below(right, 1)
    save(figure, folder / "load.png")
    return {
        "load.png": "Left, middle: perception before faster cameras with more objects. Right: commands to the moving arm, with and without "
        "load; dotted: the motion that the arm has in its queue."
    }


STUDY = Experiment(
    name="load",
    place=140,
    title="Limits of load",
    question=(
        "Where does each stage shed load, does it say so, and does the arm ever wait? Sources in processes of their own publish over DDS. "
        "`camera`: rendered depth images, 640 x 480, of one to ten boxes before perception. `streams`: poses of each object, pusher, "
        "wrench and joint states at 1 kHz before identification, three pushes. `recorder`: a camera at 30 Hz and such streams; on the "
        f"slow disk the kernel delays each write to the bag by {SLOW_WRITE:.1f} s (strace). `arm`: pushes that are cancelled in the "
        "middle; in the overloaded cell a camera of 60 Hz with ten objects and its perception, streams of three objects at 1 kHz and their "
        f"identification, and two processes that only compute run beside it, all at "
        f"niceness {NODE.niceness} as nodes that do not move the arm; "
        "in the last case all are as urgent as the arm. Nodes and sources share two cores, so a rate that a source does not reach is the "
        "limit of the machine."
    ),
    variants=_VARIANTS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("perception", "pushing", "identification", "bags", "nodes"),
    once=_VARIANTS,
    one_at_a_time=True,
)
