"""Kinematics of the arm from its URDF: tool tip pose, Jacobian, and inverse for a tool that may spin about its own axis."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from push_ident.errors import InputError
from push_ident.types import Float64Array

TOOL_DOWN = np.array([0.0, 0.0, -1.0])
"""Direction of the tool's z axis when it points at the table, root frame."""
TOOL_DOWN.setflags(write=False)


class ArmKinematics:
    """Serial arm from the root link of a URDF (`table`) to a tip frame whose z axis points down the tool.

    Only the joints between root and tip are variables; others (fingers) are fixed at zero. Configurations `q` have shape (n_joints,) [rad],
    in the order of `joint_names`. Not safe to share between threads: each thread builds its own.
    """

    def __init__(self, urdf_xml: str, tip_frame: str = "tool_tip", neutral: ArrayLike | None = None) -> None:
        """Build from the text of a URDF (meshes are not read).

        `neutral` is the posture towards which `inverse` moves within the redundancy of the task; default: the middle of the joint limits.
        For an iiwa that is the singular upright arm, so pass a bent posture for real work.
        Raises InputError when the URDF cannot be parsed, lacks the tip, or has a joint without position limits.
        """
        try:
            full = pin.buildModelFromXML(urdf_xml)
        except (ValueError, RuntimeError) as error:
            raise InputError(f"The robot description is not a valid URDF: {str(error).strip()}") from None
        if not full.existFrame(tip_frame):
            raise InputError(f"The robot description has no link `{tip_frame}`; it has {', '.join(f.name for f in full.frames[-5:])}, ...")
        chain = set(full.supports[full.frames[full.getFrameId(tip_frame)].parentJoint])
        self._model = pin.buildReducedModel(full, [j for j in range(1, full.njoints) if j not in chain], pin.neutral(full))
        if self._model.nq != self._model.nv or not np.all(np.isfinite(self._model.lowerPositionLimit)):
            raise InputError("Every joint between the root and the tip needs finite position limits; a continuous joint has none.")
        self._data = self._model.createData()
        self._tip = self._model.getFrameId(tip_frame)

        self.tip_frame = tip_frame
        self.root_frame: str = self._model.frames[1].name
        self.joint_names: tuple[str, ...] = tuple(self._model.names[1:])
        self.position_lower: Float64Array = np.array(self._model.lowerPositionLimit)
        """[rad], shape (n_joints,)."""
        self.position_upper: Float64Array = np.array(self._model.upperPositionLimit)
        self.velocity_limit: Float64Array = np.array(self._model.velocityLimit)
        """[rad/s], shape (n_joints,)."""
        self.effort_limit: Float64Array = np.array(self._model.effortLimit)
        """[N m], shape (n_joints,)."""
        middle = 0.5 * (self.position_lower + self.position_upper)
        self.neutral: Float64Array = middle if neutral is None else self.check_configuration(neutral)

    @property
    def n_joints(self) -> int:
        """Number of joints between root and tip."""
        return len(self.joint_names)

    def check_configuration(self, q: ArrayLike) -> Float64Array:
        """`q` as a float64 array; raises InputError unless it has one finite angle per joint."""
        q = np.array(q, dtype=np.float64)
        if q.shape != (self.n_joints,) or not np.all(np.isfinite(q)):
            raise InputError(f"A configuration needs {self.n_joints} finite angles ({', '.join(self.joint_names)}), got {q.tolist()}.")
        return q

    def forward(self, q: ArrayLike) -> Float64Array:
        """Pose of the tip in the root frame, homogeneous, shape (4, 4)."""
        pin.forwardKinematics(self._model, self._data, self.check_configuration(q))
        return np.array(pin.updateFramePlacement(self._model, self._data, self._tip).homogeneous)

    def lowest_joint(self) -> tuple[str, float]:
        """Name and height [m], root frame, of the lowest moving joint in the configuration of the last `forward`; the first joint does
        not move and is excluded."""
        heights = [float(self._data.oMi[j].translation[2]) for j in range(2, self._model.njoints)]
        lowest = int(np.argmin(heights))
        return self.joint_names[lowest + 1], heights[lowest]

    def jacobian(self, q: ArrayLike) -> Float64Array:
        """Geometric Jacobian of the tip, axes of the root frame: rows (linear, angular), shape (6, n_joints)."""
        q = self.check_configuration(q)
        return np.array(pin.computeFrameJacobian(self._model, self._data, q, self._tip, pin.LOCAL_WORLD_ALIGNED))

    def inverse(
        self,
        position: ArrayLike,
        q_start: ArrayLike,
        *,
        axis: ArrayLike = TOOL_DOWN,
        x_axis: ArrayLike | None = None,
        max_iterations: int = 100,
        tolerance: float = 1e-6,
        posture_gain: float = 0.05,
    ) -> tuple[Float64Array, bool]:
        """Configuration near `q_start` that puts the tip at `position` with its z axis along `axis`; spin about the axis is free.

        `position` [m] and the unit vector `axis` have shape (3,), root frame. `x_axis`, a unit vector of
        shape (3,) across `axis`, fixes the spin as well: the tip's x axis lies along it. Returns `(q, converged)`; converged means that
        position [m] and axes [rad] are met to `tolerance` within the joint limits. Damped least squares on the task coordinates; the
        remaining freedom moves each step by a fraction `posture_gain` towards `neutral`, and so away from the joint limits
        (Nakamura & Hanafusa 1986; Liegeois 1977).
        """
        q = np.clip(self.check_configuration(q_start), self.position_lower, self.position_upper)
        position = np.asarray(position, dtype=np.float64)
        axis = np.asarray(axis, dtype=np.float64)
        x_target = None if x_axis is None else np.asarray(x_axis, dtype=np.float64)
        across = np.linalg.svd(axis[None, :])[2][1:]  # two unit vectors across the axis: rotation about `axis` is no error
        for _ in range(max_iterations):
            jacobian6 = self.jacobian(q)
            tip = pin.updateFramePlacement(self._model, self._data, self._tip)
            error = np.concatenate([position - tip.translation, across @ _rotation_between(tip.rotation[:, 2], axis)])
            jacobian = np.vstack([jacobian6[:3], across @ jacobian6[3:]])
            if x_target is not None:
                tip_x = tip.rotation[:, 0]
                error = np.append(error, np.arctan2(axis @ np.cross(tip_x, x_target), tip_x @ x_target))
                jacobian = np.vstack([jacobian, axis @ jacobian6[3:]])
            if np.linalg.norm(error[:3]) < tolerance and np.linalg.norm(error[3:]) < tolerance:
                return q, True
            # Damping in proportion to the error keeps far steps bounded and near ones quadratic.
            damping = 1e-10 + 1e-2 * min(1.0, float(error @ error))
            pseudo = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + damping * np.eye(len(error)))
            posture = posture_gain * (self.neutral - q)
            step = pseudo @ (error - jacobian @ posture) + posture
            step *= min(1.0, 0.3 / max(float(np.max(np.abs(step))), 1e-12))
            q = np.clip(q + step, self.position_lower, self.position_upper)
        return q, False


def _rotation_between(a: Float64Array, b: Float64Array) -> Float64Array:
    """Rotation vector [rad] that turns unit vector `a` onto `b` the short way, shape (3,)."""
    cross = np.cross(a, b)
    sine = float(np.linalg.norm(cross))
    angle = float(np.arctan2(sine, a @ b))
    if sine < 1e-9:
        # Opposite vectors: any axis across will do. Equal ones: no rotation.
        return angle * np.linalg.svd(a[None, :])[2][1] if angle > 1.0 else cross
    return cross * (angle / sine)
