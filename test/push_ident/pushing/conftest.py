"""The arm of the simulated cell, and a cell in memory."""

from __future__ import annotations

import pytest

from helpers.memory_cell import Bench
from push_ident.geometry.kinematics import ArmKinematics
from push_ident_sim.cell.robot import HOME, robot_description


@pytest.fixture(scope="module")
def kinematics() -> ArmKinematics:
    return ArmKinematics(robot_description(), neutral=HOME)


@pytest.fixture
def bench(kinematics: ArmKinematics) -> Bench:
    return Bench(kinematics)
