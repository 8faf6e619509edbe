"""Named quantities as text, in millimetres where they are lengths."""

from __future__ import annotations

from push_ident.identification.identifiability import Quantity

__all__ = ["before_text", "value_text"]


def value_text(quantity: Quantity) -> str:
    """Value and standard deviation after the pushes, with the unit: `27.6 ± 1.8 mm`."""
    scale, digits, unit = _scale(quantity)
    return f"{scale * quantity.value:z.{digits}f} ± {scale * quantity.std:.{digits}f}{unit}"


def before_text(quantity: Quantity) -> str:
    """Standard deviation before the pushes, with the unit: `± 25.4 mm`."""
    scale, digits, unit = _scale(quantity)
    return f"± {scale * quantity.prior_std:.{digits}f}{unit}"


def _scale(quantity: Quantity) -> tuple[float, int, str]:
    if quantity.unit == "m":
        return 1e3, 1, " mm"
    return 1.0, 3, f" {quantity.unit}" if quantity.unit else ""
