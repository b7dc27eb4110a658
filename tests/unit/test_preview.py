"""What a preview holds, and when one is built."""

import pytest

from filter_service.messages import Camera, ProfileSettings
from filter_service.planning import grid
from filter_service.planning.grid import GridSpec
from filter_service.service.build_job import LookAt
from filter_service.service.preview import is_worthwhile, preview_spec
from filter_service.wire import profiles

CAMERA = Camera(200, 100, (-0.5, 0.5, 0.25, -0.25))


@pytest.mark.parametrize(
    ("look_at", "pupil_mm", "focus_dpt"),
    [
        (LookAt(3.5, 2.0), 3.5, 2.0),
        (LookAt(8.0, 9.0), 6.0, 4.0),  # beyond what frames were to ask for
        (LookAt(1.0, 0.0), 2.0, 1.0),
        (None, 4.0, 1.0),
    ],
)
def test_a_preview_is_for_what_the_last_frame_looked_at(look_at, pupil_mm, focus_dpt):
    whole = GridSpec(
        CAMERA,
        pupil_range_mm=(2.0, 6.0),
        focus_range_dpt=(1.0, 4.0),
        object_range_dpt=(0.0, 3.0),
        chromatic=False,
    )
    spec = preview_spec(whole, look_at)
    assert spec.pupil_range_mm == (pupil_mm, pupil_mm)
    assert spec.focus_range_dpt == (focus_dpt, focus_dpt)
    assert (spec.object_range_dpt, spec.chromatic) == ((0.0, 3.0), False)


def test_a_preview_follows_the_field_where_the_whole_does():
    on_axis = preview_spec(GridSpec(CAMERA), None)
    assert not on_axis.follows_field
    field = preview_spec(GridSpec(CAMERA, mode="quality", grid="paper"), None)
    assert (field.mode, field.grid, field.tolerance) == ("dynamic", "planned", "loose")
    assert field.field_range_deg == GridSpec(CAMERA, mode="quality").field_range_deg


def test_a_preview_is_built_only_where_the_whole_takes_long():
    assert is_worthwhile(preview_s=0.3, whole_s=6.0)
    assert not is_worthwhile(preview_s=0.01, whole_s=0.2)
    assert not is_worthwhile(preview_s=2.0, whole_s=4.0)


def test_the_wire_knows_the_choices_and_defaults_of_the_grid():
    assert profiles.MODES == grid.MODES
    assert profiles.GRIDS == grid.GRIDS
    assert profiles.TOLERANCES == grid.TOLERANCES
    # A stream follows the field unless told otherwise; a bare grid is the simplest one.
    settings, spec = ProfileSettings(), GridSpec(CAMERA, mode="dynamic")
    for name in vars(settings).keys() & vars(spec).keys():
        assert getattr(settings, name) == getattr(spec, name), name
    for mode in grid.MODES:
        follows = ProfileSettings(mode=mode).follows_field
        assert follows == GridSpec(CAMERA, mode=mode).follows_field
