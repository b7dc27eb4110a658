"""Filter a frame without what Windows or macOS lacks: ``SYSTEM ENDPOINT``.

Prints the sums of two images: filtered in this process, and by the service.
"""

import importlib
import mmap
import os
import signal
import socket
import sys

LINUX_ONLY = {
    os: ("memfd_create", "MFD_CLOEXEC", "MFD_ALLOW_SEALING", "sched_getaffinity"),
    socket: ("SO_PEERCRED", "SO_PASSCRED", "SCM_CREDENTIALS", "SOCK_NONBLOCK"),
    mmap: ("MADV_HUGEPAGE",),
}
UNIX_ONLY = {
    os: (
        *("O_NONBLOCK", "O_CLOEXEC", "O_NOFOLLOW", "O_DIRECTORY", "posix_fallocate"),
        *("fork", "nice", "pread", "getuid", "geteuid", "fchmod", "sysconf"),
        "register_at_fork",
    ),
    socket: ("AF_UNIX", "SCM_RIGHTS", "CMSG_LEN", "CMSG_SPACE"),
    mmap: ("MAP_SHARED", "MAP_PRIVATE", "MAP_ANONYMOUS", "PROT_READ", "PROT_WRITE"),
    signal: ("SIGKILL", "SIGHUP", "SIGCHLD", "SIGUSR1"),
}
UNIX_MODULES = ("fcntl", "resource", "termios", "pwd", "grp", "syslog")


OTHERS = (
    *("asyncio", "concurrent.futures", "ctypes.util", "multiprocessing.connection"),
    *("subprocess", "tempfile", "lz4.block", "matplotlib.pyplot", "moderngl"),
    *("msgpack", "msgspec", "onnxruntime", "OpenEXR", "PIL.Image", "rich"),
    *("scipy.optimize", "typer", "zmq.utils.monitor"),
)
"""Modules that have their own ways on other systems, and keep those of Linux here."""


def become(system):
    """Remove what a system lacks."""
    lacking = [LINUX_ONLY] if system == "darwin" else [LINUX_ONLY, UNIX_ONLY]
    for names_of in lacking:
        for module, names in names_of.items():
            for name in names:
                if hasattr(module, name):
                    delattr(module, name)
    if system == "win32":
        sys.modules.update(dict.fromkeys(UNIX_MODULES))
    sys.platform = system


def main(system, endpoint):
    for name in OTHERS:
        importlib.import_module(name)
    become(system)
    import numpy as np

    from ocufilter import Camera, EyeFilter, FilterClient

    camera = Camera.from_fov(10.0, width_px=64, height_px=36)
    color = np.random.default_rng(0).integers(0, 256, (36, 64, 3)).astype(np.uint8)
    depth_m = np.full((36, 64), 2.0, np.float32)
    state = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
    with EyeFilter("myopia", camera, worker=False) as eye_filter:
        print(eye_filter.filter(color, depth_m, **state).color.sum())
    # A service on Linux has shared memory for clients of the same machine alone.
    with FilterClient(endpoint, shared_memory=False) as client:
        client.set_profile("myopia", views=[camera])
        print(client.filter(color, depth_m, **state).color.sum())


if __name__ == "__main__":
    main(*sys.argv[1:])
