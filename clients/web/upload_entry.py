"""File upload that reports rejected files."""

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
"""Header of an upload; the buttons of Quasar's default have no accessible names."""

UploadHandler = Callable[[str, bytes], Awaitable[None]]


class _Upload(ui.upload):
    """Upload whose page may be closed by the time a file has arrived."""

    async def handle_uploads(self, files: list[Any]) -> None:
        """Pass the files on; raise an HTTP error if the page was closed.

        NiceGUI's own method raises an error that ends up in the log.
        """
        if self.is_deleted:
            raise HTTPException(410, "the page was closed")
        await super().handle_uploads(files)


def upload_entry(
    label: str, accept: str, max_bytes: int, on_file: UploadHandler
) -> ui.element:
    """Return a file upload that shows errors below it.

    Parameters
    ----------
    accept : as in HTML; the browser rejects other files itself, without a message
    max_bytes : size limit, checked before the file is in memory
    on_file : called with the name and content of each file; a ValueError is shown
    """
    allowed = "a picture" if accept == "image/*" else accept.replace(",", ", ")
    allowed += f", up to {max_bytes / 1e6:g} MB"

    def show_problem(text: str) -> None:
        problem.text = text

    def reject() -> None:
        show_problem(f"{label}: not such a file; allowed: {allowed}")

    async def check(event: events.UploadEventArguments) -> None:
        event.sender.reset()  # ready for the next file
        if event.file.size() > max_bytes:  # the browser should have rejected it
            reject()
            return
        show_problem("")
        name = plain_name(event.file.name)
        try:
            await on_file(name, await event.file.read())
        except ValueError as error:
            text = str(error)
            show_problem(text if name in text else f"{name}: {text}")
        except RuntimeError:
            if not entry.is_deleted:  # otherwise the page was closed meanwhile
                raise

    with ui.element("div").classes("oc-upload-entry") as box:
        entry = _Upload(
            auto_upload=True,
            label=label,
            max_file_size=max_bytes,
            on_upload=check,
            on_rejected=reject,
        ).props(f'accept="{accept}" flat bordered')
        entry.classes("oc-upload")
        entry.add_slot("header", HEADER.replace("LABEL", label))
        problem = ui.label("").classes("oc-problem").props("role=alert")
    return box
