"""Identify the mass and friction of every cell of an unknown object by pushing it.

    import push_ident as pi

    pushes = pi.load("bags/hammer_depth")
    result = pi.identify(pushes[:3])
    pi.predict(result, pushes[3:])

`load`, `record`, `records`, `check`, `identify`, `save`, `predict`, `diagnose`, `selftest`, `next_push` and `plot` are imported at their
first use (`api/calls.py`): the package itself is imported in milliseconds.

The stages, each a subpackage that imports only from those before it: `geometry`, `checking`, `perception`, `pushing`, `physics`,
`identification`, `simulators`, `planning`, `diagnosis`, `recovery`, `bags`, `offline`, `fleet`, `api`, `nodes`, `cli`. The types they
share are in `types` and `errors`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from push_ident.api.calls import check, diagnose, identify, load, next_push, plot, predict, record, records, save, selftest

__all__ = ["__version__", "check", "diagnose", "identify", "load", "next_push", "plot", "predict", "record", "records", "save", "selftest"]

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it offers {', '.join(__all__[1:])}")
    from push_ident.api import calls

    return getattr(calls, name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
