"""Diagnoses in a separate process: one takes seconds, and a node that computes receives nothing meanwhile."""

from __future__ import annotations

import multiprocessing
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.diagnosis_json import to_json
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.errors import PushIdentError
from push_ident.nodes.base.lifetime import end_with_parent, stop_signals_blocked
from push_ident.pushing.push import PushSettings
from push_ident.types import PushRecord

_STAGE, _DONE, _FAILED = "stage", "done", "failed"


class DiagnosisProcess:
    """One diagnosis at a time. The process begins with the first one and stays: the next one, of some more pushes, starts at its fits."""

    def __init__(self) -> None:
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: Connection | None = None

    def diagnose(
        self,
        records: Sequence[PushRecord],
        settings: DiagnosisSettings,
        push_settings: PushSettings,
        *,
        on_stage: Callable[[str], None],
        should_continue: Callable[[], bool],
    ) -> dict[str, Any] | None:
        """The outcome as JSON; None where it was ended because `should_continue` returned False.

        Raises PushIdentError: the diagnosis failed.
        """
        is_over = False
        try:
            connection = self._connected()
            connection.send((list(records), settings, push_settings))
            while should_continue():
                if not connection.poll(0.1):
                    continue
                kind, content = connection.recv()
                if kind == _STAGE:
                    on_stage(content)
                    continue
                is_over = True
                if kind == _FAILED:
                    raise PushIdentError(content)
                outcome: dict[str, Any] = content
                return outcome
        except (EOFError, OSError):
            raise PushIdentError(f"The diagnosis ended with exit code {self._exit_code()}; is there enough memory?") from None
        finally:
            if not is_over:
                self.stop()
        return None

    @property
    def pid(self) -> int | None:
        """Of the process; None while there is none."""
        return None if self._process is None else self._process.pid

    def stop(self) -> None:
        """End the process at once, and forget the fits."""
        if self._process is not None and self._connection is not None:
            self._process.kill()
            self._process.join()
            self._connection.close()
        self._process = self._connection = None

    def _connected(self) -> Connection:
        if self._process is not None and not self._process.is_alive():
            self.stop()
        if self._connection is None:
            # A fork would copy the locks of the middleware's threads.
            context = multiprocessing.get_context("spawn")
            self._connection, other = context.Pipe()
            self._process = context.Process(target=diagnose_requests, args=(other,), daemon=True)
            # A Ctrl-C at the terminal reaches this process, too; the node ends it.
            with stop_signals_blocked():
                self._process.start()
            other.close()
        return self._connection

    def _exit_code(self) -> int | None:
        if self._process is None:
            return None
        self._process.join(1.0)
        return self._process.exitcode


def diagnose_requests(connection: Connection) -> None:
    """What the process does: one diagnosis after the other, each starting at the fits of the latest one that succeeded."""
    end_with_parent()
    latest: Diagnosis | None = None
    while True:
        try:
            records, settings, push_settings = connection.recv()
        except EOFError:
            return
        try:
            latest = diagnose(
                records, settings, push_settings=push_settings, earlier=latest, on_progress=lambda text: connection.send((_STAGE, text))
            )
            connection.send((_DONE, to_json(latest)))
        except PushIdentError as error:
            connection.send((_FAILED, str(error)))
        except Exception as error:
            traceback.print_exc()  # unexpected: the log of the node has its traceback
            connection.send((_FAILED, f"{type(error).__name__}: {error}"))
