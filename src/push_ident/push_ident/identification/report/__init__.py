"""The page that `push-ident identify --out` writes."""

from push_ident.identification.report.report import Provenance, PushErrors, write_report

__all__ = ["Provenance", "PushErrors", "write_report"]
