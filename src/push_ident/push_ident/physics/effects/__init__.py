"""The catalogue of effects. Every module of this folder defines one as `EFFECT`. To add an effect, add a file.

Files in the folders of `PUSH_IDENT_EFFECTS` (`kernel.py`) belong to the catalogue too.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from importlib import import_module
from pkgutil import iter_modules

from push_ident.physics.effect import MAPS, Effect
from push_ident.physics.kernel import VARIABLE, extra_effect_files, extra_effect_folders

__all__ = ["CAMERA_ERRORS", "CAUSES", "EFFECTS", "FORCE_CAUSES", "SENSOR_ERRORS"]

_MUTUAL = ("exact_twins", "refit_with")
"""Fields that hold in both directions."""


def _discover() -> dict[str, Effect]:
    """The effects by name, in alphabetical order."""
    extra = [file.stem for file in extra_effect_files()]
    built_in = [module.name for module in iter_modules(__path__)]
    if doubled := [name for name, count in Counter([*built_in, *extra]).items() if count > 1]:
        raise ImportError(f"There are two effects {doubled[0]}; rename the one in the folders of {VARIABLE}.")
    __path__.extend(str(folder) for folder in extra_effect_folders())
    effects: dict[str, Effect] = {}
    for name in sorted([*built_in, *extra]):
        effect: Effect = import_module(f"{__name__}.{name}").EFFECT
        if effect.name != name:
            raise ImportError(f"The effect in {name}.py is called {effect.name!r}; give file and effect the same name.")
        effects[name] = effect
    _check_names(effects)
    return _with_both_directions(effects, set(extra))


def _check_names(effects: dict[str, Effect]) -> None:
    """Refuse relations to effects that do not exist."""
    for name, effect in effects.items():
        rivals = [rival.name for rival in effect.rivals if rival.name != MAPS]
        for other in (*effect.exact_twins, *effect.special_case_of, *effect.refit_with, *rivals):
            if other not in effects or other == name:
                raise ImportError(f"The effect {name} names {other!r} as a related effect, expected another one of {', '.join(effects)}.")


def _with_both_directions(effects: dict[str, Effect], extra: set[str]) -> dict[str, Effect]:
    """The effects, with each mutual relation present in both.

    Two effects of this folder must both declare it. For an effect of another folder one declaration suffices, because installed files are
    not edited.
    """
    complete = dict(effects)
    for field in _MUTUAL:
        for name, effect in effects.items():
            for other in getattr(effect, field):
                related: tuple[str, ...] = getattr(complete[other], field)
                if name in related:
                    continue
                if not {name, other} & extra:
                    raise ImportError(f"The effect {name} has {other} among its {field}, but not the reverse; add {name} to {other}.py.")
                complete[other] = replace(complete[other], **{field: (*related, name)})  # type: ignore[arg-type]
    return complete


EFFECTS = _discover()
"""All effects by name."""

CAUSES = tuple(name for name, effect in EFFECTS.items() if not effect.needs_forces)
"""Names of the effects that are a named cause, and that poses show."""

FORCE_CAUSES = tuple(name for name, effect in EFFECTS.items() if effect.needs_forces)
"""Names of the effects that are a named cause, and that only measured forces show."""

SENSOR_ERRORS = tuple(name for name in FORCE_CAUSES if EFFECTS[name].is_sensor_error)
"""Names of the effects in the base model of identification where forces are measured."""


def _accuracy(name: str) -> float:
    return min(parameter.camera_std for parameter in EFFECTS[name].parameters if parameter.camera_std is not None)


CAMERA_ERRORS = tuple(sorted((name for name, effect in EFFECTS.items() if effect.is_camera_error), key=_accuracy))
"""Names of the effects in the base model where a camera traced the outline, sorted by accuracy. The order affects rounding only."""
