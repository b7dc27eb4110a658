"""Scenery, a filter and a viewer for tests of the headset, without a headset."""

import numpy as np

from clients.headset.runtime import (
    eye_views,
    matrix_of,
)
from clients.headset.stereo_filter import FilteredStereoFrame
from clients.headset.stereo_gaze import RgbdPicture, StereoGaze
from clients.headset.viewer import Controls, Viewer

SIZE_PX = (40, 36)
WALL_M = 2.0


class Wall:
    """A wall in front of the room's origin, painted by where it is hit.

    Its pictures tell the pose that they were rendered for: red goes with the azimuth of
    a pixel's ray in the room, green with its elevation, blue with the eye.
    """

    def pictures(self, views, size_px):
        return tuple(self._picture(view, size_px) for view in views)

    def _picture(self, view, size_px):
        width, height = size_px
        left, right, up, down = view.tangents
        x = left + (right - left) * (np.arange(width) + 0.5) / width
        y = up + (down - up) * (np.arange(height) + 0.5) / height
        rays = np.stack(np.broadcast_arrays(x, y[:, None], -1.0), axis=-1)
        matrix = matrix_of(view.pose)
        toward = rays @ matrix[:3, :3].T
        depth_m = (-WALL_M - matrix[2, 3]) / toward[..., 2]
        h = np.arctan2(toward[..., 0], -toward[..., 2])
        v = np.arctan2(toward[..., 1], np.hypot(toward[..., 0], toward[..., 2]))
        blue = np.full(h.shape, 60.0 if view.eye == "left" else 180.0)
        color = np.stack([127 + 80 * h, 127 + 80 * v, blue], axis=-1)
        color = np.clip(color, 0, 255).astype(np.uint8)
        seen = np.where(depth_m > 0, depth_m, np.inf).astype(np.float32)
        return RgbdPicture(view, color, seen)


class Inverting:
    """Sees each picture inverted; answers so many frames late."""

    def __init__(self, late=0):
        self.frames, self.late, self.changes = [], late, []

    def change(self, eye, profile):
        self.changes.append((eye, profile))

    def see(self, frame):
        self.frames.append(frame)
        if len(self.frames) <= self.late:
            return None
        frame = self.frames[-1 - self.late]
        return FilteredStereoFrame(
            frame,
            tuple(255 - picture.color for picture in frame.pictures),
            tuple(eye.state.focus_dpt for eye in frame.eyes),
        )

    def known(self, picture):
        return picture

    def restart(self):
        """What was seen in another session does not come back."""
        self.frames = []

    def close(self):
        """Nothing is held."""


def viewer_of(
    runtime, seeing, *, said=None, keys=str, profiles=None, scenery=None, look=None
):
    opened = iter(runtime if isinstance(runtime, list) else [runtime])

    def open_runtime():
        found = next(opened)
        if isinstance(found, Exception):
            raise found
        return found

    return Viewer(
        open_runtime,
        scenery or Wall(),
        seeing,
        look or StereoGaze(age_years=35.0),
        Controls(profiles or {}, seeing.change),
        read_keys=keys,
        say=(said if said is not None else []).append,
    )


def pictures_of(head, depth_of_wall=Wall):
    return depth_of_wall().pictures(eye_views(head), (400, 360))
