"""Models as files: JSON, validated when it is read, with their posterior and their sources."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from push_ident import __version__
from push_ident.errors import InputError, ModelFileError
from push_ident.files import read_regular, write_whole
from push_ident.identification.prior import Prior
from push_ident.identification.result import Estimate, ModelPosterior
from push_ident.identification.unknowns import Unknowns
from push_ident.limits import LIMITS, plain_text
from push_ident.types import CellGrid, Float64Array, ObjectShape, SolveStatus

__all__ = [
    "ModelContent", "failure_of_model", "is_model_file", "load_model", "model_content", "model_of_text", "model_text", "posterior_of",
    "prior_of", "read_checked", "save_model",
]  # fmt: skip

_FORMAT = "push_ident/model/1"

_Content = TypeVar("_Content", bound=BaseModel)


class ModelContent(BaseModel):
    """Content of a model file."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    format: str
    version: str
    object_id: str
    sources: list[str]
    """Bags and pushes that the model was fitted to."""
    status: str = ""
    """How the fit ended, as in the JSON of `identify`; empty where it is not known."""
    cell_size: float
    cells: list[tuple[float, float]]
    outline: list[tuple[float, float]]
    outline_std: list[float] | None = None
    """Of each edge along its normal [m], where a camera traced the outline."""
    prior: dict[str, float]
    modes: list[list[float]]
    """Of the maps, one row per cell. Kept, since eigenvectors differ between machines."""
    effects: list[str] = []
    """Names of the effects that were fitted beside the maps."""
    effect_values: list[float] = []
    """Of their parameters; they follow from `z`."""
    z: list[float]
    covariance: list[list[float]]
    total_mass: float
    total_mass_std: float
    total_mass_identifiable: bool
    pose_noise_factor: float | None = None
    """On the stated noise of poses that no other frame checks, where the pushes set it."""
    mass: list[float]
    friction: list[float]
    pusher_friction: float
    """The last three follow from the other fields; they are there for readers of the file."""


def model_content(posterior: ModelPosterior, object_id: str, sources: Sequence[str], status: SolveStatus | None = None) -> ModelContent:
    """Content of the file of a posterior."""
    shape, model = posterior.unknowns.shape, posterior.model
    return ModelContent(
        format=_FORMAT,
        version=__version__,
        object_id=object_id,
        sources=list(sources),
        status=status.name.lower() if status else "",
        cell_size=shape.cells.size,
        cells=[(float(x), float(y)) for x, y in shape.cells.centres],
        outline=[(float(x), float(y)) for x, y in shape.outline],
        outline_std=None if shape.outline_std is None else shape.outline_std.tolist(),
        prior=asdict(posterior.prior),
        modes=posterior.unknowns.modes.tolist(),
        effects=list(posterior.effects.names),
        effect_values=posterior.effects.values.tolist(),
        z=posterior.z.tolist(),
        covariance=posterior.covariance.tolist(),
        total_mass=posterior.total_mass.value,
        total_mass_std=posterior.total_mass.std,
        total_mass_identifiable=posterior.total_mass_identifiable,
        pose_noise_factor=posterior.pose_noise_factor,
        mass=model.mass.tolist(),
        friction=model.friction.tolist(),
        pusher_friction=model.pusher_friction,
    )


def save_model(
    path: Path, posterior: ModelPosterior, *, object_id: str, sources: Sequence[str] = (), status: SolveStatus | None = None
) -> None:
    """Write a model, with the status of its fit, for this user only; the file appears complete or not at all.

    Raises ModelFileError where it cannot be written.
    """
    content = model_content(posterior, object_id, sources, status).model_dump_json(indent=1)
    write_whole(path, content, "the model", private=True, error=ModelFileError)


def load_model(path: Path) -> tuple[str, ModelPosterior]:
    """Read a model.

    Returns:
        The id of the object, and its posterior.

    Raises:
        ModelFileError: no such file, or not one written by `save_model`.
    """
    content = _read(path)
    return content.object_id, posterior_of(content, path)


def model_text(posterior: ModelPosterior, object_id: str, sources: Sequence[str] = (), status: SolveStatus | None = None) -> str:
    """Content of the file of a posterior, for a message."""
    return model_content(posterior, object_id, sources, status).model_dump_json()


def model_of_text(text: str, what: str) -> ModelPosterior:
    """The posterior of a text that `model_text` made; `what` names where it comes from. Raises ModelFileError where it is none."""
    LIMITS.TEXT_FILE.check(len(text), what, error=ModelFileError)
    try:
        content = ModelContent.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the text"
        raise ModelFileError(f"{what} is not a model: {where}: {first['msg']}; is identification_node of this version?") from None
    LIMITS.CELLS.check(len(content.cells), what, error=ModelFileError)
    LIMITS.VERTICES.check(len(content.outline), what, error=ModelFileError)
    return posterior_of(content, Path(what))


def failure_of_model(path: Path) -> str:
    """Why the fit of a model failed, so that its maps are the prior; empty where it did not. Raises ModelFileError as `load_model`."""
    name = _read(path).status.upper()
    status = SolveStatus[name] if name in SolveStatus.__members__ else None
    return status.value if status is not None and status.is_failure else ""


def _read(path: Path) -> ModelContent:
    return read_checked(path, ModelContent, "a model file", "`push-ident identify BAG --out DIR` writes DIR/model.json")


def is_model_file(path: Path) -> bool:
    """Whether a file says that it is one of `save_model`, complete or not."""
    try:
        content = json.loads(read_regular(path))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.get("format") == _FORMAT


def read_checked(path: Path, content: type[_Content], what: str, remedy: str) -> _Content:
    """Read JSON of a known form. Raises ModelFileError: missing, too large, or of another form."""
    try:
        return content.model_validate_json(read_regular(path))
    except OSError as error:
        raise ModelFileError(f"Cannot read {plain_text(str(path))}: {error.strerror}; {remedy}.") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        raise ModelFileError(f"{path} is not {what}: {where}: {first['msg']}; {remedy}.") from None


def posterior_of(content: ModelContent, path: Path) -> ModelPosterior:
    """The posterior of a file. Raises ModelFileError where its parts contradict each other."""
    if content.format != _FORMAT:
        raise ModelFileError(f"{path} has the format `{content.format}`, expected `{_FORMAT}`; identify again with this version.")
    try:
        std = None if content.outline_std is None else np.array(content.outline_std)
        shape = ObjectShape(CellGrid(np.array(content.cells), content.cell_size), np.array(content.outline), std)
        unknowns = Unknowns(shape, prior_of(content.prior), modes=np.array(content.modes), effects=content.effects)
    except (InputError, ValueError) as error:
        raise ModelFileError(f"{path} does not describe an object: {error}") from None
    z, covariance = np.array(content.z), np.array(content.covariance)
    if z.shape != (unknowns.size,) or covariance.shape != (unknowns.size, unknowns.size):
        raise ModelFileError(f"{path} has {z.shape[0]} unknowns, expected {unknowns.size} for its cells; the file is damaged.")
    if content.effect_values and not _equal(unknowns.effects_at(z).values, content.effect_values):
        raise ModelFileError(f"{path} states other values of its effects than its unknowns give; identify again with this version.")
    return ModelPosterior(
        unknowns=unknowns,
        z=z,
        covariance=covariance,
        total_mass=Estimate(content.total_mass, content.total_mass_std),
        total_mass_identifiable=content.total_mass_identifiable,
        pose_noise_factor=content.pose_noise_factor,
    )


def _equal(values: Float64Array, stated: Sequence[float]) -> bool:
    return len(values) == len(stated) and np.allclose(values, stated, rtol=1e-9, atol=1e-15)


def prior_of(values: dict[str, float]) -> Prior:
    """The prior of a file; fields that this version does not have are ignored."""
    known = {name: value for name, value in values.items() if name in Prior.__dataclass_fields__}
    known.setdefault("pressure_map_std", 0.0)  # of files written before there was such a map
    for name in ("max_modes", "feet"):
        known[name] = int(known.get(name, getattr(Prior(), name)))
    return Prior(**known)  # type: ignore[arg-type]
