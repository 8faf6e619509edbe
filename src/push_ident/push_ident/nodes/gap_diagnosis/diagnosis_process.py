"""A diagnosis in a process of its own: it takes seconds, and a node that computes receives nothing meanwhile."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any, Final

from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.diagnosis_json import to_json
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.errors import PushIdentError
from push_ident.nodes.lifetime import end_with_parent, stop_signals_blocked
from push_ident.pushing.push import PushSettings
from push_ident.types import PushRecord

__all__ = ["DiagnosisProcess"]

_STAGE, _DONE, _FAILED = "stage", "done", "failed"
_POLL_INTERVAL: Final = 0.1
"""Between two checks whether it should continue [s]."""


class DiagnosisProcess:
    """Runs one diagnosis; `wait` returns its JSON, `stop` ends it at once."""

    def __init__(self, records: Sequence[PushRecord], settings: DiagnosisSettings, push_settings: PushSettings) -> None:
        # A fork would copy the locks of the middleware's threads.
        context = multiprocessing.get_context("spawn")
        self._receive, send = context.Pipe(duplex=False)
        self._process = context.Process(target=_run, args=(send, list(records), settings, push_settings), daemon=True)
        # A Ctrl-C at the terminal reaches this process, too; the node ends it.
        with stop_signals_blocked():
            self._process.start()
        send.close()

    def wait(self, on_stage: Callable[[str], None], should_continue: Callable[[], bool]) -> dict[str, Any] | None:
        """The outcome as JSON; None where it was ended because `should_continue` returned False.

        Raises:
            PushIdentError: the diagnosis failed.
        """
        try:
            while should_continue():
                if not self._receive.poll(_POLL_INTERVAL):
                    continue
                kind, content = self._receive.recv()
                if kind == _STAGE:
                    on_stage(content)
                elif kind == _FAILED:
                    raise PushIdentError(content)
                else:
                    outcome: dict[str, Any] = content
                    return outcome
        except EOFError:
            raise PushIdentError(f"The diagnosis ended with exit code {self._process.exitcode}; is there enough memory?") from None
        finally:
            self.stop()
        return None

    def stop(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.join()
        self._receive.close()


def _run(send: Connection, records: list[PushRecord], settings: DiagnosisSettings, push_settings: PushSettings) -> None:
    end_with_parent()
    try:
        found = diagnose(records, settings, push_settings=push_settings, on_progress=lambda text: send.send((_STAGE, text)))
        send.send((_DONE, to_json(found)))
    except PushIdentError as error:
        send.send((_FAILED, str(error)))
    except Exception as error:
        send.send((_FAILED, f"{type(error).__name__}: {error}"))
