"""Time from a slider movement to a new picture on the web page, in a browser.

    python -m tests.benchmarks.bench_web [--quick] [--json]

Needs what `sh setup.sh web` installs.  `ocufilter web` runs as a program, Chromium
without a window opens it and looks at the courtyard.  Sliders of pupil, focus, sphere
are moved by one step with a key.  The time runs in the browser, from the key's event to
the end of drawing: of the first new picture (preview) and of the full one, which waits
until the hand has rested for 0.12 s.  "drag" is a slider that is moved for two seconds,
every 30 ms: the times are those between two new pictures.

Errors are of linear light, of what is drawn (a preview enlarged to the full size),
against the same eye with finest interpolation and exact rendering.  Memory is that of
the program with the processes beside it, without the browser.  Writes results/web.json.
"""

import argparse
import io
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

from clients.web.filter_thread import FULL, EyeView, PictureRequest
from clients.web.picture import linear_from_srgb8, scene_picture
from filter_service import EyeFilter
from filter_service.messages import State
from tests.benchmarks.harness import ROOT, Row, publish
from tests.web.browser import PageUnderTest, open_browser

SLIDERS = {"pupil": "pupil_diameter_mm", "focus": "focus_dpt", "sphere": "sphere_dpt"}
PUPIL_MM, FOCUS_DPT, SPHERE_DPT = 4.0, 0.5, -2.0
STATES = (
    {},
    {"pupil_diameter_mm": 6.0},
    {"focus_dpt": 3.0},
    {"sphere_dpt": 0.0},
    {"sphere_dpt": -5.0},
)
COUNT = 8
DRAG_S, DRAG_STEP_S = 2.0, 0.03
REFERENCE = "tolerance fine, exact rendering"

TIME_KEYS = """
window.pressed = [];
document.addEventListener("keydown",
  () => window.pressed.push({at_ms: performance.now(), after: window.ocufilter.drawn
    .reduce((n, d) => Math.max(n, d.number), 0)}), true);
"""


def pressed(page: PageUnderTest, name: str, key: str) -> dict[str, float]:
    """Move a slider by one step; return the times in ms to its pictures."""
    page.slider(name).press(key)
    press = page.page.evaluate("window.pressed.at(-1)")
    page.settle(after=press["after"])
    newer = [entry for entry in page.drawn() if entry["number"] > press["after"]]
    full = next(entry for entry in newer if entry["kind"] == "full")
    return {
        "preview": newer[0]["at_ms"] - press["at_ms"],
        "full": full["at_ms"] - press["at_ms"],
    }


def dragged(page: PageUnderTest, name: str) -> list[float]:
    """Move a slider to and fro; return the times between two pictures, ms."""
    thumb = page.slider(name)
    first = page.number()
    end_s, step = time.monotonic() + DRAG_S, 0
    while time.monotonic() < end_s:
        thumb.press("ArrowRight" if (step // 6) % 2 else "ArrowLeft")
        step += 1
        time.sleep(DRAG_STEP_S)
    page.settle(after=first)
    seen = [entry for entry in page.drawn() if entry["number"] > first]
    return list(np.diff([entry["at_ms"] for entry in seen if entry["kind"] != "full"]))


def program_mb(process_id: int) -> float:
    """Return the memory of a process and of those that it started, 10^6 bytes."""
    children = Path(f"/proc/{process_id}/task/{process_id}/children")
    own = Path(f"/proc/{process_id}/smaps_rollup").read_text(encoding="utf-8")
    line = next(line for line in own.splitlines() if line.startswith("Pss:"))
    total = int(line.split()[1]) * 1024 / 1e6
    return total + sum(map(program_mb, map(int, children.read_text().split())))


def times(count: int) -> tuple[dict[tuple[str, str], list[float]], float]:
    """Return the times in ms of each slider and kind, and the program's memory."""
    command = [sys.executable, "-m", "ocufilter", "web"]
    command += ["--no-browser", "--port", "0", "--json"]
    found: dict[tuple[str, str], list[float]] = {}
    with (
        subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.PIPE, text=True
        ) as program,
        sync_playwright() as playwright,
    ):
        address = json.loads(program.stdout.readline())["address"]
        with open_browser(playwright) as browser:
            page = PageUnderTest(
                browser.new_page(viewport={"width": 1280, "height": 800})
            )
            page.open(address)
            page.page.evaluate(TIME_KEYS)
            for slider, name in SLIDERS.items():
                pressed(page, name, "ArrowRight")  # its first, not counted
                for turn in range(count):
                    key = "ArrowLeft" if turn % 2 else "ArrowRight"
                    for kind, taken_ms in pressed(page, name, key).items():
                        found.setdefault((slider, kind), []).append(taken_ms)
                found[slider, "drag"] = dragged(page, name)
            memory_mb = program_mb(program.pid)
        program.terminate()
    return found, memory_mb


def _wish(number: int, picture, changes) -> PictureRequest:
    state = {"pupil_diameter_mm": PUPIL_MM, "focus_dpt": FOCUS_DPT} | changes
    sphere_dpt = state.pop("sphere_dpt", SPHERE_DPT)
    body = {"kind": "prescription", "sphere_dpt": sphere_dpt, "age_years": 30.0}
    return PictureRequest(
        number, picture, {"OD": body}, State(**state, gaze_deg=(0.0, 0.0))
    )


def errors(states) -> dict[str, float]:
    """Return the lowest PSNR over some states of each kind of picture, dB."""
    picture, eye = scene_picture("courtyard"), EyeView("OD")
    found: dict[str, list[float]] = {"preview": [], "full": []}
    with EyeFilter(settings=FULL.changed(tolerance="fine")) as exact:
        for number, changes in enumerate(states, 1):
            wish = _wish(number, picture, changes)
            exact.set_profile(wish.bodies["OD"], views=picture.view.camera)
            state = {
                "pupil_diameter_mm": wish.pupil_diameter_mm,
                "focus_dpt": wish.focus_dpt,
            }
            exact.wait()
            reference = exact.filter([picture.view], **state, render_tolerance=0.0)
            for kind, values in found.items():
                while (seen := eye.picture(kind, wish)) is None:
                    time.sleep(0.002)
                values.append(_psnr_db(seen.data, reference.color))
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


def rows_of(found, memory_mb: float, worst_db: dict[str, float]) -> list[Row]:
    """Return a row for each slider and kind."""
    return [
        Row(
            bench="web",
            method=kind,
            case=slider,
            setting="courtyard 480x270" if kind != "full" else "courtyard 960x540",
            n=len(values),
            median_ms=float(np.median(values)),
            p95_ms=float(np.percentile(values, 95)),
            memory_mb=memory_mb,
            error_name="psnr_db, worst",
            error=worst_db["full" if kind == "full" else "preview"],
            reference=REFERENCE,
        )
        for (slider, kind), values in found.items()
    ]


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few moves, one state")
    parser.add_argument("--json", action="store_true", help="print the report alone")
    options = parser.parse_args()
    found, memory_mb = times(4 if options.quick else COUNT)
    worst_db = errors(STATES[:1] if options.quick else STATES)
    rows = rows_of(found, memory_mb, worst_db)
    publish("web", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
