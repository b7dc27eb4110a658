"""Round trips by a client written from PROTOCOL.md alone.

python latency_protocol_client.py ENDPOINT FRAMES.npz RATE_HZ N PROFILE [KEY.toml]
"""

import json
import sys
import time
import tomllib
from pathlib import Path

import msgpack
import numpy as np
import zmq

endpoint, frames_file, rate_hz, n_frames, profile, *key_file = sys.argv[1:]
loaded = np.load(frames_file)
images = list(zip(loaded["color"], loaded["depth_m"], strict=True))
height_px, width_px = loaded["depth_m"].shape[1:]
view = {"width_px": width_px, "height_px": height_px}
view["tangents"] = loaded["tangents"].tolist()
color = {"color": {"dtype": "uint8", "space": "srgb"}}
state = {"views": [view | color], "pupil_diameter_mm": 4.0, "focus_dpt": 0.0}

socket = zmq.Context().socket(zmq.DEALER)
socket.linger, socket.immediate, socket.sndtimeo = 0, True, 10_000
for name in key_file:
    key = tomllib.loads(Path(name).read_text(encoding="utf-8"))
    socket.curve_publickey, socket.curve_secretkey, socket.curve_serverkey = (
        key[part].encode() for part in ("public", "secret", "server")
    )
socket.connect(endpoint)


def send(header, *parts):
    packed = msgpack.packb(header | {"version": 1})
    socket.send_multipart([packed, *parts], copy=False)


def await_reply(*kinds):
    while socket.poll(60_000):
        parts = socket.recv_multipart(copy=False)
        header = msgpack.unpackb(parts[0].buffer)
        if header["type"] in (*kinds, "error"):
            return header["type"]
    return "error"


def round_trip_ms(k):
    """Return None for a frame that was dropped."""
    start_s = time.monotonic()
    send({"type": "frame", "frame_id": k} | state, *images[k % len(images)])
    if await_reply("result", "dropped") == "result":
        return 1000 * (time.monotonic() - start_s)
    return time.sleep(0.03)


send({"type": "hello"})
assert await_reply("welcome") == "welcome"
send({"type": "profile", "profile_id": 1, "views": [view]}, profile.encode())
assert await_reply("ready") == "ready"
for k in range(len(images)):  # the warm-up
    while round_trip_ms(k) is None:
        pass
times_ms, begin_s = [], time.monotonic()
for k in range(int(n_frames)):  # one at a time; a frame that is late starts at once
    time.sleep(max(0.0, begin_s + k / float(rate_hz) - time.monotonic()))
    times_ms.append(round_trip_ms(k))
send({"type": "bye"})
print(json.dumps([ms for ms in times_ms if ms is not None]))
