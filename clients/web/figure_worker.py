"""Worker process for figures and point-spread functions.

Estimating and tracing an eye holds the GIL for tenths of a second, which in the page's
own process would block its event loop and its frames.
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


class FigureFailed(Exception):
    """Raised when the function fails or the worker process ends."""


class FigureWorker:
    """One worker process.

    A newer request of the same page and kind replaces one that is still waiting.
    """

    def __init__(self) -> None:
        self._newest: dict[tuple[str, str], int] = {}
        self._lock = asyncio.Lock()
        self._is_over = False
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        # not a daemon: a report starts a worker of its own
        self._process = context.Process(target=_serve_requests, args=(theirs,))
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
        """Return the function's result; None if a newer request superseded it.

        Raises
        ------
        FigureFailed
            If the function failed or the process ended.
        """
        key = (page, kind)
        number = self._newest.get(key, 0) + 1
        self._newest[key] = number
        async with self._lock:  # one at a time, so that waiting requests can be dropped
            if self._newest.get(key) != number:
                return None
            return await asyncio.to_thread(self._exchange, (function, args, options))

    def _exchange(
        self, request: tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]
    ) -> Any:
        try:
            self._connection.send(request)
            result, error_text = self._connection.recv()
        except (EOFError, OSError):
            if not self._is_over:
                self._start()
            raise FigureFailed(
                "The process that draws figures ended and was restarted"
            ) from None
        if error_text is not None:
            raise FigureFailed(error_text)
        return result

    def forget(self, page: str) -> None:
        """Drop a page's requests."""
        for key in [key for key in self._newest if key[0] == page]:
            del self._newest[key]

    def close(self) -> None:
        """Terminate the process, whatever it is drawing."""
        self._is_over = True  # a pending request must not restart the process
        self._process.terminate()
        self._process.join()


def _serve_requests(connection: Connection) -> None:
    """Handle requests until the parent process ends."""
    os.nice(NICENESS)
    from clients.web import eye_figures, point_spread  # noqa: F401  (loads slowly)

    while True:
        try:
            function, args, options = connection.recv()
            connection.send(_call(function, args, options))
        except (EOFError, OSError):
            return


def _call(
    function: Callable[..., Any], args: tuple[Any, ...], options: dict[str, Any]
) -> tuple[Any, str | None]:
    """Return a result, or an error message, as some exceptions cannot be pickled."""
    try:
        return function(*args, **options), None
    except (ValueError, FilterError) as error:
        return None, str(error)
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"
