"""Texts that are cut to what a header may hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from filter_service.wire.checks import take_list, take_text

MAX_NOTES = 8
MAX_NOTE_BYTES = 200
MAX_TEXT_BYTES = 1600
MAX_ALLOWED_BYTES = 1000


def clip(text: str, max_bytes: int) -> str:
    """Return the text, shortened with dots where its UTF-8 form is too long."""
    encoded = text.encode("utf-8", "replace")
    if len(encoded) <= max_bytes:
        return encoded.decode("utf-8")
    return encoded[: max_bytes - 3].decode("utf-8", "ignore") + "..."


def clip_notes(notes: Sequence[str]) -> list[str]:
    """Return the notes that fit into a header."""
    return [clip(note, MAX_NOTE_BYTES) for note in notes[:MAX_NOTES]]


def take_notes(header: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the notes of a reply."""
    notes = take_list(header, "notes", min_items=0, max_items=MAX_NOTES, default=[])
    return tuple(
        take_text({"note": note}, "note", max_characters=2048, path=f"notes[{i}]")
        for i, note in enumerate(notes)
    )
