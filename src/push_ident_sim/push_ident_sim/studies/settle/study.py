"""Whether the live cell settles a diagnosis by itself: push, diagnose, make the proposed push, diagnose again."""

from __future__ import annotations

import os
import random
import tempfile
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.cli.supervisor import Supervisor, node_commands
from push_ident.errors import InputError
from push_ident.nodes.client.cell_client import CellClient
from push_ident.pushing.push import PushCode
from push_ident_msgs.action import DiagnoseGap, ExecutePush
from push_ident_msgs.msg import GapReport
from push_ident_sim.injected import INJECTED
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, label_below, markdown_table, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment

__all__ = ["STUDY"]

_VARIANTS: Final = ("none", "table_tilt", "table_anisotropy", "pusher_friction", "position_dependent_friction", "pose_latency")
"""Injected effects, identified from different features of the pushes."""
_FIRST: Final = 6
"""Random pushes before the first diagnosis."""
_MOST: Final = 4
"""Largest number of pushes that a diagnosis may request."""
_TRIES: Final = 12
_PAUSE: Final = 2.0
"""After a push that was refused [s]."""
_SLOWER: Final = 2
"""Times that a push may be made at half the speed because of a limit of the arm."""
_SETTLED: Final = ("no_gap", "named", "several")


def _run(case: Case, settings: CaseSettings) -> Json:
    rng = random.Random(zlib.crc32(case.key.encode()))
    os.environ["ROS_DOMAIN_ID"] = str(rng.randint(1, 100))
    cell: dict[str, object] = {"object": case.object_name, "seed": case.model, "noise_seed": case.model}
    if case.variant != "none":
        cell[f"effects.{case.variant}"] = list(INJECTED[case.variant].typical()[case.variant])
    commands = node_commands("sim", parameters={"sim_cell_node": cell})
    with (
        tempfile.TemporaryDirectory() as folder,
        Supervisor(commands, log_dir=Path(folder)) as nodes,
        CellClient(check=nodes.check) as client,
    ):
        object_id = client.wait_for_object()
        made = 0
        for attempt in range(_TRIES):
            goal = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, object_id=object_id, seed=1000 * case.model + attempt)
            result = client.execute_push(goal)
            made += result.error_code == PushCode.NONE
            if made == _FIRST:
                break
            if result.error_code != PushCode.NONE:
                time.sleep(_PAUSE)  # the hand may still be closing
        if not made:
            raise InputError(f"None of {_TRIES} pushes was made; the last one: {result.error_text}")
        client.wait_for_map(object_id, made)
        reports = [_diagnose(client, object_id)]
        asked: list[Json] = []
        while (goal := _proposed(reports[-1], object_id)) is not None and len(asked) < _MOST:
            result = _make(client, goal)
            asked.append({"code": int(result.error_code), "text": result.error_text, "distance2": reports[-1].next_push_mahalanobis2})
            made += result.error_code == PushCode.NONE
            client.wait_for_map(object_id, made)
            reports.append(_diagnose(client, object_id))
    return {"pushes": made, "asked": asked, "reports": [_row(report, case.variant) for report in reports]}


def _diagnose(client: CellClient, object_id: str) -> GapReport:
    result = client.diagnose_gap(DiagnoseGap.Goal(object_id=object_id))
    if not result.success:
        raise InputError(f"The diagnosis failed: {result.message}")
    return result.report


def _is_settled(report: GapReport) -> bool:
    return report.verdict in _SETTLED and not report.confusable


def _make(client: CellClient, goal: ExecutePush.Goal) -> ExecutePush.Result:
    """Make a push, slower where the arm cannot make it as fast: the ranking of pushes does not know the limits of the arm."""
    for _ in range(_SLOWER):
        result = client.execute_push(goal)
        if result.error_code != PushCode.LIMIT:
            return result
        goal.speed *= 0.5
    return client.execute_push(goal)


def _proposed(report: GapReport, object_id: str) -> ExecutePush.Goal | None:
    """The push that a report asks for: to separate what is open, or since the pushes are too few to know. None where it asks for none."""
    if not _is_settled(report) and report.has_next_push:
        push = report.contact_point, report.direction, report.distance, report.speed
    elif report.verdict == "no_gap" and report.more_pushes > 0 and report.has_first_push:
        push = report.first_contact_point, report.first_direction, report.first_distance, report.first_speed
    else:
        return None
    point, direction, distance, speed = push
    return ExecutePush.Goal(
        mode=ExecutePush.Goal.MODE_CONTACT,
        object_id=object_id,
        frame_id="table",
        contact_point=point,
        direction=direction,
        distance=distance,
        speed=speed,
    )


def _row(report: GapReport, truth: str) -> Json:
    found = [effect.name for effect in report.effects]
    return {
        "verdict": report.verdict,
        "sentence": report.sentence,
        "found": found,
        "confusable": list(report.confusable),
        "right": found == ([] if truth == "none" else [truth]),
        "in_set": truth in (*found, *report.confusable) if truth != "none" else not found,
        "before_m": report.before,
        "after_m": report.after,
        "noise_m": report.noise,
    }


def _summarise(results: Sequence[CaseResult]) -> Json:
    rows = []
    for result in results:
        reports: list[Any] = result.values["reports"]
        last = reports[-1]
        settled = last["verdict"] in _SETTLED and not last["confusable"]
        rows.append(
            {
                "object": result.case.object_name,
                "effect": result.case.variant,
                "first": reports[0]["verdict"],
                "last": last["verdict"],
                "found": last["found"],
                "confusable": last["confusable"],
                "right": last["right"],
                "settled": settled,
                "asked": len(result.values["asked"]),
                "refused": [a["text"] for a in result.values["asked"] if a["code"]],
            }
        )
    return {
        "cases": rows,
        "n": len(rows),
        "settled": sum(r["settled"] for r in rows),
        "right": sum(r["right"] for r in rows),
        "asked": [r["asked"] for r in rows if r["settled"]],
    }


def _tables(summary: Json) -> str:
    rows = [
        [
            r["object"],
            r["effect"],
            r["first"],
            str(r["asked"]),
            r["last"],
            ", ".join(r["found"]) + (f" (or {', '.join(r['confusable'])})" if r["confusable"] else "") or "–",
            "yes" if r["right"] else "no",
        ]
        for r in summary["cases"]
    ]
    head = ["object", "injected", f"after {_FIRST} random pushes", "requested pushes", "in the end", "found", "right"]
    mean = f"{np.mean(summary['asked']):.1f}" if summary["asked"] else "–"
    text = f"Settled: {summary['settled']} of {summary['n']}, after {mean} requested pushes on average; right: {summary['right']}."
    return markdown_table(head, rows) + "\n\n" + text


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    figure, (axes,) = new_figure(1, width=6.0, height=3.2)
    for right, colour, label in ((True, COLOURS["gauss_newton"], "right"), (False, COLOURS["uniform"], "wrong or open")):
        counts = [sum(r["asked"] == n and r["right"] is right for r in summary["cases"]) for n in range(_MOST + 1)]
        below = [sum(r["asked"] == n and r["right"] is not right for r in summary["cases"]) if not right else 0 for n in range(_MOST + 1)]
        axes.bar(range(_MOST + 1), counts, bottom=below, color=colour, label=label)
    axes.set_xlabel("requested pushes")
    axes.set_ylabel("cases")
    label_below(axes, 2)
    save(figure, folder / "settle.png")
    return {"settle.png": "Number of pushes that the diagnosis requested until it was settled."}


STUDY = Experiment(
    name="settle",
    place=120,
    title="Settling an open diagnosis by further pushes",
    question=(
        "Can the cell find the cause of the gap without help? All nodes run live on the simulated cell, with an effect injected at its "
        f"typical size and with depth images. After {_FIRST} random pushes `diagnose_gap` is called. While its verdict is open, or "
        "nothing is found and it says that the pushes are too few to know, `execute_push` makes the push that it proposes, at most "
        f"{_MOST} times, and it is called again."
    ),
    variants=_VARIANTS,
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    needs_truth=False,
    stages=("geometry", "perception", "pushing", "physics", "identification", "diagnosis", "nodes"),
    one_at_a_time=True,
)
