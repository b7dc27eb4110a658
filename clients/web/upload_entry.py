"""An entry for a file, which says so where it is of another kind."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui


def upload_entry(label: str, accept: str, take: Callable[[Any], Any]) -> ui.upload:
    """Return an entry for a file.

    Parameters
    ----------
    accept : as HTML has it: the browser itself refuses other files, and says nothing
    take : called with each file
    """
    allowed = "a picture" if accept == "image/*" else accept.replace(",", ", ")

    def refuse() -> None:
        ui.notify(f"{label}: not such a file; allowed: {allowed}", type="negative")

    entry = ui.upload(
        auto_upload=True, label=label, on_upload=take, on_rejected=refuse
    ).props(f'accept="{accept}" flat bordered')
    return entry.classes("oc-upload")
