"""A client written from PROTOCOL.md alone: prints a line for every filtered frame.

python minimal_client.py ENDPOINT WIDTH_PX HEIGHT_PX PROFILE_JSON
"""

import sys
import time

import msgpack
import zmq

SILENCE_S = 2.0
PROFILE_ID = 1

endpoint, width_px, height_px, profile = sys.argv[1:]
view = {
    "width_px": int(width_px),
    "height_px": int(height_px),
    "tangents": [-0.5, 0.5, 0.28, -0.28],
}
n_pixels = view["width_px"] * view["height_px"]
images = [bytes(3 * n_pixels), bytes(4 * n_pixels)]  # depth 0 is missing

socket = zmq.Context().socket(zmq.DEALER)
socket.linger = 0
socket.immediate = True
socket.sndtimeo = 0
socket.heartbeat_ivl = 500
socket.heartbeat_timeout = 2000
socket.connect(endpoint)

is_greeting = True
session_key = ""
n_unanswered = frame_id = 0
active_s = next_frame_s = 0.0  # of the last message received or sent; of the next frame


def send(header, *parts):
    """Send a message; without a connection it is lost."""
    global active_s
    try:
        socket.send_multipart([msgpack.packb(header | {"version": 1}), *parts])
    except zmq.Again:
        return False
    active_s = time.monotonic()
    return True


def send_profile():
    """Send the profile."""
    header = {"type": "profile", "profile_id": PROFILE_ID, "views": [view]}
    send(header, profile.encode())


while True:
    now_s = time.monotonic()
    is_due = is_greeting or n_unanswered > 0
    if is_due and now_s - active_s > SILENCE_S:
        is_greeting = True
        send({"type": "hello", "session_key": session_key})
    if not is_greeting and n_unanswered == 0 and now_s >= next_frame_s:
        frame_id += 1
        color = {"dtype": "uint8", "space": "srgb"}
        header = {
            "type": "frame",
            "frame_id": frame_id,
            "views": [view | {"color": color}],
            "pupil_diameter_mm": 4.0,
            "focus_dpt": 0.0,
        }
        n_unanswered += 1  # if it cannot be sent, the silence is noticed
        send(header, *images)
    if not socket.poll(50):
        continue
    parts = socket.recv_multipart()
    reply = msgpack.unpackb(parts[0])
    kind, code = reply["type"], reply.get("code")
    if kind == "alive":
        continue
    active_s = time.monotonic()
    if "frame_id" in reply:
        n_unanswered = max(0, n_unanswered - 1)
        next_frame_s = active_s + 1e-3 * reply.get("retry_after_ms", 0.0)
    if kind == "result":
        print(reply["frame_id"], flush=True)
    elif kind == "welcome":
        session_key = reply["session_key"]
        n_unanswered = reply.get("n_unanswered", 0)
        is_known = PROFILE_ID in reply["profile_ids"].values()
        if not (reply["is_resumed"] and is_known):
            send_profile()
        is_greeting = False
    elif code == "no_session":
        if not is_greeting:
            is_greeting = True
            send({"type": "hello", "session_key": session_key})
    elif code in ("no_profile", "worker_crashed"):
        send_profile()
    elif "profile_id" in reply and kind == "error" and code != "build_cancelled":
        sys.exit(f"{code}: {reply['message']}")
