"""`ocufilter filter` reads files with their place, shape and notes."""

from functools import partial

import numpy as np
import pytest

from clients.commands.filter_image import image_tangents, read_view
from filter_service.camera import PixelGrid
from filter_service.image_files import write_image


@pytest.fixture
def light(rng):
    return rng.random((4, 6, 3), np.float32)


def view_of(color, depth=None, *, camera=(90.0, None, None), **how):
    how = {"distance_m": 2.0 if depth is None else None, "depth_scale": None, **how}
    tangents_of = partial(image_tangents, *camera)
    return read_view(color, depth, tangents_of=tangents_of, depth_kind="planar", **how)


@pytest.mark.parametrize(
    ("camera", "expected"),
    [
        # Pixels twice as wide as high: 6 of them are 12 heights, 4 rows are 90 deg.
        ((90.0, None, None), [-3.0, 3.0, 1.0, -1.0]),
        ((None, 2.0, None), [-3.0, 3.0, 1.0, -1.0]),
        ((None, None, "3,2,2.5,1.5"), [-1.0, 1.0, 1.0, -1.0]),  # as they are given
    ],
)
def test_options_of_the_camera_know_the_shape_of_pixels(
    tmp_path, light, camera, expected
):
    grid = PixelGrid(6, 4, pixel_aspect_ratio=2.0)
    write_image(tmp_path / "a.exr", light, grid=grid)
    view, found, notes = view_of(tmp_path / "a.exr", camera=camera)
    assert found == grid
    np.testing.assert_allclose(view.tangents, expected)
    assert "pixels are 2 times as wide as high" in notes[0]


@pytest.mark.parametrize(
    "camera", [(90.0, None, None), (None, 4.0, None), (None, None, "4,4,5.5,3.5")]
)
def test_options_of_the_camera_are_those_of_the_whole_picture(tmp_path, light, camera):
    write_image(tmp_path / "a.exr", light, grid=PixelGrid(6, 4, 2, 1, 12, 8))
    view, _, notes = view_of(tmp_path / "a.exr", camera=camera)
    np.testing.assert_allclose(view.tangents, [-1.0, 0.5, 0.75, -0.25])
    assert "6x4 px of a picture of 12x8" in notes[0]


def test_notes_of_all_files_are_kept_and_sizes_compared(tmp_path, light):
    write_image(tmp_path / "a.npy", light)
    np.save(tmp_path / "d.npy", np.full((4, 6), 1500, np.int16))
    hidden = (tmp_path / "a.npy", tmp_path / "d.npy")
    view, _, notes = view_of(
        tmp_path / "a.npy", tmp_path / "d.npy", hidden_paths=hidden
    )
    assert [note[:7] for note in notes] == ["'d.npy'", "'d.npy'"]
    np.testing.assert_allclose(view.hidden_depth_m, 1.5)
    np.save(tmp_path / "d.npy", np.ones((6, 4), np.float32))
    with pytest.raises(ValueError, match=r"--depth .*4x6 px; allowed: .* 6x4 \(photo"):
        view_of(tmp_path / "a.npy", tmp_path / "d.npy")
