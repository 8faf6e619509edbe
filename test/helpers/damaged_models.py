"""Models as JSON, right ones and damaged ones, and paths that no file can be read from."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from helpers.objects import hammer_shape
from push_ident.identification.results.model_file import model_text
from push_ident.identification.results.posterior import Estimate, ModelPosterior
from push_ident.identification.unknowns.prior import Prior
from push_ident.identification.unknowns.spec import UnknownsSpec
from push_ident.types import CellGrid, SolveStatus


def right_model() -> dict[str, Any]:
    """A hammer with uneven maps, its cells in the order of a grid."""
    shape = hammer_shape()
    rows = np.lexsort(np.round(shape.cells.centres, 6).T)
    unknowns = UnknownsSpec.of(replace(shape, cells=CellGrid(shape.cells.centres[rows], shape.cells.size)), Prior(max_modes=8))
    rng = np.random.default_rng(3)
    root = 0.2 * rng.normal(size=(unknowns.size, unknowns.size)) / np.sqrt(unknowns.size)
    covariance = root @ root.T + 0.01 * np.eye(unknowns.size)
    z = 0.5 * rng.normal(size=unknowns.size)
    posterior = ModelPosterior(unknowns, z, covariance, Estimate(0.83, 0.4), total_mass_identifiable=False)
    content: dict[str, Any] = json.loads(model_text(posterior, "o1", ["push 0"], SolveStatus.CONVERGED))
    return content


def _set(*path: Any, to: Any) -> Callable[[dict[str, Any]], None]:
    """Replace what lies at a path; a function is applied to what is there."""

    def change(content: dict[str, Any]) -> None:
        place: Any = content
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = to(place[path[-1]]) if callable(to) else to

    return change


def _scaled(factor: float) -> Callable[[Any], Any]:
    def scale(value: Any) -> Any:
        return [scale(item) for item in value] if isinstance(value, list) else factor * value

    return scale


def _swap(one: str, other: str) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        content[one], content[other] = content[other], content[one]

    return change


DAMAGE: Final[dict[str, tuple[Callable[[dict[str, Any]], None], str]]] = {
    # numbers that are none of an object
    "cell size beyond any object": (_set("cell_size", to=1e300), "extent of an object"),
    "cells too small for their outline": (_set("cell_size", to=0.0055), "expected about the"),
    "cell twice": (_set("cells", to=lambda cells: [cells[1], *cells[1:]]), "apart, expected at least their size"),
    "coordinate beyond any cell": (_set("outline", 0, 0, to=1e200), "a coordinate is"),
    "outline that crosses itself": (_set("outline", to=lambda o: [o[0], o[3], o[1], o[2], *o[4:]]), "crosses itself"),
    "outline of another unit": (_set("outline", to=_scaled(1e-3)), "wide, expected at least"),
    "deviation of an outline beyond any object": (_set("outline_std", to=[1e300] * 8), "extent of an object"),
    "ragged covariance": (_set("covariance", -1, to=lambda row: row[:-1]), "rows of 25 to 26 numbers"),
    "negative variance": (_set("covariance", 3, 3, to=-0.1), "has the variance -0.1"),
    "correlation beyond 1": (lambda c: (_set("covariance", 3, 4, to=9.0)(c), _set("covariance", 4, 3, to=9.0)(c)), "eigenvalue"),
    "covariance that is not symmetric": (_set("covariance", 3, 4, to=0.05), "not symmetric"),
    "covariance of another unit": (_set("covariance", to=_scaled(1e9)), "changes a logarithm by"),
    "unknown that is no number of a map": (_set("z", 2, to=1e6), "changes a logarithm by"),
    "modes of another size": (_set("modes", to=_scaled(3.0)), "expected at most 1"),
    "modes cut short": (_set("modes", to=lambda rows: rows[:-1]), r"shape \(69, 8\)"),
    "negative total mass": (_set("total_mass", to=-0.83), "The total mass is -0.83"),
    "total mass beyond any object": (lambda c: (_set("total_mass", to=1e9)(c), _set("mass", to=_scaled(1e9 / 0.83))(c)), "a mass is"),
    "negative deviation of the total mass": (_set("total_mass_std", to=-0.4), "± -0.4 kg"),
    "noise of poses beyond a camera": (_set("pose_noise_factor", to=-1.0), "`pose_noise_factor` is -1"),
    # what is stated twice
    "mass list cut short": (_set("mass", to=lambda mass: mass[:-1]), "`mass` has 69 values, expected 70"),
    "other pusher friction": (_set("pusher_friction", to=0.9), "`pusher_friction` states 0.9, expected"),
    "mass and friction swapped": (_swap("mass", "friction"), "`mass` states"),
    # the prior
    "negative deviation of the prior": (_set("prior", "friction_std", to=-0.4), "Prior.friction_std is -0.4"),
    "feet without end": (_set("prior", "feet", to=1e12), "number of cells of one object is"),
    "half a foot": (_set("prior", "feet", to=2.5), "expected a whole number"),
    # names, and types that JSON has
    "unknown format": (_set("format", to="push_ident/model/99"), "expected `push_ident/model/1`"),
    "unknown status": (_set("status", to="splendid"), "`status` is 'splendid'"),
    "unknown effect with a long name": (_set("effects", to=["a" * 1_000_000]), "There is no effect"),
    "object id of a page": (_set("object_id", to="o" * 10_000), "length of a string"),
    "number as text": (_set("total_mass", to="0.83"), "valid number"),
    "nothing as a list": (_set("mass", to=None), "mass: "),
    "no cells": (_set("cells", to=[]), "empty"),
    "no outline": (_set("outline", to=[]), "expected at least 3"),
}
"""What damages the content of a right model, and a pattern of what is said of it."""


def _text(**changes: Any) -> str:
    return json.dumps(right_model() | changes)


DAMAGED_TEXT: Final[dict[str, tuple[Callable[[], str], str]]] = {
    "NaN": (lambda: _text(total_mass=float("nan")), "finite number"),
    "integer of 10,000 digits": (lambda: _text().replace('"total_mass": 0.83', '"total_mass": ' + "9" * 10_000), "JSON: "),
    "name twice": (lambda: _text()[:-1] + ', "total_mass": 9.0}', "`total_mass` is there 2 times"),
    "100,000 names": (lambda: _text()[:-1] + "".join(f', "k{i}": 1' for i in range(100_000)) + "}", "at most 1000"),
    "deep nesting": (lambda: _text().replace('"z": [', '"z": [' + "[" * 500_000), "nested too deeply"),
    "list instead of an object": (lambda: "[" + _text() + "]", "object"),
    "text": (lambda: "mass: 0.5", "JSON: "),
    "control characters in a name": (lambda: _text()[:-1] + ', "\\u001b[2J\\n": 1}', "not permitted"),
}
"""What JSON can do beyond the content, and a pattern of what is said of it."""


def unreadable_paths(folder: Path) -> dict[str, Path]:
    """Paths in a folder, and elsewhere, that no model can be read from, by what is wrong with them."""
    (folder / "loop.json").symlink_to(folder / "loop.json")
    (folder / "dangling.json").symlink_to(folder / "gone")
    (folder / "folder.json").mkdir()
    (folder / "file").write_text("{}")
    os.mkfifo(folder / "pipe.json")
    return {
        "loop of links": folder / "loop.json",
        "link to nothing": folder / "dangling.json",
        "folder": folder / "folder.json",
        "nothing": folder / "gone.json",
        "below a file": folder / "file" / "model.json",
        "pipe": folder / "pipe.json",
        "device": Path("/dev/zero"),
        "name too long": folder / ("n" * 300 + ".json"),
        "path too long": folder / "/".join(["d" * 200] * 30) / "model.json",
        "new line": folder / "a\nb.json",
        "root": Path("/"),
        "here": Path("."),
    }
