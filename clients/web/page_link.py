"""The address of a page: its entries as a fragment, and the link to copy."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from typing import Any

from nicegui import events, ui

from clients.web.page_state import PageState
from clients.web.shared_entries import fragment_of

UPDATE_DELAY_S = 0.5
"""Delay after the last change before the address in the browser is updated."""

READ = """
window.addEventListener("hashchange",
  () => emitEvent("oc-fragment", location.hash.slice(1)));
return location.hash.slice(1);
"""
COPY = """
const link = location.origin + "/?token=" + TOKEN + location.hash;
if (navigator.clipboard) navigator.clipboard.writeText(link);
else {  // no clipboard API over HTTP from another machine
  const text = document.body.appendChild(document.createElement("textarea"));
  text.value = link;
  text.select();
  document.execCommand("copy");
  text.remove();
}
"""


class PageLink:
    """Keep the fragment of the browser's address in sync with the entries.

    Parameters
    ----------
    token : the access token, part of a copied link
    scene : returns the chosen scene
    on_fragment : called with the new fragment when the address of the open page changes
    element : an element of the page
    """

    def __init__(
        self,
        state: PageState,
        token: str,
        *,
        scene: Callable[[], str],
        on_fragment: Callable[[str], None],
        element: ui.element,
    ) -> None:
        self._state, self._token, self._scene = state, token, scene
        self._on_fragment, self._element = on_fragment, element
        self._fragment = ""
        self._is_read = False
        self._pending_update: asyncio.Task[None] | None = None
        ui.on("oc-fragment", self._changed)

    async def read(self) -> str | None:
        """Return the fragment that the page was opened with; None if the browser left.

        The address is not written before that, as it would replace the fragment.
        """
        try:
            fragment = str(await ui.run_javascript(READ, timeout=10.0))
        except TimeoutError:
            return None
        self._is_read, self._fragment = True, fragment
        return fragment

    def _changed(self, event: events.GenericEventArguments) -> None:
        fragment: Any = event.args
        if isinstance(fragment, str) and fragment not in ("", self._fragment):
            self._fragment = fragment
            self._on_fragment(fragment)

    def schedule_update(self) -> None:
        """Write the entries to the browser's address after a delay without changes."""
        self.close()
        if self._is_read:
            self._pending_update = asyncio.create_task(self._write_later())

    async def _write_later(self) -> None:
        await asyncio.sleep(UPDATE_DELAY_S)
        self._pending_update = None
        self._write()

    def _write(self) -> None:
        if self._element.is_deleted:  # an upload may end after its page was closed
            return
        fragment = fragment_of(self._state, self._scene())
        if fragment != self._fragment:
            self._fragment = fragment
            with self._element:
                ui.run_javascript(f'history.replaceState(null, "", "#{fragment}")')

    def copy(self) -> None:
        """Copy a link to the entries that contains the token."""
        self._write()
        ui.run_javascript(COPY.replace("TOKEN", json.dumps(self._token)))
        ui.notify(
            "Link copied. Anyone who has it can use this page; it does not contain "
            "uploaded files.",
            position="top",
            timeout=6000,
        )

    def close(self) -> None:
        """Cancel the pending update."""
        if self._pending_update is not None:
            self._pending_update.cancel()
            self._pending_update = None
