"""A program that tells JSON lines, as the tests of a headset start them."""

import json
import os
import subprocess
import sys
import threading

TIMEOUT_S = 150.0


class Program:
    """A program with what it says, ended with the context.

    Parameters
    ----------
    folder : Path
        For what it says, and for the validation layer's report.
    environment : dict of str
        Beside this process's own.
    *arguments : str
        Of python.
    """

    def __init__(self, folder, environment, *arguments: str):
        self._said, self._report = folder / "said.txt", folder / "validation.txt"
        own = {
            "XR_CORE_VALIDATION_EXPORT_TYPE": "text",
            "XR_CORE_VALIDATION_FILE_NAME": str(self._report),
        }
        with self._said.open("wb") as said:
            self._process = subprocess.Popen(
                [sys.executable, "-X", "faulthandler", *arguments],
                env=os.environ | own | environment,
                stdout=subprocess.PIPE,
                stderr=said,
                text=True,
            )
        self._timer = threading.Timer(TIMEOUT_S, self._process.kill)
        self._timer.start()

    def __enter__(self) -> "Program":
        return self

    def __exit__(self, *_) -> None:
        self._timer.cancel()
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()

    def lines(self):
        """Yield what it tells, until it ends."""
        for line in self._process.stdout:
            if line.startswith("{"):
                yield json.loads(line)

    def exit_code(self) -> int:
        """Wait until it has ended."""
        return self._process.wait()

    @property
    def said(self) -> str:
        return self._said.read_text(encoding="utf-8", errors="replace")

    def complaints(self) -> list[str]:
        """Return what the validation layer reports, beside that it was there."""
        lines = self._report.read_text(encoding="utf-8").splitlines()
        assert "VUID-CoreValidation-Initialize" in lines[0]
        return [line for line in lines if "VUID" in line and "VALID_DEBUG" not in line]
