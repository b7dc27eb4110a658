"""Sanitize file names sent by browsers, for display and for saving."""

from pathlib import Path

MAX_STEM_CHARACTERS, MAX_SUFFIX_CHARACTERS = 60, 8


def plain_name(sent: str) -> str:
    """Return a name without folders, control characters and excess length."""
    name = sent.replace("\\", "/").rpartition("/")[2]
    shown = Path("".join(filter(str.isprintable, name)).strip(" ."))
    stem, suffix = shown.stem[:MAX_STEM_CHARACTERS], shown.suffix
    return (stem + suffix[:MAX_SUFFIX_CHARACTERS]) or "unnamed"
