"""Light of bright pixels beyond their kernels: error of a lamp's halo, and cost.

Halo: a pixel of 1,000 times white on black; error is the largest deviation of the light
in a ring or a sixteenth of a ring outside its spot, up to 100 px, from brute force.
Frames: 1280x720 with 8-bit output, the state changing with each frame, with this light
and without, in turn, through both engines; error is that of the added light against
every pixel by itself, as rms over the rms of leaving it out.  OpenGL filters the lamps
alone, in few frames.
"""

import time
from unittest import mock

import numpy as np

from estimator.profiles.parse import parse_profile
from filter_service.gl.gpu import Gpu
from filter_service.planning.plan import plan_cache
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.store import PsfStore, build_psf_store
from filter_service.rendering import edge_kinds, edge_light
from filter_service.rendering.edge_light import EdgeLight
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.gl import FilterRenderer
from filter_service.rendering.media_effects import begin_through_media
from filter_service.rendering.native import NativeRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.view_state import State
from tests.benchmarks.frame_runs import states_towards
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.rows import row_of
from tests.grid_specs import grid_spec
from tests.numerical.scene_frames import scene_view
from tests.numerical.synthetic import tangents
from tests.reference.edge_light import lamp_light, ring_ratios

MINUTES = 3
ENGINES = {"native": NativeRenderer, "gl": lambda: FilterRenderer(Gpu())}
GL_SCENES, GL_FRAMES = ("three lamps",), 4
LAMP, RADIUS_PX, PITCH_MRAD = 1000.0, 100, 0.7
EMMETROPE = {
    "kind": "prescription",
    "sphere_dpt": 0.0,
    "age_years": 30,
    "higher_order": "none",
}
LAMPS = {
    "sharp": (EMMETROPE, 0.0, 4.0),
    "1 dpt": (EMMETROPE, 1.0, 4.0),
    "3 dpt": (EMMETROPE, 3.0, 4.0),
    "keratoconus": ({"kind": "preset", "name": "keratoconus"}, 0.0, 5.0),
}


def lamp_rows(radius_px: int):
    """Yield the errors of the light around lamps on the axis and at 30 deg."""
    width, height = 2 * radius_px + 60, 2 * radius_px + 40
    x, y = width // 2, height // 2
    fov_deg = float(np.degrees(height * PITCH_MRAD / 1e3))
    engine = NativeRenderer()
    for name, (profile, focus_dpt, pupil_mm) in LAMPS.items():
        for eccentricity_deg in (0.0, 30.0):
            spec = grid_spec(
                width_px=width,
                height_px=height,
                tangents=tangents(width, height, fov_deg),
                mode="quality",
                gaze_deg=(-eccentricity_deg, 0.0),
                pupil_range_mm=(pupil_mm, pupil_mm + 0.5),
            )
            eye, _ = eye_for_spec(parse_profile(profile), spec)
            store = PsfStore(eye, spec, plan_cache(eye, spec))
            color = np.zeros((height, width, 3), np.float32)
            color[y, x] = LAMP
            depth_m = np.full((height, width), 1e6, np.float32)
            view = RgbdView(color, depth_m, spec.camera.tangents, "radial")
            request = ViewRequest(view, engine.load(store), State(pupil_mm, focus_dpt))
            plain = engine.begin(request)().color
            started_s = time.perf_counter()
            seen = begin_through_media(engine, request, None)()
            elapsed_ms = 1e3 * (time.perf_counter() - started_s)
            window = (
                slice(y - radius_px, y + radius_px + 1),
                slice(x - radius_px, x + radius_px + 1),
            )
            exact = lamp_light(
                store,
                *(x, y),
                pupil_mm=pupil_mm,
                focus_dpt=focus_dpt,
                object_dpt=1e-6,
                radius_px=radius_px,
                channel=1,
            )
            outside = plain[window][..., 1] <= 0.0
            ratios = ring_ratios(
                seen.color[window][..., 1] / LAMP, exact, outside, 8, 16
            )
            for error_name, error in (
                ("largest relative error of rings", np.abs(ratios[:, -1] - 1.0).max()),
                ("of sixteenths of rings", np.nanmax(np.abs(ratios - 1.0))),
            ):
                yield row_of(
                    *("edge_light", "halo", name, f"{eccentricity_deg:g} deg"),
                    *([elapsed_ms], error_name, error, "brute force"),
                )
    engine.close()


def scenes(size: tuple[int, int]):
    """Scenes of linear light over the courtyard, and the courtyard itself."""
    view = scene_view("courtyard", width_px=size[0], height_px=size[1])
    rng = np.random.default_rng(1)
    gray = (view.color.astype(np.float32) / 255.0) ** 2.2
    height, width = gray.shape[:2]
    y, x = np.mgrid[:height, :width] * (1280.0 / width)
    lamps, sparks, window = gray.copy(), gray.copy(), gray.copy()
    for at_x, at_y, radius, level in (
        (300, 200, 6, 500),
        (900, 150, 4, 900),
        (655, 400, 4, 900),
    ):
        lamps[(x - at_x) ** 2 + (y - at_y) ** 2 < radius**2] = level
    at = rng.integers(0, height * width, 400)
    sparks.reshape(-1, 3)[at] = rng.uniform(5.0, 200.0, (400, 1))
    window[(x >= 600) & (x < 900) & (y >= 80) & (y < 280)] = 40.0
    colors = {
        "8 bits": view.color,
        "floats up to 1": gray,
        "three lamps": lamps,
        "400 highlights": sparks,
        "window of 300x200 px": window,
    }
    return view, colors


def exact_limits():
    """Return patches with which every pixel is a source of its own."""
    return [
        mock.patch.object(edge_kinds, "MAX_SOURCES", 10**9),
        mock.patch.object(edge_kinds, "MAX_KINDS", 10**9),
        mock.patch.object(edge_kinds, "MAX_KINDS_PX", 10**12),
        mock.patch.object(edge_light, "MAX_FAR_KINDS", 10**9),
        mock.patch.object(edge_light, "MAX_PARTLY_HIDDEN", 10**9),
        mock.patch.object(edge_light, "MAX_NEAR_PRODUCTS", 10**15),
        mock.patch.object(edge_light, "LEFT_OUT_RATIO", 0.0),
    ]


def frame_rows(size: tuple[int, int], count: int, engines=("native", "gl")):
    """Added time of frames, and the error of limited numbers of sources and kernels."""
    view, colors = scenes(size)
    spec = grid_spec(
        width_px=size[0],
        height_px=size[1],
        tangents=view.tangents,
        pupil_range_mm=(4.0, 5.0),
        focus_range_dpt=(0.0, 1.0),
        mode="dynamic",
    )
    eye, _ = eye_for_spec(parse_profile({"kind": "preset", "name": "myopia"}), spec)
    store = build_psf_store(eye, spec)
    without = mock.patch.object(EdgeLight, "of", return_value=None)
    for engine_name in engines:
        engine = ENGINES[engine_name]()
        handle = engine.load(store)

        def frame(color, state, output="srgb8", engine=engine, handle=handle):
            shown = RgbdView(color, view.depth_m, view.tangents, view.depth_kind)
            request = ViewRequest(shown, handle, State(**state), output=output)
            return begin_through_media(engine, request, None)()

        is_gl = engine_name == "gl"
        states = states_towards(
            spec, 4.5, 0.5, min(count, GL_FRAMES) if is_gl else count
        )
        for name in GL_SCENES if is_gl else colors:
            color = colors[name]
            times_ms: dict[bool, list[float]] = {True: [], False: []}
            half = len(states) // 2  # each frame changes the state
            others = [*states[half:], *states[:half]]
            for k, pair in enumerate([*zip(states, others, strict=True)] * 2):
                for is_added, state in zip((False, True), pair, strict=True):
                    started_s = time.perf_counter()
                    if is_added:
                        frame(color, state)
                    else:
                        with without:
                            frame(color, state)
                    if k >= len(states):
                        elapsed_ms = 1e3 * (time.perf_counter() - started_s)
                        times_ms[is_added].append(elapsed_ms)
            added_ms = np.array(times_ms[True]) - times_ms[False]
            error = limited_error(frame, without, color, states[0])
            yield row_of(
                *("edge_light", f"{engine_name}, added to a frame", name),
                *(f"{size[0]}x{size[1]}", added_ms, "rms of the added light", error),
                "every pixel by itself",
            )


def limited_error(frame, without, color, state) -> float:
    """Rms error of the added light where the image is below 2.

    It is relative to the rms of that light, or absolute if there is none.
    """
    limited = frame(color, state, "linear").color
    with without:
        plain = frame(color, state, "linear").color
    patches = exact_limits()
    for patch in patches:
        patch.start()
    exact = frame(color, state, "linear").color
    for patch in patches:
        patch.stop()
    is_dim = exact.max(axis=2) < 2.0
    added, error = (
        float(np.sqrt(np.mean((image - exact)[is_dim] ** 2)))
        for image in (plain, limited)
    )
    return error / added if added else error


def measure(run: Run) -> list[Row]:
    """Return the rows of lamps and frames."""
    if run.is_quick:
        return [*lamp_rows(30), *frame_rows((160, 90), 2, ("native",))]
    return [*lamp_rows(RADIUS_PX), *frame_rows((1280, 720), 12)]
