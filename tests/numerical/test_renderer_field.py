"""Off the axis: points of light against the exact PSF of their direction."""

import math

import numpy as np
import pytest

from estimator.profiles.parse import parse_profile
from estimator.psf.compute import compute_psf_batch
from filter_service.planning.grid import (
    angles_deg,
    field_deg,
    gaze_rotation,
    pixel_from_mrad,
    unit_direction,
)
from filter_service.planning.state_samples import MEAN_OF_HALF_WAY
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.store import build_psf_store
from filter_service.rgbd_view import RgbdView
from tests.grid_specs import grid_spec
from tests.numerical.plan_cases import image_error, mean_db
from tests.numerical.synthetic import psnr_db, tangents, texture

WIDTH, HEIGHT = 160, 120
PUPIL_MM, FOCUS_DPT, OBJECT_M = 5.0, 0.5, 2.0


def tangents_of(h_low, h_high, v_low, v_high):
    low, high = np.tan(np.radians([[h_low, v_low], [h_high, v_high]]))
    return low[0], high[0], high[1], low[1]


class FieldBench:
    """A traced eye before a camera, ready to render."""

    def __init__(
        self,
        engine,
        name,
        view_tangents,
        size=(WIDTH, HEIGHT),
        periphery="people",
        **settings,
    ):
        self.spec = grid_spec(
            width_px=size[0],
            height_px=size[1],
            tangents=view_tangents,
            pupil_range_mm=(PUPIL_MM, PUPIL_MM),
            focus_range_dpt=(FOCUS_DPT, FOCUS_DPT),
            object_range_dpt=(0.0, 2.0),
            **{"mode": "quality", "tolerance": "fine", **settings},
        )
        profile = parse_profile(
            {"kind": "preset", "name": name, "periphery": periphery}
        )
        self.eye, _ = eye_for_spec(profile, self.spec)
        self.store = build_psf_store(self.eye, self.spec)
        self.renderer = engine.new_renderer()
        self.handle = self.renderer.load(self.store)

    def render(self, color, depth_m):
        depth_m = np.broadcast_to(np.float32(depth_m), color.shape[:2])
        view = RgbdView(color, depth_m.astype(np.float32), self.spec.camera.tangents)
        return self.renderer.render(
            view, self.handle, pupil_diameter_mm=PUPIL_MM, focus_dpt=FOCUS_DPT
        )

    def exact_kernels(self, x, y, distance_m, radius_px=None, *, of_cells=False):
        """PSFs (3 n) of the directions of n pixels, channel fastest.

        With ``of_cells`` those that the pixels' cells stand for: of the middle of the
        cell, with the defocus of the pixel.
        """
        own = self._direction(x + 0.5, y + 0.5)
        shown = own
        if of_cells:
            cell_px = self.handle.image.cell_px
            shown = self._direction(*((at // cell_px + 0.5) * cell_px for at in (x, y)))
        distance_m = np.repeat(np.ravel(distance_m), 3)
        n_pixels = own["h_deg"].size // 3
        state = {
            "pupil_diameter_mm": PUPIL_MM,
            "accommodation_dpt": self.eye.accommodation_dpt(
                FOCUS_DPT, pupil_diameter_mm=PUPIL_MM
            ),
            "wavelength_nm": np.tile(self.spec.channel_wavelengths_nm, n_pixels),
        }
        total_dpt = self.eye.total_defocus_dpt(**own, **state) + 1.0 / distance_m
        found = self.eye.wavefronts(**shown, **state, total_defocus_dpt=total_dpt)
        return compute_psf_batch(
            found.zernike_um,
            pupil_diameter_mm=found.circle_diameter_mm,
            pupil_ellipse=found.pupil_ellipse,
            wavelength_nm=state["wavelength_nm"],
            pixel_from_mrad=pixel_from_mrad(
                self.spec.camera,
                *shown.values(),
                gaze_deg=self.spec.settings.gaze_deg,
            ),
            radius_px=radius_px,
        )

    def _direction(self, x_px, y_px):
        """Field angles of n places in the image, each three times."""
        gaze_deg = self.spec.settings.gaze_deg
        angles = field_deg(self.spec.camera, x_px, y_px, gaze_deg=gaze_deg)
        return dict(
            zip(
                ("h_deg", "v_deg"),
                (np.repeat(np.ravel(a), 3) for a in angles),
                strict=True,
            )
        )


def radial_depth_m(spec, distance_m):
    """Planar depth (height, width) of a sphere about the eye."""
    camera = spec.camera
    left, right, up, down = camera.tangents
    x = left + (right - left) * (np.arange(camera.width_px) + 0.5) / camera.width_px
    y = up + (down - up) * (np.arange(camera.height_px) + 0.5) / camera.height_px
    return distance_m / np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2)


WORST_OVER_MEAN_DB = -10.0 * math.log10(MEAN_OF_HALF_WAY)
"""Half-way between two nodes against the mean over all places between them."""


def unit_sum(kernels):
    """Kernels (side, side, 3) that hold the light of one."""
    return kernels / kernels.sum(axis=(0, 1))


def filtering_db(kernels, others):
    """Of an image with a natural spectrum, filtered with one or the other (..., 3)."""
    difference = np.moveaxis(unit_sum(kernels) - unit_sum(others), -1, 0)
    return mean_db([image_error(channel) for channel in difference])


@pytest.mark.parametrize(
    ("corner_deg", "gaze_deg"),
    [
        pytest.param((22, 32, 8, 15), (0, 0), marks=pytest.mark.slow),
        pytest.param((-33, -23, -16, -9), (0, 0), marks=pytest.mark.slow),
        ((2, 12, 4, 11), (-14, 9)),
    ],
)
def test_points_of_light_become_the_psf_of_their_direction(
    engine, corner_deg, gaze_deg
):
    """As near as the plan says its nodes are, at the worst place between two.

    What the cell leaves out, a direction up to half its edge away, is not in that: the
    kernels are compared with those of the cell's middle.
    """
    bench = FieldBench(
        engine,
        "keratoconus",
        tangents_of(*corner_deg),
        gaze_deg=gaze_deg,
        periphery="model",  # which changes fast: one cell's kernels are not another's
    )
    depth_m = radial_depth_m(bench.spec, OBJECT_M)
    stated_db = bench.store.plan.prediction.interpolation_db
    errors_db, apart_db = [], []
    for x, y in [(40, 30), (120, 35), (77, 88)]:
        point = np.zeros((HEIGHT, WIDTH, 3), np.float32)
        point[y, x] = 1.0
        radius = 28
        part = (slice(y - radius, y + radius + 1), slice(x - radius, x + radius + 1))
        seen = bench.render(point, depth_m).color[part].astype(float)
        at = (np.array(x), np.array(y), OBJECT_M, radius)
        cell, own = (
            np.stack([psf.kernel for psf in psfs], axis=-1).astype(float)
            for psfs in (
                bench.exact_kernels(*at, of_cells=True),
                bench.exact_kernels(*at),
            )
        )
        errors_db.append(filtering_db(seen, cell))
        apart_db.append(filtering_db(cell, own))
        assert errors_db[-1] >= stated_db - WORST_OVER_MEAN_DB
        for turns, flip in np.ndindex(4, 2):
            if (turns, flip) != (0, 0):
                turned = np.rot90(cell[:, :: 1 - 2 * flip], turns, axes=(0, 1))
                assert filtering_db(seen, turned) < stated_db - 20.0
    # What is found is finer than what a cell is away from the point itself: kernels of
    # another cell would be told, let alone another orientation.
    assert np.mean(apart_db) < np.mean(errors_db)


def splat_exactly(bench, color, depth_m):
    """Every pixel through the PSF of its own direction and distance; one surface."""
    height, width = depth_m.shape
    y, x = np.mgrid[0:height, 0:width]
    camera = bench.spec.camera
    left, right, up, down = camera.tangents
    slope_x = left + (right - left) * (x + 0.5) / width
    slope_y = up + (down - up) * (y + 0.5) / height
    distance_m = depth_m * np.sqrt(1.0 + slope_x**2 + slope_y**2)
    psfs = bench.exact_kernels(x, y, distance_m)
    margin = int(psfs.radius_px.max())
    light = np.zeros((height + 2 * margin, width + 2 * margin, 3))
    weight = np.zeros_like(light)
    for n, psf in enumerate(psfs):
        row, column, c = n // 3 // width + margin, n // 3 % width + margin, n % 3
        r = psf.radius_px
        part = (slice(row - r, row + r + 1), slice(column - r, column + r + 1), c)
        light[part] += psf.kernel * color[row - margin, column - margin, c]
        weight[part] += psf.kernel
    inside = (slice(margin, -margin), slice(margin, -margin))
    return light[inside] / weight[inside]


@pytest.mark.long("every pixel's PSF is computed")
@pytest.mark.parametrize(
    "name", [pytest.param("emmetropia", marks=pytest.mark.slow), "keratoconus"]
)
def test_whole_field_agrees_with_the_exact_psf_of_every_pixel(engine, rng, name):
    width, height = 64, 48
    bench = FieldBench(
        engine, name, tangents(width, height, 40.0), size=(width, height)
    )
    color = texture(rng, height, width, cell_px=3)
    # a floor that comes nearer: half a diopter to two
    depth_m = 1.0 / np.linspace(0.4, 1.6, height)[:, None] * np.ones((1, width))
    truth = splat_exactly(bench, color, depth_m.astype(np.float32))
    result = bench.render(color, depth_m)
    assert psnr_db(result.color, truth) >= 46.0


def test_perfect_eye_stays_sharp_in_the_corner(engine, rng):
    spec = grid_spec(
        width_px=WIDTH,
        height_px=HEIGHT,
        tangents=tangents(WIDTH, HEIGHT, 90.0),
        pupil_range_mm=(3.0, 3.0),
        focus_range_dpt=(0.0, 0.0),
        object_range_dpt=(0.0, 0.0),
        mode="quality",
        diffraction=False,
        chromatic=False,
    )
    eye, _ = eye_for_spec(
        parse_profile({"kind": "prescription", "sphere_dpt": 0.0}),
        spec.with_settings(eye_model="wavefront"),
    )
    renderer = engine.new_renderer()
    handle = renderer.load(build_psf_store(eye, spec))
    image = texture(rng, HEIGHT, WIDTH, cell_px=1)
    view = RgbdView(
        image, np.full(image.shape[:2], np.inf, np.float32), spec.camera.tangents
    )
    result = renderer.render(view, handle, pupil_diameter_mm=3.0, focus_dpt=0.0)
    corner = (slice(0, 16), slice(0, 16))
    assert psnr_db(result.color[corner], image[corner]) >= 60.0


def test_gaze_turns_the_field_the_way_the_eye_turns():
    spec = grid_spec(width_px=200, height_px=100, tangents=(-1.0, 1.0, 0.5, -0.5))
    gaze_deg = (20.0, -10.0)
    direction = gaze_rotation(gaze_deg) @ unit_direction(0.0, 0.0)
    assert np.allclose(angles_deg(direction), gaze_deg)
    tangent = direction[:2] / -direction[2]
    x_px, y_px = 100 * (1 + tangent[0]), 50 * (1 - tangent[1] / 0.5)
    assert np.allclose(field_deg(spec.camera, x_px, y_px, gaze_deg=gaze_deg), 0.0)
