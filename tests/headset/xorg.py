"""An X server without a screen that has all that Xvfb lacks, such as mode switching.

Xorg   the server with its dummy driver, from `start` to `stop`

For use in a chroot with the packages xserver-xorg-core and xserver-xorg-video-dummy.
"""

import subprocess
from pathlib import Path

from tests.headset.monado import end, start_x_server

SIZE_PX = (1280, 800)
VIDEO_KB = 64000

# AutoAddDevices: devices of the machine that runs the tests are not this server's.
CONFIGURATION = """
Section "ServerFlags"
    Option "AutoAddDevices" "false"
    Option "AutoEnableDevices" "false"
    Option "DontVTSwitch" "true"
EndSection
Section "Device"
    Identifier "device"
    Driver "dummy"
    VideoRam {video_kb}
EndSection
Section "Monitor"
    Identifier "monitor"
    HorizSync 5-1000
    VertRefresh 5-200
EndSection
Section "Screen"
    Identifier "screen"
    Device "device"
    Monitor "monitor"
    DefaultDepth 24
    SubSection "Display"
        Depth 24
        Modes "{width_px}x{height_px}"
    EndSubSection
EndSection
"""


class Xorg:
    """Xorg with the dummy driver; hello_xr ends on Xvfb, which has no VidMode.

    Parameters
    ----------
    log_dir : Path
        Where `xorg.conf`, `xorg.log` and `xorg.out` are written.
    """

    def __init__(self, log_dir: Path):
        self._log_dir = log_dir
        self._server: subprocess.Popen | None = None

    def start(self) -> str:
        """Start it and return the name of its display.

        Raises
        ------
        RuntimeError
            It did not start.
        """
        width_px, height_px = SIZE_PX
        configuration = self._log_dir / "xorg.conf"
        configuration.write_text(
            CONFIGURATION.format(
                video_kb=VIDEO_KB, width_px=width_px, height_px=height_px
            )
        )
        self._server, display = start_x_server(
            self._log_dir / "xorg.out",
            *("Xorg", "-config", str(configuration), "-noreset"),
            *("+extension", "GLX", "-logfile", str(self._log_dir / "xorg.log")),
            *("-novtswitch", "-sharevts"),
        )
        return display

    def stop(self) -> None:
        """End it."""
        end(self._server)
