"""The execution of pushes along a path that are corrected while they are made, on a cell in memory."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from helpers.memory_cell import PARKED, SETTINGS, Bench, Cell, code_of
from push_ident.errors import InputError
from push_ident.pushing.ports import Phase
from push_ident.pushing.push import PushCode
from push_ident.pushing.push_request import Mode, PushRequest
from push_ident.pushing.steering import PathRequest, ToolCorrection
from push_ident.pushing.tool_path import Corridor, ToolPath

OUTWARD = np.array([math.sin(0.3), -math.cos(0.3)])
"""Of the long face of the box that is pushed along a path."""
TOUCH = np.array([0.0, 0.02]) + 0.048 * OUTWARD
WAY = ToolPath(np.array([0.0, 0.3, 1.1]), np.array([TOUCH + 0.03 * OUTWARD, TOUCH, TOUCH - 0.08 * OUTWARD]))
AROUND = Corridor(np.vstack([WAY.position, TOUCH - 0.18 * OUTWARD]), 0.07)
ASIDE = np.array([math.cos(0.3), math.sin(0.3)])
ALONG_PATH = PushRequest(Mode.PATH, "box", path=PathRequest(WAY, AROUND, 0.15))


class Corrector:
    """Publishes corrections every 30 ms from the contact on, which lead the tool aside and on, until it has come a way."""

    def __init__(self, bench: Bench, length: float = 0.10, last: float = math.inf) -> None:
        self.bench, self.length, self.last, self.n, self.refusals = bench, length, last, 0, 0
        bench.cell.events.append(self)

    def __call__(self, cell: Cell) -> None:
        if not (self.bench.execution.is_pushing and self.bench.client.begun):
            return
        push_id, start = self.bench.client.begun[-1]
        now = cell.time - start
        if now < 0.3 + 0.03 * self.n or now > self.last:
            return
        self.n += 1
        stamp = cell.time - 0.02
        way = -OUTWARD * 0.1 + ASIDE * 0.05 if now > 0.5 else -OUTWARD * 0.1
        tip = np.array([np.interp(now - 0.02, WAY.time, c) for c in WAY.position.T]) if now < 0.5 else cell.tip[:2] - 0.02 * way
        time = np.linspace(0.0, 0.5, 6)
        travel = float((cell.tip[:2] - TOUCH) @ -OUTWARD)
        stop = travel > self.length
        self.last = now if stop else self.last
        try:
            self.bench.execution.correct(ToolCorrection(push_id, stamp, stop, time, tip + np.outer(time, way)))
        except InputError:
            self.refusals += 1


def test_push_along_a_path_takes_corrections_until_it_is_told_to_stop(bench: Bench) -> None:
    before, corrector = bench.cell.box.copy(), Corrector(bench)
    outcome = bench.push(ALONG_PATH)
    assert code_of(outcome) == PushCode.NONE, outcome.error
    assert corrector.refusals <= 1 < 20 < outcome.n_corrections and outcome.n_refused == corrector.refusals
    # Further than the path that was sent, and aside as only the corrections say.
    moved = bench.cell.box[:2] - before[:2]
    assert moved @ -OUTWARD == pytest.approx(0.105, abs=0.012) and moved @ ASIDE > 0.025
    (push,) = bench.pushes
    start, stop, end = push.times()
    assert push.error is None and start < push.contact < stop < end <= push.ended
    assert push.plan.push.distance == pytest.approx(np.hypot(*moved), abs=0.012)
    assert bench.cell.q == pytest.approx(PARKED, abs=1e-3) and not bench.execution.is_pushing
    assert bench.client.begun[-1][0] == 1 and bench.execution.steering is None
    order = list(dict.fromkeys(bench.client.phases))
    assert order == [Phase.PLAN, Phase.APPROACH, Phase.PUSH, Phase.REST, Phase.RETREAT]


def test_corrections_that_stop_in_a_push_end_it_within_their_timeout_and_the_arm_goes_home(bench: Bench) -> None:
    stopped: list[tuple[float, float]] = []
    Corrector(bench, last=0.6)
    bench.cell.events.append(lambda cell: stopped.append((cell.time, float(cell.tip[1]))) if cell.holds and len(stopped) < 60 else None)
    outcome = bench.push(ALONG_PATH)
    assert code_of(outcome) == PushCode.CORRECTION and "The arm went home." in str(outcome.error)
    _, start = bench.client.begun[-1]
    # 0.2 s, twice the timeout of the arm, is the least patience; the arm stands 0.1 s later.
    assert stopped[0][0] - start == pytest.approx(0.6 + 0.2, abs=0.05)
    assert abs(stopped[12][1] - stopped[10][1]) < 1e-4
    assert bench.cell.q == pytest.approx(PARKED, abs=1e-3) and bench.pushes[0].error is outcome.error


def test_tool_backs_off_from_the_object_where_the_push_was_broken_off_and_not_where_its_path_would_have_led(bench: Bench) -> None:
    """The path turns round: at its end, backing off against the motion would be into the object."""
    place = np.array([(0.03, 0.0), (0.0, 0.0), (-0.04, 0.0), (-0.04, 0.05), (0.0, 0.05)])
    tool = TOUCH + place[:, :1] * OUTWARD + place[:, 1:] * ASIDE
    path = ToolPath(np.array([0.0, 0.3, 0.7, 1.2, 1.6]), tool)
    held: list[tuple[np.ndarray, np.ndarray]] = []
    bench.cell.events.append(lambda cell: held.append((cell.box.copy(), cell.tip.copy())) if cell.holds else None)
    outcome = bench.push(PushRequest(Mode.PATH, "box", path=PathRequest(path, Corridor(tool, 0.07), 0.15)))
    assert code_of(outcome) == PushCode.CORRECTION and "The arm went home." in str(outcome.error)
    box, tip = held[16]  # it stands
    assert (box[:2] - [0.0, 0.02]) @ -OUTWARD > 0.01, "it was pushed"
    np.testing.assert_allclose(bench.cell.box, box, atol=1e-4)
    low = [(place - tip)[:2] @ OUTWARD for _, place in held if place[2] < tip[2] + 1e-3]
    assert max(low) == pytest.approx(SETTINGS.motion.back_off, abs=1e-3) and min(low) > -2e-3


@pytest.mark.parametrize(("change", "code"), [({"is_cancel_requested": True}, PushCode.CANCELED), ({"force": 40.0}, PushCode.FORCE)])
def test_cancel_and_force_end_a_corrected_push_as_any_other(bench: Bench, change: dict[str, Any], code: PushCode) -> None:
    Corrector(bench)
    when: list[float] = []

    def meddle(cell: Cell) -> None:
        if bench.execution.is_pushing and bench.client.begun and cell.time - bench.client.begun[-1][1] > 0.7 and not when:
            when.append(cell.time)
            for name, value in change.items():
                setattr(bench.client if hasattr(bench.client, name) else cell, name, value)

    bench.cell.events.append(meddle)
    assert code_of(bench.push(ALONG_PATH)) == code
    assert len(bench.cell.holds) == 1 and bench.cell.time - when[0] <= 0.05


@pytest.mark.parametrize(
    ("request_", "code", "words"),
    [
        (PushRequest(Mode.PATH, "box"), PushCode.INVALID_GOAL, "tool_path"),
        (replace(ALONG_PATH, path=PathRequest(WAY, Corridor(WAY.position, 0.5))), PushCode.UNREACHABLE, "corridor"),
        (replace(ALONG_PATH, path=PathRequest(ToolPath(WAY.time, WAY.position - 0.01), AROUND)), PushCode.INVALID_GOAL, "mm"),
        (replace(ALONG_PATH, path=PathRequest(ToolPath(0.3 * WAY.time, WAY.position), AROUND)), PushCode.INVALID_GOAL, "m/s"),
    ],
    ids=["no path", "corridor out of reach", "beside the object", "too fast"],
)
def test_paths_that_cannot_be_made_are_refused_and_nothing_moves(bench: Bench, request_: PushRequest, code: PushCode, words: str) -> None:
    settings = replace(SETTINGS, push=replace(SETTINGS.push, workspace=(-0.9, 0.9, -0.9, 0.9)))
    outcome = bench.push(request_, settings)
    assert code_of(outcome) == code and words in str(outcome.error), outcome.error
    assert bench.cell.pieces == [] and bench.pushes == []
    with pytest.raises(InputError, match="no push along a path now"):
        bench.execution.correct(ToolCorrection(1, 0.0, True, np.empty(0), np.empty((0, 2))))
