"""The state of an online identification as a file: JSON, validated when it is read, with every number to the last bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from push_ident.errors import InputError, ModelFileError
from push_ident.files import write_whole
from push_ident.identification.known_effects import KnownEffect
from push_ident.identification.model_file import ModelContent, model_content, posterior_of, prior_of, read_checked
from push_ident.identification.online import OnlineState
from push_ident.identification.prior import MapPrior
from push_ident.identification.quadratic import Quadratic
from push_ident.identification.result import WarmStart
from push_ident.identification.scoring import PushScore, RunningRecord
from push_ident.identification.summary import Summary
from push_ident.types import CameraAccuracy, Float64Array, ObjectShape, PoseTrack, PusherPath, PushRecord, SolveStatus, WrenchTrack

__all__ = ["KeptState", "load_state", "save_state"]

_FORMAT = "push_ident/state/3"
_EARLIER = "push_ident/state/2"
"""Its starts of the next solve are of a solver that is no more; the rest is as now."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class _Push(_Part):
    source: str
    order: int
    pose_time: list[float]
    pose: list[tuple[float, float, float]]
    pose_covariance: list[list[list[float]]]
    camera: tuple[float, float] = (0.0, 0.0)
    pusher_time: list[float]
    pusher: list[tuple[float, float]]
    radius: float
    polygon: list[tuple[float, float]] | None
    yaw: list[float] | None
    wrench_time: list[float] | None
    force: list[tuple[float, float]] | None


class _Past(_Part):
    n_pushes: int
    point: list[float]
    gradient: list[float]
    hessian: list[list[float]]
    log_forces: list[float] = []
    """Of earlier versions, which kept forces beside the unknowns; not used."""
    has_prior: bool = False


class _Known(_Part):
    name: str
    value: list[float]
    std: list[float]
    share: float


class _Start(_Part):
    name: str
    x: list[float]
    map_prior: tuple[float, float, float, float] | None


class _Score(_Part):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=True, ser_json_inf_nan="constants", populate_by_name=True)

    number: int
    source: str
    start: float
    cell_error: float = Field(alias="error")
    expected_cell_error: float = Field(alias="expected")
    mahalanobis2: float = Field(alias="distance2")
    uniform_cell_error: float = Field(alias="uniform")
    explained: bool = True


class _Record(_Part):
    n: int
    sums: tuple[float, float, float, float]
    latest: list[_Score]


class _State(_Part):
    format: str
    model: ModelContent
    prior: dict[str, float]
    pushes: list[_Push]
    past: _Past | None
    starts: list[_Start | list[float]]
    status: str | None
    record: _Record
    keys: list[tuple[float, float, float]]
    """When and where each known push began [s, m, m]."""
    known: list[_Known] = []
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
        format=_FORMAT,
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
        known=[_Known(name=own.name, value=own.value.tolist(), std=own.std.tolist(), share=own.share) for own in state.known],
    )
    text = content.model_dump_json(by_alias=True, exclude_defaults=True)
    write_whole(path, text, "the state of the identification", private=True, error=ModelFileError)


def load_state(path: Path) -> KeptState:
    """Read a state. Raises ModelFileError: no such file, or not one written by `save_state`."""
    content = read_checked(path, _State, "a state of the identification", "remove it to start again")
    if content.format not in (_FORMAT, _EARLIER):
        raise ModelFileError(f"{path} has the format `{content.format}`, expected `{_FORMAT}`; remove it to start again.")
    posterior = posterior_of(content.model, path)
    unknowns, past = posterior.unknowns, None
    try:
        if content.past:
            point, gradient, hessian = (np.array(v) for v in (content.past.point, content.past.gradient, content.past.hessian))
            if point.shape != gradient.shape or hessian.shape != (unknowns.size, unknowns.size) or point.shape != (unknowns.size,):
                raise ModelFileError(f"{path} sums up pushes in {len(point)} unknowns, expected {unknowns.size}; the file is damaged.")
            cost = Quadratic(point, gradient, hessian)
            past = Summary(content.past.n_pushes, unknowns.modes, cost, unknowns.prior.feet, content.past.has_prior)
        state = OnlineState(
            shape=unknowns.shape,
            prior=prior_of(content.prior),
            records=tuple(_record(push, content.model.object_id, unknowns.shape) for push in content.pushes),
            past=past,
            warm_starts=tuple(_warm_start(start) for start in content.starts if isinstance(start, _Start)),
            posterior=posterior,
            status=SolveStatus[content.status] if content.status else None,
            known=tuple(KnownEffect(own.name, np.array(own.value), np.array(own.std), own.share) for own in content.known),
        )
    except (InputError, KeyError, ValueError) as error:
        raise ModelFileError(f"{path} does not hold pushes of one object: {error}; remove it to start again.") from None
    latest = tuple(PushScore(**score.model_dump()) for score in content.record.latest)
    record = RunningRecord(content.record.n, content.record.sums, latest)
    return KeptState(content.model.object_id, state, tuple(content.model.sources), record, tuple(content.keys))


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
        wrench_time=_listed(wrench.time if wrench else None),
        force=_listed(wrench.force if wrench else None),
    )


def _listed(values: Float64Array | None) -> Any:
    return None if values is None else values.tolist()


def _record(push: _Push, object_id: str, shape: ObjectShape) -> PushRecord:
    polygon, yaw = (None if v is None else np.array(v) for v in (push.polygon, push.yaw))
    return PushRecord(
        object_id=object_id,
        shape=shape,
        poses=PoseTrack(np.array(push.pose_time), np.array(push.pose), np.array(push.pose_covariance), CameraAccuracy(*push.camera)),
        pusher=PusherPath(np.array(push.pusher_time), np.array(push.pusher), push.radius, polygon, yaw),
        wrench=None if push.wrench_time is None else WrenchTrack(np.array(push.wrench_time), np.array(push.force)),
        source=push.source,
        order=push.order,
    )


def _start(start: WarmStart) -> _Start:
    prior = start.prior
    values = None if prior is None else (prior.mass_std, prior.pressure_std, prior.friction_std, prior.length)
    return _Start(name=start.name, x=start.x.tolist(), map_prior=values)


def _warm_start(start: _Start) -> WarmStart:
    return WarmStart(start.name, np.array(start.x), MapPrior(*start.map_prior) if start.map_prior else None)
