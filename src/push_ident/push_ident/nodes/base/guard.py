"""The guard around everything that reaches a node from outside: what cannot be used is refused, counted and named, and the node goes on."""

from __future__ import annotations

import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from inspect import signature
from typing import Any, Final, TypeVar

from push_ident.errors import PushIdentError
from push_ident.limits import plain_text
from push_ident.nodes.base.settings import NODE

_OTHERS: Final = "other sources"
_MARK: Final = "guarded_source"
_MESSAGE_AND_INFO: Final = signature(lambda message, info: None)

T = TypeVar("T")


class Guard:
    """Refuses, counts and names.

    A `PushIdentError` is a refusal with its own text. Any other exception is one as well, with the name of its type: an unforeseen
    message must not end a node that watches an arm. Its traceback is logged at debug level.

    Args:
        logger: gives the logger of the node.
        is_alive: whether the context of ROS still exists; what fails because it was shut down is no refusal.
    """

    def __init__(self, logger: Callable[[], Any], is_alive: Callable[[], bool] = lambda: True) -> None:
        self._logger, self._is_alive = logger, is_alive
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._last = ""
        self._logged: dict[str, float] = {}

    @property
    def refused(self) -> int:
        """Messages, requests and jobs refused so far."""
        return self._counts.total()

    def values(self) -> dict[str, str]:
        """For diagnostics: how much was refused, and the last of it."""
        with self._lock:
            return {"refused": str(self._counts.total()), "last refusal": self._last or "none"}

    def refuse(self, source: str, why: str) -> None:
        """Count and log something from `source`, a topic, service, action or thread, that cannot be used."""
        text = f"{source}: {plain_text(why)}"
        with self._lock:
            self._counts[source if source in self._counts or len(self._counts) < NODE.n_sources else _OTHERS] += 1
            self._last = text
            now = time.monotonic()
            key = source if source in self._counts else _OTHERS
            is_due = now >= self._logged.get(key, -NODE.log_period) + NODE.log_period
            if is_due:
                self._logged[key] = now
            count = self._counts[key]
        if is_due:
            self._logger().warning(f"refused: {text}" + (f" ({count} so far)" if count > 1 else ""))

    def explain(self, error: Exception) -> str:
        """Description of an exception: its text, and its type where this package did not raise it deliberately."""
        if isinstance(error, PushIdentError):
            return str(error)
        self._logger().debug("".join(traceback.format_exception(error)))
        return f"{type(error).__name__}: {error}"

    @contextmanager
    def watch(self, source: str) -> Iterator[None]:
        """Refuse whatever fails inside, instead of raising it."""
        try:
            yield
        except Exception as error:
            if self._is_alive():
                self.refuse(source, self.explain(error))

    def callback(self, source: str, work: Callable[..., T]) -> Callable[..., T | None]:
        """`work`, a callback with at most one argument, such that it never raises."""

        # Not *args: rclpy looks at the signature of a subscription's callback.
        def guarded(message: Any = None) -> T | None:
            with self.watch(source):
                return work() if message is None else work(message)
            return None

        return self._marked(guarded, source)

    def noted(self, source: str, work: Callable[[Any], T], note: Callable[[Any], None]) -> Callable[..., T | None]:
        """The same for a subscription whose callback gets message and info: `note` gets the info, `work` the message."""

        def guarded(*taken: Any) -> T | None:
            with self.watch(source):
                # Executors with wait sets pass two arguments, that of events (rclpy 7.1.6) a tuple of both.
                message, info = taken if len(taken) == 2 else taken[0]
                note(info)
                return work(message)
            return None

        # By which rclpy sees that the callback takes the info.
        guarded.__signature__ = _MESSAGE_AND_INFO  # type: ignore[attr-defined]
        return self._marked(guarded, source)

    def service(self, source: str, work: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """`work`, the callback of a service, such that every request gets an answer: a refusal has success = false and the reason."""

        def guarded(request: Any, response: Any) -> Any:
            try:
                return work(request, response)
            except Exception as error:
                why = self.explain(error)
            self.refuse(source, why)
            return refusal(request, type(response)(), why)

        return self._marked(guarded, source)

    @staticmethod
    def _marked(callback: Callable[..., Any], source: str) -> Callable[..., Any]:
        setattr(callback, _MARK, source)
        return callback


def is_guarded(callback: Callable[..., Any]) -> bool:
    """Whether a callback was made by a guard."""
    return hasattr(callback, _MARK)


def refusal(request: Any, response: Any, why: str) -> Any:
    """The response of a service that refuses: `success` and `message` where it has them; one result a parameter where it sets those."""
    why = plain_text(why)
    if hasattr(response, "success"):
        response.success = False
    if hasattr(response, "message"):
        response.message = why
    if hasattr(response, "results") and hasattr(request, "parameters"):
        from rcl_interfaces.msg import SetParametersResult

        response.results = [SetParametersResult(successful=False, reason=why) for _ in request.parameters]
    if hasattr(response, "result") and hasattr(response.result, "successful"):
        response.result.successful, response.result.reason = False, why
    return response
