"""Profiles of both eyes: from options, from files that change, and from commands."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from clients.arguments import profile_title, read_profile
from clients.headset.options import TRACKED_RANGE_DEG, profiles_of
from clients.headset.runtime import EYES, Eye
from clients.headset.stereo_filter import Say, StereoFilter
from clients.headset.stereo_gaze import StereoGaze


class _ProfileFiles:
    """Profiles that come from files, which are read again when they change."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._paths: dict[Eye, Path] = {}
        self._seen: dict[Eye, tuple[int, int] | None] = {}
        for eye in EYES:
            text = getattr(options, eye)
            self.watch(eye, options.profile if text is None else text)

    def watch(self, eye: Eye, text: str) -> None:
        """Watch the file of an eye's profile if it is one."""
        path = Path(text)
        self._paths.pop(eye, None)
        if not text.lstrip().startswith("{") and path.is_file():
            self._paths[eye] = path
            self._seen[eye] = _stamp(path)

    def changed(self) -> Iterator[tuple[Eye, str]]:
        """Yield the eyes whose file has changed, and its path."""
        for eye, path in self._paths.items():
            stamp = _stamp(path)
            if stamp is not None and stamp != self._seen[eye]:
                self._seen[eye] = stamp
                yield eye, str(path)


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:  # while it is replaced
        return None
    return found.st_mtime_ns, found.st_size


class Eyes:
    """Profiles of both eyes, which change while frames are filtered.

    Parameters
    ----------
    options : argparse.Namespace
        Options of `add_eye_arguments`.
    seeing : StereoFilter
        Filter that is told of each change.
    look : StereoGaze
        Gaze, focus and pupils.
    say : callable
        Called with each message for the user, one line.

    Raises
    ------
    ValueError
        If a profile cannot be read.
    """

    def __init__(
        self,
        options: argparse.Namespace,
        seeing: StereoFilter,
        look: StereoGaze,
        say: Say,
    ) -> None:
        self._seeing, self._look, self._say = seeing, look, say
        self._files = _ProfileFiles(options)
        self._profiles = profiles_of(options)
        self._is_range_given = options.gaze_range is not None
        self._request()

    def _request(self) -> None:
        for eye, profile in self._profiles.items():
            self._seeing.change(eye, profile)

    def prepare_for_gaze(self) -> None:
        """Prepare a range of gaze for an eye tracker, unless the user gave one."""
        if self._is_range_given or any(self._look.gaze_range_deg):
            return
        self._look.gaze_range_deg = TRACKED_RANGE_DEG
        settings = self._seeing.settings
        self._seeing.settings = settings.changed(gaze_range_deg=TRACKED_RANGE_DEG)
        self._request()

    def change(self, eye: Eye, text: str) -> None:
        """Change an eye's profile.

        Raises
        ------
        ValueError
            If the profile cannot be read.
        """
        profile = read_profile(text, f"--{eye}")
        self._files.watch(eye, text)
        self._profiles[eye] = profile
        self._look.change(eye)
        self._seeing.change(eye, profile)
        self._say(f"{eye} eye: {profile_title(profile)}")

    def reread(self) -> None:
        """Read the files that have changed."""
        for eye, text in list(self._files.changed()):
            try:
                self.change(eye, text)
            except ValueError as error:
                self._say(f"{eye} eye is unchanged: {error}")
