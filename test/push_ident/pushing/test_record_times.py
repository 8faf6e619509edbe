"""The times of a push are those of the stamps of its arm, as the poses of the tool are, whatever the clock of the cell shows."""

from __future__ import annotations

import pytest

from helpers.memory_cell import CONTACT, SETTINGS, Bench, Cell
from push_ident.geometry.kinematics import ArmKinematics
from push_ident_sim.cell.robot import HOME, robot_description


@pytest.fixture(scope="module")
def kinematics() -> ArmKinematics:
    return ArmKinematics(robot_description(), neutral=HOME)


@pytest.mark.parametrize(("behind", "rate"), [(0.0, 0.3), (3.0, 1.0), (3.0, 0.3)], ids=["slow", "behind", "slow and behind"])
def test_record_has_the_times_of_the_tool_where_the_clock_is_wrong(kinematics: ArmKinematics, behind: float, rate: float) -> None:
    bench = Bench(kinematics)
    lowered: list[float] = []

    def note(cell: Cell) -> None:
        if bench.execution.is_pushing:
            lowered.append(cell.time)

    bench.cell.events.append(note)
    bench.cell.now = lambda: 100.0 - behind + rate * (bench.cell.time - 100.0)  # type: ignore[method-assign]
    outcome = bench.push()
    assert outcome.error is None, outcome.error
    (push,) = bench.pushes
    start, stop, end = push.times()
    assert start == pytest.approx(lowered[0], abs=0.03) and end == pytest.approx(lowered[-1], abs=0.03)
    assert push.contact is not None and start < push.contact < stop < end
    assert end - stop == pytest.approx(SETTINGS.motion.rest, abs=0.05) and stop - start > CONTACT.distance / CONTACT.speed
