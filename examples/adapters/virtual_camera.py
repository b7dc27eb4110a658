"""Virtual camera that shows a video through an eye in any program that uses a webcam.

    python examples/adapters/virtual_camera.py walk.mp4 --profile cataract

The program reads a video in a loop, filters each frame at the distance `--distance-m`
and sends it to a virtual camera.  It requires `pip install av pyvirtualcam`.  On Linux
it also requires the kernel module v4l2loopback (`sudo modprobe v4l2loopback`), and on
Windows and macOS the OBS virtual camera.
"""

import argparse
import sys

import numpy as np

from filter_service import Camera, EyeFilter

try:
    import av
    import pyvirtualcam
except ModuleNotFoundError as error:
    sys.exit(f"virtual_camera: {error.name} is missing: pip install av pyvirtualcam")

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("video")
parser.add_argument("--profile", default="myopia")
parser.add_argument(
    "--fov-deg",
    type=float,
    default=50.0,
    help="vertical field of view, deg (default: 50)",
)
parser.add_argument(
    "--distance-m", type=float, default=2.0, help="distance of the scene (default: 2)"
)
parser.add_argument("--pupil-mm", type=float, default=4.0)
parser.add_argument("--focus-dpt", type=float, default=0.0)
parser.add_argument("--frames", type=int, help="number of frames (default: unlimited)")
options = parser.parse_args()


def frames():
    """Yield the frames of the video, (height, width, 3), in an endless loop."""
    while True:
        with av.open(options.video) as container:
            for frame in container.decode(video=0):
                yield frame.to_ndarray(format="rgb24")


try:
    container = av.open(options.video)
except (OSError, ValueError) as error:
    sys.exit(f"virtual_camera: {error}")
with container:
    stream = container.streams.video[0]
    size, rate_hz = (stream.width, stream.height), float(stream.average_rate or 30)
lens = Camera.from_fov(options.fov_deg, width_px=size[0], height_px=size[1])
depth_m = np.full(size[::-1], options.distance_m, np.float32)
state = {"pupil_diameter_mm": options.pupil_mm, "focus_dpt": options.focus_dpt}
try:
    device = pyvirtualcam.Camera(*size, rate_hz)
except RuntimeError as error:
    sys.exit(f"virtual_camera: {' '.join(str(error).split())}")
with device, EyeFilter(options.profile, lens) as eye:
    print(f"{device.device}: {size[0]}x{size[1]}, {rate_hz:g} frames/s; Ctrl-C to stop")
    try:
        for n, frame in enumerate(frames()):
            if n == options.frames:
                break
            device.send(eye.filter(frame, depth_m, **state, whole=n == 0).color)
            device.sleep_until_next_frame()
    except KeyboardInterrupt:
        print("stopped")
