"""Loads what plans of frames need while the service waits for its first client."""

from __future__ import annotations

import logging
import threading

log = logging.getLogger("ocufilter")


def load_ahead() -> None:
    """Begin to load in a thread; a frame that comes first waits for what it needs.

    Python's imports let other threads run every 5 ms, so that clients hardly notice.
    """
    threading.Thread(target=_load, name="load ahead", daemon=True).start()


def _load() -> None:
    try:
        from filter_service.rendering.plan_once import plan_once

        plan_once()
    except Exception:  # the first frame will say what is wrong
        log.exception("could not load ahead")
