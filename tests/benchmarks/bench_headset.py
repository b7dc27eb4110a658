r"""Stages of a headset frame, filtered in process and by a service.

    sh tests/headset/run_in_root.sh env OCUFILTER_COMMIT=$(git rev-parse --short HEAD) \
        python -m tests.benchmarks headset --openxr --json

The viewer of `ocufilter headset` in a simulated headset of 72 Hz whose head moves: the
courtyard through a myope's left and a keratoconic right eye, natural focus and pupils.
Stages: ``scene`` renders both views (Mesa, on the processor); ``look`` finds gaze,
focus and pupil; ``filter`` is the filter's own time for both eyes; ``around`` what this
process adds to it; ``service``, ``wire`` and ``wait`` what a service adds: its own
stages, the way there and back by shared memory, waiting for its turn; ``show`` hands
the pictures to the runtime, which waits for those in textures; ``age`` is from a
frame's begin to where it was shown.  "here, textures": as `ocufilter headset
--textures`, where ``filter`` is the time of the calls.

With --openxr, in the root of tests/headset: the same in Monado, with its compositor on
the processor too, before a striped wall.

The error is the peak signal-to-noise ratio, of 8 bits, of the last pictures to the same
frame filtered with no tolerance for errors of rendering.
"""

import contextlib
import os
import tempfile
import time
from pathlib import Path

import moderngl
import numpy as np

from clients.headset.gltf_scene import load_gltf
from clients.headset.runtime import SimulatedRuntime, upright
from clients.headset.scenery import SceneScenery, viewpoint
from clients.headset.stereo_filter import LocalFilter, ServiceFilter, StereoFilter
from clients.headset.stereo_gaze import StereoGaze
from clients.headset.viewer import Controls, Viewer
from clients.scenes.catalog import build_scene
from clients.scenes.scene_view import read_texture
from clients.service_process import ServiceProcess
from filter_service import FilterSettings
from filter_service.errors import FilterError
from tests.benchmarks.harness import KeptRows, Row, Run
from tests.benchmarks.rows import row_of

MINUTES = 11
SIZES_PX = ((448, 504), (896, 1007))
QUICK_SIZES_PX = ((112, 126),)
N_FRAMES, QUICK_FRAMES = 48, 5
WARM_S = 60.0
RATE_HZ = 72.0
WAYS = ("here, textures", "here", "service, shm")
PROFILES = {
    "left": {"kind": "preset", "name": "myopia"},
    "right": {"kind": "preset", "name": "keratoconus"},
}
SETTINGS = FilterSettings(pupil_range_mm=(2.0, 5.0), object_range_dpt=(0.0, 8.5))


class Watched:
    """Passes on what is seen, and keeps the last frame and when eyes are complete."""

    def __init__(self, seeing: StereoFilter):
        self._seeing = seeing
        self.last = None

    def change(self, eye, profile) -> None:
        self._seeing.change(eye, profile)

    def see(self, frame):
        self.last = self._seeing.see(frame) or self.last
        return self.last

    def known(self, picture):
        return self._seeing.known(picture)

    def restart(self) -> None:
        self._seeing.restart()

    def close(self) -> None:
        self._seeing.close()


def error_db(seen, context) -> float:
    """Return the PSNR of what was seen to the same frame without tolerance."""
    with context:
        colors = [
            color if isinstance(color, np.ndarray) else read_texture(color)[..., :3]
            for color in seen.colors
        ]
    exact = LocalFilter(SETTINGS, lambda line: None)
    try:
        for eye, profile in PROFILES.items():
            exact.change(eye, profile)
        while (whole := exact.see(seen.frame)) is None or not whole.is_complete:
            time.sleep(0.01)
        squares = []
        for n, (picture, eye) in enumerate(
            zip(seen.frame.pictures, seen.frame.eyes, strict=True)
        ):
            wanted = exact.filters[picture.view.eye].filter(
                seen.frame.views[n],
                pupil_diameter_mm=eye.state.pupil_diameter_mm,
                focus_dpt=eye.state.focus_dpt,
                gaze_deg=eye.gaze_deg,
                render_tolerance=0.0,
            )
            squares.append((wanted.color - colors[n].astype(float)) ** 2)
        return float(10.0 * np.log10(255.0**2 / np.mean(squares)))
    finally:
        exact.close()


def watched_run(open_runtime, scenery, seeing, n_frames: int):
    """Warm up until both eyes are whole, then measure: log, last frame, seconds."""
    watched = Watched(seeing)
    for eye, profile in PROFILES.items():
        watched.change(eye, profile)

    def viewer_of() -> Viewer:
        return Viewer(
            open_runtime,
            scenery,
            watched,
            StereoGaze(age_years=30.0),
            Controls(dict(PROFILES), watched.change),
            say=lambda line: None,
        )

    viewer, end_s = viewer_of(), time.monotonic() + WARM_S
    n_whole = 0
    while time.monotonic() < end_s and n_whole < 5:
        viewer.run(max_frames=viewer.log.n_filtered + 1, limit_s=WARM_S)
        n_whole = n_whole + 1 if watched.last and watched.last.is_complete else 0
    viewer = viewer_of()
    start_s = time.monotonic()
    log = viewer.run(max_frames=n_frames, limit_s=WARM_S)
    return log, watched.last, time.monotonic() - start_s


def rows_of(log, took_s: float, method: str, case: str, error: float):
    dropped = f"{log.n_filtered / took_s:.1f} Hz, {log.n_repeated} shown again"
    for name, values in log.stages_ms.items():
        yield row_of(
            *("headset", f"{method}: {name.removesuffix('_ms')}", case, dropped),
            *(values, "psnr_db", error, "no tolerance"),
        )


def ways(context):
    """Yield (name, seeing) of each way to filter pictures of a context."""
    for name in WAYS:
        with contextlib.ExitStack() as stack:
            if name == "service, shm":
                folder = stack.enter_context(tempfile.TemporaryDirectory())
                service = stack.enter_context(
                    ServiceProcess({"bind": f"ipc://{folder}/service"})
                )
                seeing = ServiceFilter(service.endpoint, SETTINGS, lambda line: None)
            else:
                own = context if name == "here, textures" else None
                seeing = LocalFilter(SETTINGS, lambda line: None, own)
            stack.callback(seeing.close)
            yield name, seeing


def simulated_rows(sizes_px, n_frames: int) -> list[Row]:
    """Return the rows of a simulated headset."""
    scene = build_scene("courtyard")
    stand = upright(viewpoint(scene))
    rows: list[Row] = []
    kept = KeptRows("headset")
    context = moderngl.create_context(standalone=True, backend="egl", require=430)

    def finish() -> None:
        with context:
            context.finish()

    with contextlib.closing(SceneScenery(context, scene, stand)) as scenery:
        for size_px in sizes_px:
            for name, seeing in ways(context):
                log, seen, took_s = watched_run(
                    lambda size_px=size_px: SimulatedRuntime(
                        size_px, rate_hz=RATE_HZ, finish=finish
                    ),
                    scenery,
                    seeing,
                    n_frames,
                )
                case = f"2 x {size_px[0]}x{size_px[1]}"
                for row in rows_of(log, took_s, name, case, error_db(seen, context)):
                    rows.append(row)
                    kept.add(row)
    context.release()
    return rows


def openxr_rows(n_frames: int) -> list[Row]:
    """Return the rows of Monado."""
    from clients.headset.openxr_runtime import OpenXrRuntime
    from tests.headset.monado import Monado
    from tests.headset.rooms import stripes

    rows = []
    with tempfile.TemporaryDirectory() as folder:
        scene = load_gltf(stripes(Path(folder) / "room.glb"))
        for screen in (False, True):
            with contextlib.ExitStack() as stack:
                monado = stack.enter_context(Monado(Path(folder), screen=screen))
                os.environ.update(monado.environment)
                context = moderngl.create_context(
                    standalone=True, backend="egl", require=430
                )
                scenery = SceneScenery(context, scene, upright(viewpoint(scene)))
                stack.callback(context.release)
                stack.callback(scenery.close)
                for name, seeing in ways(context):
                    log, seen, took_s = watched_run(
                        lambda context=context: OpenXrRuntime(context),
                        scenery,
                        seeing,
                        n_frames,
                    )
                    height_px, width_px = seen.colors[0].shape[:2]
                    kind = "XCB compositor" if screen else "null compositor"
                    case = f"2 x {width_px}x{height_px}, Monado's {kind}"
                    rows += rows_of(log, took_s, name, case, error_db(seen, context))
    return rows


def size_of(text: str) -> tuple[int, int]:
    """Return width and height of WxH."""
    width_px, height_px = text.split("x")
    return int(width_px), int(height_px)


def options(parser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--openxr", action="store_true", help="in Monado; see above")
    parser.add_argument("--sizes", nargs="+", type=size_of, metavar="WxH")


def measure(run: Run) -> list[Row]:
    """Return the rows of a simulated headset, or of Monado."""
    n_frames = QUICK_FRAMES if run.is_quick else N_FRAMES
    sizes_px = QUICK_SIZES_PX if run.is_quick else run.options.sizes or SIZES_PX
    try:
        if run.options.openxr:
            return openxr_rows(n_frames)
        return simulated_rows(sizes_px, n_frames)
    except FilterError as error:
        raise SystemExit(f"headset: {error}") from None
