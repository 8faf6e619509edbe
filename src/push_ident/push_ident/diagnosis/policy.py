"""The decision policy: every number that decides what a diagnosis reports, in one place.

Each stage has a section. A field states its unit, its meaning and the evidence it was set on. Reasons that need more than a line are
decision records (docs/decisions, 32 to 42). Four sources recur:

- *tuning cases*: cases of the blind check with seeds below 1000 and of earlier report sets, in Bullet and in the planar engine
  (docs/results/blind.md). The published report set, seeds 31000 to 31019, was scored once under these numbers.
- *prototype*: bags of another engine with 14 random pushes of 1 mm noise, 13 effects in 52 cases and 14 effect-free ones.
- *camera nulls*: 20 effect-free objects, pushed in the simulated cell and perceived through rendered depth images.
- *judgement*: no measurement chose this value over its neighbours.

Log Bayes factors are natural logarithms [nat]: 5 are odds of 150 to 1.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from push_ident.physics.effect import Law
from push_ident.physics.effects import CAUSES


@dataclass(frozen=True, slots=True)
class GatePolicy:
    """When data or numerics cannot be trusted, so that the diagnosis abstains."""

    min_pushes: int = 3
    """Pushes that touch the object; with fewer, no push can be held out of a fit to at least two. Judgement."""
    max_gap: float = 0.01
    """Reported gap between a pusher and the object that it moves, up to which it counts as touching [m]: five prior standard deviations of
    a displaced tool."""
    min_frames: int = 6
    """Frames of a push from which missing frames are counted. Judgement."""
    missing_frame_interval: float = 1.8
    """Interval between frames, in medians of the push, from which a frame counts as missing: the next multiple is 2. Judgement."""
    max_missing_share: float = 0.3
    """Share of intervals of a push with a missing frame, from which it counts by its poses at rest only. Judgement."""
    jump_size: tuple[float, float, float] = (0.02, 0.02, 0.35)
    """Change of a pose that comes back, beyond noise, from which it counts as a jump [m, m, rad]; no push moves an object as far within a
    frame. Judgement from the speed of pushes (0.3 m/s at 15 frames a second)."""
    jump_deviations: float = 8.0
    """Stated standard deviations that are added to `jump_size` [1]. Judgement."""
    max_burst: float = 1.0
    """Longest time for which poses that jump away and come back together are left out [s]; longer ones remain. Judgement: twice what a
    tracker of motion capture was seen to lose a body for."""
    max_jump_share: float = 0.02
    """Share of poses that jump, below which data are accepted. Judgement: a tracker that flips by half a turn exceeds it."""
    min_rest_pairs: int = 80
    """Pairs of neighbouring frames at rest from which their correlation is known to a tenth: its standard error is 1/sqrt(n)."""
    max_step_effect: float = 0.2
    """Median change of end poses under half the time steps and half the smoothing speed, below which numerics are accepted, in standard
    deviations of the poses' noise [1]. Twice what the steps are chosen for (`physics/accuracy.py`); judgement."""
    max_floor: tuple[float, float] = (1e-3, 0.01)
    """Largest standard deviations of a pose that all frames of a rest share [m, rad], up to which poses count as no more exact than the
    time steps. Judgement: with those of a usual camera a diagnosis still says something."""
    step_margin: float = 1.2
    """Factor of the variance that this adds [1]: the median of the step effect then ends below its limit. Judgement."""


@dataclass(frozen=True, slots=True)
class SelectionPolicy:
    """What is expected before any push, what errors cost and what evidence is worth; which effects are refitted, added, or in a tie."""

    prior_nothing: float = 0.5
    """Probability that the base model leaves out nothing that matters [1]. Judgement: a cell is diagnosed because somebody doubts it."""
    prior_effects: float = 0.4
    """Probability that one effect of the catalogue acts, shared by all of them alike [1]. Judgement."""
    prior_something_else: float = 0.1
    """Probability that something else acts [1]. Judgement: a fifth of all gaps."""
    imitated_wholly: float = 0.05
    """Probability that what an effect explains alone is a cause outside the catalogue, whose law says nearly the same [1]."""
    imitated_in_part: float = 0.5
    """Probability that what effects explain is part of the trace of something else, where that leaves a structure beside them and
    held-out pushes are not certainly nearer to their prediction with them [1]; else it is `imitated_wholly`."""
    cost_false_alarm: float = 6.0
    """Cost of a cause where there is none, in that of a cause that is not reported [1]. With the prior it asks for a log Bayes factor of
    5.1 nat; with 5.0, 40 of 40 effect-free cases had no false alarm."""
    cost_wrong_name: float = 6.0
    """Cost of a wrong name, in that of leaving it open [1]. As a false alarm: both send somebody to repair what is in order."""
    discrepancy_first: float = 1.0
    """Factor by which the log evidence of a first effect is too large [1]. Set on tuning cases, as the following ones: with it, no false
    alarm in the published null cases."""
    discrepancy_next: float = 2.4
    """The same of an effect beside others, whose laws are not exactly those of the world [1]: 12 nat are needed."""
    discrepancy_next_share: float = 0.012
    """At least this times the log Bayes factors of all approximate laws found before [1/nat]: the error of a law grows with its effect. Of
    93 tuning cases, wrong effects brought up to 12 nat beside 107, a true one 19 beside 273."""
    discrepancy_rivals: float = 3.35
    """The same of the difference between two effects that explain the same pushes [1]: 6 nat exclude a rival, as in the prototype."""
    discrepancy_rivals_share: float = 0.056
    """At least this times the log Bayes factor of the effect that was found, where the law of the rival is approximate [1/nat]."""
    min_deficit_standard_errors: float = 2.0
    """Standard errors by which a rival is behind, above which it is excluded [1]: about 95 %, as of `min_gap_standard_errors`."""
    discrepancy_something_else: float = 1.0
    """Factor by which the log evidence of a structure in the residuals is too large [1]. Of 12 tuning cases without effects none had a log
    Bayes factor above -1.4, and of 16 whose effects were named rightly none above -1.0."""
    discrepancy_something_else_share: float = 0.02
    """The same beside effects, at least this times their log Bayes factors [1/nat], as of a further effect: an outline that was 3 mm too
    small in Bullet, which rounds its corners in another way, left a structure of 4 nat beside the right name."""
    usual_discrepancy: float = 2.0
    """Factor on the default up to which the size of a discrepancy is usual [1]; beyond it, effects are also looked for under the default.
    Also its standard deviation: effect-free pushes of the simulators have a third to the double."""
    larger_discrepancy: float = 5.0
    """Factor by which it is larger where each push departs from the model in a way of its own [1]. Recordings of others: 5 to 30."""
    relabellings: int = 200
    """Draws of pushes that are called the changed ones: the quantile below is known to a percent [1]."""
    chance_quantile: float = 0.975
    """Share of these draws in which a change gains no more than what is taken from its evidence [1]: of 40 recordings without a change one
    may have more."""
    min_promise_first: float = -2.0
    """Expected log Bayes factor below which a first effect is not refitted [nat]. The score test is of second order: the
    margin below `min_log_bayes_factor` is a judgement of its error."""
    min_promise_next: float = 0.5
    """The same of an effect beside others, which needs more evidence [nat]."""
    promise_share: float = 0.5
    """This share of the best score is added to `min_promise_first` [1]: an effect with many times less is no rival. On 25 tuning cases no
    effect within a tie of the best one had less than 0.7 of its score."""
    min_promised_share: float = 0.2
    """Share of the log Bayes factor that one more effect needs, below which the best score justifies no refit at all [1]. On 25 tuning
    cases no refit brought as much as was needed where the best score was below."""
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
    negligible: Mapping[str, float] = field(default_factory=lambda: {"s": 2e-3, "m": 1e-4, "rad": 1e-3, "": 1e-3, "N": 0.1})
    """Size by unit below which an effect with an exact law is negligible and becomes part of the base model: no clock, surface or scale of
    a cell is known better. Set on poses of 0.02 to 0.05 mm noise: without this, 7 of 15 effect-free objects in Bullet were diagnosed with
    0.5 to 0.8 ms of lag or latency."""

    @property
    def log_prior_effect(self) -> float:
        """Log prior odds of one effect against nothing [nat]."""
        return math.log(self.prior_effects / len(CAUSES) / self.prior_nothing)

    @property
    def log_prior_something_else(self) -> float:
        """Log prior odds of something else against nothing [nat]."""
        return math.log(self.prior_something_else / self.prior_nothing)

    @property
    def detection_log_bayes_factor(self) -> float:
        """Log Bayes factor of one effect at which silence costs as much as a false alarm [nat]."""
        return math.log(self.cost_false_alarm) - self.log_prior_effect

    @property
    def log_cost_wrong_name(self) -> float:
        """Log odds at which a wrong name costs as much as leaving it open [nat]."""
        return math.log(self.cost_wrong_name)

    @property
    def max_probability_of_nothing(self) -> float:
        """Probability of nothing below which something is reported [1]."""
        return 1.0 / (1.0 + self.cost_false_alarm)

    @property
    def max_probability_of_error(self) -> float:
        """Probability of another cause above which a name is left open [1]."""
        return 1.0 / (1.0 + self.cost_wrong_name)

    @property
    def min_log_bayes_factor(self) -> float:
        """Log Bayes factor from which a first effect is detected [nat]: to leave it out would then cost more than a false alarm."""
        return self.discrepancy_first * self.detection_log_bayes_factor

    @property
    def min_log_bayes_factor_next(self) -> float:
        """The same of an effect beside others [nat]."""
        return self.discrepancy_next * self.detection_log_bayes_factor

    @property
    def tie_margin(self) -> float:
        """Differences of log evidence below this are a tie [nat]: to exclude the rival could cost more than to leave it open."""
        return self.discrepancy_rivals * self.log_cost_wrong_name

    def tie_margin_of(self, law: Law, log_bayes_factor: float) -> float:
        """That of a rival with a law over an effect with a log Bayes factor [nat].

        It grows with the evidence for an approximate law: where it is the true effect, its law still differs from the world's.
        """
        share = 0.0 if law is Law.EXACT else self.discrepancy_rivals_share
        return self.log_cost_wrong_name * max(self.discrepancy_rivals, share * log_bayes_factor)


@dataclass(frozen=True, slots=True)
class ValidationPolicy:
    """What held-out pushes have to confirm."""

    max_folds: int = 7
    """Fits without some pushes; with more pushes, two or more are held out together. A limit of time, not of evidence."""
    min_gap_standard_errors: float = 2.0
    """Standard errors by which the held-out error exceeds the pose noise, above which there is a gap to close [1]. About 95 %,
    two-sided."""
    min_log_bayes_factor_without_push: float = -1.0
    """Log Bayes factor in the fit without any one fold, from which an effect is supported [nat]. Of 31 true effects with 14 pushes, 30 kept
    a third of their evidence and more. With six pushes some of 21 kept hardly any, so that any gain suffices, up to rounding of fits."""
    max_p_value: float = 0.05
    """Of the sizes of an effect in fits without some of the pushes, if it did not act, up to which they agree that it does [1]."""
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
    seeds below 50, 6 and 14 pushes; decision 21), where maps mispredicted held-out pushes by 0.76 of what the posterior states: a fit
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
    """When the cause lies outside the catalogue: residuals have a structure that no named law explains, or are too large."""

    draws: int = 400
    """Draws of the noise that pass through the search for structure: the smallest p-value is 1/401."""
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


@dataclass(frozen=True, slots=True)
class ResidualPolicy:
    """How residuals are compared with their expectation."""

    draws: int = 1000
    """Draws of residuals under the model: p-values down to 1/1000 are counted, smaller ones extrapolated."""
    rest_speed: float = 0.01
    """Speed of the object below which a frame is at rest [m/s]. Judgement: a pose noise of 1 mm at 15 frames a second."""
    contact_share: float = 0.1
    """Share of the travel that counts as the contact phase; the same share at the end is the stop. For display only."""
    min_differences: int = 40
    """Differences of neighbouring frames in motion from which the correlation of their errors is estimated. Judgement: standard error
    0.16."""


@dataclass(frozen=True, slots=True)
class NextPushPolicy:
    """Which push is proposed."""

    candidates: int = 39
    """Candidate pushes, spread evenly over `speeds`. A limit of time."""
    speeds: tuple[float, ...] = (0.04, 0.12, 0.25)
    """Of the candidates [m/s]; some effects differ only in their dependence on speed. From the catalogue's signatures."""
    references: int = 20
    """Random pushes whose predictions decide which push teaches most of the maps. As many as on the page of an identification."""


@dataclass(frozen=True, slots=True)
class CameraPolicy:
    """Poses and outline from a camera, whose errors depend on the pose."""

    max_moving_frames: int = 10
    """Frames of a motion that are kept at most: neighbours share a pose-dependent error, so that more add nothing. Judgement."""
    max_deviations: float = 2.5
    """Fitted error of the camera in prior standard deviations (`EffectParameter.camera_std`), above which the camera itself is in question
    [1]. About one in eighty by chance for each number."""


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

    @property
    def sha256(self) -> str:
        """Hash of all values, hexadecimal."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()
