"""The decision policy: every number is documented, and a changed number changes the hash."""

from __future__ import annotations

import ast
import inspect
from dataclasses import fields, is_dataclass, replace

from push_ident.diagnosis import policy as module
from push_ident.diagnosis.policy import DecisionPolicy


def test_hash_depends_on_every_number() -> None:
    policy = DecisionPolicy()
    hashes = {policy.sha256}
    for section in fields(policy):
        own = getattr(policy, section.name)
        for field in fields(own):
            value = getattr(own, field.name)
            other = {**value, "": 9.0} if isinstance(value, dict) else (*value[:-1], 9.0) if isinstance(value, tuple) else value + 1
            hashes.add(replace(policy, **{section.name: replace(own, **{field.name: other})}).sha256)
    assert len(hashes) == 1 + sum(len(fields(getattr(policy, section.name))) for section in fields(policy)) > 50
    assert DecisionPolicy().sha256 == policy.sha256


def test_every_number_is_documented() -> None:
    """A field is followed by a string that gives its meaning and its source."""
    for node in ast.parse(inspect.getsource(module)).body:
        if not (isinstance(node, ast.ClassDef) and is_dataclass(getattr(module, node.name)) and node.name != "DecisionPolicy"):
            continue
        for statement, after in zip(node.body, [*node.body[1:], None], strict=True):
            if isinstance(statement, ast.AnnAssign):
                assert isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant), ast.unparse(statement)
                assert len(str(after.value.value)) > 20, ast.unparse(statement)
