"""JSON from outside in a known form, read in bounded time and memory and refused in one line.

The size of a file bounds what its values take, but not what is said of them: pydantic keeps a record of some 400 bytes for every value that
is wrong, 8 GB for a file of 16 MB. So lists end at their first wrong item, and objects may have few names.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from push_ident.errors import ModelFileError, PushIdentError
from push_ident.files import read_regular
from push_ident.limits import plain_text

_Item = TypeVar("_Item")
_Content = TypeVar("_Content", bound=BaseModel)

Listed = Annotated[list[_Item], Field(fail_fast=True)]
Numbers = Listed[float]
Rows = Listed[Numbers]
Points = Listed[tuple[float, float]]


class CheckedContent(BaseModel):
    """Base of contents: every name is known and every number finite."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def read_checked(path: Path, content: type[_Content], what: str, remedy: str) -> _Content:
    """Read JSON of a known form. Raises ModelFileError: missing, unreadable, too large, or of another form."""
    try:
        text = read_regular(path)
    except OSError as error:
        raise ModelFileError(f"Cannot read {plain_text(str(path))}: {error.strerror}; {remedy}.") from None
    return parse_checked(text, content, f"{plain_text(str(path))} is not {what}", remedy)


def parse_checked(
    text: str | bytes, content: type[_Content], refusal: str, remedy: str, *, error: type[PushIdentError] = ModelFileError
) -> _Content:
    """The content of JSON, where no text or truth value stands for a number; `refusal` begins the text of the `error` for another form."""
    try:
        json.loads(text, object_pairs_hook=_with_unique_names)
        return content.model_validate_json(text, strict=True)
    except ValidationError as failure:
        first = failure.errors(include_url=False, include_input=False)[0]
        why = f"{'.'.join(map(str, first['loc'])) or 'all of it'}: {first['msg']}"
    except RecursionError:
        why = "it is nested too deeply"
    except ValueError as failure:
        why = f"JSON: {failure}"
    raise error(f"{refusal}: {plain_text(why)}; {remedy}.")


def _with_unique_names(pairs: list[tuple[str, Any]], most: int = 1_000) -> dict[str, Any]:
    """Readers differ in which value of a repeated name counts. The largest object of this package has some 50 names."""
    names = dict(pairs)
    if len(pairs) > most:
        raise ValueError(f"an object has {len(pairs)} names, expected at most {most}")
    if len(names) < len(pairs):
        (name, n), *_ = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"the name `{name}` is there {n} times in one object, expected once")
    return names
