"""Derivatives of poses and impulses: every column against differences of known accuracy, and the adjoint against the Jacobian."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from helpers.random_pushes import CLASSES, DT, ENGINES, Case, fixed_seeds, line_tool_case, random_case, steps_of
from push_ident.physics.active_effects import NO_MODES
from push_ident.physics.effect import OnTable
from push_ident.physics.effect_values import EffectValues, effect_values
from push_ident.physics.effects import CAUSES, EFFECTS
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import BodyParameters, Motion, SimulationSettings, simulate_body, simulate_body_with_pullback
from push_ident.types import Float64Array, SolveStatus

ORDER = 3.0
NONE = effect_values(None)
RESOLVED_EFFECTS = ("outline_error", "pose_latency", "pusher_lag", "restitution", "table_anisotropy", "table_tilt")
ADJOINT = {"circle": 1e-10, "quasi-static": 1e-10, "pyramid": 1e-8}
"""Rounding of the adjoint. A cell of the pyramid that sticks costs more digits, with effects and without."""


def ridders(f: Callable[[float], Float64Array], h: float, *, one_sided: bool) -> tuple[Float64Array, float]:
    """Derivative of f at 0 from differences over h, h / 2, h / 4, ..., extrapolated to zero length, and how far it may be off.

    Source: Ridders, Accurate computation of F'(x) and F'(x) F''(x), 1982.
    """
    base = 2.0 if one_sided else 4.0
    before: list[Float64Array] = []
    best, least = np.empty(0), np.inf
    at_zero = f(0.0) if one_sided else None
    for i in range(5):
        step = h / 2**i
        row = [(f(step) - at_zero) / step if at_zero is not None else (f(step) - f(-step)) / (2 * step)]
        for j, old in enumerate(before):
            row.append(row[j] + (row[j] - old) / (base ** (j + 1) - 1))
            error = float(max(np.abs(row[-1] - row[-2]).max(), np.abs(row[-1] - old).max()))
            if error < least:
                best, least = row[-1], error
        before = row
    return best, least


def some_values(names: tuple[str, ...], seed: int) -> EffectValues:
    """Values of about the typical size, off their null values and within their ranges; a latency shorter than these short pushes."""
    values = []
    for name in names:
        rng = np.random.default_rng([seed, *name.encode()])
        for p in EFFECTS[name].parameters:
            size = 0.2 * p.typical if name == "pose_latency" else p.typical
            sign = 1.0 if p.low == 0.0 else rng.choice([-1.0, 1.0])
            values.append(p.nominal + sign * size * rng.uniform(0.3, 0.7))
    return effect_values(names).with_values(values)


class Compared:
    """Columns whose differences are certain, by what the contact did; largest errors, relative to a hundredth of the motion at least."""

    def __init__(self) -> None:
        self.kinds: Counter[str] = Counter()
        self.n = self.n_certain = 0
        self.worst = {"pose": 0.0, "impulse": 0.0, "adjoint": 0.0}

    def add(
        self,
        case: Case,
        how: SimulationSettings,
        effects: EffectValues = NONE,
        *,
        between: bool = False,
        only_effects: bool = False,
        modes: Float64Array = NO_MODES,
    ) -> None:
        """Compare all columns of a push, or those of the effects and of the `modes` of the outline; `between` the steps' ends no latency
        has a kink."""
        body, mu = case.body, case.model.pusher_friction
        n, ends = 8 + len(body.limit), case.pusher.time
        within = np.r_[ends[1:-1] + 0.4 * np.diff(ends[1:]), ends[-1]]
        point = np.r_[case.pose, body.mass, body.centre, body.inertia, mu, body.limit, effects.values, np.zeros(len(modes))]
        m = n + len(effects)
        typical = [*(p.typical for p in effects.parameters), *np.full(len(modes), 1e-3)]
        scale = np.r_[0.05, 0.05, 1.0, body.mass, 0.05, 0.05, body.inertia, 0.5, np.full(len(body.limit), body.limit.mean()), typical]
        # A small friction coefficient of the pusher leaves no room below it.
        low = [
            max(p.low, -mu) if label == "pusher_friction.excess" else p.low
            for label, p in zip(effects.labels, effects.parameters, strict=True)
        ]
        low = np.r_[np.full(7, -np.inf), np.zeros(n - 7), low, np.full(len(modes), -np.inf)]

        def arguments(q: Float64Array):  # type: ignore[no-untyped-def]
            scenario = PushScenario(case.pusher, q[:3], ends[:-1] + 0.4 * (ends[1] - ends[0]) if between else ends, ORDER, within)
            shape = case.model.shape
            if len(modes):
                shape = replace(shape, outline=shape.outline + np.tensordot(q[m:], modes, axes=1))
            return shape, BodyParameters(q[3], q[4:6], q[6], q[8:n], modes), q[7], scenario

        def simulated(q: Float64Array, *, jacobian: bool = False) -> Motion:
            return simulate_body(*arguments(q), settings=how, effects=effects.with_values(q[n:m]), jacobian=jacobian)

        motion = simulated(point, jacobian=True)
        assert motion.status is not SolveStatus.SIMULATION_FAILED
        certain = 0
        for column in range(n if only_effects else 0, len(point)):
            first = 1e-4 if column in (3, 6) else 3e-5 if column < 7 else 1e-3
            unit = scale[column] * np.eye(len(point))[column]
            moved = lru_cache(lambda h, unit=unit: simulated(point + h * unit))  # type: ignore[misc]
            one_sided = point[column] < low[column] + first * scale[column]
            both = True
            for name, limit, whole, exact in (
                ("pose", 1e-7, np.abs(motion.pose - case.pose).max(), motion.jacobian),
                ("impulse", 1e-6, np.abs(motion.impulse).max(), motion.impulse_jacobian),
            ):
                estimate, uncertain = ridders(lambda h, f=moved, name=name: getattr(f(h), name), first, one_sided=one_sided)  # type: ignore[misc]
                exact = exact[..., column] * scale[column]
                size = max(float(np.abs(exact).max()), 0.01 * float(whole), 1e-9)
                # Differences that straddle a switch of the contact prove nothing, nor do those that vanish in rounding.
                rounding = np.spacing(np.abs(getattr(motion, name)).max()) / first
                if max(uncertain, rounding) < limit * size:
                    self.worst[name] = max(self.worst[name], float(np.abs(exact - estimate).max()) / size)
                else:
                    both = False
            certain += both
        self.n, self.n_certain = self.n + len(point) - (n if only_effects else 0), self.n_certain + certain
        _, pull_back = simulate_body_with_pullback(*arguments(point), settings=how, effects=effects)
        self.worst["adjoint"] = max(self.worst["adjoint"], adjoint_error(motion, pull_back))
        if between:
            return
        steps = steps_of(case, motion)
        kinds = {step.kind for step in steps} | {"turning" for step in steps if step.turning and step.force.any()}
        self.kinds.update({kind: certain for kind in kinds})

    def check(self, adjoint: float, doubtful: float) -> None:
        print(f"{self.n_certain} of {self.n} columns, {self.worst}, {dict(self.kinds)}")
        assert self.worst["pose"] <= 1e-6 and self.worst["impulse"] <= 1e-5 and self.worst["adjoint"] <= adjoint
        assert self.n_certain >= (1.0 - doubtful) * self.n


def adjoint_error(motion: Motion, pull_back) -> float:  # type: ignore[no-untyped-def]
    by_pose = np.random.default_rng(1).normal(size=motion.pose.shape)
    terms = np.abs(by_pose[:, :, None] * motion.jacobian).sum(axis=(0, 1))
    by_all = np.einsum("fi,fip->p", by_pose, motion.jacobian)
    return float((np.abs(pull_back(by_pose) - by_all) / (terms + 1e-6 * terms.max())).max())


@pytest.mark.parametrize("mode", ENGINES)
def test_every_column_equals_differences_to_six_digits(mode: str) -> None:
    compared = Compared()
    for seed in fixed_seeds(16):
        compared.add(random_case(seed, 9 + seed % 7, seed % 2 == 1, 5), ENGINES[mode])
    compared.check(ADJOINT[mode], 0.2)
    assert all(compared.kinds[kind] >= 20 for kind in CLASSES if (kind, mode) != ("separating", "quasi-static"))


@pytest.mark.parametrize("mode", ENGINES)
def test_all_columns_are_exact_while_all_effects_act_at_once(mode: str) -> None:
    left_out = {"circle": set(), "quasi-static": {"restitution"}, "pyramid": {n for n in CAUSES if isinstance(EFFECTS[n].acts, OnTable)}}
    compared = Compared()
    for seed in range(3):
        compared.add(
            random_case(seed, 9 + seed, seed % 2 == 1, 5), ENGINES[mode], some_values(tuple(sorted({*CAUSES} - left_out[mode])), seed)
        )
    compared.check(ADJOINT[mode], 0.2)


@pytest.mark.parametrize("names", [(), RESOLVED_EFFECTS], ids=["base model", "effects"])
def test_all_columns_are_exact_where_events_are_resolved_within_steps(names: tuple[str, ...]) -> None:
    compared = Compared()
    for seed in range(6):
        how = SimulationSettings(step=0.4 * DT, resolve_events=True)
        compared.add(random_case(seed, 9 + seed, seed % 2 == 1, 5), how, some_values(names, seed), between=True)
    compared.check(1e-9, 0.2)


@pytest.mark.parametrize("mode", ENGINES)
@pytest.mark.parametrize("names", [(), ("outline_error", "pusher_friction", "restitution")], ids=["base model", "effects"])
def test_columns_of_displaced_vertices_are_exact(mode: str, names: tuple[str, ...]) -> None:
    names = tuple(name for name in names if not (EFFECTS[name].needs_inertia and mode == "quasi-static"))
    compared = Compared()
    for seed in range(12):
        case = random_case(seed, 9 + seed % 7, seed % 2 == 1, 5)
        modes = np.random.default_rng(seed).normal(size=(4, *case.model.shape.outline.shape))
        compared.add(case, ENGINES[mode], some_values(names, seed), only_effects=True, modes=modes)
    compared.check(max(ADJOINT[mode], 1e-9), 0.3)
    assert all(compared.kinds[kind] >= 10 for kind in ("sticking", "sliding"))


@pytest.mark.parametrize("name", CAUSES)
def test_columns_of_an_effect_are_exact_at_the_null_value_where_absence_is_tested(name: str) -> None:
    compared = Compared()
    for seed in range(4):
        compared.add(
            random_case(seed, 9 + seed, seed % 2 == 1, 5), ENGINES["circle"], effect_values((name,)), between=True, only_effects=True
        )
    compared.check(ADJOINT["circle"], 0.25)


@pytest.mark.parametrize("mode", ENGINES)
@pytest.mark.parametrize(("tool", "on_corner"), [("plate", False), ("fingers", False), ("fingers", True)])
def test_every_column_is_exact_for_tools_with_two_contacts(tool: str, on_corner: bool, mode: str) -> None:
    compared = Compared()
    for seed in fixed_seeds(8):
        compared.add(line_tool_case(seed, tool, 5, on_corner=on_corner), ENGINES[mode])
    compared.check(max(ADJOINT[mode], 1e-9), 0.35)
    assert all(compared.kinds[kind] >= 20 for kind in (("cornered",) if on_corner else ("sticking", "sliding")))
