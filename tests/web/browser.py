"""How tests and the benchmark see the page: what is drawn, and what is entered."""

import io
import shutil
import time

import numpy as np
from PIL import Image

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
WAIT_MS = 90_000
REST_MS = 300
"""Time without another picture after which one is final."""
DRAWN = "window.ocufilter?.drawn ?? []"


def open_browser(playwright):
    """Start Chromium of the system."""
    path = next(filter(None, map(shutil.which, BROWSERS)))
    # as root there is no sandbox; what is opened is our own page
    return playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])


class PageUnderTest:
    """The page, as a person sees it."""

    def __init__(self, page, wait_ms: int = WAIT_MS) -> None:
        self.page = page
        self.wait_ms = wait_ms
        self.errors = []
        page.set_default_timeout(wait_ms)
        page.on("pageerror", lambda error: self.errors.append(str(error)))

    def open(self, address) -> None:
        """Open it and wait for the first full picture."""
        self.page.goto(address)
        self.settle()

    def choose(self, text) -> None:
        """Press what bears a text."""
        self.page.get_by_role("button", name=text, exact=True).first.click()

    def pick(self, css, text) -> None:
        """Choose an option of a list."""
        self.page.locator(css).first.click()
        self.page.get_by_role("option", name=text, exact=True).click()

    def wear(self, kind) -> None:
        """Wear a kind of correction."""
        if self.page.locator(".oc-worn-kind").count() == 0:
            self.page.get_by_text("Wears a correction").first.click()
        self.pick(".oc-worn-kind", kind)

    def press(self, slider, key, count) -> None:
        """Move a slider by keys."""
        thumb = self.slider(slider)
        thumb.focus()
        for _ in range(count):
            thumb.press(key)
        self.page.wait_for_timeout(100)  # a slider reports every 30 ms

    def drawn(self):
        """Return what was drawn, in order."""
        return self.page.evaluate(DRAWN)

    def number(self) -> int:
        """Return the number of the newest wish that was drawn."""
        return max((entry["number"] for entry in self.drawn()), default=0)

    def settle(self, after: int = 0, eye: str = "OD"):
        """Wait for a full picture of a newer wish; return what was told of it.

        Newest: no preview of a later wish came before it.

        Raises
        ------
        TimeoutError
            If pictures keep changing for `wait_ms`.
        """
        end_s = time.monotonic() + 1e-3 * self.wait_ms
        wanted = f"""({DRAWN}).filter(d => d.eye === '{eye}').at(-1)"""
        while time.monotonic() < end_s:
            self.page.wait_for_function(
                f"(() => {{ const last = {wanted}; return last && last.kind === 'full' "
                f"&& last.number > {after}; }})()",
                timeout=self.wait_ms,
            )
            found = self.page.evaluate(wanted)
            # an entry may send two requests: a preview of the second follows at once
            self.page.wait_for_timeout(REST_MS)
            if self.page.evaluate(wanted) == found:
                return found
        raise TimeoutError(
            f"the pictures of {eye} still change after {self.wait_ms} ms"
        )

    def seen(self, eye: str = "OD", layer: str = "after"):
        """Return the pixels that are drawn for an eye, (h, w, 3)."""
        data = self.page.evaluate(
            """([eye, layer]) => {
              const canvas = document.querySelector(
                `.oc-view[data-eye=${eye}] .oc-${layer}`);
              return canvas.toDataURL("image/png").split(",")[1];
            }""",
            [eye, layer],
        )
        return pixels_of(data)

    def entry(self, name, index=0):
        """Return the entry of a number."""
        return self.page.locator(f"input[data-name={name}]").nth(index)

    def slider(self, name, index=0):
        """Return the part of a slider that takes keys."""
        return self.page.locator(f".oc-slider input[data-name={name}]").nth(index)

    def box(self, eye: str = "OD"):
        """Return where the pictures of an eye are."""
        return self.page.locator(f".oc-view[data-eye={eye}]").bounding_box()


def pixels_of(base64_png):
    """Return the picture in a text."""
    import base64

    image = Image.open(io.BytesIO(base64.b64decode(base64_png)))
    return np.asarray(image.convert("RGB"))
