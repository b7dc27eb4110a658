"""Streaming: a service in a process of its own, and a client that sends it frames.

    python examples/06_streaming.py

The service can serve several programs, on this machine or on others, in any language.
Here it is started for the example; usually `ocufilter serve` runs all day.  Frames come
back in order; while one is on its way the client goes on with its own work.
"""

import numpy as np
from common import load_courtyard, save_pictures

from clients import FilterClient, FilteredFrame, ServiceProcess
from filter_service import RgbdView

FRAME_COUNT = 24
SHOWN = (0, 6, 12, 18)
PERSON = {"kind": "prescription", "sphere_dpt": 0.0, "age_years": 25}
SETTINGS = {  # all is prepared before the first frame; usually it is done on the way
    "prepare": "ranges",
    "pupil_range_mm": (3.0, 5.0),
    "focus_range_dpt": (0.0, 3.0),
    "object_range_dpt": (0.0, 3.0),
}

color, depth_m, camera = load_courtyard()
view = RgbdView(color, depth_m, camera.tangents)
phase = np.linspace(0.0, 2.0 * np.pi, FRAME_COUNT, endpoint=False)
pupils_mm = 4.0 + np.sin(phase)  # a pupil that opens and closes
foci_dpt = 1.5 * (1.0 - np.cos(phase))  # a gaze that comes near and goes away again

frames, times_ms = [], []
with ServiceProcess() as service, FilterClient(service.endpoint) as client:
    client.set_profile(PERSON, settings=SETTINGS, views=[view])  # waits for the eye
    for pupil_mm, focus_dpt in zip(pupils_mm, foci_dpt, strict=True):
        client.submit([view], pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt)
        # ... here a renderer would draw its next frame ...
        while client.n_unanswered:
            for event in client.poll(timeout_s=1.0):  # frames, and news of the eye
                if isinstance(event, FilteredFrame):
                    frames.append(np.array(event.color))  # its memory is used again
                    times_ms.append(event.header.total_ms)

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
