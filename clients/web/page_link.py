"""The address of a page: its entries as the fragment, and the link that is copied."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from typing import Any

from nicegui import events, ui

from clients.web.page_state import PageState
from clients.web.shared_entries import fragment_of

REST_S = 0.5
"""Time after the last change until the address in the browser is renewed."""

READ = """
window.addEventListener("hashchange",
  () => emitEvent("oc-fragment", location.hash.slice(1)));
return location.hash.slice(1);
"""
COPY = """
const link = location.origin + "/?token=" + TOKEN + location.hash;
if (navigator.clipboard) navigator.clipboard.writeText(link);
else {  // unencrypted, and not from this machine
  const text = document.body.appendChild(document.createElement("textarea"));
  text.value = link;
  text.select();
  document.execCommand("copy");
  text.remove();
}
"""


class PageLink:
    """Keeps the fragment of the browser's address up to date with the entries.

    Parameters
    ----------
    token : the access token, part of a copied link
    scene : returns the chosen scene
    on_fragment : called with a fragment that the address got in the open page
    place : an element of the page
    """

    def __init__(
        self,
        state: PageState,
        token: str,
        *,
        scene: Callable[[], str],
        on_fragment: Callable[[str], None],
        place: ui.element,
    ) -> None:
        self._state, self._token, self._scene = state, token, scene
        self._on_fragment, self._place = on_fragment, place
        self._fragment = ""
        self._is_read = False
        self._waiting: asyncio.Task[None] | None = None
        ui.on("oc-fragment", self._changed)

    async def read(self) -> str | None:
        """Return the fragment that the page was opened with; None if it has left.

        Until then the address is not written, which would replace that fragment.
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

    def renew(self) -> None:
        """Write the entries to the browser's address once they have rested."""
        self.close()
        if self._is_read:
            self._waiting = asyncio.create_task(self._write_later())

    async def _write_later(self) -> None:
        await asyncio.sleep(REST_S)
        self._waiting = None
        self._write()

    def _write(self) -> None:
        if self._place.is_deleted:  # an upload may end after its page was closed
            return
        fragment = fragment_of(self._state, self._scene())
        if fragment != self._fragment:
            self._fragment = fragment
            with self._place:
                ui.run_javascript(f'history.replaceState(null, "", "#{fragment}")')

    def copy(self) -> None:
        """Copy a link to the entries that contains the token."""
        self._write()
        ui.run_javascript(COPY.replace("TOKEN", json.dumps(self._token)))
        ui.notify(
            "Link copied. Whoever has it can use this page; uploaded files are not "
            "part of it.",
            position="top",
            timeout=6000,
        )

    def close(self) -> None:
        """Cancel what waits."""
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None
