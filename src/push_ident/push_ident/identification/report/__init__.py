"""The page that `push-ident identify --out` writes."""

from push_ident.identification.report.report import Provenance, report_text, write_report

__all__ = ["Provenance", "report_text", "write_report"]
