"""A push record condensed for a fit: few frames, each with the noise that it really has.

All frames before the contact show one pose, and so do the frames after the object has come to rest: each group becomes its mean. Of the
frames in between, a limited number is kept. The noise of a frame is its own plus a model discrepancy that grows with travel, since no
model of pushing is exact; the frames of one push share this discrepancy.

With `NoiseModel.discrepancy_modes` the frames of a push share the discrepancy as one smooth function of the way: a Wiener process by its
first modes (Karhunen-Loeve), of which each push has its own amplitudes. It is the form of discrepancy of Kennedy & O'Hagan (Bayesian
calibration of computer models, J. R. Stat. Soc. B 2001), and its size can be estimated from the pushes (`fitting/discrepancy.py`).

The frames at rest show how much better a mean is than a frame. Where they scatter as their covariance states, the error averages out.
Where they scatter far less, as those of a tracker do, the covariance describes an error that they share. Errors that are correlated from
frame to frame (`NoiseModel.correlation`) average out more slowly, and neighbouring frames of the motion carry less information.

An outline that a camera traced is wrong by as much as its deviations say, elsewhere by another amount. Where a push touches it, all frames
of that push are displaced with respect to the pusher (`Observation.surface_std`), and the surface is also inclined otherwise than it looks,
which turns the motion (`NoiseModel.with_outline_of`).

Measured forces become means over windows: a mean averages the noise of the sensor and what hands and contacts shake, and its model is a
difference of impulses, which the engine gives with its exact derivative. What the samples scatter from one to the next is the noise of the
sensor. The model itself is wrong by a share of the force, since no law of friction is exact; the windows of a push share this discrepancy.
Where a force comes or goes it takes its time, which a rigid contact does not. A pusher that stands still against the object may press it
with any force up to friction: what is measured then says nothing of the object, nor does a window with a part of that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from push_ident.geometry.outline import outline_distance
from push_ident.physics.effect_values import EffectValues, force_times, measured_forces
from push_ident.physics.simulation import Motion
from push_ident.types import BoolArray, Float64Array, ObjectShape, PoseTrack, PushRecord

UNCHECKED = 2.0
"""Factor on the stated standard deviation of a pose that nothing checks, where the pushes do not set it [-]."""
_SHARING = 10
"""Frames of a motion, or windows of forces, for which the discrepancies of `NoiseModel` in a fit hold; of more, each counts less."""
_OUTLIER = 6.0
"""Standard deviations from the median of a rest beyond which a pose is wrong, or the object no longer there [-]."""
_MAX_CORRELATION = 0.98
"""Largest correlation of neighbouring frames that is assumed [-]: the mean of 100 frames is then as uncertain as a single one."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Errors of observed poses beyond the covariance that comes with them."""

    floor_position: float = 1e-4
    """Least standard deviation of a position: contact is not known better [m]."""
    floor_yaw: float = 1e-3
    """Least standard deviation of a yaw [rad]."""
    fit_discrepancy_position: float = 0.012
    """Model discrepancy of position by travel, of a frame in a fit [-]: larger than of a prediction, as the frames of a push share it."""
    fit_discrepancy_yaw: float = 0.12
    """Model discrepancy of yaw by travel, of a frame in a fit [rad/m]."""
    model_discrepancy_position: float = 0.003
    """Model discrepancy of position by travel, of a predicted pose [-]."""
    model_discrepancy_yaw: float = 0.03
    """Model discrepancy of yaw by travel, of a predicted pose [rad/m]."""
    discrepancy_factor: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """On the displacement of the surface that a push touches, and on the model discrepancy of a predicted position and yaw, as pushes set
    them [-]."""
    frame_factor: float = 1.0
    """On the standard deviation of every frame but the first, as pushes set it [-]: what neither noise nor shared discrepancy explains."""
    discrepancy_modes: int = 0
    """Modes by which the frames of a push share the model discrepancy in a fit, as in a prediction; 0: they count as independent, each
    with the discrepancy of a frame in a fit."""
    rest_factor: tuple[float, float] = (0.0, 0.0)
    """On the model discrepancy of a predicted position and yaw, of whose process the modes beyond `discrepancy_modes` are independent
    errors of the frames [-]. One of its own, so that fits of other sizes of the shared discrepancy know the frames as well."""
    floor_force: float = 0.02
    """Least standard deviation of a mean force: offset and hysteresis that a tare leaves [N]."""
    force_discrepancy: float = 0.1
    """Model discrepancy of a mean force by its size, of a window in a fit [-]: the windows of a push share it."""
    force_rise: float = 0.02
    """Time within which a force may come or go where the model has it at once [s]: contacts that give, and filters of sensors."""
    single_frame_inflation: float | None = None
    """Factor on the stated standard deviation of a pose at rest with one frame only, which no other frame checks [-]. None: `UNCHECKED`,
    unless a solver sets it by the pushes."""
    max_moving_frames: int = 10
    """Largest number of frames of the motion that are kept."""
    correlation: float = 0.0
    """Of the errors of neighbouring frames [-]; see `noise_correlation`."""
    outline_errors: bool = True
    """Whether the errors of a traced outline come on top, push by push."""

    def with_outline_of(self, shape: ObjectShape) -> NoiseModel:
        """The noise of pushes of an object: a traced outline makes the model less exact.

        Deviations of s over an object of size r incline its surface by about s / r, and motion turns by as much: s / r of the travel across
        it, and s / r^2 in yaw. `r` is the root mean square distance of the cells from their middle.
        """
        if shape.outline_error is None or not self.outline_errors:
            return self
        size = float(np.sqrt(np.mean(np.sum((shape.cells.centres - shape.cells.centres.mean(axis=0)) ** 2, axis=1))))
        slope, shared = shape.outline_error / size, 4.0  # discrepancy of a frame in a fit over that of a prediction, as of the defaults
        return replace(
            self,
            fit_discrepancy_position=float(np.hypot(self.fit_discrepancy_position, shared * slope)),
            fit_discrepancy_yaw=float(np.hypot(self.fit_discrepancy_yaw, shared * slope / size)),
            model_discrepancy_position=float(np.hypot(self.model_discrepancy_position, slope)),
            model_discrepancy_yaw=float(np.hypot(self.model_discrepancy_yaw, slope / size)),
        )

    def surface_std(self, shape: ObjectShape) -> float:
        """Standard deviation of the place where a push touches an object, along each axis [m]."""
        traced = shape.outline_error if shape.outline_error is not None and self.outline_errors else 0.0
        if self.discrepancy_modes == 0:
            return traced
        return self.discrepancy_factor[0] * (traced or self.floor_position)

    @property
    def floor(self) -> Float64Array:
        """Least covariance of an observed pose, shape (3, 3)."""
        return np.diag([self.floor_position**2, self.floor_position**2, self.floor_yaw**2])

    @property
    def model_discrepancy(self) -> Float64Array:
        """Model discrepancy of a predicted pose, by travel [1, 1, rad/m], shape (3,)."""
        _, position, yaw = self.discrepancy_factor
        return np.array([position, position, yaw]) * self.unscaled_discrepancy

    @property
    def unscaled_discrepancy(self) -> Float64Array:
        """The same, as it was before pushes set its size, shape (3,)."""
        return np.array([self.model_discrepancy_position, self.model_discrepancy_position, self.model_discrepancy_yaw])


@dataclass(frozen=True, slots=True)
class Observation:
    """A condensed push."""

    time: Float64Array
    """[s], shape (n_frames,)."""
    pose: Float64Array
    """Table frame, shape (n_frames, 3). The first is the pose at rest before contact, the last the pose at rest afterwards."""
    whitening: Float64Array
    """W with W' W = inverse covariance of a frame, shape (n_frames, 3, 3)."""
    first_covariance: Float64Array
    """Of the first pose, shape (3, 3)."""
    last_covariance: Float64Array
    """Of the last pose without the model discrepancy that `whitening` contains, shape (3, 3)."""
    touched: bool
    """Whether the pusher comes near the observed object."""
    end_covariance: Float64Array
    """Of the last pose with what a fit allows it to differ from the model, where the frames share the discrepancy, shape (3, 3): numerics
    need not be more exact."""
    discrepancy: Float64Array
    """Standard deviation of the model discrepancy, which is correlated from frame to frame; part of `whitening` [m, m, rad], shape
    (n_frames, 3)."""
    correlation: float = 0.0
    """Of the errors of neighbouring frames of the motion [-]; `whitening` assumes larger independent errors instead."""
    surface_std: float = 0.0
    """Standard deviation of a displacement of all frames alike, along each axis of the table: the surface lies elsewhere than its outline
    [m]; 0 for an exact outline."""
    is_unchecked: bool = False
    """Whether both rests have one frame only, so that nothing but pushes shows how large the errors of poses are."""
    shared: Float64Array = field(default_factory=lambda: np.zeros((0, 3, 0)))
    """Displacement of each frame by the unit normal numbers that the frames of the push share: those of the surface, then those of the
    model discrepancy, shape (n_frames, 3, n_shared)."""


def observe_push(record: PushRecord, noise: NoiseModel | None = None) -> Observation:
    """Condense one push record."""
    noise = (noise or NoiseModel()).with_outline_of(record.shape)
    poses = record.poses
    before, after, touched = rest_frames(record)
    moving = np.arange(before[-1] + 1, after[0])
    stride = max(1.0, len(moving) / noise.max_moving_frames)
    if len(moving) > noise.max_moving_frames:
        moving = moving[np.linspace(0, len(moving) - 1, noise.max_moving_frames).round().astype(int)]
    before, after = _agreeing(record, before), _agreeing(record, after)
    singles = [np.array([frame]) for frame in moving]
    if after[0] <= before[-1]:  # never touched: the last frame is at rest in both
        before = before[:-1] if len(before) > 1 else np.array([0])
    groups = [before, *singles, after]

    time = np.array([poses.time[g].mean() for g in groups])
    # The object rests until it is touched. In a simulation whose pusher touches it from the start, a later time would not be of the first
    # pose, which nothing then determines.
    time[0] = min(time[0], record.pusher.time[0])
    pose = np.array([poses.pose[g].mean(axis=0) for g in groups])
    floor = noise.floor
    travel = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pose[:, :2], axis=0), axis=1))])
    # A turn by a radian counts as half the size of a usual object.
    travel = np.minimum(travel, np.linalg.norm(pose[:, :2] - pose[0, :2], axis=1) + 0.05 * np.abs(pose[:, 2] - pose[0, 2]))
    fit_discrepancy = np.array([noise.fit_discrepancy_position, noise.fit_discrepancy_position, noise.fit_discrepancy_yaw])
    growth = fit_discrepancy**2 * max(1.0, len(moving) / _SHARING) if noise.discrepancy_modes == 0 else np.zeros(3)
    scatter = _scatter(record, before, after, correlation=min(max(noise.correlation, 0.0), _MAX_CORRELATION))
    inflation = UNCHECKED if noise.single_frame_inflation is None else noise.single_frame_inflation
    neighbours = min(max(noise.correlation, 0.0), _MAX_CORRELATION) ** stride
    repeated = repetition(neighbours)
    checked = scatter if noise.discrepancy_modes else max(scatter, 1.0)
    stated = [poses.covariance[g].mean(axis=0) * checked * repeated for g in groups]
    for end in (0, -1):
        n = len(groups[end])
        common = 0.0 if noise.discrepancy_modes else max(0.0, 1.0 - 2.0 * scatter)
        independent = variance_of_mean(n, noise.correlation)
        stated[end] = stated[end] / repeated * (inflation**2 if n == 1 else common + (1.0 - common) * independent)
    modes, rest = _modes_of_discrepancy(travel, noise.discrepancy_modes)
    of_rest = np.array([noise.rest_factor[0], noise.rest_factor[0], noise.rest_factor[1]]) * noise.unscaled_discrepancy
    errors = np.multiply.outer(travel**2, growth) + np.multiply.outer(rest, of_rest**2)
    covariance = np.array([c + floor + np.diag(error) for c, error in zip(stated, errors, strict=True)])
    covariance[1:] *= noise.frame_factor**2
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    discrepancy = travel[:, None] * noise.model_discrepancy
    unchecked = len(before) == len(after) == 1
    surface_std = noise.surface_std(record.shape)
    shared, last = _shared_displacements(modes, surface_std, noise), stated[-1] + floor
    end = last if noise.discrepancy_modes == 0 else covariance[-1] + shared[-1] @ shared[-1].T
    return Observation(time, pose, whitening, covariance[0], last, touched, end, discrepancy, neighbours, surface_std, unchecked, shared)


def _shared_displacements(modes: Float64Array, surface_std: float, noise: NoiseModel) -> Float64Array:
    """`Observation.shared` of frames with such modes of the discrepancy, shape (n_frames, n_modes), shape (n_frames, 3, n_shared)."""
    axes = np.eye(3)[:, :2] * surface_std if surface_std > 0 else np.zeros((3, 0))
    surface = np.broadcast_to(axes, (len(modes), *axes.shape))
    of_model = np.einsum("fm,i,ij->fijm", modes, noise.model_discrepancy, np.eye(3)).reshape(len(modes), 3, -1)
    return np.concatenate([surface, of_model], axis=2)


def _modes_of_discrepancy(travel: Float64Array, n_modes: int) -> tuple[Float64Array, Float64Array]:
    """Of a Wiener process of the travel [m], shape (n_frames,), whose standard deviation in the end is the whole travel: its first modes
    [m], shape (n_frames, n_modes), and the variance of all others [m^2], shape (n_frames,)."""
    whole = max(float(np.max(travel)), 1e-9)
    rate = (np.arange(n_modes) + 0.5) * np.pi
    modes = whole * np.sqrt(2.0) / rate * np.sin(np.outer(travel / whole, rate))
    return modes, np.maximum(whole * travel - np.sum(modes**2, axis=1), 0.0)


def at_rest(record: PushRecord) -> PushRecord:
    """The same push with its frames at rest only, before contact and after it: what is known of one whose motion was not seen."""
    before, after, _ = rest_frames(record)
    kept, poses = np.unique(np.concatenate([before, after])), record.poses
    return replace(record, poses=PoseTrack(poses.time[kept], poses.pose[kept], poses.covariance[kept]))


def noise_at_rest(records: Sequence[PushRecord], noise: NoiseModel | None = None) -> NoiseModel:
    """The noise, with errors at least as correlated as the frames at rest of the records show."""
    noise, correlation = noise or NoiseModel(), noise_correlation(records)
    return replace(noise, correlation=correlation) if correlation > noise.correlation else noise


def noise_correlation(records: Sequence[PushRecord], *, enough_pairs: int = 40) -> float:
    """Correlation of the errors of neighbouring frames, from the frames at rest; NaN where these make fewer than `enough_pairs`.

    The errors are assumed to be first-order autoregressive. The mean of each rest absorbs a part of them (Marriott & Pope, Bias in the
    estimation of autocorrelations, Biometrika 41, 1954): the estimate is the correlation for which sums over all rests are expected as they
    are.
    """
    rests = _clear_rests(records)
    squares = sum(float(np.sum(error**2)) for error in rests)
    if sum(len(error) - 1 for error in rests) < enough_pairs or squares <= 0.0:
        return float("nan")
    ratio = sum(float(np.sum(error[1:] * error[:-1])) for error in rests) / squares
    n = np.array([len(error) for error in rests], dtype=np.float64)

    def excess(rho: float) -> float:
        """Of the expected products of neighbours over those of a ratio as observed, for errors of unit variance."""
        first = (1.0 - rho**n) / (n * (1.0 - rho))  # covariance of the first error, or the last, with the mean
        of_mean = ((1.0 + rho) / (1.0 - rho) - 2.0 * rho * first / (1.0 - rho)) / n
        return float(np.sum((n - 1.0) * rho - (n + 1.0) * of_mean + 2.0 * first - ratio * n * (1.0 - of_mean)))

    bounds = (-_MAX_CORRELATION, _MAX_CORRELATION)
    if excess(bounds[1]) <= 0.0 or excess(bounds[0]) >= 0.0:
        return bounds[int(excess(bounds[1]) <= 0.0)]
    return float(brentq(excess, *bounds))


def noise_correlation_std(records: Sequence[PushRecord]) -> float:
    """Standard error of `noise_correlation`, that of n pairs of independent errors, 1 / sqrt(n); infinite where there is no pair."""
    n_pairs = sum(len(error) - 1 for error in _clear_rests(records))
    return float(1.0 / np.sqrt(n_pairs)) if n_pairs else float("inf")


def _clear_rests(records: Sequence[PushRecord]) -> list[Float64Array]:
    """Errors of the frames of each rest of four frames and more, in standard deviations, each of shape (n, 3)."""
    errors = []
    for record in records:
        before, after, _ = rest_frames(record)
        # With an error of tool or camera, the object moves before the pusher seems to touch it; none is as large as a centimetre.
        clear = before[record.poses.time[before] < _first_time(record, pusher_gaps(record) < 0.01)]
        for rest in (_agreeing(record, clear), _agreeing(record, after)):
            if len(rest) >= 4:
                error = record.poses.pose[rest] - record.poses.pose[rest].mean(axis=0)
                errors.append(error / np.sqrt(np.diagonal(record.poses.covariance[rest], axis1=1, axis2=2)))
    return errors


def _agreeing(record: PushRecord, rest: NDArray[np.intp]) -> NDArray[np.intp]:
    """Frames at rest without wrong poses: a single one would shift the mean."""
    if len(rest) < 2:
        return rest
    error = record.poses.pose[rest] - np.median(record.poses.pose[rest], axis=0)
    deviation = np.sqrt(np.diagonal(record.poses.covariance[rest], axis1=1, axis2=2))
    fits = np.max(np.abs(error) / deviation, axis=1) < _OUTLIER
    return rest[fits] if np.any(fits) else rest


def repetition(correlation: float) -> float:
    """Factor of the variance of a mean of many frames over that of independent ones."""
    rho = min(max(correlation, 0.0), _MAX_CORRELATION)
    return (1.0 + rho) / (1.0 - rho)


def variance_of_mean(n: int, correlation: float) -> float:
    """Variance of the mean of n errors of unit variance, first-order autoregressive.

    Priestley, Spectral Analysis and Time Series, 1981, section 5.3.2.
    """
    rho = min(max(correlation, 0.0), _MAX_CORRELATION)
    return (repetition(rho) - 2.0 * rho * (1.0 - rho**n) / (n * (1.0 - rho) ** 2)) / n


def rest_frames(record: PushRecord) -> tuple[NDArray[np.intp], NDArray[np.intp], bool]:
    """Frames at rest before contact and after the push, at least one each; and whether the pusher comes near the object.

    Contact is where outline and pusher are reported; where the poses show that the object moves before or after that, they count. Where no
    frame shows the object after the push, the last frame stands for it.
    """
    poses, pusher = record.poses, record.pusher
    near = pusher_gaps(record) < _near_gap(record)
    contact_time = _first_time(record, near)
    speed, slow = _pusher_speed(record)
    driving = near & (speed > slow)
    coast = 0.15  # time within which an object released at 0.3 m/s on friction 0.2 comes to rest [s]
    rest_time = float(pusher.time[np.flatnonzero(driving)[-1]]) + coast if np.any(driving) else -np.inf
    before = np.flatnonzero(poses.time <= contact_time)
    before = _still(record, before) if len(before) else np.array([0])
    after = np.flatnonzero(poses.time >= max(rest_time, contact_time)) if np.isfinite(contact_time) else np.array([], dtype=int)
    after = after[after > before[-1]]
    after = _still(record, after[::-1])[::-1] if len(after) else np.array([len(poses.time) - 1])
    return before, after, bool(np.any(near))


def _still(record: PushRecord, rest: NDArray[np.intp]) -> NDArray[np.intp]:
    """The frames of a rest, those farthest from the push first, up to the one from which on all others show the object elsewhere."""
    pose, farthest = record.poses.pose[rest], slice(0, max(1, len(rest) // 4))
    error = pose - np.median(pose[farthest], axis=0)
    stated = np.diagonal(record.poses.covariance[rest], axis1=1, axis2=2)
    # Errors that are larger than stated, or that hardly change from frame to frame, are no motion.
    deviation = np.sqrt(np.maximum(stated, np.mean(error[farthest] ** 2, axis=0)))
    elsewhere = np.any(np.abs(error) > _OUTLIER * deviation, axis=1)
    at_rest = np.flatnonzero(~elsewhere)
    return rest[: at_rest[-1] + 1] if len(at_rest) else rest[:1]


def _near_gap(record: PushRecord) -> float:
    """Gap below which the pusher may touch [m]: at least three standard deviations of a position."""
    return max(3e-3, 3 * float(np.sqrt(np.median(record.poses.covariance[:, 0, 0]))))


def _pusher_speed(record: PushRecord) -> tuple[Float64Array, float]:
    """At every pusher sample [m/s], shape (n_samples,), and the speed above which it counts as driving: 5 % of its top speed."""
    speed = np.linalg.norm(np.gradient(record.pusher.position, record.pusher.time, axis=0), axis=1)
    return speed, 0.05 * max(float(speed.max()), 1e-9)


def _first_time(record: PushRecord, when: BoolArray) -> float:
    """Time of the first true sample of the pusher, shape (n_samples,) [s]; infinity where none is true."""
    return float(record.pusher.time[np.argmax(when)]) if np.any(when) else np.inf


def _scatter(record: PushRecord, *rests: NDArray[np.intp], correlation: float = 0.0, enough: float = 12.0) -> float:
    """Variance of the frames at rest over the one that their covariance states; 1 where they have less than `enough` degrees of freedom.

    `correlation`: of the errors of neighbouring frames [-]; the mean of a rest then follows them, and they scatter less about it.
    """
    poses = record.poses
    squares = freedom = 0.0
    for rest in rests:
        error = poses.pose[rest] - poses.pose[rest].mean(axis=0)
        squares += float(np.sum(error**2 / np.diagonal(poses.covariance[rest], axis1=1, axis2=2)))
        lags = np.arange(1, len(rest))
        mean_repeats = 1.0 + 2.0 * float(np.sum((1.0 - lags / len(rest)) * correlation**lags))
        freedom += 3.0 * (len(rest) - mean_repeats)
    return squares / freedom if freedom >= enough else 1.0


def scatter_at_rest(record: PushRecord, correlation: float = 0.0) -> float:
    """Variance of the frames of the rests, without wrong poses, over the one that their covariance states; see `_scatter`."""
    before, after, _ = rest_frames(record)
    return _scatter(record, _agreeing(record, before), _agreeing(record, after), correlation=correlation)


def errors_shared_by_frames(records: Sequence[PushRecord]) -> tuple[float, float, float]:
    """Standard deviation (x, y, yaw) of the errors of a pose that all frames of a rest have in common [m, m, rad].

    What is stated of a frame and its scatter at rest does not show; the median of the records. Zero where frames scatter as stated.
    """
    shared = [max(0.0, 1.0 - scatter_at_rest(r)) * np.diagonal(r.poses.covariance.mean(axis=0)) for r in records]
    x, y, yaw = map(float, np.sqrt(np.median(shared, axis=0)))
    return x, y, yaw


def pusher_gaps(record: PushRecord) -> Float64Array:
    """Gap between pusher and outline at every pusher sample, from the observed poses [m], shape (n_samples,)."""
    poses, pusher = record.poses, record.pusher
    pose = np.column_stack([np.interp(pusher.time, poses.time, poses.pose[:, axis]) for axis in range(3)])
    return outline_distance(pusher.position, pose, record.shape.outline) - pusher.radius


# --- measured forces


@dataclass(frozen=True, slots=True)
class ForceObservation:
    """Mean forces of the pusher on the object over windows that follow each other."""

    edges: Float64Array
    """Where windows begin and end [s], on the clock of the push, shape (n + 1,)."""
    force: Float64Array
    """Mean of each [N], shape (n, 2), table frame."""
    std: Float64Array
    """Standard deviation of each component, the discrepancy of the model included [N], shape (n,); infinite where nothing was measured, and
    where the pusher stands still against the object at some time."""

    def times(self, effects: EffectValues) -> Float64Array:
        """When the forces at `edges` were measured [s], shape (n + 1,)."""
        return force_times(effects, self.edges)[0]

    def residual(self, simulated: Float64Array) -> Float64Array:
        """Whitened difference between simulated forces, shape (n, 2), and the measured ones."""
        return np.asarray((simulated - self.force) / self.std[:, None])

    def simulated(self, impulse: Float64Array, factor: float, effects: EffectValues) -> Float64Array:
        """Forces that a sensor would measure [N], shape (n, 2), from impulses of the pusher until each of `times` [N s], shape (n + 1, 2).

        `factor`: of the total mass over that of the simulation. Of the effects, those on forces act.
        """
        return measured_forces(effects, factor * np.diff(impulse, axis=0) / np.diff(self.edges)[:, None])[0]

    def derivative(
        self, motion: Motion, by_impulse: Float64Array, factor: float, effects: EffectValues
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Derivative of `residual(simulated(...))`.

        Args:
            motion: simulated, with the impulse at `times`.
            factor, effects: as of `simulated`.
            by_impulse: derivative of the impulse by some unknowns, shape (n + 1, 2, n_unknowns).

        Returns:
            By these unknowns, shape (n, 2, n_unknowns); by the logarithm of the factor, shape (n, 2); by the values of the effects as far
            as they act on forces and their times, shape (n, 2, n_values).
        """
        length = np.diff(self.edges)[:, None]
        force = factor * np.diff(motion.impulse, axis=0) / length
        _, by_force, by_value = measured_forces(effects, force)
        whitened = by_force / self.std[:, None, None]
        by_unknown = whitened @ (factor * np.diff(by_impulse, axis=0) / length[:, :, None])
        _, by_time = force_times(effects, self.edges)
        moved = factor * np.diff(by_time[:, :, None] * motion.force_at, axis=1) / length
        values = np.moveaxis(by_value, 0, 2) / self.std[:, None, None] + np.einsum("nij,vnj->niv", whitened, moved)
        return by_unknown, np.einsum("nij,nj->ni", whitened, force), values


def observe_forces(
    record: PushRecord, noise: NoiseModel | None = None, *, max_windows: int = 20, least_samples: int = 3
) -> ForceObservation | None:
    """Condense the measured forces of one push into windows of some samples each, where it has so many; None where there are none."""
    wrench, noise = record.wrench, noise or NoiseModel()
    if wrench is None or len(wrench.time) < 2:
        return None
    # A sample is the mean since the one before.
    step = float(np.median(np.diff(wrench.time)))
    n = int(np.clip(len(wrench.time) // least_samples, 1, max_windows))
    edges = np.linspace(wrench.time[0] - step, wrench.time[-1], n + 1)
    window = np.clip(np.searchsorted(edges, wrench.time - 0.5 * step, side="right") - 1, 0, n - 1)
    count = np.bincount(window, minlength=n)
    measured = (count > 0) & ~_leans(record, edges)
    sums = np.column_stack([np.bincount(window, weights=wrench.force[:, axis], minlength=n) for axis in (0, 1)])
    force = sums / np.maximum(count, 1)[:, None]
    # Of a sample about its neighbours, from the median: robust against the jumps of a contact.
    sample_std = float(np.median(np.abs(np.diff(wrench.force, axis=0))) / (0.6745 * np.sqrt(2.0)))
    sensor = np.hypot(sample_std / np.sqrt(np.maximum(count, 1)), noise.floor_force)
    discrepancy = noise.force_discrepancy * np.linalg.norm(force, axis=1) * np.sqrt(max(1.0, n / _SHARING))
    jump = np.r_[0.0, np.linalg.norm(np.diff(force, axis=0), axis=1), 0.0]  # from each window to its neighbours
    rise = min(1.0, noise.force_rise / (edges[1] - edges[0])) * np.maximum(jump[:-1], jump[1:])
    std = np.sqrt(sensor**2 + discrepancy**2 + rise**2)
    return ForceObservation(edges, force, np.where(measured, std, np.inf))


def _leans(record: PushRecord, edges: Float64Array) -> BoolArray:
    """Windows in a part of which the pusher stands still where it may touch the object, after it drove there, shape (n,)."""
    pusher, gap, near = record.pusher, pusher_gaps(record), _near_gap(record)
    speed, slow = _pusher_speed(record)
    arrived = pusher.time[(gap < near) & (speed > slow)]
    if not len(arrived):
        return np.zeros(len(edges) - 1, dtype=bool)
    standing = np.append(pusher.time[speed < slow], edges[np.interp(edges, pusher.time, speed) < slow])
    standing.sort()
    stands = np.searchsorted(standing, edges[1:], side="right") > np.searchsorted(standing, edges[:-1], side="left")
    nearest = np.minimum(*(np.interp(side, pusher.time, gap) for side in (edges[:-1], edges[1:])))
    return np.asarray(stands & (nearest < near) & (edges[:-1] > arrived[0]))
