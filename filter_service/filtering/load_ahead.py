"""Loads the code that frames need while the service waits for its first client."""

from __future__ import annotations

import logging
import threading

log = logging.getLogger("ocufilter")


def load_ahead() -> None:
    """Start loading in a thread; an earlier frame waits for what it needs.

    Python's imports let other threads run every 5 ms, so clients hardly notice.
    """
    threading.Thread(target=_load, name="load ahead", daemon=True).start()


def _load() -> None:
    try:
        from filter_service.rendering.plan_once import plan_once

        plan_once()
    except Exception:  # the first frame reports the error
        log.exception("could not load ahead")
