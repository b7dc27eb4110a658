"""Messages to test with, and their parts changed."""

import msgpack
import numpy as np

from filter_service import messages
from filter_service.messages import (
    Camera,
    FilterSettings,
    Frame,
    Limits,
    ProfileRequest,
    ViewHeader,
    ViewImages,
    encode,
)

CAMERA = Camera(4, 3, (-1.0, 1.25, 0.75, -0.5))


def as_bytes(parts):
    return [bytes(memoryview(part)) for part in parts]


def view_images(color_dtype=np.uint8):
    color = np.arange(36).reshape(3, 4, 3).astype(color_dtype)
    return ViewImages(color, np.linspace(0.5, 6, 12, dtype=np.float32).reshape(3, 4))


def frame(**changes):
    fields = {
        "frame_id": 7,
        "views": (ViewHeader.of(CAMERA),),
        "pupil_diameter_mm": 4.0,
        "focus_dpt": 0.5,
        "images": (view_images(),),
    }
    return Frame(**fields | changes)


def changed_header(parts, **changes):
    """Return the parts with header fields replaced; None removes a field."""
    header = msgpack.unpackb(parts[0]) | changes
    header = {key: value for key, value in header.items() if value is not None}
    return [msgpack.packb(header), *as_bytes(parts[1:])]


def frame_parts(**changes):
    return changed_header(encode(frame()), **changes)


def view_map(**changes):
    return ViewHeader.of(CAMERA).fields() | changes


REQUESTS = [
    messages.Hello("a client"),
    messages.Ping(12.5),
    messages.Bye(),
    frame(),
    frame(gaze_deg=(12.5, -60.0)),
    ProfileRequest(
        3,
        {"kind": "preset"},
        FilterSettings(
            age_years=40.0, gaze_deg=(-5.0, 2.0), gaze_range_deg=(10.0, 0.0)
        ),
        (CAMERA, CAMERA),
    ),
]
REPLIES = [
    messages.Welcome(1, {"name": "ocufilter"}, Limits(), 2, ("tcp",)),
    messages.Accepted(1, 2, True),
    messages.Progress(1, 2, "psfs", 0.5),
    messages.Ready(1, 2, 10.5, 99, 1.5, (1.0, 1.1), ("a note",)),
    messages.Dropped(4, "superseded"),
    messages.Dropped(4, "preparing", 100.0),
    messages.ErrorReply("bad_message", "text", "views[0]", "1 to 2", frame_id=3),
    messages.Pong(1.0, 2.0, 50.0, 1, 2, 3, False),
    messages.Alive(),
    messages.Closing(),
    messages.Shared(7, 4096, "/proc/1/fd/9"),
    messages.Shared(reason="there is unknown"),
]


def profile_parts(body):
    return [encode(ProfileRequest(1, {}))[0], body]
