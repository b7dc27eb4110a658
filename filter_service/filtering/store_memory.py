"""What the stores of all streams may take together, and which of them go for others."""

from __future__ import annotations

from collections.abc import Sequence

from filter_service.errors import OutOfMemory
from filter_service.filtering.stream_eyes import StreamEyes, Wanted

IDLE_S = 5.0
"""A store that no frame has used for so long may go; its eye is prepared again when
frames come for it.  To take those in use would only have them take turns."""


def held_mb(streams: Sequence[StreamEyes]) -> float:
    """Return what all stores take."""
    return sum(
        prepared.whole_mb
        for stream in streams
        for eye in stream.eyes
        for prepared in eye.stores
    )


def make_room(
    streams: Sequence[StreamEyes],
    wanted: Wanted,
    size_mb: float,
    *,
    max_mb: float,
    now_s: float,
) -> None:
    """Retire stores, those unused for longest first, until one more has room.

    Raises
    ------
    OutOfMemory
        The rest is in use.
    """
    replaced = wanted.eye.store_for(wanted.camera)
    kept_mb = held_mb(streams) - (replaced.whole_mb if replaced is not None else 0.0)
    idle = sorted(
        (
            (prepared.used_s, number, stream, eye, prepared)
            for number, stream in enumerate(streams)
            for eye in stream.eyes
            for prepared in eye.stores
            if now_s - prepared.used_s > IDLE_S and prepared is not replaced
        ),
        key=lambda found: found[:2],
    )
    for _, _, stream, eye, prepared in idle:
        if kept_mb + size_mb <= max_mb:
            return
        eye.stores.remove(prepared)
        stream.retired += prepared.loaded
        kept_mb -= prepared.whole_mb
    if kept_mb + size_mb > max_mb:
        raise OutOfMemory(
            f"these PSFs take {size_mb:.0f} MB, and those in use {kept_mb:.0f} MB",
            allowed=f"{max_mb:.0f} MB in all (max_stores_mb)",
        )
