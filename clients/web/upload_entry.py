"""File upload that reports files of another kind."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from fastapi import HTTPException
from nicegui import events, ui

from clients.web.file_names import plain_name

HEADER = """
<div class="row no-wrap items-center q-px-sm" style="min-height: 40px">
  <span class="col">LABEL</span>
  <q-btn v-if="props.canAddFiles" icon="add" flat dense @click="props.pickFiles"
         aria-label="Choose a file: LABEL"></q-btn>
  <span style="display: none"><q-uploader-add-trigger></q-uploader-add-trigger></span>
</div>"""
"""Head of an upload; the buttons of Quasar's own have no accessible names."""

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


def upload_entry(label: str, accept: str, most_bytes: int, take: Taking) -> ui.element:
    """Return a file upload; what is wrong with a file is written below it.

    Parameters
    ----------
    accept : as in HTML; the browser rejects other files itself, without a message
    most_bytes : a larger file is refused before it is in memory
    take : called with the name and the content of each file; a ValueError is shown
    """
    allowed = "a picture" if accept == "image/*" else accept.replace(",", ", ")
    allowed += f", up to {most_bytes / 1e6:g} MB"

    def say(text: str) -> None:
        problem.text = text

    def refuse() -> None:
        say(f"{label}: not such a file; allowed: {allowed}")

    async def check(event: events.UploadEventArguments) -> None:
        event.sender.reset()  # ready for the next file
        if event.file.size() > most_bytes:  # the browser should have rejected it
            refuse()
            return
        say("")
        name = plain_name(event.file.name)
        try:
            await take(name, await event.file.read())
        except ValueError as error:
            text = str(error)
            say(text if name in text else f"{name}: {text}")
        except RuntimeError:
            if not entry.is_deleted:  # otherwise its page was closed meanwhile
                raise

    with ui.element("div").classes("oc-upload-entry") as box:
        entry = _Upload(
            auto_upload=True,
            label=label,
            max_file_size=most_bytes,
            on_upload=check,
            on_rejected=refuse,
        ).props(f'accept="{accept}" flat bordered')
        entry.classes("oc-upload")
        entry.add_slot("header", HEADER.replace("LABEL", label))
        problem = ui.label("").classes("oc-problem").props("role=alert")
    return box
