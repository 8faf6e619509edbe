"""Kinematics of an arm from its description."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from push_ident.errors import InputError
from push_ident.geometry.kinematics import ArmKinematics
from push_ident_sim.cell.robot import HOME, robot_description


@pytest.fixture(scope="module")
def arm() -> ArmKinematics:
    return ArmKinematics(robot_description(), neutral=HOME)


def test_forward_of_the_upright_arm_adds_up_the_lengths_of_its_links(arm: ArmKinematics) -> None:
    # Pedestal 0.43, iiwa from base to joint 7 1.261, flange 0.045, palm 0.1, fist 0.04, finger tips 0.08 m.
    pose = arm.forward(np.zeros(7))
    assert pose[:3, 3] == pytest.approx([-0.44, 0.0, 0.43 + 1.261 + 0.045 + 0.1 + 0.04 + 0.08], abs=1e-6)
    assert pose[:3, 2] == pytest.approx([0, 0, 1], abs=1e-6)
    assert arm.root_frame == "table"


def test_jacobian_matches_finite_differences(arm: ArmKinematics) -> None:
    q = np.array([0.3, 0.4, -0.2, -1.3, 0.5, 0.9, -0.7])
    jacobian = arm.jacobian(q)
    for j in range(7):
        step = 1e-6 * np.eye(7)[j]
        before, after = arm.forward(q - step), arm.forward(q + step)
        spin = (after[:3, :3] - before[:3, :3]) / 2e-6 @ arm.forward(q)[:3, :3].T
        assert jacobian[:3, j] == pytest.approx((after[:3, 3] - before[:3, 3]) / 2e-6, abs=1e-6)
        assert jacobian[3:, j] == pytest.approx([spin[2, 1], spin[0, 2], spin[1, 0]], abs=1e-6)


def test_inverse_puts_the_tip_down_on_every_point_of_the_workspace(arm: ArmKinematics) -> None:
    for x, y in product((-0.15, 0.0, 0.15), (-0.25, 0.0, 0.25)):
        q, converged = arm.inverse([x, y, 0.012], HOME)
        pose = arm.forward(q)
        assert converged and pose[:3, 3] == pytest.approx([x, y, 0.012], abs=2e-6)
        assert pose[:3, 2] == pytest.approx([0, 0, -1], abs=1e-5)


def test_inverse_keeps_a_given_axis_and_leaves_the_spin_about_it_free_or_returns_to_neutral(arm: ArmKinematics) -> None:
    axis = np.array([0.3, 0.0, -1.0]) / np.hypot(0.3, 1.0)
    first, converged = arm.inverse([0.0, 0.1, 0.1], HOME, axis=axis)
    turned = first + np.array([0, 0, 0, 0, 0, 0, 1.0])
    kept, kept_converged = arm.inverse([0.0, 0.1, 0.1], turned, axis=axis, posture_gain=0.0)
    assert converged and kept_converged
    assert arm.forward(first)[:3, 2] == pytest.approx(axis, abs=1e-5)
    assert kept == pytest.approx(turned, abs=1e-5)
    twisted = np.array([0.0, 0.3, 0.9, -1.5, 0.6, 1.2, 1.5])
    kept, drifted = (arm.inverse([0.0, 0.0, 0.1], twisted, posture_gain=gain)[0] for gain in (0.0, 0.3))
    q, _ = arm.inverse([0.0, 0.0, 0.1], HOME)
    assert np.linalg.norm(drifted - q) < 0.5 * np.linalg.norm(kept - q)


@pytest.mark.parametrize("target", [[0.6, 0.0, 0.1], [-0.44, 0.0, 0.1], [0.0, 2.0, 0.0]])
def test_inverse_reports_a_point_out_of_reach_and_stays_within_the_joint_limits(arm: ArmKinematics, target: list[float]) -> None:
    q, converged = arm.inverse(target, HOME)
    assert not converged
    assert np.all((q >= arm.position_lower) & (q <= arm.position_upper))


def test_description_without_tip_or_not_xml_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="no link `gripper`"):
        ArmKinematics(robot_description(), "gripper")
    with pytest.raises(InputError, match="not a valid URDF"):
        ArmKinematics("<robot name='a'>")
