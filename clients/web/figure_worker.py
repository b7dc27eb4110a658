"""Worker process for figures and point-spread functions.

Estimating and tracing an eye holds Python's global lock for tenths of a second: in the
page's own process that would block its event loop and its frames.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from filter_service import FilterError

NICENESS = 10
"""Pictures have priority over figures."""


class StudyFailed(Exception):
    """There is no answer; the message says why."""


class FigureWorker:
    """One worker process; of waiting requests per kind and page, the newest wins."""

    def __init__(self) -> None:
        self._newest: dict[tuple[str, str], int] = {}
        self._turn = asyncio.Lock()
        self._is_over = False
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._line, theirs = context.Pipe()
        # not a daemon: a report starts a worker of its own
        self._process = context.Process(target=_answer_all, args=(theirs,))
        self._process.start()
        theirs.close()

    async def ask(
        self,
        page: str,
        kind: str,
        function: Callable[..., Any],
        *args: Any,
        **options: Any,
    ) -> Any:
        """Return the function's result; None if a newer request came.

        Raises
        ------
        StudyFailed
            The function failed, or the process ended.
        """
        key = (page, kind)
        number = self._newest.get(key, 0) + 1
        self._newest[key] = number
        async with self._turn:  # one by one, so that waiting requests can be dropped
            if self._newest.get(key) != number:
                return None
            return await asyncio.to_thread(self._answer, (function, args, options))

    def _answer(
        self, question: tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]
    ) -> Any:
        try:
            self._line.send(question)
            answer, failure = self._line.recv()
        except (EOFError, OSError):
            if not self._is_over:
                self._start()
            raise StudyFailed(
                "The process that draws figures ended and was restarted"
            ) from None
        if failure is not None:
            raise StudyFailed(failure)
        return answer

    def forget(self, page: str) -> None:
        """Drop a page's requests."""
        for key in [key for key in self._newest if key[0] == page]:
            del self._newest[key]

    def close(self) -> None:
        """Terminate the process, whatever it is drawing."""
        self._is_over = True  # a pending request must not restart the process
        self._process.terminate()
        self._process.join()


def _answer_all(line: Connection) -> None:
    """Handle requests until the page's process is gone."""
    os.nice(NICENESS)
    from clients.web import eye_figures, point_spread  # noqa: F401  (loads slowly)

    while True:
        try:
            function, args, options = line.recv()
            line.send(_answer_to(function, args, options))
        except (EOFError, OSError):
            return


def _answer_to(
    function: Callable[..., Any], args: tuple[Any, ...], options: dict[str, Any]
) -> tuple[Any, str | None]:
    """Return a result, or an error message, as some exceptions cannot be pickled."""
    try:
        return function(*args, **options), None
    except (ValueError, FilterError) as error:
        return None, str(error)
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"
