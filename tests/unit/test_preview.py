"""What a preview holds, and when one is built."""

import pytest

from filter_service.building.jobs import LookAt
from filter_service.building.preview import is_worthwhile, preview_ranges, preview_spec
from filter_service.messages import Camera
from tests.grid_specs import grid_spec

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
    whole = grid_spec(
        CAMERA,
        pupil_range_mm=(2.0, 6.0),
        focus_range_dpt=(1.0, 4.0),
        object_range_dpt=(0.0, 3.0),
        chromatic=False,
    )
    spec = preview_spec(whole, look_at)
    assert spec.settings.pupil_range_mm == (pupil_mm, pupil_mm)
    assert spec.settings.focus_range_dpt == (focus_dpt, focus_dpt)
    assert spec.settings.object_range_dpt == (0.0, 3.0)
    assert not spec.settings.chromatic
    near = preview_ranges(spec)
    assert near.pupil_mm == pytest.approx((pupil_mm - 0.1, pupil_mm + 0.1))
    assert near.focus_dpt == pytest.approx((focus_dpt - 0.05, focus_dpt + 0.05))
    assert near.object_dpt == (0.0, 3.0)


def test_a_preview_follows_the_field_where_the_whole_does():
    on_axis = preview_spec(grid_spec(CAMERA), None)
    assert not on_axis.follows_field
    field = preview_spec(grid_spec(CAMERA, mode="quality", grid="paper"), None)
    settings = field.settings
    assert (settings.mode, settings.grid) == ("dynamic", "planned")
    assert settings.tolerance == "loose"
    assert field.field_range_deg == grid_spec(CAMERA, mode="quality").field_range_deg


def test_a_preview_is_built_only_where_the_whole_takes_long():
    assert is_worthwhile(preview_s=0.3, whole_s=6.0)
    assert not is_worthwhile(preview_s=0.01, whole_s=0.2)
    assert not is_worthwhile(preview_s=2.0, whole_s=4.0)
