"""Files of exported models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from push_ident.errors import InputError, ModelFileError
from push_ident.files import json_text, write_whole
from push_ident.identification.export.description import ObjectDescription, printable
from push_ident.identification.export.mjcf import mjcf
from push_ident.identification.export.samples import sample_json
from push_ident.identification.export.sdf import sdf
from push_ident.identification.export.urdf import urdf
from push_ident.identification.results.posterior import ModelPosterior

SUFFIXES = {"sdf": ".sdf", "urdf": ".urdf", "mjcf": ".xml"}
"""Suffix of the file of each format."""


def write_description(path: Path, description: ObjectDescription, format_name: str, *, mesh: Path | None = None) -> list[Path]:
    """Write an object for a simulator, in a format of `SUFFIXES`; the files written. The same object gives the same bytes.

    SDF and URDF have no polyhedra: their outline is written to a mesh file, `path` with .obj added unless `mesh` names one in that folder.

    Raises:
        InputError: unknown format.
        ModelFileError: a file cannot be written.
    """
    mesh = mesh or path.with_name(path.name + ".obj")
    if format_name == "mjcf":
        files = {path: _xml(mjcf(description))}
    elif format_name in SUFFIXES:
        write = sdf if format_name == "sdf" else urdf
        files = {mesh: _outline_mesh(description).encode(), path: _xml(write(description, mesh.name))}
    else:
        raise InputError(f"The format `{format_name}` is unknown, expected one of {', '.join(SUFFIXES)}.")
    for file, content in files.items():
        write_whole(file, content, "the description", error=ModelFileError)
    return list(files)


def write_samples(
    folder: Path, drawn: Sequence[ModelPosterior], described: Callable[[ModelPosterior], ObjectDescription], format_name: str
) -> list[Path]:
    """Write drawn objects for a simulator, `sample_000` and so on, which share their mesh, and all their numbers as `samples.json`.

    Args:
        folder: where to, made if missing.
        drawn: of `drawn_objects`.
        described: an object for a simulator.
        format_name: of `SUFFIXES`.

    Returns:
        The files written.

    Raises:
        InputError: unknown format.
        ModelFileError: a file cannot be written.
    """
    files: dict[Path, None] = {}
    for number, one in enumerate(drawn):
        path = folder / f"sample_{number:03d}{SUFFIXES.get(format_name, '')}"
        files |= dict.fromkeys(write_description(path, described(one), format_name, mesh=folder / "outline.obj"))
    numbers = folder / "samples.json"
    write_whole(numbers, json_text({"samples": [sample_json(one) for one in drawn]}), "the samples", error=ModelFileError)
    return [numbers, *files]


def _xml(root: ElementTree.Element) -> bytes:
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"


def _outline_mesh(description: ObjectDescription) -> str:
    """Wavefront OBJ, one object for each convex piece: Bullet takes the convex hull of each."""
    lines = [f"# {printable(description.provenance)}"]
    first = 1
    for number, prism in enumerate(description.prisms):
        n = len(prism) // 2
        lines.append(f"o piece_{number}")
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in prism.tolist()]
        bottom, top = first + np.arange(n), first + n + np.arange(n)
        faces = [[int(bottom[0]), int(bottom[i + 1]), int(bottom[i])] for i in range(1, n - 1)]
        faces += [[int(top[0]), int(top[i]), int(top[i + 1])] for i in range(1, n - 1)]
        for i in range(n):
            j = (i + 1) % n
            faces += [[int(bottom[i]), int(bottom[j]), int(top[j])], [int(bottom[i]), int(top[j]), int(top[i])]]
        lines += ["f " + " ".join(map(str, face)) for face in faces]
        first += 2 * n
    return "\n".join(lines) + "\n"
