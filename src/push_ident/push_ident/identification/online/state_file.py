"""The state of an online identification as a file: JSON, validated when it is read, with every number to the last bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, Self

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, NonNegativeFloat, PositiveFloat, model_validator

from push_ident.checked_json import CheckedContent, Listed, Numbers, Points, Rows, read_checked
from push_ident.errors import InputError, ModelFileError
from push_ident.files import write_whole
from push_ident.geometry.shape_check import check_pusher_radius
from push_ident.identification.fitting.summary import Summary
from push_ident.identification.online.identifier import OnlineState
from push_ident.identification.predicting.scoring import PushScore, RunningRecord
from push_ident.identification.results.known_effects import KnownEffect
from push_ident.identification.results.model_file import (
    ModelContent,
    array_of,
    check_information,
    check_start,
    model_content,
    posterior_of,
    prior_of,
)
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.results.result import WarmStart
from push_ident.identification.unknowns.prior import MapPrior, Prior
from push_ident.identification.unknowns.quadratic import Quadratic
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.limits import LIMITS, Limit, check_coordinates, plain_text
from push_ident.types import CameraAccuracy, Float64Array, ObjectShape, PoseTrack, PusherPath, PushRecord, SolveStatus, WrenchTrack

_STATE_FORMAT = "push_ident/state/3"
_EARLIER = "push_ident/state/2"
"""Its starts of the next solve are of a solver that is no more; the rest is as now."""
_REMEDY: Final = "remove it to start again"
_Count = Annotated[int, Field(ge=0, le=1_000_000_000)]
"""Far above the pushes of any object, and a number that messages have."""
_Row3 = tuple[float, float, float]


def _at_least_zero(value: float) -> float:
    if value < 0:
        raise ValueError("Input should be 0 or more, or not a number")
    return value


_Scored = Annotated[float, AfterValidator(_at_least_zero)]
"""NaN where a push could not be simulated."""


class _Push(CheckedContent):
    source: str
    order: _Count
    pose_time: Numbers
    pose: Listed[_Row3]
    pose_covariance: Listed[tuple[_Row3, _Row3, _Row3]]
    camera: tuple[float, float] = (0.0, 0.0)
    pusher_time: Numbers
    pusher: Points
    radius: float
    polygon: Points | None
    yaw: Numbers | None
    fingers: Points | None = None
    wrench_time: Numbers | None
    force: Points | None


class _Past(CheckedContent):
    n_pushes: _Count
    point: Numbers
    gradient: Numbers
    hessian: Rows
    log_forces: Numbers = Field(default_factory=list)
    """Of earlier versions, which kept forces beside the unknowns; not used."""
    has_prior: bool = False


class _Known(CheckedContent):
    name: str
    value: Numbers
    std: Numbers
    share: float


class _Start(CheckedContent):
    name: str
    x: Numbers
    map_prior: tuple[PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat] | None


class _Score(CheckedContent):
    model_config = ConfigDict(allow_inf_nan=True, ser_json_inf_nan="constants", populate_by_name=True)

    number: _Count
    source: str
    start: float = Field(ge=-LIMITS.STAMP.value, le=LIMITS.STAMP.value)
    cell_error: _Scored = Field(alias="error")
    expected_cell_error: _Scored = Field(alias="expected")
    mahalanobis2: _Scored = Field(alias="distance2")
    uniform_cell_error: _Scored = Field(alias="uniform")
    explained: bool = True


class _Record(CheckedContent):
    n: _Count
    sums: tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat, NonNegativeFloat]
    latest: Listed[_Score]

    @model_validator(mode="after")
    def _means_are_possible(self) -> Self:
        if max(self.sums) > LIMITS.COORDINATE.value * self.n:
            raise ValueError(f"Sums of {self.n} errors should be at most {LIMITS.COORDINATE.value} m for each")
        return self


class _State(CheckedContent):
    format: str
    model: ModelContent
    prior: dict[str, float]
    pushes: Listed[_Push] = Field(max_length=LIMITS.PUSHES.value)
    past: _Past | None
    starts: Listed[_Start | Numbers]
    status: str | None
    record: _Record
    keys: Listed[_Row3]
    """When and where each known push began [s, m, m]."""
    known: Listed[_Known] = Field(default_factory=list)
    """Of effects from elsewhere."""


@dataclass(frozen=True, slots=True)
class KeptState:
    """Content of a state file."""

    object_id: str
    state: OnlineState
    sources: tuple[str, ...]
    """Bags and pushes of the estimate."""
    record: RunningRecord
    pushes: tuple[tuple[float, float, float], ...]
    """When and where each known push began [s, m, m]."""


def save_state(
    path: Path,
    state: OnlineState,
    *,
    object_id: str,
    sources: Sequence[str] = (),
    record: RunningRecord | None = None,
    pushes: Sequence[tuple[float, float, float]] = (),
) -> None:
    """Write a state with the other fields of `KeptState`; the file appears complete or not at all.

    Raises ModelFileError where it cannot be written.
    """
    past, record = state.past, record or RunningRecord()
    content = _State(
        format=_STATE_FORMAT,
        model=model_content(state.posterior, object_id, sources),
        prior=asdict(state.prior),
        pushes=[_push(record) for record in state.records],
        past=None
        if past is None
        else _Past(
            n_pushes=past.n_pushes,
            point=past.cost.point.tolist(),
            gradient=past.cost.gradient.tolist(),
            hessian=past.cost.hessian.tolist(),
            has_prior=past.has_prior,
        ),
        starts=[_start(start) for start in state.warm_starts],
        status=state.status.name if state.status else None,
        record=_Record(n=record.n, sums=record.sums, latest=[_Score(**asdict(score)) for score in record.latest]),
        keys=list(pushes),
        known=[_Known(name=e.name, value=e.value.tolist(), std=e.std.tolist(), share=e.share) for e in state.known],
    )
    text = content.model_dump_json(by_alias=True, exclude_defaults=True)
    write_whole(path, text, "the state of the identification", private=True, error=ModelFileError)


def load_state(path: Path) -> KeptState:
    """Read a state. Raises ModelFileError: no such file, or not one written by `save_state`."""
    where, content = plain_text(str(path)), read_checked(path, _State, "a state of the identification", _REMEDY)
    if content.format not in (_STATE_FORMAT, _EARLIER):
        raise ModelFileError(f"{where} has the format `{plain_text(content.format)}`, expected `{_STATE_FORMAT}`; {_REMEDY}.")
    posterior = posterior_of(content.model, where, _REMEDY)
    try:
        state = _state(content, posterior)
    except InputError as error:
        raise ModelFileError(f"{where} does not hold pushes of one object: {plain_text(str(error)).rstrip('.')}; {_REMEDY}.") from None
    latest = tuple(PushScore(**score.model_dump()) for score in content.record.latest)
    record = RunningRecord(content.record.n, content.record.sums, latest)
    return KeptState(content.model.object_id, state, tuple(content.model.sources), record, tuple(content.keys))


def _state(content: _State, posterior: ModelPosterior) -> OnlineState:
    unknowns = posterior.unknowns
    if content.status and content.status not in SolveStatus.__members__:
        raise InputError(f"Its `status` is {content.status!r}, expected one of {', '.join(SolveStatus.__members__)}.")
    prior = prior_of(content.prior)
    _check_same_unknowns(prior, unknowns)
    return OnlineState(
        shape=unknowns.shape,
        prior=prior,
        records=tuple(_record(push, content.model.object_id, unknowns.shape) for push in content.pushes),
        past=_summary(content.past, unknowns) if content.past else None,
        warm_starts=tuple(_warm_start(start) for start in content.starts if isinstance(start, _Start)),
        posterior=posterior,
        status=SolveStatus[content.status] if content.status else None,
        known=tuple(KnownEffect(effect.name, np.array(effect.value), np.array(effect.std), effect.share) for effect in content.known),
    )


def _check_same_unknowns(prior: Prior, unknowns: UnknownsSpec) -> None:
    """Raise InputError where a prior has other unknowns than the estimate under it: pushes that are summed up count in these."""
    stored = unknowns.prior
    same = replace(prior.on_feet(stored.feet), pressure_map_std=prior.pressure_map_std if stored.pressure_map_std > 0 else 0.0)
    outline = len(unknowns.outline_modes) > 0
    n = UnknownsSpec.of(unknowns.shape, same, modes=unknowns.modes, effects=unknowns.effects.names, outline=outline).size
    if n != unknowns.size:
        raise InputError(f"Its prior has {n} unknowns, expected the {unknowns.size} of its estimate.")


def _summary(past: _Past, unknowns: UnknownsSpec) -> Summary:
    n, hessian = unknowns.size, array_of(past.hessian, "hessian")
    if not len(past.point) == len(past.gradient) == n or hessian.shape != (n, n):
        raise InputError(f"It sums up pushes in {len(past.point)} unknowns with a `hessian` of {hessian.shape}, expected {n} and {(n, n)}.")
    cost = Quadratic(np.array(past.point), np.array(past.gradient), hessian)
    check_information(cost, unknowns)
    return Summary(past.n_pushes, unknowns.modes, cost, unknowns.prior.feet, past.has_prior)


def _push(record: PushRecord) -> _Push:
    poses, pusher, wrench = record.poses, record.pusher, record.wrench
    return _Push(
        source=record.source,
        order=record.order,
        pose_time=poses.time.tolist(),
        pose=poses.pose.tolist(),
        pose_covariance=poses.covariance.tolist(),
        camera=(poses.camera.position, poses.camera.heading),
        pusher_time=pusher.time.tolist(),
        pusher=pusher.position.tolist(),
        radius=pusher.radius,
        polygon=_listed(pusher.polygon),
        yaw=_listed(pusher.yaw),
        fingers=_listed(pusher.fingers),
        wrench_time=_listed(wrench.time if wrench else None),
        force=_listed(wrench.force if wrench else None),
    )


def _listed(values: Float64Array | None) -> Any:
    return None if values is None else values.tolist()


def _record(push: _Push, object_id: str, shape: ObjectShape) -> PushRecord:
    polygon, yaw, fingers, force = (None if v is None else np.array(v) for v in (push.polygon, push.yaw, push.fingers, push.force))
    if (push.wrench_time is None) != (force is None):
        raise InputError("A push has forces without their times, or times without forces; expected both or none.")
    return _check_record(
        PushRecord(
            object_id=object_id,
            shape=shape,
            poses=PoseTrack(np.array(push.pose_time), np.array(push.pose), np.array(push.pose_covariance), CameraAccuracy(*push.camera)),
            pusher=PusherPath(np.array(push.pusher_time), np.array(push.pusher), push.radius, polygon, yaw, fingers),
            wrench=None if force is None else WrenchTrack(np.array(push.wrench_time), force),
            source=push.source,
            order=push.order,
        )
    )


def _start(start: WarmStart) -> _Start:
    prior = start.prior
    values = None if prior is None else (prior.mass_std, prior.pressure_std, prior.friction_std, prior.length)
    return _Start(name=start.name, x=start.x.tolist(), map_prior=values)


def _warm_start(start: _Start) -> WarmStart:
    return check_start(WarmStart(start.name, np.array(start.x), MapPrior(*start.map_prior) if start.map_prior else None))


# --- whether numbers from a file can be a push; bags and messages are checked as they are decoded


def _check_record(record: PushRecord) -> PushRecord:
    """The same push; raises InputError where one of its numbers is beyond what a cell can send."""
    _check_path(record.pusher)
    _check_poses(record.poses)
    first, last = record.poses.time[0] - record.pusher.time[0], record.poses.time[-1] - record.pusher.time[-1]
    rest = 86_400.0  # a night: the simulation steps through it [s]
    if not max(abs(first), abs(last)) <= rest:
        raise InputError(f"Poses begin {first:.3g} s and end {last:.3g} s after the pusher, expected at most {rest:g} s before or after.")
    if record.wrench is not None:
        _check_most(record.wrench.time, LIMITS.STAMP, "Forces")
        _check_most(record.wrench.force, LIMITS.FORCE, "Forces")
    return record


def _check_path(path: PusherPath) -> None:
    _check_most(path.time, LIMITS.STAMP, "Pusher path")
    check_coordinates(path.position, "Pusher path")
    check_pusher_radius(path.radius)
    for values, most in ((path.polygon, LIMITS.PUSHER_RADIUS), (path.fingers, LIMITS.PUSHER_RADIUS), (path.yaw, LIMITS.YAW)):
        if values is not None:
            _check_most(values, most, "Pusher path")
    LIMITS.PUSH_SECONDS.check(float(path.time[-1] - path.time[0]), "Pusher path")
    LIMITS.PUSH_TRAVEL.check(float(np.sum(np.linalg.norm(np.diff(path.position, axis=0), axis=1))), "Pusher path")


def _check_poses(poses: PoseTrack) -> None:
    _check_most(poses.time, LIMITS.STAMP, "Poses")
    check_coordinates(poses.pose[:, :2], "Poses")
    _check_most(poses.pose[:, 2], LIMITS.YAW, "Poses")
    check_coordinates(poses.camera.position, "Deviation of the camera")
    largest = np.max(np.abs(poses.covariance), axis=(1, 2), keepdims=True)
    asymmetry = np.abs(poses.covariance - np.swapaxes(poses.covariance, 1, 2))
    most = LIMITS.COORDINATE.value**2
    if np.any(largest > most) or np.any(asymmetry > 1e-6 * largest):  # equal entries may have been sent in single precision
        raise InputError(f"A covariance of a pose is not symmetric, or has entries over {most} m^2 or rad^2; leave such poses out.")


def _check_most(values: Float64Array, most: Limit, what: str) -> None:
    most.check(float(np.max(np.abs(values), initial=0.0)), what, remedy="Give SI units.")
