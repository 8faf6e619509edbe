"""The decision policy: every number that decides what a diagnosis reports, in one place.

Each stage has a section. A field states its unit, its meaning and the evidence it was set on. Reasons that need more than a line are
decision records (docs/decisions, 32 to 42). Four sources recur:

- *tuning cases*: cases of the blind check with seeds below 1000 and of earlier report sets, in Bullet and in the planar engine
  (docs/results/experiments.md, "Blind check of the diagnosis"). The published report set, seeds 9000 to 9049, was scored once under
  these numbers.
- *prototype*: bags of another engine with 14 random pushes of 1 mm noise, 13 effects in 52 cases and 14 effect-free ones.
- *camera nulls*: 20 effect-free objects, pushed in the simulated cell and perceived through rendered depth images.
- *judgement*: no measurement chose this value over its neighbours.

Log Bayes factors are natural logarithms [nat]: 5 are odds of 150 to 1.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace

__all__ = [
    "AccountPolicy", "CameraPolicy", "DecisionPolicy", "GatePolicy", "NextPushPolicy", "ResidualPolicy", "SelectionPolicy", "UnknownPolicy",
    "ValidationPolicy",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class GatePolicy:
    """When data or numerics cannot be trusted, so that the diagnosis abstains."""

    min_pushes: int = 3
    """Pushes that touch the object; with fewer, no push can be held out of a fit to at least two. Judgement."""
    min_frames: int = 6
    """Frames of a push from which missing frames are counted. Judgement."""
    missing_frame_interval: float = 1.8
    """Interval between frames, in medians of the push, from which a frame counts as missing: the next multiple is 2. Judgement."""
    max_missing_share: float = 0.3
    """Share of intervals with a missing frame, below which data are accepted. Judgement."""
    jump_size: tuple[float, float, float] = (0.02, 0.02, 0.35)
    """Change of a pose that comes back, beyond noise, from which it counts as a jump [m, m, rad]; no push moves an object as far within a
    frame. Judgement from the speed of pushes (0.3 m/s at 15 frames a second)."""
    jump_deviations: float = 8.0
    """Stated standard deviations that are added to `jump_size` [1]. Judgement."""
    max_jump_share: float = 0.02
    """Share of poses that jump, below which data are accepted. Judgement: a tracker that flips by half a turn exceeds it."""
    min_rest_pairs: int = 80
    """Pairs of neighbouring frames at rest from which their correlation is known to a tenth: its standard error is 1/sqrt(n)."""
    max_step_effect: float = 0.2
    """Median change of end poses under half the time steps and half the smoothing speed, below which numerics are accepted, in standard
    deviations of the poses' noise [1]. Twice what the steps are chosen for (`physics/accuracy.py`); judgement."""
    max_outline_deviations: float = 3.75
    """Fitted distance of the surface from an outline that a camera traced, in standard deviations of that outline, below which it is
    accepted [-]: 1.5 mm where the simulated camera traced it (0.4 mm)."""


@dataclass(frozen=True, slots=True)
class SelectionPolicy:
    """Which effects are refitted, which are added, and which remain in a tie."""

    min_log_bayes_factor: float = 5.0
    """Log Bayes factor from which a first effect is detected [nat]. Odds of 150 to 1; no false alarm in the published null cases."""
    min_log_bayes_factor_next: float = 12.0
    """The same of an effect beside others [nat]: the law of the first may differ from the world's. Set on tuning cases."""
    next_share: float = 0.1
    """At least this share of the log Bayes factors of all approximate laws found before [1]: the error of a law grows with its effect. Set
    on tuning cases."""
    tie_margin: float = 6.0
    """Differences of log evidence below this are a tie [nat]. From the prototype; kept on tuning cases."""
    tie_share: float = 0.1
    """A rival with an approximate law is also in a tie within this share of the log Bayes factor of the effect that was found [1]. Set on
    tuning cases."""
    min_log_bayes_factor_single: float = 12.0
    """An effect below this is reported with every rival that brings `weak_rival_log_bayes_factor` [nat]. Set on tuning
    cases; the prototype took 25."""
    weak_rival_log_bayes_factor: float = 1.0
    """Log Bayes factor above which a refitted effect is a rival of a weak one [nat]. Judgement."""
    min_promise_first: float = -2.0
    """Expected log Bayes factor below which a first effect is not refitted [nat]. The score test is of second order: the
    margin below `min_log_bayes_factor` is a judgement of its error."""
    min_promise_next: float = 0.5
    """The same of an effect beside others, which needs more evidence [nat]."""
    promise_share: float = 0.1
    """This share of the best score is added to `min_promise_first` [1]: an effect with many times less is no rival. Judgement."""
    max_refits: int = 5
    """Effects refitted a round, the best by their score, besides those of `Effect.refit_with`. From the prototype, whose
    score test ranked the true effect first in 44 of 52 cases, and whose refits in 49."""
    max_effects: int = 3
    """Effects added at most. Judgement: pairs are tested in the blind check, triples are not."""
    max_start: float = 2.0
    """Length of a one-step estimate at which it is clipped before a refit [prior standard deviations]. From the prototype."""
    min_restart_gain: float = 1.0
    """Gain of log evidence of the *same* model, refitted from the maps beside another effect, from which the earlier fit had stopped at a
    kink of the cost [nat]: the effect gained by its start only. Judgement, above the tolerance of a comparison (0.05 nat)."""
    swap_candidate_share: float = 0.5
    """Share of the best candidate's log Bayes factor from which a runner-up is tried in its place beside a later effect [1]. Judgement."""
    min_swap_gain: float = 3.0
    """Gain of log evidence from which it takes that place [nat]. Odds of 20 to 1; judgement."""
    drop_share: float = 0.5
    """An effect found earlier is dropped when the log evidence falls by less than this share of `min_log_bayes_factor` [1]. Judgement."""
    negligible: Mapping[str, float] = field(default_factory=lambda: {"s": 2e-3, "m": 1e-4, "rad": 1e-3, "": 1e-3})
    """Size by unit below which an effect with an exact law is negligible and becomes part of the base model: no clock, surface or scale of
    a cell is known better. Set on poses of 0.02 to 0.05 mm noise: without this, 7 of 15 effect-free objects in Bullet were diagnosed with
    0.5 to 0.8 ms of lag or latency."""


@dataclass(frozen=True, slots=True)
class ValidationPolicy:
    """What held-out pushes have to confirm."""

    max_folds: int = 10
    """Fits without some pushes; with more pushes, two or more are held out together. A limit of time, not of evidence."""
    min_log_density_gain: float = 0.0
    """Mean gain of log predictive density at or below which held-out pushes are predicted no better [nat a fold]. A difference of zero."""
    min_gap_standard_errors: float = 2.0
    """Standard errors by which the held-out error exceeds the pose noise, above which there is a gap to close [1]. About 95 %,
    two-sided."""
    min_log_bayes_factor_without_push: float = -1.0
    """Log Bayes factor in the fit without any one fold, from which an effect is supported [nat]. Of 31 true effects with 14 pushes, 30 kept
    a third of their evidence and more. With six pushes some of 21 kept hardly any, so that any gain suffices, up to rounding of fits."""
    noise_draws: int = 64
    """Draws of the pose noise a push for the error that noise makes without any gap. Its median is then known to about 15 %."""
    bootstrap_draws: int = 2000
    """Resamples of the pushes for the interval of the shrink."""
    interval_quantiles: tuple[float, float] = (0.05, 0.95)
    """Quantiles of the resamples that bound the interval of the shrink: 90 %."""


@dataclass(frozen=True, slots=True)
class AccountPolicy:
    """How the error on held-out pushes is split into its parts."""

    draws: int = 24
    """Draws of noise, unknowns and discrepancy a push: the expected error of one push is then known to about 10 %, its mean over 14 pushes
    to 3 %."""
    posterior_scale: float = 0.75
    """Standard deviation of the unknowns in the draws, in those of the fit's posterior [1]. Set on effect-free tuning cases (both engines,
    seeds below 50, 6 and 14 pushes; decision 70), where maps mispredicted held-out pushes by 0.76 of what the posterior states: a fit
    assumes rather too large errors of its frames, and more uneven objects."""
    max_maps_share: float = 0.41
    """Part of maps that are not known yet, in parts of the poses' noise, above which the pushes are too few to know [1]: errors add in
    quadrature, so that maps alone would then make the same error as noise (the square root of 2, minus 1). Noise is the error that any
    number of pushes leaves."""
    negligible: float = 1e-4
    """Part below which it does not count [m]: no surface of a cell is known better, as in `SelectionPolicy.negligible`."""
    max_more_pushes: int = 100
    """Number of further pushes above which none is stated: other pushes, or better poses, are then needed. Judgement."""


@dataclass(frozen=True, slots=True)
class UnknownPolicy:
    """When the cause is unknown: a smooth wrench explains more than named effects, or residuals remain."""

    min_log_bayes_factor: float = 10.0
    """Log Bayes factor of the smooth wrench above which it may replace named effects [nat]. Twice the evidence of an effect, since its
    shape is free; set on tuning cases."""
    named_share: float = 0.8
    """Where one named effect brings this share of the wrench's log Bayes factor, the wrench is not needed [1]. Set on tuning cases."""
    max_residual_ratio: float = 1.1
    """Mean squared standardized residual over its expectation, above which something remains [1]. Set on tuning cases."""
    residual_ratio_share: float = 0.03
    """It may also reach 1 plus this share of the excess that the base model leaves [1]: the error of a law grows with its effect. Set on
    tuning cases."""
    max_excess_autocorrelation: float = 0.12
    """Part of the residual ratio that continues from frame to frame, above which something remains [1]. Set on tuning cases: it
    detects pusher wobble and gusts whose residuals are no larger than noise."""
    excess_autocorrelation_share: float = 0.02
    """Added to it: this share of the excess that the base model leaves [1]. Set on tuning cases."""
    max_p_value: float = 0.005
    """Probability under the model, below which either of the two counts [1]. Two tests: about one false alarm in a hundred at most."""
    min_promise: float = 3.0
    """Expected log Bayes factor beside all named effects, below which no wrench is fitted [nat]. Judgement."""
    imitating_effects: int = 2
    """Named effects from which a wrench is fitted in any case: together they may imitate it without a trace. Observed on tuning cases: a
    magnet under the table was fitted as a tether and an anisotropy."""
    part_cost: float = 2.0
    """Log evidence that a part of the wrench costs for having been chosen among all [nat]: 24 parts, and log 24 = 3.2 at most."""
    max_parts: int = 8
    """Parts of a wrench at most. With all 52 weights held-out pushes were predicted worse than without a wrench (5.4 against 4.6 mm)."""
    min_described_share: float = 0.2
    """Share of the wrench's evidence from which a part of it is described. Judgement."""
    max_start: float = 2.0
    """Length of a one-step estimate at which it is clipped before a fit [prior standard deviations]. As in the selection."""


@dataclass(frozen=True, slots=True)
class ResidualPolicy:
    """How residuals are compared with their expectation."""

    draws: int = 400
    """Draws of residuals under the model: the smallest p-value is 1/400, half of `UnknownPolicy.max_p_value`."""
    rest_speed: float = 0.01
    """Speed of the object below which a frame is at rest [m/s]. Judgement: a pose noise of 1 mm at 15 frames a second."""
    contact_share: float = 0.1
    """Share of the travel that counts as the contact phase; the same share at the end is the stop. For display only."""
    min_differences: int = 40
    """Differences of neighbouring frames in motion from which the correlation of their errors is estimated. Judgement: standard error
    0.16."""


@dataclass(frozen=True, slots=True)
class NextPushPolicy:
    """Which push is proposed, and when one is expected to resolve a tie."""

    candidates: int = 120
    """Candidate pushes, spread evenly over `speeds`. A limit of time."""
    speeds: tuple[float, ...] = (0.04, 0.12, 0.25)
    """Of the candidates [m/s]; some effects differ only in their dependence on speed. From the catalogue's signatures."""
    references: int = 20
    """Random pushes whose predictions decide which push teaches most of the maps. As many as on the page of an identification."""
    first_pose_std: tuple[float, float, float] = (0.01, 0.01, 0.1)
    """Standard deviation of the first pose beside what the frames show [m, m, rad]: a fit may place it anywhere. A wide prior."""
    min_mahalanobis2: float = 1.0
    """Squared Mahalanobis distance of the predictions from which a push is proposed [1]. Judgement: one standard deviation."""
    resolving_mahalanobis2: float = 9.0
    """And from which one push is expected to resolve the tie [1]: three standard deviations are rarely mistaken."""


@dataclass(frozen=True, slots=True)
class CameraPolicy:
    """Poses and outline from a camera: larger noise and larger margins, because errors of perception depend on the pose."""

    min_log_bayes_factor: float = 15.0
    """As `SelectionPolicy.min_log_bayes_factor` [nat]. Camera nulls brought up to 11 nat under the noise below, up to 18 before."""
    min_log_bayes_factor_single: float = 25.0
    """As in the selection [nat]. Scaled with the above; judgement."""
    tie_margin: float = 10.0
    """As in the selection [nat]. Scaled with the above; judgement."""
    min_log_bayes_factor_unknown: float = 30.0
    """As `UnknownPolicy.min_log_bayes_factor` [nat]. Camera nulls: edges displaced by their own amount at each place look like a wrench."""
    floor_position: float = 7e-4
    """Standard deviation of a pose that all frames of a rest share [m]. Perception of the simulated cell against its ground truth."""
    floor_yaw: float = 6e-3
    """The same of the yaw [rad]."""
    fit_discrepancy_position: float = 0.012
    """Model discrepancy a travel in a fit [1]: the edge that the pusher meets is displaced by its own amount at each place. One and a half
    times that of other poses; camera nulls."""
    fit_discrepancy_yaw: float = 0.12
    """The same of the yaw [rad/m]."""
    max_moving_frames: int = 10
    """Frames of a motion that are kept at most: neighbours share a pose-dependent error, so that more add nothing. Judgement."""
    max_deviations: float = 2.5
    """Fitted error of the camera in prior standard deviations (`EffectParameter.camera_std`), above which the camera itself is in question
    [1]. About one in eighty by chance for each number."""
    outlier_residual_ratio: float = 2.5
    """Residual ratio of one push above which it is an outlier [1]. In camera nulls single pushes had errors of 2 mm, others 0.2 mm."""
    max_outlier_share: float = 0.25
    """Share of the pushes that may be outliers; more have a common cause. Judgement."""


@dataclass(frozen=True, slots=True)
class DecisionPolicy:
    """All of them. Sealed with the code before a blind check: whoever changes a number scores it on new seeds."""

    gates: GatePolicy = field(default_factory=GatePolicy)
    selection: SelectionPolicy = field(default_factory=SelectionPolicy)
    validation: ValidationPolicy = field(default_factory=ValidationPolicy)
    account: AccountPolicy = field(default_factory=AccountPolicy)
    unknown: UnknownPolicy = field(default_factory=UnknownPolicy)
    residuals: ResidualPolicy = field(default_factory=ResidualPolicy)
    next_push: NextPushPolicy = field(default_factory=NextPushPolicy)
    camera: CameraPolicy = field(default_factory=CameraPolicy)

    def for_camera(self) -> DecisionPolicy:
        """The policy for poses and outlines that come from a camera: no margin falls, some rise."""
        selection, unknown, camera = self.selection, self.unknown, self.camera
        return replace(
            self,
            selection=replace(
                selection,
                min_log_bayes_factor=max(selection.min_log_bayes_factor, camera.min_log_bayes_factor),
                min_log_bayes_factor_single=max(selection.min_log_bayes_factor_single, camera.min_log_bayes_factor_single),
                tie_margin=max(selection.tie_margin, camera.tie_margin),
            ),
            unknown=replace(unknown, min_log_bayes_factor=max(unknown.min_log_bayes_factor, camera.min_log_bayes_factor_unknown)),
        )

    @property
    def sha256(self) -> str:
        """Hash of all values, hexadecimal."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()
