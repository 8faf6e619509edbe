"""The files that `push-ident identify --out` writes."""

from __future__ import annotations

from pathlib import Path

from push_ident.cli.output import console
from push_ident.identification.predicting.push_errors import PushErrors
from push_ident.identification.report import Provenance, write_report
from push_ident.identification.results.model_file import save_model
from push_ident.identification.results.result import Identification
from push_ident.offline.loading import LoadedPushes

__all__ = ["write_files"]


def write_files(
    out: Path,
    result: Identification,
    loaded: LoadedPushes,
    train: PushErrors,
    test: PushErrors,
    *,
    record: bool = False,
) -> None:
    """Write model and report, and name the files, `result.json` included.

    Args:
        out: folder.
        result: of the identification.
        loaded: all pushes.
        train: errors of the pushes of the fit.
        test: errors of the others.
        record: predict each push from those before it, for the report; an identification for each push.

    Raises:
        PushIdentError: a file cannot be written.
    """
    sources = [loaded.records[i].source for i in train.pushes]
    save_model(out / "model.json", result.posterior, object_id=loaded.object_id, sources=sources, status=result.status)
    scores = []
    if record and not loaded.nuisances:  # the model of these predictions would lack the nuisances
        from push_ident.identification.online.running_record import running_record

        scores = running_record(loaded.records, result.posterior.prior)
    write_report(
        out / "report.html",
        result,
        train,
        test,
        Provenance(loaded.object_id, tuple(sources), (*loaded.notes, *result.explanation.notes(sources))),
        loaded.records[0].pusher.radius,
        scores,
    )
    names = ("report.html", "model.json", "result.json")
    console.print(f"written: {', '.join(str(out / name) for name in names)}", highlight=False, soft_wrap=True)
