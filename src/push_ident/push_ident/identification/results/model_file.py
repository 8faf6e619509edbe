"""Models as files: JSON, validated when it is read, with their posterior and their sources."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, astuple, replace
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import Field

from push_ident import __version__
from push_ident.checked_json import CheckedContent, Listed, Numbers, Points, Rows, parse_checked, read_checked
from push_ident.errors import InputError, ModelFileError
from push_ident.files import read_regular, write_whole
from push_ident.geometry.cut_cells import cut_at_outline
from push_ident.geometry.shape_check import check_shape
from push_ident.identification.results.posterior import Estimate, ModelPosterior
from push_ident.identification.results.result import WarmStart
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.quadratic import Quadratic
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.limits import LIMITS, check_coordinates, plain_text
from push_ident.types import CellGrid, Float64Array, ObjectShape, SolveStatus

_MODEL_FORMAT: Final = "push_ident/model/1"
_CELL_ROUNDING: Final = 1e-6
"""Of the places of cells [m]."""


class AlternativeContent(CheckedContent):
    """Another kind of support, with the same outline, modes and effects; its total mass is that of the model where no force shows it."""

    weight: float
    """[1]"""
    prior: dict[str, float]
    z: Numbers
    covariance: Rows
    total_mass: float
    total_mass_std: float


class ModelContent(CheckedContent):
    """Content of a model file."""

    format: str
    version: str
    object_id: str
    sources: Listed[str]
    """Bags and pushes that the model was fitted to."""
    status: str = ""
    """How the fit ended, as in the JSON of `identify`; empty where it is not known."""
    cell_size: float
    cells: Points = Field(max_length=LIMITS.CELLS.value)
    """Their centroids [m]."""
    squares: Points | None = Field(None, max_length=LIMITS.CELLS.value)
    """Of which the outline cuts the cells: their centres [m]; None where cells are whole squares."""
    outline: Points = Field(max_length=LIMITS.VERTICES.value)
    outline_std: Numbers | None = None
    """Of each edge along its normal [m], where a camera traced the outline."""
    prior: dict[str, float]
    modes: Rows
    """Of the maps, one row per cell. Kept, since eigenvectors differ between machines."""
    effects: Listed[str] = Field(default_factory=list)
    """Names of the effects that were fitted beside the maps."""
    effect_values: Numbers = Field(default_factory=list)
    """Of their parameters; they follow from `z`."""
    z: Numbers
    covariance: Rows
    total_mass: float
    total_mass_std: float
    total_mass_identifiable: bool
    pose_noise_factor: float | None = None
    """On the stated noise of poses that no other frame checks, where the pushes set it."""
    alternatives: Listed[AlternativeContent] = Field(default_factory=list)
    """Other kinds of support that the pushes leave possible."""
    touched_outline: Points | None = None
    """The outline as the pushes show it, where it is an unknown; it follows from the other fields, as the last three do."""
    mass: Numbers
    friction: Numbers
    pusher_friction: float
    """The last three follow from the other fields; they are there for readers of the file."""


def model_content(posterior: ModelPosterior, object_id: str, sources: Sequence[str], status: SolveStatus | None = None) -> ModelContent:
    """Content of the file of a posterior."""
    shape, model = posterior.unknowns.shape, posterior.model
    squares = shape.cells.squares
    return ModelContent(
        format=_MODEL_FORMAT,
        version=__version__,
        object_id=object_id,
        sources=list(sources),
        status=status.name.lower() if status else "",
        cell_size=shape.cells.size,
        cells=[(float(x), float(y)) for x, y in shape.cells.centres],
        squares=None if np.array_equal(squares, shape.cells.centres) else [(float(x), float(y)) for x, y in squares],
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
        alternatives=[_alternative_content(weight, part) for weight, part in posterior.alternatives],
        touched_outline=[(float(x), float(y)) for x, y in model.shape.outline] if len(posterior.unknowns.outline_modes) else None,
        mass=model.mass.tolist(),
        friction=model.friction.tolist(),
        pusher_friction=model.pusher_friction,
    )


def _alternative_content(weight: float, part: ModelPosterior) -> AlternativeContent:
    return AlternativeContent(
        weight=weight,
        prior=asdict(part.prior),
        z=part.z.tolist(),
        covariance=part.covariance.tolist(),
        total_mass=part.total_mass.value,
        total_mass_std=part.total_mass.std,
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
    return content.object_id, posterior_of(content, plain_text(str(path)))


def model_text(posterior: ModelPosterior, object_id: str, sources: Sequence[str] = (), status: SolveStatus | None = None) -> str:
    """Content of the file of a posterior, for a message."""
    return model_content(posterior, object_id, sources, status).model_dump_json()


def model_of_text(text: str, what: str) -> ModelPosterior:
    """The posterior of a text that `model_text` made; `what` names where it comes from. Raises ModelFileError where it is none."""
    LIMITS.TEXT_FILE.check(len(text), what, error=ModelFileError)
    return posterior_of(parse_checked(text, ModelContent, f"{what} is not a model", "is identification_node of this version?"), what)


def failure_of_model(path: Path) -> str:
    """Why the fit of a model failed, so that its maps are the prior; empty where it did not. Raises ModelFileError as `load_model`."""
    status = SolveStatus.__members__.get(_read(path).status.upper())
    return status.value if status is not None and status.is_failure else ""


def sources_of_model(path: Path) -> tuple[str, ...]:
    """Bags and pushes that a model was fitted to. Raises ModelFileError as `load_model`."""
    return tuple(_read(path).sources)


def _read(path: Path) -> ModelContent:
    return read_checked(path, ModelContent, "a model file", "`push-ident identify BAG --out DIR` writes DIR/model.json")


def is_model_file(path: Path) -> bool:
    """Whether a file says that it is one of `save_model`, complete or not."""
    try:
        content = json.loads(read_regular(path))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.get("format") == _MODEL_FORMAT


def posterior_of(content: ModelContent, where: str, remedy: str = "identify again with this version") -> ModelPosterior:
    """The posterior of a file; `where` names it. Raises ModelFileError where its numbers are none of a model, or contradict each other."""
    if content.format != _MODEL_FORMAT:
        raise ModelFileError(f"{where} has the format `{plain_text(content.format)}`, expected `{_MODEL_FORMAT}`; {remedy}.")
    try:
        LIMITS.STRING.check(len(content.object_id), "Object id")
        if content.status and content.status.upper() not in SolveStatus.__members__:
            raise InputError(f"`status` is {content.status!r}, expected one of {', '.join(SolveStatus.__members__).lower()}.")
        # What overflows is refused as not finite.
        with np.errstate(all="ignore"):
            posterior = check_posterior(_posterior(content))
            _check_stated(content, posterior)
    except InputError as error:
        raise ModelFileError(f"{where} holds no model: {plain_text(str(error)).rstrip('.')}; {remedy}.") from None
    return posterior


def _posterior(content: ModelContent) -> ModelPosterior:
    LIMITS.EXTENT.check(content.cell_size, "Cell")
    squares = content.cells if content.squares is None else content.squares
    for name, points in (("Cells", content.cells), ("Squares", squares), ("Outline", content.outline)):
        check_coordinates(points, name)
    std = None if content.outline_std is None else np.array(content.outline_std)
    cells = CellGrid(np.array(squares).reshape(-1, 2), content.cell_size)
    shape = check_shape(ObjectShape(cells, np.array(content.outline).reshape(-1, 2), std))
    if content.squares is not None:
        shape = cut_at_outline(shape)
        if len(content.cells) != len(squares) or not np.max(np.abs(shape.cells.centres - content.cells)) <= _CELL_ROUNDING:
            raise InputError("`cells` are not the centroids of `squares` within `outline`, expected those that were written with them.")
    modes = array_of(content.modes, "modes")
    posterior = ModelPosterior(
        unknowns=UnknownsSpec.of(
            shape, prior_of(content.prior), modes=modes, effects=content.effects, outline=content.touched_outline is not None
        ),
        z=np.array(content.z),
        covariance=array_of(content.covariance, "covariance"),
        total_mass=Estimate(content.total_mass, content.total_mass_std),
        total_mass_identifiable=content.total_mass_identifiable,
        pose_noise_factor=content.pose_noise_factor,
    )
    others = tuple((one.weight, _alternative(one, posterior)) for one in content.alternatives)
    if not (all(weight >= 0.0 for weight, _ in others) and sum(weight for weight, _ in others) <= 1.0):
        raise InputError(f"`alternatives` have the weights {[weight for weight, _ in others]}, expected numbers >= 0 of sum 1 at most.")
    return replace(posterior, alternatives=others)


def _alternative(content: AlternativeContent, beside: ModelPosterior) -> ModelPosterior:
    """Raises InputError where its numbers are none of an object."""
    return check_posterior(
        replace(
            beside,
            unknowns=replace(beside.unknowns, prior=prior_of(content.prior)),
            z=np.array(content.z),
            covariance=array_of(content.covariance, "covariance"),
            total_mass=Estimate(content.total_mass, content.total_mass_std),
        )
    )


def array_of(rows: Sequence[Sequence[float]], name: str) -> Float64Array:
    """The matrix of its rows, shape (n_rows, n_columns). Raises InputError where they have different lengths."""
    lengths = {len(row) for row in rows}
    if len(lengths) > 1:
        raise InputError(f"`{name}` has rows of {min(lengths)} to {max(lengths)} numbers, expected as many in each.")
    return np.array(rows, dtype=np.float64).reshape(len(rows), max(lengths, default=0))


def _check_stated(content: ModelContent, posterior: ModelPosterior) -> None:
    """Raise InputError where what follows from the unknowns is stated otherwise."""
    model = posterior.model
    for name, expected, stated in (
        ("effect_values", posterior.effects.values, content.effect_values),
        ("mass", model.mass, content.mass),
        ("friction", model.friction, content.friction),
        ("pusher_friction", np.array([model.pusher_friction]), [content.pusher_friction]),
    ):
        if name == "effect_values" and not stated:  # of files written before they were stated
            continue
        if len(expected) != len(stated):
            raise InputError(f"`{name}` has {len(stated)} values, expected {len(expected)}.")
        # Machines differ in the last of 16 digits, and exponentials enlarge it.
        differs = ~np.isclose(stated, expected, rtol=1e-6, atol=1e-15)
        if np.any(differs):
            first = int(np.argmax(differs))
            raise InputError(f"`{name}` states {stated[first]:.6g}, expected {expected[first]:.6g} as the unknowns `z` give it.")


def prior_of(values: dict[str, float]) -> Prior:
    """The prior of a file; fields that this version does not have are ignored. Raises InputError where it is none."""
    known = {name: value for name, value in values.items() if name in Prior.__dataclass_fields__}
    known.setdefault("pressure_map_std", 0.0)  # of files written before there was such a map
    for name in ("max_modes", "feet"):
        number = known.get(name, getattr(Prior(), name))
        if number != int(number):
            raise InputError(f"Prior.{name} is {number}, expected a whole number.")
        known[name] = int(number)
    return check_prior(Prior(**known))  # type: ignore[arg-type]


# --- whether numbers from outside can be the posterior of an object


_MATRIX_ROUNDING: Final = 1e-9
"""Error of a matrix that rounding explains, relative to its largest entry [-]: condition numbers are below 1e7."""
_MODE_ROUNDING: Final = 1e-6
"""By which the variance of a cell of a unit map may exceed 1 [-]."""
_MOST_LOG: Final = 700.0
"""Logarithm of a ratio with its standard deviation [-]: e^709 is the largest number. Right pushes leave 5, some that contradict each other
left 150."""
_MOST_DEVIATION: Final = 10.0
"""Standard deviation of a logarithm in a prior [-]: a factor of 22,000 either way says nothing."""
_MAP_PRIOR: Final = (1e-4, 100.0)
"""What pushes can make of each number of a prior of maps [-]; pushes that contradict each other made 0.05 to 8."""
_MOST_START: Final = 100.0
"""Unknown at which a solve may start, in units of its prior [-]: fits reach 40, and from some 200 on the maps may be no number."""
_LEAST_VARIANCE: Final = 1e-15
"""Of an unknown, whose prior variance is 1 [-]: below it rounding decides. Frozen unknowns have 1e-8."""
_LEAST_MASS: Final = 1e-6
"""[kg]: a grain of foam as small as the smallest object."""
_LENGTHS: Final = (1e-3, 1e3)
"""Correlation length of the maps over the size of the object [-]: below a cell, and the same everywhere."""
_MOST_NOISE_FACTOR: Final = 1e5
"""On the stated noise of poses [-]: it makes 100 m of 1 mm."""
_LOGS: Final = (
    "total_mass_std", "friction_std", "pusher_friction_std", "mass_map_std", "pressure_map_std", "friction_map_std",
)  # fmt: skip


def check_prior(prior: Prior) -> Prior:
    """The same prior; raises InputError where one of its numbers is beyond what `Prior` leaves open for a search."""
    for name in _LOGS:
        if getattr(prior, name) > _MOST_DEVIATION:
            raise InputError(f"Prior.{name} is {getattr(prior, name):.3g}, expected at most {_MOST_DEVIATION:g}, as of a logarithm.")
    if not _LENGTHS[0] <= prior.correlation_length <= _LENGTHS[1]:
        raise InputError(f"Prior.correlation_length is {prior.correlation_length:.3g}, expected {_LENGTHS[0]:g} to {_LENGTHS[1]:g}.")
    if prior.total_mass < _LEAST_MASS:
        raise InputError(f"Prior.total_mass is {prior.total_mass:.3g} kg, expected at least {_LEAST_MASS:g} kg.")
    return prior


def check_start(start: WarmStart) -> WarmStart:
    """The same start of a solve; raises InputError where no fit can have ended there."""
    largest = float(np.max(np.abs(start.x), initial=0.0))
    if not largest <= _MOST_START:
        raise InputError(f"The start `{plain_text(start.name)}` has the unknown {largest:.3g}, expected at most {_MOST_START:g}.")
    if start.prior is not None and not all(_MAP_PRIOR[0] <= value <= _MAP_PRIOR[1] for value in astuple(start.prior)):
        low, high = _MAP_PRIOR
        raise InputError(f"The start `{plain_text(start.name)}` has {start.prior}, expected {low:g} to {high:g} for each.")
    return start


def check_posterior(posterior: ModelPosterior) -> ModelPosterior:
    """The same posterior; raises InputError where one of its numbers can be none of an object."""
    unknowns, covariance, n = posterior.unknowns, posterior.covariance, posterior.unknowns.size
    if posterior.z.shape != (n,) or covariance.shape != (n, n):
        raise InputError(f"`z` has {len(posterior.z)} unknowns, `covariance` {covariance.shape}, expected {n} and {(n, n)} as its cells.")
    variance = np.diag(covariance)
    if not np.min(variance) >= _LEAST_VARIANCE:
        raise InputError(f"`covariance` has the variance {np.min(variance):.3g}, expected at least {_LEAST_VARIANCE:g}.")
    _check_logs(unknowns, np.abs(posterior.z) + np.sqrt(variance), "z")
    _check_positive(covariance, "covariance")
    row = float(np.max(np.sum(unknowns.modes**2, axis=1)))
    if not row <= 1.0 + _MODE_ROUNDING:
        raise InputError(f"`modes` give a cell the variance {row:.3g}, expected at most 1, that of a unit map.")
    factor = posterior.pose_noise_factor
    if factor is not None and not 0 < factor <= _MOST_NOISE_FACTOR:
        raise InputError(f"`pose_noise_factor` is {factor:.3g}, expected a number from 0 to {_MOST_NOISE_FACTOR:g}.")
    _check_masses(posterior)
    return posterior


def _check_logs(unknowns: UnknownsSpec, z: Float64Array, name: str) -> None:
    """Raise InputError for unknowns, shape (n_unknowns,), whose quantities are no number."""
    log = np.concatenate([block.std for block in unknowns.blocks.values()]) * np.abs(z)
    if not np.max(log) <= _MOST_LOG:
        raise InputError(f"`{name}` changes a logarithm by {np.max(log):.3g} with its deviation, expected at most {_MOST_LOG:g}.")


def check_information(cost: Quadratic, unknowns: UnknownsSpec) -> None:
    """Raise InputError where the cost of pushes and the unit normal prior together are no distribution of these unknowns."""
    precision = cost.hessian + np.eye(unknowns.size)
    _check_positive(precision, "hessian")
    if not np.max(np.diag(precision)) <= 1.0 / _LEAST_VARIANCE:
        raise InputError(f"`hessian` has the entry {np.max(np.diag(precision)):.3g}, expected at most {1.0 / _LEAST_VARIANCE:g}.")
    _check_logs(unknowns, cost.point, "point")
    try:
        least = np.linalg.solve(precision, cost.hessian @ cost.point - cost.gradient)
    except np.linalg.LinAlgError:
        raise InputError("`hessian` and the prior leave an unknown open, expected a positive definite sum.") from None
    _check_logs(unknowns, np.asarray(least, dtype=np.float64), "gradient")


def _check_positive(matrix: Float64Array, name: str) -> None:
    largest = float(np.max(np.abs(matrix)))
    if np.max(np.abs(matrix - matrix.T)) > _MATRIX_ROUNDING * largest:
        raise InputError(f"`{name}` is not symmetric, expected equal entries on both sides of its diagonal.")
    try:
        np.linalg.cholesky(matrix + _MATRIX_ROUNDING * largest * np.eye(len(matrix)))
    except np.linalg.LinAlgError:
        least = float(np.linalg.eigvalsh(matrix)[0])
        raise InputError(f"`{name}` has the eigenvalue {least:.3g}, expected none below 0.") from None


def _check_masses(posterior: ModelPosterior) -> None:
    total = posterior.total_mass
    if not (total.value >= _LEAST_MASS and 0 <= total.std <= _MOST_LOG * total.value):
        raise InputError(f"The total mass is {total.value:.3g} ± {total.std:.3g} kg, expected {_LEAST_MASS:g} kg or more and a deviation.")
    LIMITS.MASS.check(total.value, "Total mass", remedy="Give it in kilograms.")
    model = posterior.model
    LIMITS.FRICTION.check(float(model.mass @ model.friction) / model.total_mass, "Support, mean over the object")
    LIMITS.FRICTION.check(model.pusher_friction, "Pusher")
