"""OpenXR's runtime Monado without a headset, started for a test and ended with it.

Monado   the service: a simulated or a scripted headset, with a picture or without
RemoteHead   where the scripted headset is, and what its eyes see
read_xwd   what Xvfb shows

For use in the root of `setup_root.sh`.
"""

import contextlib
import math
import os
import re
import shutil
import socket
import struct
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

RUNTIME_JSON = "/usr/share/openxr/1/openxr_monado.json"
SOCKET_NAME = "monado_comp_ipc"
STARTED = "The Monado service has started."
REMOTE_PORT = 4242

START_TIMEOUT_S = 30.0
STOP_TIMEOUT_S = 5.0
POLL_S = 0.02

SCREEN_SIZE_PX = (1920, 1080)

DIES_WITH_US = ("setpriv", "--pdeathsig", "KILL")


class Monado:
    """Monado's service, from entering the context to leaving it.

    Parameters
    ----------
    log_dir : Path
        Where `monado.log` and `xvfb.log` are written.
    remote : bool
        The headset stands where a `RemoteHead` says; otherwise it wobbles by itself.
    screen : bool
        Compose the views on a screen of Xvfb, for `screenshot`; otherwise frames are
        taken, 20 a second, and shown nowhere.
    variables : dict of str
        More of Monado's environment variables.

    Attributes
    ----------
    environment : dict of str
        What a program needs in its environment to find this runtime.
    """

    def __init__(
        self,
        log_dir: Path,
        *,
        remote: bool = False,
        screen: bool = False,
        variables: dict[str, str] | None = None,
    ):
        self._log_path = log_dir / "monado.log"
        self._xvfb = Xvfb(log_dir) if screen else None
        # not in log_dir: the path of a socket has at most 107 characters
        self._run_dir = Path(tempfile.mkdtemp(prefix="monado-"))
        self._service: subprocess.Popen | None = None
        self._variables = {
            "XDG_RUNTIME_DIR": str(self._run_dir),
            "XDG_CONFIG_HOME": str(self._run_dir),
            "XRT_NO_STDIN": "1",
            ("XRT_COMPOSITOR_FORCE_XCB" if screen else "XRT_COMPOSITOR_NULL"): "1",
            **({"P_OVERRIDE_ACTIVE_CONFIG": "remote"} if remote else {}),
            **(variables or {}),
        }
        self.environment = {
            "XR_RUNTIME_JSON": RUNTIME_JSON,
            "XDG_RUNTIME_DIR": str(self._run_dir),
        }

    def __enter__(self) -> "Monado":
        try:
            if self._xvfb:
                self._variables["DISPLAY"] = self._xvfb.start()
            self.start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def close(self) -> None:
        """End the service and its screen, and remove its folder."""
        self.stop()
        if self._xvfb:
            self._xvfb.stop()
        shutil.rmtree(self._run_dir, ignore_errors=True)

    def start(self) -> None:
        """Start the service and wait until it takes programs.

        Raises
        ------
        RuntimeError
            It did not start; the end of its log is in the message.
        """
        begin = len(self.log())
        with self._log_path.open("ab") as log:
            self._service = subprocess.Popen(
                [*DIES_WITH_US, "monado-service"],
                env=os.environ | self._variables,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while not (STARTED in self.log()[begin:] and self._socket.exists()):
            if self._service.poll() is not None or time.monotonic() > deadline_s:
                self.kill()
                raise RuntimeError(f"monado-service: {self.log()[begin:][-2000:]}")
            time.sleep(POLL_S)

    def stop(self) -> None:
        """Ask the service to end, and wait until it has."""
        end(self._service)

    def kill(self) -> None:
        """End the service as a crash would: its socket stays behind."""
        if self._service:
            self._service.kill()
            self._service.wait()

    def restart(self) -> None:
        """Start it anew after a crash, without the socket that stayed behind."""
        self.kill()
        self._socket.unlink(missing_ok=True)
        self.start()

    def log(self) -> str:
        """Return what the service has written so far, in all its lives."""
        if not self._log_path.exists():
            return ""
        return self._log_path.read_text(encoding="utf-8", errors="replace")

    def screenshot(self) -> np.ndarray:
        """Return what the headset shows, (height, width, 3) uint8 sRGB.

        The left eye's view is the left half.

        Raises
        ------
        RuntimeError
            There is no screen, or no program has had one yet.
        """
        sizes_px = re.findall(r"imageExtent: \{(\d+), (\d+)\}", self.log())
        if not self._xvfb or not sizes_px:
            raise RuntimeError("the compositor shows nothing")
        width_px, height_px = map(int, sizes_px[-1])
        return self._xvfb.picture()[:height_px, :width_px]

    @property
    def _socket(self) -> Path:
        return self._run_dir / SOCKET_NAME


def start_x_server(log_path: Path, *command: str) -> tuple[subprocess.Popen, str]:
    """Start an X server; return it and the name of its display.

    Parameters
    ----------
    log_path : Path
        Where its output is written.
    *command : str
        Program and options.

    Raises
    ------
    RuntimeError
        It did not start.
    """
    read_end, write_end = map(os.fdopen, os.pipe(), "rw")
    with read_end, write_end, log_path.open("wb") as log:
        server = subprocess.Popen(
            [
                *(*DIES_WITH_US, *command, "-nolisten", "tcp"),
                *("-displayfd", str(write_end.fileno())),
            ],
            pass_fds=[write_end.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        write_end.close()
        number = read_end.readline().strip()  # empty where it has ended
    if not number:
        server.wait()
        raise RuntimeError(
            f"{command[0]}: {log_path.read_text(errors='replace')[-2000:]}"
        )
    return server, f":{number}"


class Xvfb:
    """A screen in memory.

    Parameters
    ----------
    log_dir : Path
        Where `xvfb.log` is written.
    """

    def __init__(self, log_dir: Path):
        self._log_path = log_dir / "xvfb.log"
        self._frame_dir = Path(tempfile.mkdtemp(prefix="xvfb-"))
        self._server: subprocess.Popen | None = None

    def start(self) -> str:
        """Start it and return the name of its display.

        Raises
        ------
        RuntimeError
            It did not start.
        """
        width_px, height_px = SCREEN_SIZE_PX
        options = ("-screen", "0", f"{width_px}x{height_px}x24")
        self._server, display = start_x_server(
            self._log_path, "Xvfb", *options, "-fbdir", str(self._frame_dir)
        )
        return display

    def stop(self) -> None:
        """End it."""
        end(self._server)
        shutil.rmtree(self._frame_dir, ignore_errors=True)

    def picture(self) -> np.ndarray:
        """Return the whole screen, (height, width, 3) uint8."""
        return read_xwd((self._frame_dir / "Xvfb_screen0").read_bytes())


def read_xwd(content: bytes) -> np.ndarray:
    """Return the picture in an X window dump of 32 bits a pixel.

    Parameters
    ----------
    content : bytes
        A header of 25 big-endian numbers and a name, a table of colors, the rows.

    Returns
    -------
    (height, width, 3) uint8

    Raises
    ------
    ValueError
        It is another kind of dump.
    """
    header = struct.unpack_from(">25I", content)
    header_bytes, version, _, _, width_px, height_px = header[:6]
    bits_per_pixel, row_bytes = header[11:13]
    masks, color_count = header[14:17], header[19]
    if (version, bits_per_pixel) != (7, 32):
        raise ValueError(f"XWD version {version} of {bits_per_pixel} bits a pixel")
    start = header_bytes + 12 * color_count
    order = ">" if header[7] else "<"
    rows = np.frombuffer(content, f"{order}u4", row_bytes // 4 * height_px, start)
    pixels = rows.reshape(height_px, -1)[:, :width_px]
    shifts = [(mask & -mask).bit_length() - 1 for mask in masks]
    return np.stack([pixels >> shift & 255 for shift in shifts], -1).astype(np.uint8)


@dataclass(frozen=True)
class Pose:
    """A place and a turn.

    Attributes
    ----------
    position_m : tuple of three floats
    orientation : tuple of four floats
        Quaternion (x, y, z, w) of unit length.
    """

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    def __matmul__(self, inner: "Pose") -> "Pose":
        """Return where something is that has a pose within this one."""
        axis, cosine = np.array(self.orientation[:3]), self.orientation[3]
        inner_axis, inner_cosine = np.array(inner.orientation[:3]), inner.orientation[3]
        crossed = 2 * np.cross(axis, inner.position_m)
        moved_m = inner.position_m + cosine * crossed + np.cross(axis, crossed)
        turned = cosine * inner_axis + inner_cosine * axis + np.cross(axis, inner_axis)
        return Pose(
            position_m=tuple(self.position_m + moved_m),
            orientation=(*turned, cosine * inner_cosine - axis @ inner_axis),
        )


@dataclass(frozen=True)
class Eye:
    """One eye of the scripted headset.

    Attributes
    ----------
    pose : Pose
        Within the head.
    angles_deg : tuple of four floats
        Edges of what it sees: left, right, up, down; left and down are negative.
    """

    pose: Pose
    angles_deg: tuple[float, float, float, float]


class RemoteHead:
    """Says where the headset of a `Monado` with `remote` is, in one of its lives.

    Parameters
    ----------
    port : int
        The service listens on it at all addresses, without asking who comes.

    Raises
    ------
    TimeoutError
        Nobody listens there.
    ConnectionError
        Another version of the driver does.

    Notes
    -----
    The driver reads records of 376 bytes, `struct r_remote_data`: "mndrmt3" and a zero;
    two views (fov left, right, up, down in rad; orientation x, y, z, w; position in m;
    4 bytes unused); the head's pose in the stage; whether the views hold; 3 bytes
    unused; two controllers of 120 bytes.  To whoever connects it sends two such
    records, without the name: its first state and its latest.  A second connection
    waits until the first has hung up.
    """

    _VIEW = "4f7f4x"
    _HEAD = struct.Struct(f"<8s{_VIEW}{_VIEW}7f?3x")
    _RECORD_BYTES = 376
    _MAGIC = b"mndrmt3\0"
    _FIRST_HEIGHT_M = 1.6  # of the head that nobody has moved

    def __init__(self, port: int = REMOTE_PORT):
        self._socket = _connected(port)
        try:
            self._controllers = self._greeting()
        except BaseException:
            self._socket.close()
            raise

    def __enter__(self) -> "RemoteHead":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def close(self) -> None:
        """Hang up; the headset stays where it is."""
        self._socket.close()

    def move(self, head: Pose, eyes: tuple[Eye, Eye] | None = None) -> None:
        """Put the head somewhere, at once.

        Parameters
        ----------
        head : Pose
            In the stage.
        eyes : two Eyes, left and right
            Without them eyes and fields of view are Monado's own.
        """
        views = [_numbers(eye) for eye in eyes or (Eye(Pose(), (0.0,) * 4),) * 2]
        record = self._HEAD.pack(
            self._MAGIC, *views[0], *views[1], *_pose_numbers(head), eyes is not None
        )
        self._socket.sendall(record + self._controllers)

    def _greeting(self) -> bytes:
        """Return the controllers' part of the driver's latest state."""
        first, latest = (self._receive(self._RECORD_BYTES) for _ in range(2))
        *_, y_m, _, _ = self._HEAD.unpack_from(first)
        if not math.isclose(y_m, self._FIRST_HEIGHT_M, rel_tol=1e-6):
            raise ConnectionError("this driver's records are laid out otherwise")
        return latest[self._HEAD.size :]

    def _receive(self, size_bytes: int) -> bytes:
        content = b""
        while len(content) < size_bytes:
            part = self._socket.recv(size_bytes - len(content))
            if not part:
                raise ConnectionError("Monado's remote driver has hung up")
            content += part
        return content


def _numbers(eye: Eye) -> list[float]:
    return [*np.radians(eye.angles_deg), *_pose_numbers(eye.pose)]


def _pose_numbers(pose: Pose) -> list[float]:
    return [*pose.orientation, *pose.position_m]


def _connected(port: int) -> socket.socket:
    """Return a connection as soon as somebody listens."""
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while True:
        with contextlib.suppress(ConnectionRefusedError):
            return socket.create_connection(("127.0.0.1", port), STOP_TIMEOUT_S)
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"nobody listens on port {port}")
        time.sleep(POLL_S)


def end(process: subprocess.Popen | None) -> None:
    """Ask a process to end, and see to it."""
    if process is None:
        return
    process.terminate()
    try:
        process.wait(STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
