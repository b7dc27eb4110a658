"""A process beside the page that draws figures and point-spread functions.

Estimating and tracing an eye takes tenths of a second in which Python's lock is held:
in the page's own process that would hold up its event loop and its frames.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any


def _begin() -> None:
    """End with the page's process, however that ends; load what is slow to load."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    from clients.web import eye_figures, point_spread  # noqa: F401


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(0)  # in the midst of whatever it draws: nobody waits for it


class Studying:
    """One process; of the questions of one kind and page that wait, the newest wins."""

    def __init__(self) -> None:
        self._pool = ProcessPoolExecutor(
            1, mp_context=multiprocessing.get_context("spawn"), initializer=_begin
        )
        self._newest: dict[tuple[str, str], int] = {}
        self._turn = asyncio.Lock()
        self._pool.submit(int)  # starts the process now

    async def ask(
        self, page: str, kind: str, function: Callable[..., Any], *args, **options
    ) -> Any:
        """Return what the function returns there; None where a newer question came.

        Raises
        ------
        Exception
            What the function raised.
        """
        key = (page, kind)
        number = self._newest.get(key, 0) + 1
        self._newest[key] = number
        async with self._turn:  # asked one by one: what waits can be dropped
            if self._newest.get(key) != number:
                return None
            call = _Call(function, args, options)
            loop = asyncio.get_running_loop()
            return await loop.run_in_executor(self._pool, call)

    def forget(self, page: str) -> None:
        """Let go of a page's questions."""
        for key in [key for key in self._newest if key[0] == page]:
            del self._newest[key]

    def close(self) -> None:
        """End the process."""
        self._pool.shutdown(wait=False, cancel_futures=True)


class _Call:
    """A call that travels to the other process."""

    def __init__(self, function, args, options) -> None:
        self.function, self.args, self.options = function, args, options

    def __call__(self) -> Any:
        return self.function(*self.args, **self.options)
