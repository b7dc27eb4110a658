"""Frames through a running service: what comes back, and what happens to bad ones."""

import time
from dataclasses import replace

import msgpack
import numpy as np
import pytest
import zmq

from clients.filter_client import FilterClient, FilteredFrame, RgbdView
from filter_service import errors
from filter_service.messages import Bye, Hello, Ping, encode
from filter_service.wire.images import packed
from tests.end_to_end.conftest import make_view, small_frame

SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}


def double(mark, **more):
    return {"kind": "double", "mark": mark, **more}


@pytest.mark.parametrize("size", [(64, 36), (1, 1), (7, 301), (640, 480)])
def test_a_frame_comes_back_filtered_in_8_bits(client, size):
    view = make_view(*size)
    client.set_profile(double(7), views=[view])
    reply = client.filter(view, **SEE)
    expected = 255 - view.color
    expected[0, 0] = 7
    np.testing.assert_array_equal(reply.color, expected)


def test_a_linear_frame_comes_back_linear(client):
    view = make_view(dtype=np.float32)
    client.set_profile(double(7), views=[view])
    reply = client.filter(view, **SEE, output="linear")
    assert reply.color.dtype == np.float32
    np.testing.assert_array_equal(reply.color[1:], 1 - view.color[1:])


def test_half_floats_go_there_and_back(client):
    view = make_view(dtype=np.float32)
    half = RgbdView(view.color.astype(np.float16), view.depth_m, view.tangents)
    client.set_profile(double(7), views=[half])
    reply = client.filter(half, **SEE, output="linear16")
    assert reply.color.dtype == np.float16
    expected = (np.float32(1) - half.color).astype(np.float16)
    np.testing.assert_array_equal(reply.color[1:], expected[1:])


@pytest.mark.parametrize("encoding", ["float16", "dpt16", "mm16"])
def test_depth_in_two_bytes_arrives_as_meters(client, encoding):
    """Eight frames: the first ones as parts, the others in shared memory."""
    view = make_view()
    view.depth_m[0, :3] = (0.0, -1.0, np.nan)
    client.set_profile(double(7), views=[view])
    for _ in range(8):
        reply = client.filter(view, **SEE, depth_encoding=encoding)
        assert reply.missing_depth_count == 3
        np.testing.assert_array_equal(reply.color[1:], 255 - view.color[1:])
    with pytest.raises(ValueError, match="depth_encoding is 'png'"):
        client.submit(view, **SEE, depth_encoding="png")


def test_a_result_says_what_it_was_made_with(client):
    view = make_view()
    view.depth_m[0, :3] = (0.0, -1.0, np.nan)
    ready = client.set_profile(double(7), views=[view])
    reply = client.filter(
        view, pupil_diameter_mm=9.0, focus_dpt=1.5, accumulation="paper"
    )
    header = reply
    assert (header.profile_id, header.generation) == (
        ready.profile_id,
        ready.generation,
    )
    assert (header.pupil_diameter_mm, header.focus_dpt) == (7.0, 1.5)
    assert header.missing_depth_count == 3
    assert header.notes == ("paper",)


def test_stage_times_are_named_and_sum_to_the_total(client):
    view = make_view()
    client.set_profile(double(7), views=[view])
    header = client.filter(view, **SEE)
    stages = header.stage_times_ms
    assert {"decode_ms", "queue_ms", "filter_ms", "other_ms"} <= set(stages)
    assert sum(stages.values()) == pytest.approx(header.total_ms, abs=1e-6)
    assert stages["filter_ms"] >= 2.0  # what the double is told to take
    assert 0 <= stages["other_ms"] < header.total_ms


@pytest.mark.parametrize("second_size", [(64, 36), (32, 40)])
def test_two_views_come_back_in_order(client, second_size):
    left, right = make_view(64, 36, seed=1), make_view(*second_size, seed=2)
    client.set_profile(double(9), views=[left, right])
    reply = client.filter([left, right], **SEE)
    for view, color in zip((left, right), reply.colors, strict=True):
        np.testing.assert_array_equal(color[1:], 255 - view.color[1:])


@pytest.mark.parametrize("name", ["hidden_color", "hidden_depth_m"])
def test_half_a_hidden_layer_is_refused_before_it_is_sent(name):
    view = make_view()
    with pytest.raises(ValueError, match="missing"):
        replace(view, **{name: getattr(view, name.removeprefix("hidden_"))})
    with pytest.raises(ValueError, match="shape"):
        replace(view, hidden_color=view.color[:5], hidden_depth_m=view.depth_m[:5])


def test_the_caller_may_reuse_its_arrays_at_once(client):
    view = make_view(640, 360)
    client.set_profile(double(9), views=[view])
    for value in range(20):
        view.color[:] = value
        frame_id = client.submit(view, **SEE)
        view.color[:] = 200
        (reply,) = client.poll(10.0)
        assert isinstance(reply, FilteredFrame)
        assert reply.frame_id == frame_id
        assert np.all(reply.color[1:] == 255 - value)


def test_a_frame_that_cannot_be_filtered_is_an_error_and_the_next_one_works(client):
    view = make_view()
    client.set_profile(double(7), views=[view])
    with pytest.raises(errors.RenderFailed, match=r"breaks at 8\.75 mm"):
        client.filter(view, pupil_diameter_mm=8.75, focus_dpt=0.0)
    assert client.filter(view, **SEE).color[0, 0, 0] == 7


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"gaze_deg": 3.0}, r"gaze_deg: .*3\.0.* two numbers"),
        ({"states": [1]}, r"states\[0\]: 1 .* a ViewState"),
        ({"color": [1]}, r"color: a list of int .* an RgbdView, or several"),
        ({"pupil_diameter_mm": np.nan}, r"pupil_diameter_mm: it is nan .* 0\.5 to 9"),
    ],
)
def test_a_wrong_argument_is_named_and_the_next_frame_works(client, change, words):
    view = make_view()
    client.set_profile(double(7), views=view)  # one view needs no list
    with pytest.raises(errors.BadMessage, match=words):
        client.filter(**{"color": view, **SEE, **change})
    assert client.filter(view, **SEE).color[0, 0, 0] == 7
    with pytest.raises(errors.BadMessage, match=r"profile: is a NoneType .* mapping"):
        client.set_profile(None)


def test_images_too_large_for_the_service_are_refused_by_the_client(client):
    with pytest.raises(ValueError, match="4097 x 300"):
        client.submit(make_view(4097, 300), **SEE)


def test_a_frame_before_hello_and_before_a_profile_is_answered(
    shared_service, raw_client
):
    raw = raw_client(shared_service)
    reply = raw.ask(small_frame(5))
    assert (reply.code, reply.frame_id) == ("no_session", 5)
    raw.ask(Hello("raw"))
    reply = raw.ask(small_frame(6))
    assert (reply.code, reply.frame_id) == ("no_profile", 6)


@pytest.mark.parametrize("size", [(320, 180), (640, 360), (1920, 1080)])
def test_a_large_frame_before_hello_is_answered(shared_service, raw_client, size):
    for frame_id in range(3):
        raw = raw_client(shared_service)
        width_px, height_px = size
        frame = small_frame(frame_id, width_px=width_px, height_px=height_px)
        reply = raw.ask(frame)
        assert (reply.code, reply.frame_id) == ("no_session", frame_id)


def test_hello_again_tells_what_is_still_filtered(shared_service, raw_client):
    raw = raw_client(shared_service)
    welcome = raw.begin(more={"filter_ms": 500})
    assert (welcome.is_resumed, welcome.n_unanswered) == (False, 0)
    raw.send(encode(small_frame(3)))
    for n_unanswered in (1, 0):
        again = raw.ask(Hello("raw", welcome.session_key))
        assert (again.is_resumed, again.session_id) == (True, welcome.session_id)
        assert (again.profile_ids, again.n_unanswered) == ({"both": 1}, n_unanswered)
        if n_unanswered:
            assert raw.receive().frame_id == 3
    assert not raw.ask(Hello("raw")).is_resumed, "no key was given"


def broken_frames():
    color, depth_m = bytes(16 * 8 * 3), bytes(16 * 8 * 4)
    header = msgpack.unpackb(encode(small_frame(3))[0])

    def packed(**changes):
        return msgpack.packb(header | changes)

    bad_dtype = header["views"][0] | {"color": {"dtype": "float64", "space": "srgb"}}
    return {
        "parts": ([packed(), color], "bad_message", "parts", 3),
        "more parts": ([packed(), color, depth_m, b""], "bad_message", "parts", 3),
        "sizes": ([packed(), depth_m, color], "bad_message", "views[0].color", 3),
        "dtype": (
            [packed(views=[bad_dtype]), color, depth_m],
            "bad_message",
            "views[0].color.dtype",
            3,
        ),
        "nan": (
            [packed(focus_dpt=float("nan")), color, depth_m],
            "bad_message",
            "focus_dpt",
            3,
        ),
        "oversize header": (
            [packed(more="x" * 5000), color, depth_m],
            "bad_message",
            "header",
            None,
        ),
        "garbage": ([b"\xc1\x00"], "bad_message", "header", None),
        "empty": ([b""], "bad_message", "header", None),
        "type": ([packed(type="frames")], "unknown_type", "type", 3),
        "version": ([packed(version=2), color], "version_mismatch", "version", 3),
    }


@pytest.mark.parametrize("name", broken_frames())
def test_a_broken_message_is_answered_by_field_and_the_session_lives_on(
    name, shared_service, raw_client
):
    parts, code, field, frame_id = broken_frames()[name]
    raw = raw_client(shared_service)
    raw.begin(mark=4)
    raw.send(parts)
    reply = raw.receive()
    assert (reply.code, reply.field, reply.frame_id) == (code, field, frame_id)
    result = raw.ask(small_frame(8))
    assert (result.type_name, result.frame_id) == ("result", 8)


def test_a_part_beyond_the_limit_ends_only_the_connection_that_sent_it(
    small_service, raw_client
):
    good, bad = raw_client(small_service), raw_client(small_service)
    good.begin()
    key = bad.begin().session_key
    bad.send([encode(small_frame(1))[0], bytes(2**20 + 1)])
    assert good.ask(small_frame(1)).type_name == "result"
    # libzmq connects again by itself; to the service it is somebody new.
    bad.socket.rcvtimeo = 500
    with pytest.raises(zmq.Again):
        bad.receive()
    assert bad.ask(small_frame(2)).code == "no_session"
    assert bad.ask(Hello("raw", key)).is_resumed


def test_of_three_frames_at_once_the_third_exceeds_a_credit_of_two(
    shared_service, raw_client
):
    raw = raw_client(shared_service)
    raw.begin(more={"filter_ms": 400})
    for frame_id in (1, 2, 3):
        raw.send(encode(small_frame(frame_id)))
    replies = {reply.frame_id: reply for reply in (raw.receive() for _ in range(3))}
    assert replies[3].code == "credit_exceeded"
    assert replies[2].type_name == "result"
    first = replies[1]
    assert first.type_name == "result" or first.reason == "superseded"


def test_a_client_that_ignores_its_credit_is_told_and_every_frame_is_answered(
    shared_service, raw_client
):
    raw = raw_client(shared_service)
    assert raw.begin(more={"filter_ms": 100}).credit == 2
    count = 12
    for frame_id in range(count):
        raw.send(encode(small_frame(frame_id)))
    answers = [raw.receive() for _ in range(count)]
    assert sorted(answer.frame_id for answer in answers) == list(range(count))
    cheated = [a for a in answers if a.type_name == "error"]
    assert {a.code for a in cheated} == {"credit_exceeded"}
    # The first two are within the credit.  How many more are taken in depends on how
    # many the socket hands over between one frame and the next; some come too soon.
    assert 1 <= len(cheated) <= count - 2
    assert raw.ask(small_frame(count)).type_name == "result"


def test_of_two_waiting_frames_the_newer_is_filtered(small_service, raw_client):
    raw = raw_client(small_service)
    raw.begin(more={"filter_ms": 300})
    raw.send(encode(small_frame(1)))
    time.sleep(0.05)  # frame 1 is being filtered when the others come
    raw.send(encode(small_frame(2)))
    raw.send(encode(small_frame(3)))
    answers = [raw.receive() for _ in range(3)]
    kinds = {a.frame_id: a.type_name for a in answers}
    assert kinds == {1: "result", 2: "dropped", 3: "result"}
    assert [a.reason for a in answers if a.frame_id == 2] == ["superseded"]


def test_bye_ends_a_session_and_too_many_sessions_are_refused(
    small_service, raw_client
):
    other, first, second = (raw_client(small_service) for _ in range(3))
    for client in (other, first):
        client.begin()
    assert second.ask(Hello("second")).code == "too_many_sessions"
    first.send(encode(Bye()))
    assert first.ask(Ping(2.5)).t == 2.5
    assert second.ask(Hello("second")).type_name == "welcome"


@pytest.mark.parametrize("encoding", ["float32", "mm16"])
@pytest.mark.parametrize("output", ["srgb8", "linear"])
def test_compressed_frames_and_results_are_those_without(
    shared_service, client, encoding, output
):
    view = make_view(96, 64)
    client.set_profile(double(7), views=[view])
    how = {**SEE, "output": output, "depth_encoding": encoding}
    usual = client.filter([view, view], **how)
    with FilterClient(
        shared_service.endpoint, shared_memory=False, compression="lz4"
    ) as thin:
        thin.set_profile(double(7), views=[view])
        seen = thin.filter([view, view], **how)
    assert seen.compression == "lz4"
    for color, other in zip(seen.colors, usual.colors, strict=True):
        assert color.tobytes() == other.tobytes()
    stages_ms = seen.stage_times_ms
    assert {"unpack_ms", "copy_out_ms"} <= set(stages_ms)
    assert sum(stages_ms.values()) == pytest.approx(seen.total_ms)


def test_parts_that_are_no_blocks_are_refused_by_name(shared_service, raw_client):
    raw = raw_client(shared_service)
    raw.begin()
    frame = small_frame(1).packed("lz4")
    header, color, depth = encode(frame)
    depth_m = small_frame(1).images[0].depth_m
    short, long = packed(depth_m[:-1]), packed(np.concatenate([depth_m, depth_m]))
    for wrong, allowed in (
        (b"", "1 to"),
        (b"\xff" * 40, "512 bytes"),
        (bytes(5000), "1 to"),
        (short.tobytes(), "512 bytes"),
        (long.tobytes(), "512 bytes"),
    ):
        raw.send([header, color.tobytes(), wrong])
        error = raw.receive()
        assert (error.code, error.field) == ("bad_message", "views[0].depth")
        assert allowed in error.allowed
        assert error.frame_id == 1
    raw.send([header, color.tobytes(), depth.tobytes()])
    assert raw.receive().type_name == "result", "its credit is as before"


def test_an_unknown_compression_is_refused():
    with pytest.raises(ValueError, match="'zip'; allowed: none, lz4"):
        FilterClient(compression="zip")
