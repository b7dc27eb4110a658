"""File upload that reports files of another kind."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from fastapi import HTTPException
from nicegui import events, ui

from clients.web.file_names import plain_name

Taking = Callable[[str, bytes], Awaitable[None]]


class _Upload(ui.upload):
    """Upload whose page may be closed by the time a file has arrived."""

    async def handle_uploads(self, files: list[Any]) -> None:
        """Pass the files on; raise an HTTP error if the page was closed.

        NiceGUI's own method raises an error that ends up in the log.
        """
        if self.is_deleted:
            raise HTTPException(410, "the page was closed")
        await super().handle_uploads(files)


def upload_entry(label: str, accept: str, most_bytes: int, take: Taking) -> ui.upload:
    """Return a file upload.

    Parameters
    ----------
    accept : as in HTML; the browser rejects other files itself, without a message
    most_bytes : a larger file is refused before it is in memory
    take : called with the name and the content of each file
    """
    allowed = "a picture" if accept == "image/*" else accept.replace(",", ", ")
    allowed += f", up to {most_bytes / 1e6:g} MB"

    def refuse() -> None:
        ui.notify(f"{label}: not such a file; allowed: {allowed}", type="negative")

    async def check(event: events.UploadEventArguments) -> None:
        event.sender.reset()  # ready for the next file
        if event.file.size() > most_bytes:  # the browser should have rejected it
            refuse()
        else:
            await take_in(event)

    async def take_in(event: events.UploadEventArguments) -> None:
        try:
            await take(plain_name(event.file.name), await event.file.read())
        except RuntimeError:
            if not entry.is_deleted:  # otherwise its page was closed meanwhile
                raise

    entry = _Upload(
        auto_upload=True,
        label=label,
        max_file_size=most_bytes,
        on_upload=check,
        on_rejected=refuse,
    ).props(f'accept="{accept}" flat bordered')
    return entry.classes("oc-upload")
