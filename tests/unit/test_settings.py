"""One set of settings: checked where it is made, an option of the command at once."""

import pickle
import re
from typing import Annotated, Literal

import numpy as np
import pytest
from msgspec import Meta
from typer.testing import CliRunner

from clients.commands.options import with_setting_options
from clients.commands.program import app
from filter_service.camera import Camera
from filter_service.errors import BadMessage
from filter_service.settings import (
    DEFAULTS,
    FilterSettings,
    RenderOptions,
    as_settings,
    setting_help,
    setting_types,
)
from filter_service.validation import RISING, checked


@pytest.mark.parametrize("name", setting_types())
def test_every_setting_says_what_it_means(name):
    assert setting_help(name).endswith(".")


@pytest.mark.parametrize(
    ("changes", "field", "allowed"),
    [
        ({"mode": "fast"}, "mode", "one of dynamic, on-axis, quality"),
        ({"pupil_range_mm": (5.0, 2.0)}, "pupil_range_mm", "0.5 to 9, lowest first"),
        ({"pupil_range_mm": (0.1, 2.0)}, "pupil_range_mm[0]", "0.5 to 9"),
        ({"pupil_range_mm": 4.0}, "pupil_range_mm", "two numbers"),
        ({"focus_range_dpt": (0.0, float("inf"))}, "focus_range_dpt[1]", "0 to 20"),
        ({"gaze_deg": (0.0, -61.0)}, "gaze_deg[1]", "-60 to 60"),
        ({"chromatic": 1}, "chromatic", "true or false"),
        ({"age_years": 2}, "age_years", "3 to 120"),
    ],
)
def test_a_wrong_setting_is_named_with_what_is_allowed(changes, field, allowed):
    with pytest.raises(ValueError, match="it is") as caught:
        FilterSettings(**changes)
    assert isinstance(caught.value, BadMessage)
    assert caught.value.field == field
    assert allowed in caught.value.allowed


def test_the_published_pipeline_has_its_own_grid_and_accumulation():
    settings = FilterSettings(pipeline="published", mode="on-axis")
    assert settings.grid == "paper"
    assert settings.covering(pupils_mm=(1.0,)).pipeline == "published"
    asked = RenderOptions(merge=False, render_tolerance=0.0, peripheral_merging=True)
    assert settings.frame_options(asked) == RenderOptions(
        accumulation="paper", merge=False, render_tolerance=0.0
    )
    assert DEFAULTS.frame_options(asked) is asked


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("diffraction", False),
        ("eye_model", "wavefront"),
        ("lateral_color", True),
        ("stiles_crawford", True),
        ("wide_primaries", True),
    ],
)
def test_settings_that_the_published_pipeline_does_not_model_are_refused(name, value):
    with pytest.raises(BadMessage, match="with pipeline 'published'") as caught:
        FilterSettings(pipeline="published", **{name: value})
    assert caught.value.field == name
    assert "or pipeline 'exact'" in caught.value.allowed
    assert getattr(FilterSettings(**{name: value}), name) == value


def test_lists_integers_and_numpys_numbers_are_as_good():
    plain = FilterSettings(pupil_range_mm=(2.0, 4.0), gaze_deg=(1.0, 0.0))
    given = FilterSettings(pupil_range_mm=[2, 4], gaze_deg=np.array([1.0, 0.0]))
    assert given == plain
    assert given == FilterSettings(
        pupil_range_mm=tuple(np.float32([2, 4])), gaze_deg=[1, 0]
    )
    assert pickle.loads(pickle.dumps(given)) == given
    assert type(given.pupil_range_mm[0]) is float


def test_a_range_may_be_a_single_value():
    assert FilterSettings(pupil_range_mm=(4.0, 4.0)).pupil_range_mm == (4.0, 4.0)


def test_changes_are_checked_too():
    assert DEFAULTS.changed(mode="on-axis").follows_field is False
    with pytest.raises(BadMessage, match="tolerance"):
        DEFAULTS.changed(tolerance="none")


@pytest.mark.parametrize(
    ("size_px", "tangents", "field"),
    [
        ((0, 9), (-1, 1, 1, -1), "width_px"),
        ((9, 2.5), (-1, 1, 1, -1), "height_px"),
        ((9, 9), (1, -1, 1, -1), "tangents"),
        ((9, 9), (-1, 1, 1), "tangents"),
        ((9, 9), (-1, 21, 1, -1), "tangents[1]"),
    ],
)
def test_a_camera_that_is_none_is_refused(size_px, tangents, field):
    with pytest.raises(BadMessage) as caught:
        Camera(*size_px, tangents)
    assert caught.value.field == field


def test_nested_values_are_named_by_their_path():
    kind = dict[str, list[Annotated[int, Meta(ge=0, le=3)]]]
    with pytest.raises(BadMessage) as caught:
        checked({"a": [1, 9]}, kind, "root")
    told = "root[...][1]: it is {'a': [1, 9]} (allowed: an integer 0 to 3)"
    assert str(caught.value) == told
    assert RISING == {"is_rising": True}


def has_option(name):
    return "_range_" not in name and "_planes_" not in name


def test_the_filter_command_has_an_option_for_every_setting_but_distances():
    text = CliRunner().invoke(app, ["filter", "--help"]).output
    options = set(re.findall(r"--[a-z-]+", text))
    for name in setting_types():
        words = name.replace("_", "-")
        stem, _, unit = words.rpartition("-")
        forms = {f"--{words}", f"--no-{words}", f"--{stem}-h-{unit}"}
        assert has_option(name) == bool(forms & options), name


def test_options_become_settings():
    seen = {}

    @with_setting_options(mode="on-axis")
    def command(out: str = "", *, settings: dict):
        seen.update(settings)

    command(
        **{
            name: parameter.default
            for name, parameter in command.__signature__.parameters.items()
        }
    )
    expected = DEFAULTS.changed(mode="on-axis")
    assert seen == {
        name: getattr(expected, name) for name in setting_types() if has_option(name)
    }


def test_an_option_out_of_range_is_named_as_an_option():
    arguments = [
        "--color",
        "a",
        "--depth",
        "b",
        "--fov-deg",
        "5",
        "--profile",
        "myopia",
        "-o",
        "c.png",
    ]
    result = CliRunner().invoke(app, ["filter", *arguments, "--gaze-v-deg", "80"])
    assert "--gaze-v-deg: it is 80.0" in str(result.exception)
    choices = Literal["a", "b"]
    with pytest.raises(BadMessage, match="one of a, b"):
        checked("c", choices, "x")


def test_some_settings_may_be_given_by_name():
    settings = FilterSettings(mode="quality", gaze_deg=(1.0, 2.0))
    assert as_settings(settings) is settings
    assert as_settings({"mode": "quality", "gaze_deg": [1, 2]}) == settings
    assert as_settings({}) == FilterSettings()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"mod": "quality"}, r"settings: .*'mod'.* \(allowed: pipeline, mode, grid, "),
        ({"mode": "best"}, r"mode: .*'best'"),
        ("quality", r"settings: .*str.* \(allowed: FilterSettings, or"),
    ],
)
def test_settings_that_there_are_not_are_named(settings, words):
    with pytest.raises(BadMessage, match=words):
        as_settings(settings)
