"""The page that `push-ident identify --out` writes."""

from push_ident.identification.report.report import Provenance, write_report

__all__ = ["Provenance", "write_report"]
