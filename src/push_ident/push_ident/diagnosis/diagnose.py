"""From pushes to a verdict: the stages in their order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from push_ident.diagnosis.base_fit import fit_base_model
from push_ident.diagnosis.camera import camera_is_in_question, camera_settings, question_camera
from push_ident.diagnosis.decide import decide
from push_ident.diagnosis.earlier import EarlierFits
from push_ident.diagnosis.explain import explain
from push_ident.diagnosis.gates import check_pushes, reference_pushes
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.select import select
from push_ident.diagnosis.settings import DiagnosisSettings, Progress
from push_ident.diagnosis.state import DiagnosisState
from push_ident.diagnosis.validate import validate
from push_ident.errors import InputError
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.effects import EFFECTS
from push_ident.pushing.push import PushSettings
from push_ident.simulators.gap import simulator_gap
from push_ident.simulators.protocol import PushSimulator
from push_ident.types import PushRecord


def with_simulator(
    diagnosis: Diagnosis,
    records: Sequence[PushRecord],
    simulator: PushSimulator,
    prior: Prior | None = None,
    *,
    nuisances: Sequence[str] = (),
    on_progress: Progress | None = None,
) -> Diagnosis:
    """A diagnosis of pushes with the gap of somebody else's simulator on them, divided by the causes that were found.

    `nuisances`: names of effects that all fits have. Raises InputError as `simulator_gap` does.
    """
    names = [effect.name for effect in diagnosis.effects]
    gap = simulator_gap(records, simulator, prior, effects=names, nuisances=nuisances, on_progress=on_progress)
    return replace(diagnosis, simulator=gap)


def diagnose(
    records: Sequence[PushRecord],
    settings: DiagnosisSettings | None = None,
    *,
    against: Sequence[PushRecord] = (),
    push_settings: PushSettings | None = None,
    proposes_push: bool = True,
    earlier: Diagnosis | None = None,
    on_progress: Progress | None = None,
) -> Diagnosis:
    """Explain why a simulation differs from pushes of one object.

    Args:
        records: the pushes, in the order in which they were made.
        settings: of the base model and of the decisions.
        against: pushes of the same object in the same cell while all was well. What both recordings share is then no cause: effects are
            changes since.
        push_settings: limits of the push that is proposed.
        proposes_push: False saves the time of looking for one.
        earlier: outcome for the first of these pushes: fits start at its fits, which takes less time and may end in another minimum of
            a cost with kinks, within the tolerance of the fits. Where its pushes are others, it is not used.
        on_progress: called with what is under way.

    Raises:
        InputError: no push, pushes of different objects, a reference that cannot be used, or an unknown effect in the base model.
    """
    report = on_progress or (lambda text: None)
    state = check_pushes(initial_state(records, settings or DiagnosisSettings()))
    if against and not state.abstains:
        state = replace(state, reference=reference_pushes(state, against))
    if earlier is not None and earlier.selection is not None and earlier.held_out is not None:
        selection = earlier.selection
        whole = [selection.base, selection.fit, *selection.stages.values()]
        state = replace(state, earlier=EarlierFits.of(state.records, whole, earlier.held_out.fits))
    state = select(fit_base_model(state, report), report)
    if camera_is_in_question(state):
        report("the camera is less accurate than a calibrated one: its errors are effects now")
        state = select(fit_base_model(question_camera(state), report), report)
    return explain(decide(validate(state, report)), push_settings, report, proposes_push=proposes_push)


def initial_state(records: Sequence[PushRecord], settings: DiagnosisSettings) -> DiagnosisState:
    """The state before the first stage. Raises InputError where there is no push, or an unknown effect in the base model."""
    if not records:
        raise InputError("There is no push to diagnose; give at least three.")
    if missing := [name for name in settings.base_effects if name not in EFFECTS]:
        raise InputError(f"There is no effect `{missing[0]}`; choose from {', '.join(EFFECTS)}.")
    from_camera = settings.outline_from_camera or records[0].shape.outline_std is not None
    in_force = camera_settings(settings, records) if from_camera else settings
    return DiagnosisState(tuple(records), requested=settings, settings=in_force, from_camera=from_camera)
