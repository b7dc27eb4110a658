"""Virtual camera that shows a video through an eye in any program that uses a webcam.

    python examples/adapters/virtual_camera.py walk.mp4 --profile cataract

The program reads a video in a loop, filters each frame at the distance `--distance-m`
and sends it to a virtual camera.  It requires `pip install av pyvirtualcam`.  On Linux
it also requires the kernel module v4l2loopback (`sudo modprobe v4l2loopback`), and on
Windows and macOS the OBS virtual camera.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from ocufilter import Camera, EyeFilter

try:
    import pyvirtualcam

    from clients.batch.video_reading import VideoReader  # requires av
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
        for index in range(reader.count):
            yield reader.color(index).pixels


try:
    reader = VideoReader(Path(options.video))
    first, rate_hz = reader.color(0), reader.rate_hz
except (OSError, ValueError) as error:
    sys.exit(f"virtual_camera: {error}")
for note in first.notes:
    print(f"virtual_camera: note: {note}")
size = first.grid.width_px, first.grid.height_px
lens = Camera(*size, first.grid.fov_tangents(options.fov_deg))
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
