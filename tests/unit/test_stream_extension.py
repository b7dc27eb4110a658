"""More of an eye is built when the frames of its stream leave what is prepared."""

import pytest

from filter_service.building.jobs import LookAt
from filter_service.building.used_ranges import UsedRanges
from filter_service.camera import Camera
from filter_service.errors import GridTooLarge
from filter_service.filtering.accepted_profile import PreparedStore
from filter_service.filtering.stream_eyes import StreamEyes
from filter_service.filtering.stream_use import FrameUse
from filter_service.settings import FilterSettings

CAMERA = Camera(100, 100, (-0.5, 0.5, 0.5, -0.5))
SCENE = (0.1, 1.0)


class Store:
    """Stands for a loaded store."""


class Stream:
    """A stream whose builds are done at once, ten frames a second."""

    def __init__(self, **settings):
        self.eyes = StreamEyes(on_event=lambda event: None)
        self.at_s = 0.0
        settings = FilterSettings(**settings)
        self.eye = self.eyes.add_profile(None, settings, [CAMERA])

    def frame(self, pupil_mm, focus_dpt, objects_dpt=SCENE):
        """Ask for a frame; what it is seen through."""
        self.at_s += 0.1
        self.eyes.use.note(FrameUse(self.at_s, pupil_mm, focus_dpt, objects_dpt))
        return self.eyes.plan([CAMERA], LookAt(pupil_mm, focus_dpt))

    def build(self):
        """Build what is wanted; return it."""
        wanted = self.eyes.next_build()
        if wanted is not None:
            self.eyes.put_in_place(
                wanted.eye, PreparedStore(CAMERA, Store(), ranges=wanted.ranges)
            )
        return wanted


def test_first_a_little_is_built_and_then_what_frames_use():
    stream = Stream()
    first = stream.build()
    assert not first.extends and first.ranges.pupil_mm == (3.5, 4.5)
    assert stream.build() is None
    assert stream.frame(4.0, 0.0).is_complete
    assert stream.build() is None
    assert not stream.frame(6.0, 3.0).is_complete  # seen through what there is
    second = stream.build()
    assert second.extends and second.with_preview
    assert second.ranges.pupil_mm[1] >= 6.0 and second.ranges.focus_dpt[1] >= 3.0
    assert second.ranges.pupil_mm[0] <= 4.0  # a moment ago it was there
    assert stream.frame(6.0, 3.0).is_complete
    assert stream.build() is None


class PreviewedStream(Stream):
    """A stream whose frames have left what is prepared; a preview stands before it."""

    def __init__(self, **settings):
        super().__init__(**settings)
        self.build()
        self.whole = self.eye.store_for(CAMERA)
        self.frame(6.0, 3.0)
        self.wanted = self.eyes.next_build()
        near_state = UsedRanges((5.9, 6.1), (2.9, 3.1), (0.0, 10.0))
        self.preview = PreparedStore(
            CAMERA, Store(), is_complete=False, ranges=near_state
        )
        self.eyes.put_in_place(self.eye, self.preview)


def test_a_preview_of_more_shows_what_was_not_there_and_nothing_else():
    stream = PreviewedStream()
    assert stream.frame(6.0, 3.0).stores == (stream.preview.store,)
    inside = stream.frame(4.0, 0.0)
    assert inside.stores == (stream.whole.store,) and inside.is_complete
    assert not stream.eyes.retired
    stream.eyes.put_in_place(
        stream.eye, PreparedStore(CAMERA, Store(), ranges=stream.wanted.ranges)
    )
    assert stream.eyes.retired == [stream.preview.store, stream.whole.store]


def test_a_preview_is_prepared_for_its_own_state_alone():
    stream = PreviewedStream()
    seen = stream.frame(6.05, 3.0)
    assert (seen.is_complete, seen.is_prepared) == (False, True)
    elsewhere = stream.frame(6.0, 5.0)
    assert elsewhere.stores == (stream.preview.store,), "the best there is"
    assert (elsewhere.is_complete, elsewhere.is_prepared) == (False, False)


def test_nothing_extends_a_preview_that_is_all_there_is():
    stream = Stream()
    only = UsedRanges((3.9, 4.1), (0.0, 0.1), (0.0, 10.0))
    preview = PreparedStore(CAMERA, Store(), is_complete=False, ranges=only)
    stream.eyes.put_in_place(stream.eye, preview)
    stream.frame(6.0, 3.0)
    assert not stream.eyes.next_build().extends, "the whole is to come"
    stream.eyes.fail_build(stream.eye, CAMERA, GridTooLarge("too large", field="x"))
    seen = stream.frame(6.0, 3.0)
    assert stream.eyes.next_build() is None
    assert seen.is_prepared and "too large" in seen.notes[0], "nobody waits for it"
    near = stream.frame(4.0, 0.05)
    assert not near.is_complete and "too large" in near.notes[0]
    assert stream.eyes.is_final(near)


def test_only_the_newest_whole_eye_is_final():
    stream = PreviewedStream()
    assert not stream.eyes.is_final(stream.frame(6.0, 3.0)), "a preview"
    assert stream.eyes.is_final(stream.frame(4.0, 0.0))
    stream.eyes.add_profile(None, FilterSettings(), [CAMERA])
    seen = stream.frame(4.0, 0.0)
    assert seen.is_complete and not stream.eyes.is_final(seen), "of the eye before"


def test_an_eye_was_ready_while_more_of_it_is_previewed():
    stream = PreviewedStream()
    assert stream.eyes.unfinished_eye() is None
    stream.eyes.end()
    assert len(stream.eyes.retired) == 2


def test_where_more_fails_after_its_preview_the_whole_is_back():
    stream = PreviewedStream()
    error = GridTooLarge("too large", field="settings")
    stream.eyes.fail_extension(stream.wanted, error)
    assert stream.eye.store_for(CAMERA) is stream.whole
    assert stream.eyes.retired == [stream.preview.store]
    plan = stream.frame(6.0, 3.0)
    assert not plan.is_complete and "too large" in plan.notes[0]


def test_frames_on_their_way_out_are_met_and_see_no_preview():
    stream = Stream()
    stream.build()
    pupil_mm, met = 4.0, []
    while pupil_mm < 7.0:
        pupil_mm += 0.03  # 0.3 mm/s
        met.append(stream.frame(pupil_mm, 0.0).is_complete)
        wanted = stream.build()
        assert wanted is None or not wanted.with_preview
    assert all(met)


def test_nearer_objects_are_prepared_for_too():
    stream = Stream()
    stream.build()
    assert not stream.frame(4.0, 0.0, (0.0, 5.0)).is_complete
    assert stream.build().ranges.object_dpt[1] >= 5.0
    assert stream.frame(4.0, 0.0, (0.0, 5.0)).is_complete


def test_what_could_not_be_built_is_not_asked_for_again_and_said():
    stream = Stream()
    stream.build()
    stream.frame(6.5, 0.0)
    wanted = stream.eyes.next_build()
    stream.eyes.fail_extension(wanted, GridTooLarge("too large", field="settings"))
    assert stream.eyes.next_build() is None
    plan = stream.frame(6.5, 0.0)
    assert not plan.is_complete
    assert "could not be prepared" in plan.notes[0] and "too large" in plan.notes[0]
    assert stream.frame(4.0, 0.0).notes == ()


def test_all_ranges_at_once_are_never_extended():
    stream = Stream(prepare="ranges")
    assert stream.build().ranges is None
    assert stream.frame(6.9, 5.9).is_complete
    assert stream.build() is None


def test_the_papers_grid_does_not_follow():
    assert not FilterSettings(grid="paper").follows_stream


@pytest.mark.parametrize("pupil_mm", [1.0, 9.0])
def test_beyond_the_settings_nothing_more_is_wanted(pupil_mm):
    stream = Stream(pupil_range_mm=(3.0, 5.0))
    stream.build()
    for _ in range(4):
        stream.frame(pupil_mm, 0.0)
        stream.build()
    assert stream.build() is None
    held = stream.eye.store_for(CAMERA).ranges
    assert UsedRanges((3.0, 5.0), (0.0, 6.0), (0.0, 10.0)).holds(held)


def test_what_was_begun_for_other_states_is_begun_anew():
    stream = Stream()
    stream.eyes.building = stream.eyes.next_build()
    assert not stream.eyes.builds_in_vain
    assert stream.frame(4.0, 0.0) is None and not stream.eyes.builds_in_vain
    stream.frame(6.0, 3.0)
    assert stream.eyes.builds_in_vain
    stream.eyes.building = stream.eyes.next_build()
    assert not stream.eyes.builds_in_vain
