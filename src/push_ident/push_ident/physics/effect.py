"""What an effect is: a law that the base model leaves out, stated as an equation whose parameters are null where it is absent.

Each file of `effects/` defines one: where the effect acts, and its equation in analytic arithmetic. The complex step gives derivatives
(Squire & Trapp, Using complex variables to estimate derivatives of real functions, 1998), exact to rounding: 1e-40 i is added to one
input, and the imaginary part of the result is the derivative. An equation must therefore accept real and complex numbers: it compares
only `.real`, and uses the functions of this file.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from push_ident.errors import InputError

ComplexArray = NDArray[np.complex128]
Equation = Callable[..., Any]

STEP_OF_INPUT = 1e-40
"""Imaginary part that represents a change of an input by 1."""

MAX_LOAD_NUMBERS = 4
"""An effect that changes the load of cells has no more values, and no more numbers in its memory."""

STILL = 1e-3
"""Speed below which a direction of motion fades [m/s]."""

equation = partial(njit, error_model="numpy")
"""Compiles a part of an effect into the kernels that use it; it is not kept on disk by itself."""


@equation
def analytic_sqrt(x: Any) -> Any:
    """Square root of a positive number; first-order exact in the imaginary part."""
    root = math.sqrt(x.real)
    return root + (x - x.real) * (0.5 / root)


@equation
def analytic_exp(x: Any) -> Any:
    """Exponential; first-order exact in the imaginary part."""
    value = math.exp(x.real)
    return value + (x - x.real) * value


@equation
def analytic_log(x: Any) -> Any:
    """Logarithm of a positive number; first-order exact in the imaginary part."""
    return math.log(x.real) + (x - x.real) * (1.0 / x.real)


@equation
def unit_direction(vx: Any, vy: Any) -> Any:
    """Direction of a velocity. It fades to zero below 1 mm/s, so that a body at rest has none."""
    speed = analytic_sqrt(vx * vx + vy * vy + STILL * STILL)
    return vx / speed, vy / speed


class Body(NamedTuple):
    """The object at the start of a step, an argument of equations. Numbers are real or complex."""

    x: Any
    """Centre of mass [m], table frame."""
    y: Any
    cos: Any
    """Of the yaw."""
    sin: Any
    vx: Any
    """Velocity of the centre of mass [m/s], table axes."""
    vy: Any
    omega: Any
    """[rad/s]"""
    mass: Any
    """[kg]"""
    spread: Any
    """Mean of r' r over the area of the cells [m^2], r from the centre of mass."""
    order: float
    """Number of pushes made before this one."""


class Cell(NamedTuple):
    """A cell at the start of a step, an argument of equations. Numbers are real or complex."""

    x: Any
    """Centre [m], table frame."""
    y: Any
    vx: Any
    """Velocity [m/s], table axes."""
    vy: Any
    rx: Any
    """From the centre of mass [m], object axes."""
    ry: Any


class Load(NamedTuple):
    """Moments of the friction limits of all cells without effects, an argument of equations. Numbers are real or complex."""

    x: Any
    """Their centre [m], from the centre of mass, object axes."""
    y: Any
    xx: Any
    """Their covariance about that centre [m^2]."""
    xy: Any
    yy: Any


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """One number of an effect."""

    name: str
    unit: str
    """"" where it has none."""
    what: str
    scale: float
    """Standard deviation of the prior about `nominal`."""
    typical: float
    """Typical size in practice."""
    nominal: float = 0.0
    """Value at which the effect is absent; of a shape parameter, the value without information."""
    low: float = -np.inf
    """Least and greatest admissible value."""
    high: float = np.inf
    shape: bool = False
    """Whether it only modifies the other parameters: while they are nominal it has no influence, so a test for absence holds it fixed."""
    camera_std: float | None = None
    """Accuracy of a calibrated camera: the standard deviation with which the effect belongs to the base model where a camera traced the
    outline, about `nominal`. None where it does not belong there."""
    sensor_std: float | None = None
    """Accuracy of a force sensor that was tared: the standard deviation with which the effect belongs to the base model of identification
    where forces are measured. None where it does not belong there."""


class Law(Enum):
    """How well the equation of an effect describes the world, if the effect is there."""

    EXACT = "exact"
    """The equation holds exactly: a displacement, a scale or a delay of a motion or a measurement."""
    APPROXIMATE = "approximate"
    """The equation approximates the physical law: friction, loads, forces. Its error grows with the size of the effect."""


class Mechanism(Enum):
    """What an effect does, whatever its law: several laws, and a free one, may stand for it. Values as in JSON."""

    FRICTION_BY_SPEED = "friction_by_speed"
    FRICTION_BY_PLACE = "friction_by_place"
    FRICTION_BY_HEADING = "friction_by_heading"
    """Direction of motion in the table."""
    FRICTION_BY_HEADING_IN_OBJECT = "friction_by_heading_in_object"
    FRICTION_SINCE_CONTACT = "friction_since_contact"
    """Time or way slid since the pusher touched."""
    FRICTION_BY_ORDER = "friction_by_order"
    """Of the pushes."""
    FORCE_ON_OBJECT = "force_on_object"
    """Constant, by the place, or tied to a point."""
    OUTLINE = "outline"
    TOOL_MOVED = "tool_moved"
    """From one push on, or more and more."""
    TOOL_WOBBLES = "tool_wobbles"
    """Within each push."""

    @property
    def subsystem(self) -> Subsystem:
        """Where its cause is."""
        parts = {
            Mechanism.FRICTION_BY_HEADING_IN_OBJECT: Subsystem.OBJECT, Mechanism.OUTLINE: Subsystem.CONTACT,
            Mechanism.TOOL_MOVED: Subsystem.ARM, Mechanism.TOOL_WOBBLES: Subsystem.ARM,
        }  # fmt: skip
        return parts.get(self, Subsystem.TABLE)


class ExportAs(Enum):
    """The part of an exported description of an object that carries an effect."""

    GRAVITY = "gravity"
    """The direction of gravity. The effect has two values: the slopes downwards along the table's axes x and y [rad]."""
    CELL_ANISOTROPY = "cell anisotropy"
    """Friction of the cells by direction. The effect has two values: (a, b) of E = [[a, b], [b, -a]], object axes."""
    PUSHER_FRICTION = "pusher friction"
    """The friction of the outline; the effect acts on the pusher's friction coefficient."""


MAPS: Final = "maps"
"""Name of a rival that is no effect: the maps of mass and friction."""


@dataclass(frozen=True, slots=True)
class Rival:
    """Another explanation of the same pushes."""

    name: str
    """Of an effect, or `MAPS`."""
    separated_by: str
    """Pushes or measurements that separate the two."""


@dataclass(frozen=True, slots=True)
class OnTable:
    """Acts between table and cells. Each part is compiled; `p` begins with the effect's values, `memory` with its memory.

    All parts are evaluated from the state at the start of a step and held during it (a delay of one step, some 4 ms), which leaves
    the step the convex problem that it is.
    """

    load: Equation | None = None
    """load(p, body, cell, memory): factor of the cell's friction limit; below 0 it counts as 0."""
    plane: Equation | None = None
    """plane(p, body, memory): (even, x, y) of a factor even + x rx + y ry of the friction limit of the cell at (rx, ry) from the
    centre of mass, object axes: a factor that is linear over the object, evaluated once for all cells."""
    shift: Equation | None = None
    """shift(p, body, load, memory): by how much the centre of the friction limits moves [m], object axes; their sum stays. It acts as
    the factor 1 + (r - c)' S^-1 shift, with the centre c and the covariance S of the limits: the even tilt of the load that does so."""
    skew: Equation | None = None
    """skew(p, body): (a, b) [-] of E = [[a, b], [b, -a]], object axes: a cell is held back by f (I + E) times its direction."""
    pull: Equation | None = None
    """pull(p, body): (fx, fy, torque) on the object about its centre of mass [N, N, N m], table axes; linear in `p`."""

    @property
    def is_plane(self) -> bool:
        """Whether it changes friction limits by a factor that is linear over the object."""
        return self.plane is not None or self.shift is not None


@dataclass(frozen=True, slots=True)
class OnContact:
    """Acts between pusher and outline, as one of the quantities that the law of contact has for it (`contact.py`)."""

    quantity: Literal["offset", "restitution"]


@dataclass(frozen=True, slots=True)
class OnPusherPath:
    """Acts on the path of the pusher."""

    move: Callable[[ComplexArray, Any, ComplexArray, float], ComplexArray]
    """move(values, dt, path, order): the driven path for the reported one; poses (x, y, yaw) at the steps' ends, shape (n_steps + 1, 3),
    table frame. `dt` is the length of the steps [s]: a number, or of shape (n_steps,) where they are not equal. `order`: number of pushes
    made before."""


@dataclass(frozen=True, slots=True)
class OnPusherFriction:
    """Acts on the friction coefficient of the pusher."""

    change: Callable[[ComplexArray, ComplexArray], ComplexArray]
    """change(values, coefficient): the actual coefficient, shape (1,)."""


@dataclass(frozen=True, slots=True)
class OnTimes:
    """Acts on the times at which poses are measured."""

    move: Callable[[ComplexArray, ComplexArray], ComplexArray]
    """move(values, time): time of measurement of the pose that is reported for `time` [s], shape (n_frames,)."""


@dataclass(frozen=True, slots=True)
class OnPoses:
    """Acts on measured poses."""

    report: Callable[[ComplexArray, ComplexArray], ComplexArray]
    """report(values, pose): reported poses for the true ones (x, y, yaw), shape (n_frames, 3), table frame."""


@dataclass(frozen=True, slots=True)
class OnForces:
    """Acts on measured forces of the pusher."""

    report: Callable[[ComplexArray, ComplexArray], ComplexArray]
    """report(values, force): reported forces for the true ones [N], shape (n, 2), table frame; linear in the force, so that it holds for
    means over time."""


@dataclass(frozen=True, slots=True)
class OnForceTimes:
    """Acts on the times at which forces of the pusher are measured."""

    move: Callable[[ComplexArray, ComplexArray], ComplexArray]
    """move(values, time): time of measurement of the force that is reported for `time` [s], shape (n,)."""


@dataclass(frozen=True, slots=True)
class Memory:
    """Numbers that an effect carries from step to step; 0 at the start of a push."""

    size: int
    remember: Equation
    """remember(p, body, dt, memory, after): fills `after` from the state and the memory at the start of a step; compiled."""


class Subsystem(Enum):
    """Part of a cell where an effect has its cause; values as in JSON."""

    CAMERA = "camera"
    """With its clock."""
    ARM = "arm"
    """With the tool, but for its friction."""
    CONTACT = "contact"
    TABLE = "table"
    OBJECT = "object"
    FORCE_SENSOR = "force sensor"


@dataclass(frozen=True, slots=True)
class Effect:
    """A physical or measurement law that the base model leaves out."""

    name: str
    what: str
    """In one sentence."""
    equation: str
    parameters: tuple[EffectParameter, ...]
    acts: OnTable | OnContact | OnPusherPath | OnPusherFriction | OnTimes | OnPoses | OnForces | OnForceTimes
    law: Law
    signature: str
    """Its trace in the residuals of the base model."""
    rivals: tuple[Rival, ...]
    """Explanations that are nearly as good."""
    source: str
    check: str = ""
    """What to do at the cell to confirm it without a push, one sentence. Required of a cause."""
    memory: Memory | None = None
    needs_inertia: bool = False
    """Whether it has no meaning in a quasi-static push."""
    fades_at_rest: bool = False
    """Whether nothing is left of it some time after the pusher has stopped."""
    exact_twins: tuple[str, ...] = ()
    """Effects that no push can distinguish from it. They name it as well."""
    special_case_of: tuple[str, ...] = ()
    """Effects that contain it: at some value of one of their parameters they are it."""
    refit_with: tuple[str, ...] = ()
    """Effects whose scores mislead about one another: where one of them is refitted, all are. They name it as well."""
    is_abrupt: bool = False
    """Whether its derivative where it is absent says nothing of its typical size, so that a refit starts there."""
    export: ExportAs | None = None
    """The part of an exported description that carries it; None where no format has one."""
    within: Subsystem | None = None
    """Where its cause is, if not where it acts."""
    law_of: Mechanism | None = None
    """The mechanism of which it is a law; None where it is the only one."""
    follows_order: bool = False
    """Whether it follows the order of the pushes of a recording, and says nothing of another one."""

    def __post_init__(self) -> None:
        memory = 0 if self.memory is None else self.memory.size
        loads = isinstance(self.acts, OnTable) and self.acts.load is not None
        if loads and max(len(self.parameters), memory) > MAX_LOAD_NUMBERS:
            raise InputError(
                f"The effect {self.name} loads cells by {len(self.parameters)} parameters and {memory} numbers of memory, "
                f"expected {MAX_LOAD_NUMBERS} of each at most; raise MAX_LOAD_NUMBERS and `_four` in table_laws.py, or use fewer."
            )
        if not self.check:
            raise InputError(f"The effect {self.name} has no `check`; say in one sentence how to confirm it at the cell without a push.")
        if self.export in (ExportAs.GRAVITY, ExportAs.CELL_ANISOTROPY) and len(self.parameters) != 2:
            raise InputError(
                f"The effect {self.name} has {len(self.parameters)} parameters; {self.export.value} of an exported model takes two."
            )
        if (self.export is ExportAs.PUSHER_FRICTION) != isinstance(self.acts, OnPusherFriction):
            raise InputError(f"The effect {self.name} is exported as pusher friction just if it acts on it; correct `export` or `acts`.")

    @property
    def nominal(self) -> NDArray[np.float64]:
        """Values at which it is absent, shape (n_parameters,)."""
        return np.array([parameter.nominal for parameter in self.parameters])

    @property
    def mechanism(self) -> str:
        """Name of what it does, whatever its law: its own where no other law stands for that."""
        return self.name if self.law_of is None else self.law_of.value

    @property
    def subsystem(self) -> Subsystem:
        """Where its cause is."""
        if self.within is not None:
            return self.within
        by_kind: dict[type, Subsystem] = {
            OnPoses: Subsystem.CAMERA, OnTimes: Subsystem.CAMERA, OnPusherPath: Subsystem.ARM, OnContact: Subsystem.CONTACT,
            OnPusherFriction: Subsystem.CONTACT, OnForces: Subsystem.FORCE_SENSOR, OnForceTimes: Subsystem.FORCE_SENSOR,
        }  # fmt: skip
        return by_kind.get(type(self.acts), Subsystem.TABLE)

    @property
    def is_camera_error(self) -> bool:
        """Whether it belongs to the base model where a camera traced the outline."""
        return any(parameter.camera_std is not None for parameter in self.parameters)

    @property
    def needs_forces(self) -> bool:
        """Whether poses do not show it at all."""
        return isinstance(self.acts, OnForces | OnForceTimes)

    @property
    def is_sensor_error(self) -> bool:
        """Whether it belongs to the base model of identification where forces are measured."""
        return any(parameter.sensor_std is not None for parameter in self.parameters)

    @property
    def delays_forces(self) -> bool:
        """Whether it acts on the times of measured forces."""
        return isinstance(self.acts, OnForceTimes)

    @property
    def moves_outline(self) -> bool:
        """Whether it displaces the surface that the pusher touches."""
        return isinstance(self.acts, OnContact) and self.acts.quantity == "offset"
