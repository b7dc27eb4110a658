"""Time from an entry on the web page to a new picture, in a browser.

Needs what `sh setup.sh web` installs.  `ocufilter web` runs as a program, Chromium
without a window opens it and looks at the courtyard.  Sliders of pupil, focus, sphere
and age are moved by one step with a key; "A | B" is the sphere of state B while both
states are shown.  The time runs in the browser, from the key's event to the end of
drawing: of the first new picture (``preview``) and of the full one (``full``), which
waits until the hand has rested for 0.12 s.  ``drag`` is a slider that is moved for two
seconds, every 30 ms: the times between two new pictures of its eye.  ``worst gap`` is
the longest of these in each drag, and the wait for its first picture.

Errors are of linear light, of what is drawn (a preview enlarged to the full size),
against the same eye with finest interpolation and exact rendering.  Memory is that of
the program with the processes beside it, without the browser.
"""

import io
import json
import selectors
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

from clients.web.filter_thread import FULL, EyeView, PictureRequest
from clients.web.picture import linear_from_srgb8, scene_picture
from filter_service import EyeFilter
from filter_service.messages import State
from tests.benchmarks.harness import ROOT, Row, Run
from tests.benchmarks.rows import row_of
from tests.web.browser import PageUnderTest, open_browser

MINUTES = 5
SLIDERS = {
    "pupil": ("OD", ".oc-slider input[data-name=pupil_diameter_mm]"),
    "focus": ("OD", ".oc-slider input[data-name=focus_dpt]"),
    "sphere": ("OD", ".oc-slider input[data-name=sphere_slider_dpt]"),
    "age": ("OD", ".oc-slider input[data-name=age_years]"),
    "A | B": (
        "OD_B",
        "[data-eye-panel=OD_B] .oc-slider input[data-name=sphere_slider_dpt]",
    ),
}
"""The eye whose pictures are timed, and the slider; the last one is only shown while
two states are compared."""

STATES = (
    {},
    {"pupil_diameter_mm": 6.0},
    {"focus_dpt": 3.0},
    {"sphere_dpt": 0.0},
    {"sphere_dpt": -5.0},
    {"age_years": 65.0},
)
COUNT = 8
DRAG_S, DRAG_STEP_S, N_DRAGS = 2.0, 0.03, 2
QUICK_SLIDERS = ("pupil", "A | B")
START_LIMIT_S, WAIT_MS = 30.0, 20_000

TIME_KEYS = """
window.pressed = [];
document.addEventListener("keydown",
  () => window.pressed.push({at_ms: performance.now(), after: window.ocufilter.drawn
    .reduce((n, d) => Math.max(n, d.number), 0)}), true);
"""


def say(text: str) -> None:
    """Print progress on stderr."""
    print(f"web: {text}", file=sys.stderr, flush=True)


def newer(page: PageUnderTest, eye: str, after: int) -> list[dict]:
    """Return what was drawn for an eye after a request."""
    return [d for d in page.drawn() if d["number"] > after and d["eye"] == eye]


def pressed(page: PageUnderTest, eye: str, css: str, key: str) -> dict[str, float]:
    """Move a slider by one step; return the times in ms to its pictures."""
    page.page.locator(css).first.press(key)
    press = page.page.evaluate("window.pressed.at(-1)")
    page.settle(after=press["after"], eye=eye)
    seen = newer(page, eye, press["after"])
    full = next(entry for entry in seen if entry["kind"] == "full")
    return {
        "preview": seen[0]["at_ms"] - press["at_ms"],
        "full": full["at_ms"] - press["at_ms"],
    }


def dragged(page: PageUnderTest, eye: str, css: str) -> dict[str, list[float]]:
    """Move a slider to and fro; return the times between pictures, and the worst."""
    thumb = page.page.locator(css).first
    first, n_pressed = page.number(), page.page.evaluate("window.pressed.length")
    end_s, step = time.monotonic() + DRAG_S, 0
    while time.monotonic() < end_s:
        thumb.press("ArrowRight" if (step // 6) % 2 else "ArrowLeft")
        step += 1
        time.sleep(DRAG_STEP_S)
    page.settle(after=first, eye=eye)
    begin_ms = page.page.evaluate(f"window.pressed[{n_pressed}].at_ms")
    previews_ms = [d["at_ms"] for d in newer(page, eye, first) if d["kind"] != "full"]
    gaps_ms = np.diff([begin_ms, *previews_ms])
    return {"drag": list(gaps_ms[1:]), "worst gap": [float(gaps_ms.max())]}


def program_mb(process_id: int) -> float:
    """Return the memory of a process and of those that it started, 10^6 bytes."""
    children = Path(f"/proc/{process_id}/task/{process_id}/children")
    own = Path(f"/proc/{process_id}/smaps_rollup").read_text(encoding="utf-8")
    line = next(line for line in own.splitlines() if line.startswith("Pss:"))
    total = int(line.split()[1]) * 1024 / 1e6
    return total + sum(map(program_mb, map(int, children.read_text().split())))


def printed_line(program: subprocess.Popen) -> str:
    """Return the first line that a program prints, which may take so long."""
    with selectors.DefaultSelector() as selector:
        selector.register(program.stdout, selectors.EVENT_READ)
        if not selector.select(START_LIMIT_S):
            raise TimeoutError(f"ocufilter web: no address within {START_LIMIT_S:g} s")
    return program.stdout.readline()


def times(sliders, count: int, n_drags: int) -> tuple[dict, float]:
    """Return times in ms by slider and method, and the program's memory in MB."""
    command = [sys.executable, "-m", "ocufilter", "web"]
    command += ["--no-browser", "--port", "0", "--json"]
    found: dict[tuple[str, str], list[float]] = defaultdict(list)
    program = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        address = json.loads(printed_line(program))["address"]
        with sync_playwright() as playwright, open_browser(playwright) as browser:
            size = {"width": 1280, "height": 800}
            page = PageUnderTest(browser.new_page(viewport=size), WAIT_MS)
            page.open(address)
            say("the first picture is drawn")
            page.page.evaluate(TIME_KEYS)
            for name in sliders:
                eye, css = SLIDERS[name]
                if name == "A | B":
                    number = page.number()
                    page.page.get_by_text("Compare A | B").click()
                    page.settle(after=number, eye=eye)
                pressed(page, eye, css, "ArrowRight")  # its first, not counted
                for turn in range(count):
                    key = "ArrowLeft" if turn % 2 else "ArrowRight"
                    for method, taken_ms in pressed(page, eye, css, key).items():
                        found[name, method].append(taken_ms)
                for _ in range(n_drags):
                    for method, taken in dragged(page, eye, css).items():
                        found[name, method] += taken
                say(f"{name} is done")
            return found, program_mb(program.pid)
    finally:
        program.terminate()
        program.wait(10.0)


def errors(states, tolerance: str) -> dict[str, float]:
    """Return the lowest PSNR over some states of each kind of picture, dB."""
    picture, eye = scene_picture("courtyard"), EyeView("OD")
    found: dict[str, list[float]] = {"preview": [], "full": []}
    with EyeFilter() as exact:
        for number, changes in enumerate(states, 1):
            body = {"kind": "prescription", "sphere_dpt": -2.0, "age_years": 30.0}
            state = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
            for name, value in changes.items():
                (state if name in state else body)[name] = value
            looked = State(**state, gaze_deg=(0.0, 0.0))
            wish = PictureRequest(number, picture, {"OD": body}, looked)
            pupil_mm, focus_dpt = state["pupil_diameter_mm"], state["focus_dpt"]
            settings = FULL.changed(
                tolerance=tolerance,
                pupil_range_mm=(pupil_mm, pupil_mm),
                focus_range_dpt=(focus_dpt, focus_dpt),
            )
            exact.set_profile(body, settings=settings, views=picture.view.camera)
            exact.wait()
            reference = exact.filter([picture.view], **state, render_tolerance=0.0)
            for kind, values in found.items():
                while (seen := eye.picture(kind, wish)) is None:
                    time.sleep(0.002)
                values.append(_psnr_db(seen.data, reference.color))
            say(f"state {number} is compared")
    eye.close()
    return {kind: min(values) for kind, values in found.items()}


def _psnr_db(file: bytes, reference) -> float:
    height_px, width_px = reference.shape[:2]
    with Image.open(io.BytesIO(file)) as image:
        size = (width_px, height_px)
        drawn = image.convert("RGB").resize(size, Image.Resampling.BILINEAR)
    light = linear_from_srgb8(np.asarray(drawn))
    error = np.mean((light - linear_from_srgb8(reference)) ** 2, dtype=float)
    return float(-10.0 * np.log10(error))


def measure(run: Run) -> list[Row]:
    """Return a row for each slider and method."""
    sliders, count, n_drags, states = SLIDERS, COUNT, N_DRAGS, None
    if run.is_quick:
        sliders, count, n_drags, states = QUICK_SLIDERS, 1, 1, 1
    tolerance = "normal" if run.is_quick else "fine"
    found, memory_mb = times(sliders, count, n_drags)
    worst_db = errors(STATES[:states], tolerance)
    return [
        row_of(
            *("web", method, slider),
            "courtyard 960x540" if method == "full" else "courtyard 480x270",
            *(values, "psnr_db, worst"),
            worst_db["full" if method == "full" else "preview"],
            f"tolerance {tolerance}, exact rendering",
            used_mb=memory_mb,
        )
        for (slider, method), values in found.items()
    ]
