"""Streaming: send frames to a service that runs in its own process.

    python examples/06_streaming.py

A service can filter frames for several programs, in any language, on the same machine
or on others.  This example starts its own service; usually `ocufilter serve` runs
permanently.  Results arrive in order, and the client can do other work while it waits.
"""

import numpy as np
from common import load_courtyard, save_pictures

from ocufilter import FilterClient, FilteredFrame, RgbdView, ServiceProcess

FRAME_COUNT = 24
SHOWN = (0, 6, 12, 18)
PERSON = {"kind": "prescription", "sphere_dpt": 0.0, "age_years": 25}
SETTINGS = {  # compute all PSFs before the first frame, instead of on demand
    "prepare": "ranges",
    "pupil_range_mm": (3.0, 5.0),
    "focus_range_dpt": (0.0, 3.0),
    "object_range_dpt": (0.0, 3.0),
}

color, depth_m, camera = load_courtyard()
view = RgbdView(color, depth_m, camera.tangents)
phase = np.linspace(0.0, 2.0 * np.pi, FRAME_COUNT, endpoint=False)
pupils_mm = 4.0 + np.sin(phase)  # the pupil dilates and constricts
foci_dpt = 1.5 * (1.0 - np.cos(phase))  # the focus moves closer and away

frames, times_ms = [], []
with ServiceProcess() as service, FilterClient(service.endpoint) as client:
    client.set_profile(PERSON, settings=SETTINGS, views=[view])  # waits until ready
    for pupil_mm, focus_dpt in zip(pupils_mm, foci_dpt, strict=True):
        client.submit([view], pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt)
        # ... a renderer would draw its next frame here ...
        while client.n_unanswered:
            for event in client.poll(timeout_s=1.0):  # results and status messages
                if isinstance(event, FilteredFrame):
                    frames.append(np.array(event.color))  # the buffer is reused
                    times_ms.append(event.total_ms)

print(
    f"{FRAME_COUNT} frames, {np.median(times_ms):.0f} ms each in the service (median)"
)
save_pictures(
    "06_streaming.png",
    [
        (
            f"frame {k}: pupil {pupils_mm[k]:.1f} mm, looking at {foci_dpt[k]:.1f} dpt",
            frames[k],
        )
        for k in SHOWN
    ],
)
