"""The layer's side of the connection to its helper, in Python; a helper in a thread."""

import contextlib
import fcntl
import os
import socket
import threading

import numpy as np

from clients.headset.runtime import eye_views, still
from clients.openxr_layer import wire
from clients.openxr_layer.helper import LayerHelper, LayerOptions
from filter_service.shared_memory import Slot, aligned_starts

TIMEOUT_S = 60.0


class LayerDouble:
    """Sends frames to a helper as source/link.c and source/frames.c do."""

    def __init__(self, path, name="program"):
        self.connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.connection.settimeout(TIMEOUT_S)
        self.connection.connect(str(path))
        hello = wire.Hello(wire.HELLO, wire.MAGIC, wire.VERSION, os.getpid())
        hello.application = name.encode()
        self.connection.send(bytes(hello))
        self.slot = None
        self.frame_id = 0

    def close(self):
        self.connection.close()
        if self.slot is not None:
            self.slot.close()
        self.slot = None  # with its mapping, which has a descriptor of its own

    def welcome(self):
        data = self.connection.recv(1000)
        return wire.Welcome.from_buffer_copy(data) if data else None

    def share(self, size_bytes, *, seals=fcntl.F_SEAL_SHRINK, says_bytes=None):
        """Share memory."""
        descriptor = os.memfd_create("layer", os.MFD_ALLOW_SEALING)
        os.ftruncate(descriptor, size_bytes)
        if seals:
            fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, seals)
        message = wire.Memory(wire.MEMORY, 0, says_bytes or size_bytes)
        socket.send_fds(self.connection, [bytes(message)], [descriptor])
        self.slot = Slot(0, size_bytes, descriptor)

    def frame(self, colors, depths=(None, None), *, color_format=wire.SRGB8, **values):
        """Return a frame with images in the memory, their rows as in OpenGL."""
        self.frame_id += 1
        frame = wire.Frame(wire.FRAME, 0, self.frame_id)
        frame.color_format = color_format
        frame.display_time_ns = 1_000_000_000 + 11_000_000 * self.frame_id
        given = [*colors, *depths]
        images = [image for image in given if image is not None]
        found, size_bytes = aligned_starts([image.nbytes for image in images])
        if self.slot is None or self.slot.size_bytes < size_bytes:
            self.share(-(-size_bytes // 4096) * 4096)
        self.slot.put(images, found)
        starts = iter(found)
        for view, color, eye_view in zip(
            frame.views, colors, eye_views(still(0.0)), strict=True
        ):
            view.color = wire.Image(next(starts), color.shape[1], color.shape[0])
            view.position_m[:] = eye_view.pose[:3]
            view.orientation[:] = eye_view.pose[3:]
            view.fov_rad[:] = np.arctan(eye_view.tangents)
            view.min_depth, view.max_depth, view.near_m, view.far_m = 0, 1, 0.1, 100.0
        for view, depth in zip(frame.views, depths, strict=True):
            if depth is not None:
                height_px, width_px = depth.shape
                view.depth = wire.Image(next(starts), width_px, height_px)
        for name, value in values.items():
            setattr(frame, name, value)
        return frame

    def send(self, frame):
        self.connection.send(bytes(frame))

    def result(self):
        data = self.connection.recv(1000)
        return wire.Result.from_buffer_copy(data) if data else None

    def color(self, frame, index):
        """Return the color that is in the memory, rows as in OpenGL."""
        image = frame.views[index].color
        dtype = np.uint8 if frame.color_format != wire.LINEAR16F else np.float16
        shape = image.height_px, image.width_px, 4
        return self.slot.array(image.start, shape, np.dtype(dtype)).copy()


class RunningHelper:
    """A helper in a thread.

    Parameters
    ----------
    path : Path
        Its socket.
    make_eyes : callable
        Returns its filter and its `StereoGaze`; its argument prints a line.
    **options
        Those of `LayerOptions`.

    Attributes
    ----------
    lines : list of str
        What it has said.
    changed : list of (eye, profile)
        What it was told to change.
    """

    def __init__(self, path, make_eyes, **options):
        self.lines, self.changed, self.errors = [], [], []
        self.helper = None
        self._path, self._make_eyes, self._options = path, make_eyes, options
        self._is_over = threading.Event()
        self._is_listening = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self):
        self._thread.start()
        assert self._is_listening.wait(TIMEOUT_S), self.errors
        return self

    def __exit__(self, *_):
        self._is_over.set()
        self._thread.join()
        assert not self.errors

    def _change(self, eye, text):
        if text == "nobody":
            raise ValueError("there is no eye 'nobody'")
        self.changed.append((eye, text))

    def _run(self):
        try:
            seeing, look = self._make_eyes(self.lines.append)
            with contextlib.closing(seeing):
                self.helper = LayerHelper(
                    *(seeing, look, self.lines.append),
                    *(LayerOptions(**self._options), self._change, self._path),
                )
                self._is_listening.set()
                with contextlib.closing(self.helper):
                    while not self._is_over.is_set():
                        self.helper.run_once(0.02)
        except BaseException as error:
            self.errors.append(error)
            raise
