"""The functions of `import push_ident as pi`: from bags to maps, predictions, a diagnosis and the next push.

    pushes = pi.load("bags/hammer_depth")
    result = pi.identify(pushes[:3])
    pi.predict(result, pushes[3:])

Lengths are metres, angles radians, masses kilograms, times seconds; poses are (x, y, yaw) of the object frame in the `table` frame.
Everything that can go wrong with data raises a `PushIdentError` of one line; a solve that fails is a `status`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import wraps
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, ParamSpec, TypeAlias, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike

from push_ident.api.arrays import record, records
from push_ident.bags.read_options import ReadOptions, parse_topics
from push_ident.checking.records import RecordCheck, check_records
from push_ident.diagnosis.diagnose import diagnose as _diagnose
from push_ident.diagnosis.diagnose import with_simulator
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.errors import InputError
from push_ident.extras import need
from push_ident.identification.fitting.budget import Budget
from push_ident.identification.fitting.fit import FitOptions
from push_ident.identification.identify import identify as _identify
from push_ident.identification.predicting.next_push import Proposal, propose_push
from push_ident.identification.predicting.planned import PUSHER_RADIUS, PlannedPush, predict_planned, pusher_path
from push_ident.identification.predicting.scoring import Comparison, compare_pushes
from push_ident.identification.results.model_file import load_model, save_model
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.results.result import Identification
from push_ident.identification.solvers import DEFAULT_SOLVER, solver_of
from push_ident.identification.unknowns.prior import Prior
from push_ident.offline.loading import LoadedPushes, load_pushes
from push_ident.offline.pusher_file import read_pusher_path
from push_ident.recovery.run import SelfTest, SelfTestOptions
from push_ident.recovery.run import selftest as _selftest
from push_ident.simulators.gap import check_number_of_pushes
from push_ident.simulators.protocol import FunctionSimulator, PushSimulator
from push_ident.types import Float64Array, PusherPath, PushRecord

if TYPE_CHECKING:
    from push_ident.api.plots import Picture

Model: TypeAlias = Identification | ModelPosterior | str | PathLike[str]
"""A result of `identify`, its posterior, or the path of a model file."""
__all__ = [
    "check",
    "diagnose",
    "identify",
    "in_one_thread",
    "load",
    "next_push",
    "plot",
    "predict",
    "record",
    "records",
    "save",
    "selftest",
]

_P = ParamSpec("_P")
_R = TypeVar("_R")
_CHOSEN: Final = "OPENBLAS_NUM_THREADS"


def in_one_thread(call: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let numpy and scipy use one thread while a function runs, in the whole process, and as many as before afterwards.

    The matrices of an identification are small: with the two threads that OpenBLAS starts on two cores it takes half as long again, and
    how they share a sum decides how it is rounded. The command line and the nodes choose one thread before numpy is loaded;
    a notebook has loaded it. What `OPENBLAS_NUM_THREADS` says is kept. Without the package `threadpoolctl`, which a ROS installation does
    not bring, nothing is changed.
    """

    @wraps(call)
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if _CHOSEN in os.environ:
            return call(*args, **kwargs)
        try:
            from threadpoolctl import threadpool_limits
        except ModuleNotFoundError:
            return call(*args, **kwargs)
        with threadpool_limits(limits=1, user_api="blas"):
            return call(*args, **kwargs)

    return called


def load(
    *bags: str | PathLike[str],
    object_id: str = "",
    camera_in_table: ArrayLike | None = None,
    topics: Mapping[str, str] | None = None,
    depth_unit: float | None = None,
    pose_std: tuple[float, float] | None = None,
) -> LoadedPushes:
    """Read the pushes of one object from bags of the contract; where a bag has no poses, the object is tracked in its depth images.

    Args:
        bags: folders, `.mcap`, `.db3` or ROS 1 `.bag` files, in the order of the pushes.
        object_id: the object; empty: the one with the most pushes.
        camera_in_table: pose of the depth camera in `table`, homogeneous, shape (4, 4), for depth bags without `tf_static`.
        topics: role of topics with other names than those of the contract, as `{"/camera/depth/image_raw": "depth"}`; of an object with its
            id, as `"pose:hammer"`.
        depth_unit: metres per unit of a depth image, where its encoding does not say it: 0.00025 for quarters of a millimetre.
        pose_std: standard deviations of position [m] and yaw [rad] of poses that lack a covariance; None: from the frames at rest.

    Returns:
        A sequence of `PushRecord`; a slice of it is again such a sequence. `notes` says what was missing, dropped or assumed.

    Raises:
        BagError: a bag cannot be read, lacks what is needed, or has another object than the others.
        InputError: no bag is named, or a role or a unit is none.
    """
    if not bags:
        raise InputError("load() needs the path of a bag; there is an example in bags/hammer_depth.")
    camera = None if camera_in_table is None else np.asarray(camera_in_table, dtype=np.float64)
    options = ReadOptions(parse_topics(topics or {}), depth_unit, pose_std)
    return load_pushes([Path(bag) for bag in bags], object_id=object_id, camera_in_table=camera, options=options)


def check(pushes: Sequence[PushRecord], *, page: str | PathLike[str] | None = None) -> RecordCheck:
    """Whether pusher and object meet while the object moves, and forces are those of the pusher, before anything is learned from pushes.

    Args:
        pushes: of one object, at least one.
        page: where to write the pictures and findings, as of an import (HTML).

    Returns:
        `agrees`, `warnings` in words with the probable cause (a clock, a frame, a unit, a radius), `overlap` with the numbers.

    Raises:
        InputError: no push, or the page cannot be written.
    """
    if not pushes:
        raise InputError("There is no push to check; give at least one push record.")
    checked = check_records(pushes)
    if page is not None:
        need("report")
        from push_ident.bags.importers.import_page import write_check_page

        write_check_page(Path(page), checked)
    return checked


@in_one_thread
def identify(
    pushes: Sequence[PushRecord],
    *,
    total_mass: float | None = None,
    prior: Prior | None = None,
    method: str = DEFAULT_SOLVER,
    max_seconds: float = 30.0,
) -> Identification:
    """Fit mass and friction of every cell, with their uncertainty, to pushes of one object.

    Args:
        pushes: of `load`, or some of them.
        total_mass: of the object, if it was weighed [kg]. Poses alone do not determine it.
        prior: nominal values and their standard deviations, before any push.
        method: name of a solver.
        max_seconds: longest time of the solve [s].

    Returns:
        Maps (`model.mass` [kg], `model.friction`, shape (n_cells,), at `model.shape.cells.centres` [m], shape (n_cells, 2), object
        frame), their `posterior`, and a `status`: look at it before the numbers.

    Raises:
        InputError: no push, pushes of different objects, or an unknown method.
    """
    effects = pushes.nuisances if isinstance(pushes, LoadedPushes) and solver_of(method).capabilities.takes_effects else ()
    known = _weighed(prior or Prior(), total_mass)
    options = FitOptions(threads=len(os.sched_getaffinity(0)))
    return _identify(list(pushes), known, method=method, effects=effects, budget=Budget(max_seconds=max_seconds), options=options)


def save(result: Identification, path: str | PathLike[str], object_id: str = "1") -> Path:
    """Write a result of `identify` as a model file, which `predict`, `push-ident export` and the nodes read.

    Args:
        result: to write.
        path: of the file (JSON); its folder is made.
        object_id: name of the object.

    Returns:
        The path.

    Raises:
        ModelFileError: the file cannot be written.
    """
    sources = [record.source for record in result.checked.records]
    save_model(Path(path), result.posterior, object_id=object_id, sources=sources, status=result.status)
    return Path(path)


@overload
def predict(model: Model, pushes: PushRecord | Sequence[PushRecord]) -> Comparison: ...


@overload
def predict(
    model: Model,
    *,
    pose: ArrayLike,
    path: PusherPath | str | PathLike[str] | ArrayLike,
    speed: float | None = None,
    radius: float | None = ...,
) -> PlannedPush: ...


@in_one_thread
def predict(
    model: Model,
    pushes: PushRecord | Sequence[PushRecord] | None = None,
    *,
    pose: ArrayLike | None = None,
    path: PusherPath | str | PathLike[str] | ArrayLike | None = None,
    speed: float | None = None,
    radius: float | None = None,
) -> Comparison | PlannedPush:
    """Predict recorded pushes and compare their ends with what was observed, or predict a push that was not made.

    Args:
        model: a result of `identify`, its posterior, or the path of a model file.
        pushes: recorded ones, with the cells of the model.
        pose: of the object before a push that was not made (x, y, yaw), table frame.
        path: of the axis of the pusher in that push, table frame: rows time, x, y [s, m, m], or rows x, y [m] with a `speed`; or a CSV
            file with these columns.
        speed: along a path without times [m/s].
        radius: of the pusher of that push [m]; by default that of the pushes of an `Identification`, else of the executor's pusher.

    Returns:
        For each recorded push the predicted poses (`prediction.pose`, shape (n_frames, 3), table frame) with their covariance, the cell
        error at the end [m], the error that was expected, and whether the end lies in the predicted 90 % region. For a push that was not
        made its `prediction`, whose `touched` is the chance that the pusher touches the object, and its `outcomes` with their chances.

    Raises:
        InputError: no push, or other cells than those of the model; a pose or path of another form.
        BagError: the CSV file is no such table.
        ModelFileError: the file is no model.
    """
    if not isinstance(model, Identification | ModelPosterior):
        _, model = load_model(Path(model))
    posterior = model.posterior if isinstance(model, Identification) else model
    if pushes is None:
        if pose is None or path is None:
            raise InputError("There is no push to predict; give recorded pushes, or `pose` and `path` of one that was not made.")
        if radius is None:
            made = model.checked.records if isinstance(model, Identification) else ()
            radius = made[0].pusher.radius if made else PUSHER_RADIUS
        if isinstance(path, str | PathLike):
            path = read_pusher_path(Path(path), radius, speed)
        return predict_planned(posterior, pose, path if isinstance(path, PusherPath) else pusher_path(path, radius, speed))
    if pose is not None or path is not None:
        raise InputError("Recorded pushes have their own poses and paths; give them, or `pose` and `path`, not both.")
    return compare_pushes(posterior, [pushes] if isinstance(pushes, PushRecord) else list(pushes))


@in_one_thread
def diagnose(
    pushes: Sequence[PushRecord],
    *,
    total_mass: float | None = None,
    prior: Prior | None = None,
    base_effects: Sequence[str] = (),
    from_camera: bool = False,
    against: Sequence[PushRecord] = (),
    earlier: Diagnosis | None = None,
    simulator: PushSimulator | Callable[[Float64Array, PusherPath, Float64Array], Float64Array] | None = None,
) -> Diagnosis:
    """Say where simulation and reality differ, which effect that the model lacks causes it, and how far the gap shrinks with it.

    Args:
        pushes: all that there are; some are held out inside.
        total_mass: of the object, if it was weighed [kg].
        prior: nominal values and their standard deviations.
        base_effects: effects that the base model has already.
        from_camera: whether poses and outline come from a camera.
        against: pushes of the same object in the same cell while all was well: effects are then changes since.
        earlier: outcome for the first of these pushes, from whose fits this diagnosis starts: with one more push it takes less time.
        simulator: a simulation of your own, whose gap on these pushes is divided as well: `MujocoScene`, another `PushSimulator`, or a
            function `(first_pose, tool_path, times)` that returns poses (x, y, yaw), shape (n, 3).

    Returns:
        `verdict`, `sentence`, `effects` with their sizes, `next_push`, `simulator` and more.

    Raises:
        InputError: no push, pushes of different objects, or an unknown effect.
    """
    settings = DiagnosisSettings(
        prior=_weighed(prior or Prior(), total_mass), base_effects=tuple(base_effects), outline_from_camera=from_camera
    )
    if simulator is not None:
        check_number_of_pushes(pushes)
    diagnosis = _diagnose(list(pushes), settings, against=list(against), earlier=earlier)
    if simulator is None:
        return diagnosis
    scene = simulator if isinstance(simulator, PushSimulator) else FunctionSimulator(simulator)
    nuisances = pushes.nuisances if isinstance(pushes, LoadedPushes) else ()
    return with_simulator(diagnosis, list(pushes), scene, settings.prior, nuisances=nuisances)


@in_one_thread
def selftest(
    pushes: Sequence[PushRecord],
    *,
    total_mass: float | None = None,
    prior: Prior | None = None,
    from_camera: bool = False,
    options: SelfTestOptions | None = None,
    page: str | PathLike[str] | None = None,
) -> SelfTest:
    """What an identification and a diagnosis of these pushes could tell, before one is trusted: known objects and effects are put into
    simulated twins of them, and looked for.

    Args:
        pushes: of one object, at least one; for effects at least three.
        total_mass: of the object, if it was weighed [kg].
        prior: nominal values and their standard deviations, from which objects are drawn.
        from_camera: whether poses and outline come from a camera.
        options: wall time (60 s), number of objects (4) and seed.
        page: where to write the result in words (HTML).

    Returns:
        `quantities` (errors and stated deviations of what is identified), `effects` (the smallest visible size of each), `proofs` and
        `left_out`.

    Raises:
        InputError: no push, pushes of different objects, or the page cannot be written.
    """
    nuisances = pushes.nuisances if isinstance(pushes, LoadedPushes) else ()
    settings = DiagnosisSettings(prior=_weighed(prior or Prior(), total_mass), outline_from_camera=from_camera)
    test = _selftest(list(pushes), settings, nuisances=nuisances, options=options)
    if page is not None:
        need("report")
        from push_ident.recovery.page import write_selftest_page

        write_selftest_page(Path(page), test)
    return test


@in_one_thread
def next_push(model: Identification | ModelPosterior, pusher_radius: float) -> Proposal | None:
    """The push of an object, with free space around it, after which other pushes would be predicted best.

    Args:
        model: a result of `identify`, or its posterior.
        pusher_radius: of the pusher [m].

    Returns:
        Where to touch and how to push, object frame, with the expected cell error before and after; None where no push would help.
    """
    return propose_push(model.posterior if isinstance(model, Identification) else model, pusher_radius)


def plot(thing: Any, title: str = "") -> Picture:
    """Draw what the other functions give, for a notebook or a file.

    Args:
        thing: pushes, a result of `identify` or its posterior, of `predict`, of `diagnose` or of `next_push`.
        title: above the figure; a fitting one by default.

    Returns:
        A figure of matplotlib that notebooks show; `savefig` writes it. Lengths are in millimetres.

    Raises:
        InputError: there is no figure of such a thing.
    """
    need("report")
    from push_ident.api.plots import draw

    return draw(thing, title)


def _weighed(prior: Prior, total_mass: float | None) -> Prior:
    return prior if total_mass is None else replace(prior, total_mass=total_mass, total_mass_std=0.0)
