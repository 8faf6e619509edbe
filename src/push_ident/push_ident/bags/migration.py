"""Messages recorded with another version of their definition, as the installed one serialises them.

A subscriber drops, without a word, what it cannot deserialise. So fields are taken over by name: what the installed definition does not
have is left out, what the recorded one does not have is 0 or empty.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from push_ident.bags.typestore import jazzy_typestore
from push_ident.limits import LIMITS

_TEXTS: Final = ("string", "wstring")


class Migration:
    """From the definitions of one recorded type to the installed ones."""

    def __init__(self, name: str, recorded: Typestore) -> None:
        """`name`: of the type, which both stores have."""
        self._name, self._recorded, self._installed = name, recorded, jazzy_typestore()

    def __call__(self, data: bytes | memoryview) -> bytes:
        """The message `data`, CDR as recorded, in CDR of the installed definition; raises what rosbags raises for damaged data."""
        message = self._recorded.deserialize_cdr(data, self._name)
        return bytes(self._installed.serialize_cdr(self._message(message, self._name), self._name))

    def _message(self, recorded: Any, name: str) -> Any:
        """The installed message `name` with the fields of the recorded one, or empty where that is None."""
        fields = self._installed.fielddefs[name][1]
        values = {field: self._value(getattr(recorded, field, None), kind) for field, kind in fields}
        return self._installed.types[name](**values)

    def _value(self, recorded: Any, kind: Any) -> Any:
        node, detail = kind
        if node is Nodetype.NAME:
            return self._message(recorded, detail)
        if node is Nodetype.BASE:
            return recorded if recorded is not None else "" if detail[0] in _TEXTS else False if detail[0] == "bool" else 0
        element, length = detail
        length = length if node is Nodetype.ARRAY else 0
        if element[0] is Nodetype.NAME:
            return [self._message(one, element[1]) for one in (recorded if recorded is not None else [None] * length)]
        if recorded is not None:
            return recorded
        return [""] * length if element[1][0] in _TEXTS else np.zeros(length, dtype=element[1][0])


def migration_of(name: str, types: dict[str, Any]) -> Migration | None:
    """How messages of a recorded type `name` become installed ones; None where both are equal, or where one of them is not known.

    Args:
        types: The recorded definitions: that type and those it is made of, as rosbags parses them; empty where the bag has none.
    """
    installed = jazzy_typestore().fielddefs
    if name not in types or name not in installed:
        return None
    if all(own in installed and _shape(installed[own]) == _shape(fields) for own, fields in types.items()):
        return None
    store = get_typestore(Stores.EMPTY)
    store.max_sequence_length = LIMITS.MESSAGE.value
    store.register(types)
    return Migration(name, store)


def _shape(definition: Any) -> Any:
    """Fields and their types, without constants."""
    return definition[1]
