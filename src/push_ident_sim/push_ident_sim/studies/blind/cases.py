"""The cases of the blind check, all drawn from the case's seed, and their seal: truth, policy and code are fixed before scoring."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.errors import InputError
from push_ident.files import write_whole
from push_ident.offline.loading import load_pushes
from push_ident.physics.effects import CAUSES
from push_ident.types import PushRecord
from push_ident_sim.code_digest import CORE, code_digest, code_of
from push_ident_sim.engines.planar import OUTSIDE, PlanarWorld
from push_ident_sim.injected import INJECTED, InjectedEffect, InjectedEffects
from push_ident_sim.injected.shared import mean_friction
from push_ident_sim.objects import OBJECT_NAMES, SimObject, make_object
from push_ident_sim.recordings.recording import RecordingSettings, record_pushes, seal
from push_ident_sim.recordings.truth import (
    CameraNoise,
    TrueMotion,
    TruthSettings,
    make_pushes,
    observe_motion,
    true_model,
)
from push_ident_sim.studies.common.study import Case, Json

FIRST_REPORT_MODEL = 1000
"""Ground truths from this seed on are scored once; those below are there to set thresholds."""
_SIZES = (0.15, 0.5, 1.2, 3.0)
"""Times the typical size."""
_HARDLY_DETECTABLE = ("restitution", "stribeck_friction", "wear", "speed_dependent_friction", "tether", "camera_translation")
_PAIRABLE = tuple(name for name in CAUSES if name not in _HARDLY_DETECTABLE)
"""Effects that slow pushes show, one of each pair of exact twins."""
_ELSEWHERE = ("pose_flips", "compliant_table", "viscous_film", "rolling_finger", "pusher_wobble")
"""Effects that both engines have and whose law no diagnosis holds."""
_FEWEST, _MOST = 6, 20
"""Pushes of cases that are all nulls."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """What one case is about; signs, directions and the last digits of sizes are drawn with the case."""

    engine: str
    """`bullet`, `planar`, or `camera`: Bullet through rendered depth images."""
    kind: str
    """`null`, `single`, `pair`, `foreign` (a law that the catalogue does not hold, of a mechanism that it holds), `outside`."""
    names: tuple[str, ...] = ()
    size: float = 1.0
    """Times the typical one."""


@dataclass(frozen=True, slots=True)
class Truth:
    """What is in one case."""

    scenario: Scenario
    effects: InjectedEffects
    """Of the catalogue of injected effects, with what merely disturbs (correlated noise, dropped frames)."""
    outside: tuple[tuple[str, float], ...]
    """Effects that only the planar engine has."""

    @property
    def names(self) -> tuple[str, ...]:
        """Effects that a diagnosis should name."""
        return self.scenario.names if self.scenario.kind in ("single", "pair") else ()

    def as_json(self) -> Json:
        """For the seal, and for the tables."""
        (mechanism,) = {_foreign(name).mechanism for name in self.scenario.names} if self.scenario.kind == "foreign" else {""}
        return {
            "mechanism": mechanism,
            "engine": self.scenario.engine,
            "kind": self.scenario.kind,
            "names": list(self.scenario.names),
            "size": self.scenario.size,
            "effects": {name: list(values) for name, values in self.effects.values},
            "outside": dict(self.outside),
        }


def phase_of(model: int) -> str:
    """`tune` or `report`."""
    return "report" if model >= FIRST_REPORT_MODEL else "tune"


@cache
def _plan() -> tuple[Scenario, ...]:
    """One round of scenarios in an order in which any part of it holds some of each."""
    plan: list[Scenario] = []
    rng = np.random.default_rng(20)
    for engine in ("bullet", "planar"):
        plan += [Scenario(engine, "null")] * 20
        # Bullet's spring is anchored anew at every push: no tether of the catalogue, which has one place on the table.
        plan += [Scenario(engine, "single", (name,), s) for name in CAUSES for s in _SIZES if (engine, name) != ("bullet", "tether")]
        for _ in range(12):
            first, second = rng.choice(len(_PAIRABLE), 2, replace=False)
            plan.append(Scenario(engine, "pair", (_PAIRABLE[first], _PAIRABLE[second]), 1.5))
        plan += [_without_a_law(engine, name, s) for name in _ELSEWHERE for s in (1.0, 3.0)]
    plan += [_without_a_law("planar", name, s) for name in OUTSIDE for s in (1.0, 2.0)]
    return tuple(plan[i] for i in rng.permutation(len(plan)))


def _without_a_law(engine: str, name: str, size: float) -> Scenario:
    return Scenario(engine, "foreign" if _foreign(name).mechanism else "outside", (name,), size)


def _foreign(name: str) -> InjectedEffect:
    return OUTSIDE[name] if name in OUTSIDE else INJECTED[name]


def n_pushes_of_null(object_name: str, model: int) -> int:
    """Pushes of a case of the variant of nulls."""
    return int(np.random.default_rng([model, OBJECT_NAMES.index(object_name), 78]).integers(_FEWEST, _MOST + 1))


def draw_truth(object_name: str, model: int, variant: str = "") -> Truth:
    """The truth of a case: the plan gives the scenario, the seed the rest. Where it is filmed, what no camera can film becomes a null;
    in the variant of nulls all are."""
    filmed = variant == CAMERA
    # A report begins at the other end of the plan than tuning did.
    first, plan = (FIRST_REPORT_MODEL, _plan()[::-1]) if phase_of(model) == "report" else (0, _plan())
    scenario = plan[((model - first) * len(OBJECT_NAMES) + OBJECT_NAMES.index(object_name)) % len(plan)]
    if filmed:
        can_be = all(name in INJECTED and name != "tether" and INJECTED[name].acts_on != "poses" for name in scenario.names)
        scenario = replace(scenario, engine="camera") if can_be else Scenario("camera", "null")
    elif variant == NULLS:
        scenario = Scenario(("bullet", "planar")[model % 2], "null")
    rng = np.random.default_rng([model, OBJECT_NAMES.index(object_name), 77])
    values: dict[str, tuple[float, ...]] = {}
    outside: list[tuple[str, float]] = []
    for name in scenario.names:
        size = scenario.size * float(np.exp(0.2 * rng.normal()))
        if name in OUTSIDE:
            (parameter,) = OUTSIDE[name].parameters
            outside.append((name, min(size * parameter.typical, parameter.highest)))
        else:
            values[name] = _drawn(INJECTED[name], size, make_object(object_name, model), rng)
    # What every camera may do to anyone.
    disturbance = rng.random(2)
    if scenario.kind == "null" and disturbance[0] < 0.4 and not filmed:
        values["noise_correlation"] = (float(rng.uniform(0.3, 0.6)),)
    if scenario.kind == "null" and disturbance[1] < 0.25:
        values["dropped_frames"] = (float(rng.uniform(0.05, 0.2)),)
    return Truth(scenario, InjectedEffects.of(values), tuple(outside))


def _drawn(effect: InjectedEffect, size: float, sim_object: SimObject, rng: np.random.Generator) -> tuple[float, ...]:
    """Parameters of an effect at `size` times its typical size, in any direction or of either sign, within its range."""
    acting = effect.acting
    length = size * acting[0].typical
    if len(acting) == 2:
        angle = rng.uniform(-np.pi, np.pi)
        drawn = [length * np.cos(angle), length * np.sin(angle)]
    else:
        drawn = [length * (rng.choice([-1.0, 1.0]) if acting[0].lowest < 0 else 1.0)]
    kept = [float(np.clip(v, max(p.lowest, -0.9 * p.highest), 0.9 * p.highest)) for v, p in zip(drawn, acting, strict=True)]
    kept = [float(np.sign(v) * max(abs(v), p.smallest)) for v, p in zip(kept, acting, strict=True)]
    scaled = [v * mean_friction(sim_object) if p.times_friction else v for v, p in zip(kept, acting, strict=True)]
    return (*scaled, *effect.defaults[len(acting) :])


def make_records(truth: Truth, object_name: str, model: int, n_pushes: int, noise: CameraNoise) -> list[PushRecord]:
    """The observed pushes of a case; the first ones do not depend on their number.

    `model`: seed of the object, of the pushes and of all noise. A rendered camera has its own noise in place of `noise`. Raises
    PushIdentError where the object tips over, or was not perceived.
    """
    if truth.scenario.engine == "camera":
        return _filmed(truth, object_name, model, n_pushes)
    sim_object = make_object(object_name, model)
    settings = replace(TruthSettings(n_train=n_pushes, n_test=0), effects=truth.effects)
    seed = [model, OBJECT_NAMES.index(object_name), 5]
    engine = _planar(truth, sim_object, settings) if truth.scenario.engine == "planar" else None
    motions = make_pushes(sim_object, seed, settings, engine=engine)
    return [_observed(truth, sim_object, motion, [*seed, i, 1], i, noise) for i, motion in enumerate(motions)]


def _planar(truth: Truth, sim_object: SimObject, settings: TruthSettings) -> PlanarWorld:
    radius = settings.pushes.pusher_radius
    return PlanarWorld(sim_object, radius, time_step=settings.time_step, effects=truth.effects, outside=dict(truth.outside))


def _observed(truth: Truth, sim_object: SimObject, motion: TrueMotion, seed: list[int], number: int, noise: CameraNoise) -> PushRecord:
    observed = observe_motion(motion, TruthSettings().pushes.pusher_radius, noise, np.random.default_rng(seed), truth.effects)
    return PushRecord(sim_object.name, true_model(sim_object).shape, *observed, f"push {number + 1}", number)


def _filmed(truth: Truth, object_name: str, model: int, n_pushes: int) -> list[PushRecord]:
    """Depth images of Bullet's world, in which object and poses are then perceived."""
    settings = RecordingSettings(object_name, model, n_pushes, model, truth.effects, camera=True)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "pushes"
        record_pushes(bag, settings)
        return load_pushes([bag]).records


CAMERA: Final = "camera"
"""Variant through rendered depth images and perception."""
NULLS: Final = "nulls"
"""Variant without any effect, with 6 to 20 pushes."""
ENGINES: Final = "engines"
"""Variant that compares the engines; it has no truth to be sealed."""
DECIDING_PACKAGES: Final = ("geometry", "physics", "pushing", "identification", "diagnosis", "perception")
"""Packages of the core whose code decides what a diagnosis reports."""


def decision_hashes() -> dict[str, str]:
    """SHA-256 of the values of the default policy, and of the code that decides (without comments and docstrings), hexadecimal."""
    return {"policy_sha256": DiagnosisSettings().policy.sha256, "code_sha256": _code_sha256()}


@cache
def _code_sha256() -> str:
    return code_digest(code_of(CORE, DECIDING_PACKAGES))


def seal_cases(cases: Sequence[Case], folder: Path) -> Json:
    """Write the hashes of truth, policy and code before anything is scored.

    A report set is scored by one policy and one code only: once its seal lies in `folder`, others are refused. Raises InputError for that,
    and for cases of both phases in one run.
    """
    phases = {phase_of(case.model) for case in cases}
    if len(phases) > 1:
        raise InputError("Seeds below 1000 are for setting the policy, those from 1000 on are scored once; give --seed to separate them.")
    truths = [_truth_of(case) for case in cases if case.variant != ENGINES]
    sealed: Json = {
        "phase": phases.pop(),
        "n_cases": len(truths),
        "truth_sha256": seal({"cases": truths}),
        # As it is read back from the file.
        "policy": json.loads(json.dumps(asdict(DiagnosisSettings().policy))),
        **decision_hashes(),
    }
    if sealed["phase"] == "tune":
        return sealed
    path = folder / f"sealed-{sealed['truth_sha256'][:16]}.json"
    if path.is_file():
        before: Json = json.loads(path.read_text(encoding="utf-8"))
        for what in ("policy", "code"):
            if before.get(f"{what}_sha256") != sealed[f"{what}_sha256"]:
                raise InputError(f"These cases were scored with another {what} ({path}); take other seeds from 1000 on for this one.")
        return before
    write_whole(path, json.dumps(sealed, indent=1) + "\n", "the sealed cases")
    return sealed


def _truth_of(case: Case) -> Json:
    truth = draw_truth(case.object_name, case.model, case.variant)
    return {"case": case.key, "object": case.object_name, "model": case.model, **truth.as_json()}
