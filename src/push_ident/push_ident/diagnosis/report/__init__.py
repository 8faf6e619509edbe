"""The page that `push-ident diagnose --out` writes."""

from push_ident.diagnosis.report.report import write_report

__all__ = ["write_report"]
