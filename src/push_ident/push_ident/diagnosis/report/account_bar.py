"""The account of a gap as a stacked bar of HTML and CSS: text keeps its size on a narrow screen, where a drawing would shrink."""

from __future__ import annotations

from dataclasses import dataclass

from push_ident.diagnosis.account import Account, AccountPart
from push_ident.diagnosis.wording import in_mm

__all__ = ["AccountBar", "AccountRow", "account_bar"]

_COLOURS = {"noise": "#c9d1d9", "maps": "#9fb8d6", "model": "#6f8fb5", "unexplained": "#c0561d"}
_EFFECT_COLOURS = ("#1f5fa8", "#16447a", "#0d2c50")
"""Of effects, in the order in which they were added."""
_NAMES = {
    "noise": "noise of the poses",
    "maps": "maps that are not known yet",
    "model": "the model's own discrepancy",
    "unexplained": "unexplained",
}
_BETTER = "predicted better than expected"


@dataclass(frozen=True, slots=True)
class AccountRow:
    """One part. Positions are in percent of the width of the bar."""

    name: str
    colour: str
    mean: str
    """With its unit."""
    interval: str
    """90 % interval, with its unit."""
    start: float
    """Left end of the part in the stack."""
    width: float
    low: float
    """Left end of the interval, from where the part begins."""
    spread: float
    """Width of the interval."""
    is_negative: bool


@dataclass(frozen=True, slots=True)
class AccountBar:
    """All parts of an account, stacked."""

    rows: tuple[AccountRow, ...]
    total: str
    """Mean error on held-out pushes, with its unit."""
    position: float
    """Of that error, in percent of the width."""
    in_words: str
    """The parts as text."""


def account_bar(account: Account) -> AccountBar:
    """Lay the parts out from left to right; a negative part leads back."""
    starts, ends, at = [], [], 0.0
    for part in account.parts:
        starts.append(at)
        at += part.mean
        ends.append(at)
    tips = [start + part.interval[1] for start, part in zip(starts, account.parts, strict=True)]
    unit = 100.0 / max(*ends, *tips, 1e-9)
    effects = [part.name for part in account.effects]
    rows = tuple(
        _row(part, start, unit, _EFFECT_COLOURS[effects.index(part.name) % len(_EFFECT_COLOURS)] if part.is_effect else None)
        for part, start in zip(account.parts, starts, strict=True)
    )
    total = in_mm(account.before)
    words = ", ".join(f"{row.name} {row.mean}" for row in rows)
    return AccountBar(rows, total, unit * account.before, f"Mean error {total}: {words}")


def _row(part: AccountPart, start: float, unit: float, colour: str | None) -> AccountRow:
    low, high = part.interval
    is_negative = part.mean < 0.0
    name = _BETTER if is_negative and part.name == "unexplained" else _NAMES.get(part.name, part.name)
    left = max(0.0, start + low)
    return AccountRow(
        name=name,
        colour=colour or _COLOURS[part.name],
        mean=in_mm(part.mean),
        interval=f"{in_mm(low).removesuffix(' mm')} to {in_mm(high)}",
        start=unit * min(start, start + part.mean),
        width=unit * abs(part.mean),
        low=unit * left,
        spread=unit * (start + high - left),
        is_negative=is_negative,
    )
