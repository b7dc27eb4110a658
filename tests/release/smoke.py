"""The installed commands in an empty environment: one short run of each."""

from __future__ import annotations

import json
import signal
import subprocess
import time
import urllib.request

from tests.page_commands import ENDPOINT, PAGES, SLOW, commands_of, make_files
from tests.release.commands import Failed
from tests.release.environment import Environment

PICTURE = """
import numpy as np
from PIL import Image
from pathlib import Path

rows, columns = np.indices((90, 160))
squares = (255 * ((rows // 6 + columns // 6) % 2)).astype(np.uint8)
Image.fromarray(np.repeat(squares[..., None], 3, axis=2)).save("squares.png")
for name, image in (("color", squares), ("depth", np.full((90, 160), 1000, np.uint16))):
    Path("frames", name).mkdir(parents=True)
    Image.fromarray(image).save(f"frames/{name}/0.png")
"""

CONTRAST = """
import numpy as np
from PIL import Image

names = "squares.png", "seen.png"
before, after = (np.asarray(Image.open(name), float) for name in names)
assert before.shape == after.shape, after.shape
print(after.std() / before.std())
"""

REQUEST = """
import sys
import numpy as np
from ocufilter import Camera, FilterClient, ServiceProcess

color = np.full((36, 64, 3), 128, np.uint8)
color[:, 32:] = 255
depth_m = np.full((36, 64), 2.0, np.float32)
camera = Camera.from_fov(10.0, width_px=64, height_px=36)
settings = {"mode": "on-axis", "eye_model": "wavefront"}
with ServiceProcess(command=[sys.argv[1], "serve"]) as service:
    with FilterClient(service.endpoint) as client:
        client.set_profile("myopia", settings=settings, views=[camera], timeout_s=600)
        seen = client.filter(color, depth_m, pupil_diameter_mm=4.0, focus_dpt=0.0)
    code = service.stop()
assert seen.color.shape == color.shape
assert 128 < seen.color[18, 32, 1] < 255  # the edge is blurred
assert code == 0, code
"""

LATENCY = """
import json, subprocess, sys
from ocufilter import ServiceProcess

options = ["--mode", "on-axis", "--eye-model", "wavefront", "--size", "64x36"]
options += ["--frames", "5", "--plot", "latency.png", "--json"]
with ServiceProcess(command=[sys.argv[1], "serve"]) as service:
    command = [sys.argv[1], "latency", service.endpoint, *options]
    told = subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout
(row,) = json.loads(told)["rows"]
assert row["frames"]["filtered"], row
assert row["error"]["psnr_db"] > 35, row
"""


def doctor(environment: Environment, *, needs_native: bool = True) -> None:
    """Check that `ocufilter doctor` finds a machine that can filter."""
    report = json.loads(environment.run("ocufilter", "doctor", "--json"))
    checks = {check["name"]: check for check in report["checks"]}
    names = ["networks", "shaders"] + ["native"] * needs_native
    bad = [name for name in names if not checks[name]["ok"]]
    if bad or not report["works"]["serve"]:
        raise Failed(f"doctor: {bad}: {[checks[name] for name in bad]}")


def filter_picture(environment: Environment) -> float:
    """Filter a picture through a preset; return the time it took, s."""
    if not (environment.work / "squares.png").exists():
        environment.run("python", "-c", PICTURE)
    started = time.perf_counter()
    environment.run(
        *("ocufilter", "filter", "--color", "squares.png", "--distance-m", "1"),
        *("--fov-deg", "5", "--profile", "myopia", "-o", "seen.png"),
    )
    took_s = time.perf_counter() - started
    ratio = float(environment.run("python", "-c", CONTRAST))
    if not 0.0 <= ratio < 0.5:
        raise Failed(f"filter: -5 dpt leave {ratio:.2f} of the contrast")
    return took_s


def serve(environment: Environment) -> None:
    """Start a service, filter a frame through it, and stop it."""
    program = environment.inside("venv/bin/ocufilter")
    environment.run("python", "-c", REQUEST, program)


def latency(environment: Environment) -> None:
    """Measure a service in another process."""
    environment.run("python", "-c", LATENCY, environment.inside("venv/bin/ocufilter"))


def batch(environment: Environment) -> None:
    """Filter a folder of one frame."""
    environment.run(
        *("ocufilter", "batch", "frames", "-p", "myopia", "-o", "filtered"),
        *("--fov-deg", "5", "--depth-scale", "0.001"),
    )
    if not list(environment.work.glob("filtered/**/*.png")):
        raise Failed("batch: no picture was written")


def report(environment: Environment) -> None:
    """Write a report as HTML."""
    environment.run("ocufilter", "report", "keratoconus", "-o", "eye.html")
    text = (environment.work / "eye.html").read_text(encoding="utf-8")
    if "data:image/svg+xml" not in text or "</html>" not in text:
        raise Failed("report: eye.html is not complete")


def web(environment: Environment) -> None:
    """Start the page, read it, and stop it."""
    page = environment.start(
        "ocufilter", "web", "--no-browser", "--json", "--port", "0"
    )
    try:
        line = page.stdout.readline() if page.stdout else ""
        if not line.startswith("{"):
            page.kill()
            raise Failed(f"web: no address: {line}{page.communicate()[1][-2000:]}")
        (address,) = [v for v in json.loads(line).values() if "://" in str(v)]
        # the first request exchanges the token for a cookie
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        with opener.open(address, timeout=120) as response:
            text = response.read().decode()
        if "ocufilter" not in text.lower():
            raise Failed("web: the page is another one")
        page.send_signal(signal.SIGINT)
        page.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        raise Failed("web: does not stop") from None
    except OSError as error:
        raise Failed(f"web: {error}") from None
    finally:
        page.kill()
    if page.returncode not in (0, 130, -signal.SIGINT):
        raise Failed(f"web: exit status {page.returncode}")


def pages(environment: Environment) -> None:
    """Run the brief commands of the pages, as printed."""
    make_files(environment.work)
    for command in {c.text: c for page in PAGES for c in commands_of(page)}.values():
        is_brief = command.ends and not command.is_one_of(SLOW)
        if is_brief and ENDPOINT not in command.text:
            if command.is_one_of(["keys add"]):  # two pages add a client of this name
                (environment.work / "lab.toml").unlink(missing_ok=True)
            process = environment.start("ocufilter", *command.arguments)
            _, errors = process.communicate(timeout=300)
            try:
                command.check(process.returncode, errors, may_lack=True)
            except AssertionError as error:
                raise Failed(f"pages: {error}") from None


def demo(environment: Environment) -> None:
    """Run the demo, without the packages of the extras."""
    environment.run("ocufilter", "demo", "--frames", "2", "--size", "64x36")
    for name in ("demo.gif", "contact_sheet.png"):
        if not (environment.work / "out" / "demo" / name).exists():
            raise Failed(f"demo: no {name}")


COMMANDS = {
    "demo": demo,
    "pages": pages,
    "serve": serve,
    "latency": latency,
    "batch": batch,
    "report": report,
    "web": web,
}
