"""Parameters of a node, declared whole from one table."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from push_ident.errors import InputError
from push_ident.files import read_regular
from push_ident.limits import LIMITS, plain_text

_KEYS_OF_ROS: Final = ("use_sim_time", "start_type_description_service", "qos_overrides.")


@dataclass(frozen=True, slots=True)
class Parameter:
    """One row of the table."""

    name: str
    default: bool | int | float | str | list[float] | list[int] | list[str]
    """Fixes the type as well, and the length of a list of numbers. Lists of strings have any length; `[""]` is an empty one, as ROS
    takes an empty list for one of bytes."""
    description: str
    """What it does, with its unit."""
    minimum: float | None = None
    """Smallest value allowed, of each element for a list."""
    maximum: float | None = None
    read_only: bool = False
    choices: tuple[str, ...] = ()
    """The strings allowed; empty allows all."""
    any_length: bool = False
    """For a list of numbers whose length is not known here, as one for each joint of the arm, or the corners of a table."""

    def has_type(self, value: Any) -> bool:
        """Whether `value`, from a file, has the type of the default."""
        if not isinstance(self.default, list):
            return type(value) is type(self.default)
        return isinstance(value, list) and all(type(item) is type(self.default[0]) for item in value)

    def expected_type(self, value: Any) -> str:
        """What is expected in place of a value of another type."""
        if isinstance(self.default, list):
            return f"expected a list of {type(self.default[0]).__name__}" if self.default else "expected a list"
        write = f", write {float(value)}" if isinstance(self.default, float) and isinstance(value, int) else ""
        return f"expected {type(self.default).__name__}{write}"

    def fault(self, value: Any) -> str:
        """Why `value` is refused; empty when it is fine."""
        if isinstance(self.default, str):
            return f"expected one of {', '.join(self.choices)}" if self.choices and value not in self.choices else ""
        if isinstance(self.default, list):
            if isinstance(self.default[0], str):
                return ""
            if self.any_length and not value:
                return "expected at least one value"
            if not self.any_length and len(value) != len(self.default):
                return f"expected {len(self.default)} values, got {len(value)}"
            values = list(value)
        else:
            values = [value]
        for number in values:
            if isinstance(number, float) and not math.isfinite(number):
                return "expected finite numbers"
            if isinstance(number, (int, float)) and not self._in_range(number):
                low, high = ("any" if bound is None else f"{bound:g}" for bound in (self.minimum, self.maximum))
                return f"expected {low} to {high}"
        return ""

    def descriptor(self) -> ParameterDescriptor:
        """The same for `ros2 param describe`."""
        descriptor = ParameterDescriptor(name=self.name, description=self.description, read_only=self.read_only)
        if self.choices:
            descriptor.additional_constraints = f"one of {', '.join(self.choices)}"
        if self.minimum is None and self.maximum is None:
            return descriptor
        if isinstance(self.default, float):
            low = -math.inf if self.minimum is None else float(self.minimum)
            high = math.inf if self.maximum is None else float(self.maximum)
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
        elif isinstance(self.default, int):
            low_int = -(2**63) if self.minimum is None else int(self.minimum)
            high_int = 2**63 - 1 if self.maximum is None else int(self.maximum)
            descriptor.integer_range = [IntegerRange(from_value=low_int, to_value=high_int, step=0)]
        else:
            descriptor.additional_constraints = f"each from {self.minimum} to {self.maximum}"
        return descriptor

    def _in_range(self, number: float) -> bool:
        return (self.minimum is None or number >= self.minimum) and (self.maximum is None or number <= self.maximum)


class Parameters:
    """The declared parameters of one node.

    Declares the table, warns of overrides that no row has (misspelt keys would else be ignored silently), and refuses
    later settings that are not finite or out of range, keeping the old value.

    Raises InputError: an override has the wrong type or an impossible value; the text names it.
    """

    def __init__(
        self,
        node: Node,
        table: Iterable[Parameter],
        *,
        further: Callable[[dict[str, Any]], Iterable[Parameter]] | None = None,
        check: Callable[[dict[str, Any]], object] | None = None,
        on_change: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        """Declare `table` on `node`.

        Args:
            further: Called with the values of `table`; gives the rows that follow from them, such as those of each name in a list.
            check: Called with all values as they would be; raises InputError when they do not go together.
            on_change: Called with the new values of the changed parameters, after they were accepted.
        """
        self._node = node
        self._check_together: Callable[[dict[str, Any]], object] | None = None
        self._table = {row.name: row for row in table}
        node.add_on_set_parameters_callback(self._check)
        for row in self._table.values():
            self._declare(row)
        for row in further(self.as_dict()) if further is not None else ():
            self._table[row.name] = row
            self._declare(row)
        self._warn_of_unknown_keys()
        if check is not None:
            check(self.as_dict())
            self._check_together = check
        if on_change is not None:
            node.add_post_set_parameters_callback(lambda changed: on_change({p.name: p.value for p in changed if p.name in self._table}))

    def __getitem__(self, name: str) -> Any:
        """Value in force; a list for array parameters."""
        if name not in self._table:
            raise KeyError(f"{name!r} is not a parameter of {self._node.get_name()}; it has {', '.join(self._table)}.")
        value = self._node.get_parameter(name).value
        return list(value) if isinstance(self._table[name].default, list) else value

    def as_dict(self) -> dict[str, Any]:
        """All values by name."""
        return {name: self[name] for name in self._table}

    def _declare(self, row: Parameter) -> None:
        try:
            self._node.declare_parameter(row.name, row.default, row.descriptor())
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            value = self._overrides()[row.name].value
            why = (row.fault(value) or str(error)) if isinstance(error, InvalidParameterValueException) else row.expected_type(value)
            raise InputError(f"Parameter {row.name} of {self._node.get_name()} is {value!r}: {why} ({row.description}).") from None

    def _overrides(self) -> dict[str, RosParameter]:
        # rclpy has no public function that lists the overrides a node was started with.
        return dict(getattr(self._node, "_parameter_overrides", {}))

    def _check(self, parameters: list[RosParameter]) -> SetParametersResult:
        try:
            return self._checked(parameters)
        except Exception as error:
            # rclpy would end the node: a request with any value must be answered.
            return SetParametersResult(successful=False, reason=plain_text(f"{type(error).__name__}: {error}; the old values stay"))

    def _checked(self, parameters: list[RosParameter]) -> SetParametersResult:
        for parameter in parameters:
            row = self._table.get(parameter.name)
            fault = row.fault(parameter.value) if row is not None and parameter.value is not None else ""
            if fault:
                value = plain_text(repr(parameter.value))
                return SetParametersResult(successful=False, reason=f"{parameter.name} = {value} refused: {fault}; the old value stays")
        if self._check_together is not None:
            try:
                self._check_together({**self.as_dict(), **{p.name: p.value for p in parameters if p.name in self._table}})
            except InputError as error:
                return SetParametersResult(successful=False, reason=f"{error} The old values stay.")
        return SetParametersResult(successful=True)

    def _warn_of_unknown_keys(self) -> None:
        for key in self._overrides():
            if key in self._table or key.startswith(_KEYS_OF_ROS):
                continue
            near = difflib.get_close_matches(key, self._table, n=1)
            hint = f" did you mean {near[0]}?" if near else f" known are {', '.join(self._table)}."
            self._node.get_logger().warning(f"Parameter {key} is not one of {self._node.get_name()} and is ignored;{hint}")


def description_in(file: str) -> str:
    """The robot description that the parameter `robot_description_file` names, a URDF. Raises InputError where it cannot be read."""
    try:
        return read_regular(Path(file), LIMITS.DESCRIPTION.value).decode()
    except (OSError, ValueError) as error:
        raise InputError(f"Parameter robot_description_file is {plain_text(file)}: {plain_text(str(error))}; give a URDF.") from None
