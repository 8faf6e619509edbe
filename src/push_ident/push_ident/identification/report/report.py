"""The identification report: one page, the most important results first."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from push_ident import __version__
from push_ident.errors import InputError
from push_ident.files import write_whole
from push_ident.identification.predicting.next_push import N_CANDIDATES, propose_push
from push_ident.identification.predicting.prediction import PushErrors
from push_ident.identification.predicting.scoring import PushScore, summarise_scores
from push_ident.identification.report.figures import draw_errors, draw_maps, draw_push, draw_record, shown_pushes
from push_ident.identification.results.identifiability import Identifiability, Quantity, before_text, identifiability, value_text
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.results.result import Candidate, Identification
from push_ident.identification.results.supports import Support, supports
from push_ident.pages.page import FigureSection, page_text
from push_ident.types import SolveStatus


@dataclass(frozen=True, slots=True)
class Provenance:
    """Sources of the data."""

    object_id: str
    sources: tuple[str, ...]
    """One line per push of the fit."""
    notes: tuple[str, ...] = ()
    """Missing, dropped or assumed data."""


def write_report(
    path: Path,
    result: Identification,
    train: PushErrors,
    test: PushErrors,
    provenance: Provenance,
    pusher_radius: float,
    record: Sequence[PushScore] = (),
    sections: Sequence[FigureSection] = (),
) -> None:
    """Write the page of `report_text` to `path`. Raises InputError where it cannot be written."""
    write_whole(path, report_text(result, train, test, provenance, pusher_radius, record, sections), "the report", error=InputError)


def report_text(
    result: Identification,
    train: PushErrors,
    test: PushErrors,
    provenance: Provenance,
    pusher_radius: float,
    record: Sequence[PushScore] = (),
    sections: Sequence[FigureSection] = (),
) -> str:
    """The page of an identification.

    Args:
        result: of the identification.
        train: errors of the pushes of the fit.
        test: errors of the held-out pushes; may be empty.
        provenance: sources of the data.
        pusher_radius: of the pusher that would make the next push [m].
        record: predictions made before each push, in order.
        sections: further figures.

    Returns:
        HTML, all in one file.
    """
    posterior = result.posterior
    known = identifiability(posterior)
    context = {
        "title": f"Object {provenance.object_id}: mass and friction",
        "headline": _headline(result, train, test, known),
        "warning": "" if result.status is SolveStatus.CONVERGED else f"Do not use these maps without a check: {result.status.value}.",
        "maps": draw_maps(posterior),
        "errors": draw_errors(train, test),
        "n_shown": len(shown_pushes(train, test)),
        "n_pushes": len(train.pushes) + len(test.pushes),
        "error_rows": [_error_row("pushes of the fit", train), _error_row("held-out pushes", test)],
        "held_out": bool(test.pushes),
        "record": _record(record),
        "sections": sections,
        "quantities": [_quantity(q) for q in known.quantities],
        "legend": dict.fromkeys(q.knowledge.value for q in known.quantities),
        "priors": _candidates(result.candidates),
        "n_combinations": len(known.combinations),
        "n_pinned": known.n_pinned,
        "n_open": known.n_open,
        "next_push": _next_push(posterior, pusher_radius),
        "provenance": _provenance(result, provenance),
    }
    return page_text(__package__ or "", "report.html.j2", context)


def _headline(result: Identification, train: PushErrors, test: PushErrors, known: Identifiability) -> str:
    posterior = result.posterior
    centre = posterior.model.centre_of_friction
    spread = {q.name: q.std for q in known.quantities}
    centre_text = (
        f"the centre of friction is at ({1e3 * centre[0]:z.0f} ± {1e3 * spread['centre of friction x']:.0f}, "
        f"{1e3 * centre[1]:z.0f} ± {1e3 * spread['centre of friction y']:.0f}) mm of the object frame"
    )
    mass = posterior.total_mass
    weight = (
        f"the total mass is {mass.value:.2f} ± {mass.std:.2f} kg"
        if posterior.total_mass_identifiable
        else "poses do not determine the total mass (measure forces, or weigh the object)"
    )
    n = len(train.pushes)
    learned = f"From {n} push{'es' if n != 1 else ''}: {centre_text}; {weight}."
    if not test.pushes:
        return learned
    pushes = "one push" if len(test.pushes) == 1 else f"{len(test.pushes)} pushes"
    better = f"The maps predict {pushes} not used in the fit to {1e3 * np.nanmean(test.identified):.1f} mm"
    return f"{learned} {better}, equal cells with nominal values to {1e3 * np.nanmean(test.uniform):.1f} mm."


def _error_row(name: str, errors: PushErrors) -> dict[str, Any]:
    means = {n: float(np.nanmean(v)) if len(v) else float("nan") for n, v in (("uniform", errors.uniform), ("scalar", errors.scalar))}
    identified = float(np.nanmean(errors.identified)) if len(errors.identified) else float("nan")
    return {"name": name, "n": len(errors.pushes), **means, "identified": identified}


def _candidates(candidates: Sequence[Candidate]) -> list[dict[str, str]]:
    """The best one first."""
    in_order = sorted(candidates, key=lambda c: -c.log_evidence)
    return [_candidate(candidate, in_order[0].log_evidence) for candidate in in_order]


def _candidate(candidate: Candidate, best: float) -> dict[str, str]:
    maps = candidate.maps
    return {
        "name": candidate.name,
        "probability": f"{candidate.probability:.0%}",
        "log_bayes_factor": f"{candidate.log_evidence - best:.1f}",
        "mass": "–" if maps is None else f"{maps.mass_std:.2f}",
        "load": "–" if maps is None else f"{maps.pressure_std:.2f}",
        "friction": "–" if maps is None else f"{maps.friction_std:.2f}",
        "length": "–" if maps is None else f"{maps.length:.2f}",
        "feet": "; ".join(_support(support) for support in supports(candidate.on_feet)) if candidate.on_feet else "",
    }


def _support(support: Support) -> str:
    (x, y), (x_std, y_std) = 1e3 * support.position, 1e3 * support.position_std
    return f"({x:.0f} ± {x_std:.0f}, {y:.0f} ± {y_std:.0f}) mm bears {100 * support.share:.0f} ± {100 * support.share_std:.0f} %"


def _record(scores: Sequence[PushScore]) -> dict[str, Any] | None:
    """Predictions before each push; None where there are too few."""
    if len(scores) < 2:
        return None
    summary = summarise_scores(scores)
    return {
        "figure": draw_record(scores),
        "n": summary.n,
        "mean": summary.mean_cell_error,
        "expected": summary.mean_expected_cell_error,
        "uniform": summary.mean_uniform_cell_error,
        "share": f"{summary.share_within_90:.0%}",
    }


def _quantity(quantity: Quantity) -> dict[str, str]:
    return {
        "name": quantity.name,
        "value": value_text(quantity),
        "before": before_text(quantity),
        "short": quantity.knowledge.value.partition(":")[0],
        "verdict": quantity.knowledge.value,
    }


def _next_push(posterior: ModelPosterior, pusher_radius: float) -> dict[str, Any] | None:
    proposal = propose_push(posterior, pusher_radius)
    if proposal is None:
        return None
    plan = proposal.plan
    return {
        "figure": draw_push(posterior, plan, pusher_radius),
        "x": float(plan.contact_point[0]),
        "y": float(plan.contact_point[1]),
        "heading": float(np.degrees(plan.direction)),
        "distance": plan.distance,
        "speed": plan.speed,
        "n": N_CANDIDATES,
        "before": proposal.error_before,
        "after": proposal.error_after,
    }


def _provenance(result: Identification, provenance: Provenance) -> list[tuple[str, str]]:
    prior = ", ".join(f"{name.replace('_', ' ')} {value:g}" for name, value in asdict(result.posterior.prior).items())
    rows: list[tuple[str, str]] = [("push", source) for source in provenance.sources]
    rows += [("note", note) for note in provenance.notes]
    return [
        *rows,
        ("solver", f"{result.method}: {result.status.name.lower()}, {result.n_simulations} simulations, {result.time_s:.2f} s"),
        ("squared residual per degree of freedom", f"{result.reduced_chi2:.2f} (1: residuals as large as the stated noise)"),
        ("prior", prior),
        ("version", f"push_ident {__version__}, Python {platform.python_version()}"),
    ]
