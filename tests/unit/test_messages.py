"""The wire types: round trips, and every way a message can be wrong."""

import json
import math

import msgpack
import numpy as np
import pytest

from estimator.note import Note
from filter_service import errors, messages
from filter_service.messages import (
    LINEAR,
    LINEAR16,
    PROTOCOL_VERSION,
    SRGB8,
    Limits,
    ProfileRequest,
    ViewHeader,
    ViewImages,
    decode_reply,
    decode_request,
    encode,
)
from filter_service.service.frame_reply import images_in
from filter_service.shared_memory import Slot, aligned_starts
from filter_service.wire.message import plain_message, plain_request
from filter_service.wire.requests import frame_of
from tests.unit.message_parts import (
    CAMERA,
    REPLIES,
    REQUESTS,
    as_bytes,
    changed_header,
    frame,
    frame_parts,
    profile_parts,
    view_images,
    view_map,
)


@pytest.mark.parametrize("message", REQUESTS, ids=lambda m: m.type_name)
def test_what_a_client_says_arrives_unchanged(message):
    assert decode_request(as_bytes(encode(message))) == message


@pytest.mark.parametrize("message", REPLIES, ids=lambda m: m.type_name)
def test_what_the_service_says_arrives_unchanged(message):
    assert decode_reply(as_bytes(encode(message))) == message


@pytest.mark.parametrize("message", REPLIES, ids=lambda m: m.type_name)
def test_a_plain_reply_is_read_as_one_that_is_examined(message, monkeypatch):
    parts = as_bytes(encode(message))
    assert plain_message(parts[0], messages.REPLIES, PROTOCOL_VERSION) is not None
    plain = decode_reply(parts)
    monkeypatch.setattr(messages, "plain_message", lambda *_: None)
    assert decode_reply(parts) == plain == message


@pytest.mark.parametrize("message", REQUESTS, ids=lambda m: m.type_name)
def test_a_plain_request_is_read_as_one_that_is_examined(message, monkeypatch):
    parts = as_bytes(encode(message))
    assert plain_request(parts[0], messages.REQUESTS, PROTOCOL_VERSION) is not None
    plain = decode_request(parts)
    monkeypatch.setattr(messages, "plain_request", lambda *_: None)
    assert decode_request(parts) == plain == message


def packed_map(*pairs):
    """Return a msgpack map with these pairs, in which a key may appear twice."""
    packed = b"".join(msgpack.packb(item) for pair in pairs for item in pair)
    return bytes([0x80 + len(pairs)]) + packed


@pytest.mark.parametrize(
    "header",
    [
        packed_map(("type", "ping"), ("version", 1), ("t", 1.0), ("t", 2.0)),
        packed_map(("type", "ping"), ("version", 1), ("unknown", 0)),
        packed_map(("type", "ping"), ("version", True)),
        packed_map(("type", "ping"), ("version", PROTOCOL_VERSION + 1)),
        packed_map(("type", "ping"), ("t", 1.0)),
        packed_map(("type", "nothing"), ("version", 1)),
        packed_map(("type", ["ping"]), ("version", 1)),
        packed_map(("type", "ping"), ("version", 1), ("t", "late")),
        packed_map(("type", "ping"), ("version", 1), (3, "number")),
        b"\x91" * 4000,
        b"",
    ],
    ids=lambda header: repr(header[:40]),
)
def test_a_request_that_is_not_plain_is_examined(header):
    assert plain_request(header, messages.REQUESTS, PROTOCOL_VERSION) is None


@pytest.mark.parametrize(
    "message",
    [m for m in REQUESTS if m.type_name == "frame"],
    ids=lambda m: f"{len(m.views)} views",
)
def test_a_render_worker_reads_the_same_frame_from_a_checked_header(message):
    header = as_bytes(encode(message))[0]
    received = frame_of(header)
    assert received == message
    assert [view.camera for view in received.views] == [v.camera for v in message.views]


def test_images_in_shared_memory_are_read_only_for_the_filter():
    """The client has them, too, and may send them again."""
    sent = frame()
    arrays = [sent.images[0].color, sent.images[0].depth_m]
    starts, size_bytes = aligned_starts([array.nbytes for array in arrays])
    slot = Slot.create(1, size_bytes)
    slot.put(arrays, starts)
    (found,) = images_in(sent, slot, starts, ())
    for array, expected in zip((found.color, found.depth_m), arrays, strict=True):
        np.testing.assert_array_equal(array, expected)
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0
    slot.close()


@pytest.mark.parametrize(
    ("color", "dtype"),
    [(SRGB8, np.uint8), (LINEAR, np.float32), (LINEAR16, np.float16)],
)
def test_images_of_two_views_arrive_bit_for_bit(color, dtype):
    images = (view_images(dtype), ViewImages(*reversed_images(dtype)))
    views = (ViewHeader.of(CAMERA, color), ViewHeader.of(CAMERA, color, "radial"))
    sent = frame(views=views, images=images)
    received = decode_request(as_bytes(encode(sent)))
    assert received == sent
    for mine, theirs in zip(images, received.images, strict=True):
        np.testing.assert_array_equal(mine.color, theirs.color)
        np.testing.assert_array_equal(mine.depth_m, theirs.depth_m)
        assert not theirs.color.flags.writeable


def reversed_images(dtype):
    images = view_images(dtype)
    return images.color[::-1], np.ascontiguousarray(images.depth_m[::-1])


def hidden_frame(dtype=np.uint8):
    """Two views, of which the first has a hidden layer."""
    color = SRGB8 if dtype == np.uint8 else LINEAR
    seen, behind = view_images(dtype), ViewImages(*reversed_images(dtype))
    layered = ViewImages(seen.color, seen.depth_m, behind.color, behind.depth_m)
    views = (
        ViewHeader.of(CAMERA, color, has_hidden=True),
        ViewHeader.of(CAMERA, color),
    )
    return frame(views=views, images=(layered, seen))


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_a_hidden_layer_arrives_with_the_view_that_it_belongs_to(dtype):
    sent = hidden_frame(dtype)
    received = decode_request(as_bytes(encode(sent)))
    assert received == sent
    first, second = received.images
    for name in ("color", "depth_m", "hidden_color", "hidden_depth_m"):
        np.testing.assert_array_equal(
            getattr(first, name), getattr(sent.images[0], name)
        )
    assert second.hidden_color is None
    assert second.hidden_depth_m is None
    np.testing.assert_array_equal(second.color, sent.images[1].color)


@pytest.mark.parametrize(
    ("part", "n_bytes", "field"),
    [
        (3, 35, "views[0].hidden_color"),
        (4, 52, "views[0].hidden_depth"),
        (5, 35, "views[1].color"),
    ],
)
def test_a_hidden_part_of_the_wrong_size_is_named(part, n_bytes, field):
    parts = as_bytes(encode(hidden_frame()))
    parts[part] = bytes(n_bytes)
    assert refusal(parts).field == field


def test_a_view_that_lacks_its_hidden_layer_is_refused():
    sent = hidden_frame()
    assert refusal(as_bytes(encode(sent))[:-2]).field == "parts"
    lacking = (sent.images[1], sent.images[1])
    with pytest.raises(ValueError, match="no hidden layer"):
        encode(frame(views=sent.views, images=lacking))


def test_a_result_carries_its_images_and_stage_times():
    color = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    sent = messages.Result(
        frame_id=1,
        profile_id=2,
        generation=3,
        views=(messages.ResultView(4, 3),),
        pupil_diameter_mm=4.0,
        focus_dpt=0.25,
        missing_depth_count=5,
        clamped_depth_count=6,
        total_ms=3.0,
        stage_times_ms={"decode_ms": 1.0, "other_ms": 2.0},
        gaze_deg=(3.5, -2.0),
        overflow_count=7,
        notes=(Note("pupil_capped", "capped", used_mm=4.5, near_dpt=math.inf), "plain"),
        colors=(color,),
    )
    received = decode_reply(as_bytes(encode(sent)))
    assert received == sent
    assert received.notes == ("capped", "plain")
    assert [(d.code, d.values) for d in received.note_details] == [
        ("pupil_capped", {"used_mm": 4.5}),
        ("other", {}),
    ]
    np.testing.assert_array_equal(received.colors[0], color)


def test_missing_and_infinite_depth_values_pass():
    depth_m = np.array([np.nan, np.inf, -1, 0] * 3, np.float32).reshape(3, 4)
    sent = frame(images=(ViewImages(view_images().color, depth_m),))
    received = decode_request(as_bytes(encode(sent)))
    np.testing.assert_array_equal(received.images[0].depth_m, depth_m)


def test_unknown_header_fields_are_ignored():
    assert decode_request(frame_parts(gaze={"x": [1, 2]}, later="yes")) == frame()


def test_optional_fields_have_defaults():
    assert decode_request(frame_parts(output=None, options=None)) == frame()


def refusal(parts, error=errors.BadMessage):
    with pytest.raises(error) as caught:
        decode_request(parts)
    return caught.value


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"frame_id": None}, "frame_id"),
        ({"frame_id": -1}, "frame_id"),
        ({"frame_id": True}, "frame_id"),
        ({"frame_id": 1.0}, "frame_id"),
        ({"frame_id": 2**60}, "frame_id"),
        ({"pupil_diameter_mm": float("nan")}, "pupil_diameter_mm"),
        ({"pupil_diameter_mm": float("inf")}, "pupil_diameter_mm"),
        ({"pupil_diameter_mm": 0.0}, "pupil_diameter_mm"),
        ({"pupil_diameter_mm": "4"}, "pupil_diameter_mm"),
        ({"focus_dpt": float("-inf")}, "focus_dpt"),
        ({"focus_dpt": -0.1}, "focus_dpt"),
        ({"gaze_deg": 5.0}, "gaze_deg"),
        ({"gaze_deg": [0.0, 0.0, 0.0]}, "gaze_deg"),
        ({"gaze_deg": [0.0, 60.5]}, "gaze_deg[1]"),
        ({"gaze_deg": [float("nan"), 0.0]}, "gaze_deg[0]"),
        ({"views": []}, "views"),
        ({"views": {}}, "views"),
        ({"views": [view_map()] * 3}, "views"),
        ({"views": [7]}, "views[0]"),
        ({"views": [view_map(width_px=0)]}, "views[0].width_px"),
        ({"views": [view_map(width_px=2**40)]}, "views[0].width_px"),
        ({"views": [view_map(height_px=5000)]}, "views[0].height_px"),
        ({"views": [view_map(tangents=[-1, 1, 1])]}, "views[0].tangents"),
        ({"views": [view_map(tangents=[1, -1, 1, -1])]}, "views[0].tangents"),
        (
            {"views": [view_map(tangents=[-1, float("nan"), 1, -1])]},
            "views[0].tangents[1]",
        ),
        (
            {"views": [view_map(color={"dtype": "float64", "space": "linear"})]},
            "views[0].color.dtype",
        ),
        (
            {"views": [view_map(color={"dtype": "uint8", "space": "linear"})]},
            "views[0].color.space",
        ),
        (
            {"views": [view_map(color={"dtype": "float16", "space": "srgb"})]},
            "views[0].color.space",
        ),
        ({"views": [view_map(color=None)]}, "views[0].color"),
        ({"views": [view_map(depth={"kind": "log"})]}, "views[0].depth.kind"),
        ({"views": [view_map(has_hidden="yes")]}, "views[0].has_hidden"),
        ({"views": [view_map(has_hidden=True)]}, "parts"),
        ({"output": {"dtype": "uint16", "space": "srgb"}}, "output.dtype"),
        ({"options": {"accumulation": "sum"}}, "options.accumulation"),
        ({"options": {"merge": 1}}, "options.merge"),
        ({"options": {"peripheral_merging": 1}}, "options.peripheral_merging"),
        ({"options": {"render_tolerance": -1.0}}, "options.render_tolerance"),
    ],
)
def test_a_wrong_frame_field_is_named_with_what_is_allowed(changes, field):
    error = refusal(frame_parts(**changes))
    assert error.field == field
    assert error.allowed


def test_the_limits_stated_are_those_of_the_service():
    limits = Limits(max_width_px=100, max_views=1)
    for views, allowed in (
        ([view_map(width_px=0)], "an integer 1 to 100"),
        ([view_map(width_px=101)], "an integer 1 to 100"),
        ([view_map(width_px=None)], "an integer 1 to 100"),
        ([{"height_px": 3}], "this field is required"),
        ([], "a list of 1 to 1 items"),
        ([view_map()] * 2, "a list of 1 to 1 items"),
        ([view_map()] * 9, "a list of 1 to 1 items"),
    ):
        with pytest.raises(errors.BadMessage) as caught:
            decode_request(frame_parts(views=views), limits)
        assert caught.value.allowed == allowed


@pytest.mark.parametrize(
    ("settings_map", "field"),
    [
        ({"pupil_range_mm": [2, float("nan")]}, "settings.pupil_range_mm[1]"),
        ({"pupil_range_mm": [7, 2]}, "settings.pupil_range_mm"),
        ({"pupil_range_mm": [2]}, "settings.pupil_range_mm"),
        ({"focus_range_dpt": 3}, "settings.focus_range_dpt"),
        ({"object_range_dpt": [-1, 3]}, "settings.object_range_dpt[0]"),
        ({"diffraction": "no"}, "settings.diffraction"),
        ({"lateral_color": 1}, "settings.lateral_color"),
        ({"stiles_crawford": "OD"}, "settings.stiles_crawford"),
        ({"gaze_deg": [61, 0]}, "settings.gaze_deg[0]"),
        ({"gaze_range_deg": [5, -1]}, "settings.gaze_range_deg[1]"),
        ({"gaze_range_deg": 5}, "settings.gaze_range_deg"),
        ({"age_years": 200}, "settings.age_years"),
    ],
)
def test_a_wrong_profile_setting_is_named(settings_map, field):
    parts = encode(ProfileRequest(1, {"kind": "preset"}))
    error = refusal(changed_header(parts, settings=settings_map))
    assert error.field == field


@pytest.mark.parametrize(
    ("color_bytes", "depth_bytes", "field"),
    [
        (35, 48, "views[0].color"),
        (37, 48, "views[0].color"),
        (36, 44, "views[0].depth"),
    ],
)
def test_a_part_of_the_wrong_size_is_named(color_bytes, depth_bytes, field):
    parts = [encode(frame())[0], bytes(color_bytes), bytes(depth_bytes)]
    assert refusal(parts).field == field


@pytest.mark.parametrize("n_parts", [0, 1, 3])
def test_a_wrong_number_of_parts_is_refused(n_parts):
    parts = [encode(frame())[0], *[bytes(36)] * n_parts]
    assert refusal(parts).field == "parts"


def test_an_image_beyond_the_part_limit_is_refused_before_it_is_looked_at():
    limits = Limits(max_part_bytes=35)
    with pytest.raises(errors.BadMessage, match="36 bytes"):
        decode_request(as_bytes(encode(frame())), limits)


def test_the_limit_holds_for_the_output_too():
    limits = Limits(max_part_bytes=100)  # 36 bytes come in, 144 would go out
    parts = as_bytes(encode(frame(output=LINEAR)))
    with pytest.raises(errors.BadMessage, match="144 bytes"):
        decode_request(parts, limits)


def test_another_version_is_refused_whatever_else_is_in_the_message():
    for version in (0, 2, "1", 1.0, True, None):
        error = refusal([msgpack.packb({"version": version})], errors.VersionMismatch)
        assert (error.field, error.allowed) == ("version", "1")


def test_an_unknown_type_is_refused_with_the_known_ones():
    for name in ("shutdown", 5, None, ["frame"]):
        parts = [msgpack.packb({"type": name, "version": 1})]
        error = refusal(parts, errors.UnknownType)
        assert error.field == "type"
        assert "profile" in error.allowed


def nested_arrays(depth):
    return b"\x91" * depth + b"\xc0"


@pytest.mark.parametrize(
    "header",
    [
        b"",
        b"\xc1",
        b"\x81",
        msgpack.packb({"type": "bye", "version": 1}) + b"\x00",
        msgpack.packb([1, 2]),
        msgpack.packb("text"),
        b"\x82\xa1a\x01\xa1a\x02",  # the same key twice
        b"\x81\x01\x02",  # a key that is no text
        b"\x81\x91\x01\x02",  # a key that cannot be hashed
        msgpack.packb({"x": msgpack.ExtType(5, b"abc")}),
        msgpack.packb({"x": msgpack.Timestamp(1, 0)}),
        msgpack.packb({"x": b"bytes"}),
        b"\x81\xa1x\xa2\xff\xfe",  # not UTF-8
        msgpack.packb({"x": list(range(65))}),
        nested_arrays(3000),
        b"\x81\xa1x\xdd\xff\xff\xff\xff",  # claims 4 G items
        msgpack.packb({"x": "a" * 5000}),
    ],
)
def test_a_header_that_is_no_plain_map_is_refused(header):
    assert refusal([header]).field == "header"


def test_no_parts_at_all_are_refused():
    assert refusal([]).field == "header"


def test_a_profile_body_may_be_json_or_msgpack():
    body = {"kind": "zernike", "zernike_um": {"2,0": 5.41}, "eye_side": "OD"}
    for encoded in (json.dumps(body).encode(), b" \n" + json.dumps(body).encode()):
        assert decode_request(profile_parts(encoded)).body == body
    assert decode_request(profile_parts(msgpack.packb(body))).body == body


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"[1]",
        b'{"a": 1',
        b'{"a": 1, "a": 2}',
        b'{"a": NaN}',
        b'{"a": [1e999]}',
        b'{"a": "\xff"}',
        b'{"a": ' + b"[" * 100_000,
        b'{"a": ' + b"9" * 10_000 + b"}",
        msgpack.packb({"a": {"b": [1.0, float("nan")]}}),
        msgpack.packb({"a": list(range(5000))}),
        nested_arrays(100_000),
        b"{" + b" " * 2**20,
    ],
)
def test_a_profile_body_that_is_no_plain_map_is_refused(body):
    assert refusal(profile_parts(body)).field.startswith("profile")


def test_a_nan_inside_a_profile_is_named_by_its_path():
    body = msgpack.packb({"measurements": [{"h_deg": 0.0}, {"h_deg": float("nan")}]})
    assert refusal(profile_parts(body)).field == "profile.measurements[1].h_deg"


def test_the_longest_error_text_fits_into_a_header():
    reply = messages.ErrorReply("c" * 20, "ä" * 9000, "ß" * 9000, "€" * 9000, 2**53 - 1)
    received = decode_reply(encode(reply))
    assert received.message.endswith("...")
    assert received.frame_id == 2**53 - 1


def test_an_error_reply_becomes_the_exception_it_was_made_of():
    for error_class in errors.ERROR_CLASSES.values():
        error = error_class("text", field="f", allowed="a")
        reply = decode_reply(encode(messages.ErrorReply.from_exception(error)))
        assert type(reply.exception()) is error_class
        assert str(reply.exception()) == "f: text (allowed: a)"
    assert "later_code: text" in str(errors.error_from_code("later_code", "text"))


def test_every_error_has_a_code_of_its_own():
    classes = [
        found
        for found in vars(errors).values()
        if isinstance(found, type) and issubclass(found, errors.FilterError)
    ]
    assert len(classes) > 10
    assert sorted(found.code for found in classes) == sorted(errors.ERROR_CLASSES)


def test_ids_of_a_broken_message_are_still_found():
    assert messages.peek_ids(frame_parts(views=3)) == (7, None)
    assert messages.peek_ids(frame_parts(frame_id="7")) == (None, None)
    assert messages.peek_ids([b"\xc1"]) == (None, None)
    assert messages.peek_ids([]) == (None, None)
