"""`ocufilter stimuli`: stimuli of exact size, and how they look through eyes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import typer

from clients.batch.manifest import below
from clients.batch.options import profiles_of, workers_and_threads
from clients.batch.pools import ProcessPool
from clients.batch.program import (
    filter_batch,
    print_failures,
    print_lines,
    report_lines,
    resumable,
)
from clients.batch.run import Batch, check_folder, check_links, only_one
from clients.batch.source import Constant, Pinhole, SourceFrame, States
from clients.batch.views import Views
from clients.batch.work import Job, batch_settings
from clients.commands.options import read_object, with_options
from clients.frame_log import Notes, add_notes, note_line
from clients.provenance import code_version
from clients.stimuli.display import Display
from clients.stimuli.options import StimuliOptions, check, displays_of
from clients.stimuli.sets import described, file_notes, stimuli_of, write_stimulus
from clients.stimuli.stimulus import Stimulus
from estimator.bounded_files import loads_bounded, read_bytes
from filter_service.atomic_files import write_atomically
from filter_service.command_line import EXIT_FAILURE, Json, print_json

ORIGINALS, LISTING = "originals", "stimuli.json"
MAX_LISTING_BYTES, MAX_LISTING_ITEMS = 16_000_000, 2_000_000


@dataclass(frozen=True)
class StimulusSet:
    """Stimuli by name, their displays, and the distances of these.

    Attributes
    ----------
    views : Views
        Distances, pupils and foci.
    displays : dict
        By distance in dpt; None stands for all distances.
    stimuli : dict
        By name, for the stimuli of each display.
    suffix : str
        Suffix of the files.
    """

    views: Views
    displays: Mapping[float | None, Display]
    stimuli: Mapping[float | None, Mapping[str, Stimulus]]
    suffix: str

    @classmethod
    def of(cls, options: StimuliOptions) -> StimulusSet:
        """Draw the stimuli that options describe.

        Raises
        ------
        ValueError
            If an option is invalid.  The message names the option and its values.
        """
        check(options)
        views = Views.of(options.distance_m, options.pupil_mm, options.focus_dpt)
        displays = displays_of(options, views)
        stimuli = {}
        for distance_dpt, display in displays.items():
            folder = "" if len(displays) == 1 else f"{_name(distance_dpt)}/"
            drawn = stimuli_of(options, display)
            stimuli[distance_dpt] = {f"{folder}{one.name}": one for one in drawn}
        return cls(views, displays, stimuli, f".{options.format}")

    @property
    def all(self) -> dict[str, Stimulus]:
        """All stimuli by name."""
        return {
            name: one for some in self.stimuli.values() for name, one in some.items()
        }

    def described(self) -> dict[str, Any]:
        """Return displays and stimuli, for JSON."""
        displays = {_name(key): one for key, one in self.displays.items()}
        return described(displays, self.all)

    def frames(self, folder: Path) -> tuple[list[SourceFrame], States]:
        """Return the files of the stimuli in each view, and the state of the eye."""
        frames: list[SourceFrame] = []
        listed: dict[str, tuple[float | None, float | None]] = {}
        for distance_dpt, some in self.stimuli.items():
            views = self.views
            if distance_dpt is not None:
                views = replace(views, distances_dpt=(distance_dpt,))
            optics = _optics(self.displays[distance_dpt])
            depth = Constant(views.distances_dpt[0])
            own, states = views.of_frames(
                [
                    SourceFrame(
                        *(name, folder / f"{name}{self.suffix}", None, optics, depth),
                        facts={
                            "stimulus": {"name": one.name, **one.parameters},
                            "pixel_arcmin": one.display.pixel_arcmin,
                            "margin_arcmin": one.margin_arcmin,
                        },
                    )
                    for name, one in some.items()
                ]
            )
            frames += own
            if states.listed is None and len(self.stimuli) > 1:
                state = states.pupil_mm, states.focus_dpt
                states = replace(states, listed={one.name: state for one in own})
            listed |= states.listed or {}
        return frames, replace(states, listed=listed or None)

    def write(self, out: Path) -> None:
        """Write the pictures and their listing; remove those of an earlier listing."""
        earlier = _listed_files(out / LISTING)
        entries = self.described()
        for name, one in self.all.items():
            file = f"{ORIGINALS}/{name}{self.suffix}"
            written = write_stimulus(out / file, one)
            notes = list(file_notes(one, self.suffix))
            entries["stimuli"][name] |= {"file": file, **written, "notes": notes}
            earlier.discard(file)
        listing = {"made_by": code_version(), **entries}
        write_atomically(out / LISTING, json.dumps(listing, indent=1) + "\n")
        for file in earlier:
            path = below(out, file)
            if path is not None and path.parent != out:
                path.unlink(missing_ok=True)


def _name(distance_dpt: float | None) -> str:
    """Return the name of a display at a distance."""
    return "display" if distance_dpt is None else f"distance{1.0 / distance_dpt:g}m"


def _optics(display: Display) -> Pinhole:
    """Return the camera whose image a stimulus is."""
    focal_px = 1.0 / display.pitch_ratio
    width_px, height_px = display.width_px, display.height_px
    center_px = 0.5 * (width_px - 1), 0.5 * (height_px - 1)
    return Pinhole(focal_px, focal_px, *center_px, (width_px, height_px))


def _listing(path: Path) -> dict[str, Any]:
    """Return an earlier listing; an empty one if there is none that can be read."""
    try:
        content = read_bytes(path, max_bytes=MAX_LISTING_BYTES)
        found = loads_bounded(
            content, max_bytes=MAX_LISTING_BYTES, max_items=MAX_LISTING_ITEMS
        )
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _listed_files(path: Path) -> set[str]:
    """Return the pictures that an earlier listing names."""
    stimuli = _listing(path).get("stimuli")
    entries = stimuli.values() if isinstance(stimuli, dict) else ()
    files = (one.get("file") for one in entries if isinstance(one, dict))
    return {
        file
        for file in files
        if isinstance(file, str) and file.startswith(f"{ORIGINALS}/")
    }


def run(options: StimuliOptions, *, quiet: bool) -> dict[str, Any]:
    """Write the stimuli and what eyes see of them; return a summary.

    Raises
    ------
    ValueError
        If an option is invalid.  The message names it.
    EngineUnusable
        If the engine does not work on this machine.
    """
    drawn = StimulusSet.of(options)
    profiles = profiles_of(options, options.profile or ())
    if ORIGINALS in profiles:
        raise ValueError(f"--profile: the name '{ORIGINALS}' is reserved")
    summary: dict[str, Any] = {
        "out": str(options.out),
        "stimuli": len(drawn.all),
        "pixel_arcmin": [one.pixel_arcmin for one in drawn.displays.values()],
        "stimulus_notes": [
            note for one in drawn.all.values() for note in file_notes(one, drawn.suffix)
        ],
    }
    check_folder(options.out, own=(ORIGINALS, LISTING))
    with only_one(options.out) as lock:
        if not profiles:
            _check_listing(options, drawn)
            drawn.write(options.out)
            return summary
        batch = _batch(options, drawn, profiles)
        check_links(batch)
        n_workers, n_threads = workers_and_threads(options)
        pool = ProcessPool(
            *(batch.job, batch.out),
            n_workers=n_workers,
            n_threads=n_threads,
            lock=lock,
        )
        seen = filter_batch(
            batch,
            pool,
            overwrite=options.overwrite,
            quiet=quiet,
            prepare=lambda: drawn.write(options.out),
        )
    return summary | {"seen": seen}


def _check_listing(options: StimuliOptions, drawn: StimulusSet) -> None:
    """Check that a folder without results does not contain other stimuli."""
    earlier = _listing(options.out / LISTING)
    if not earlier or options.overwrite:
        return
    files = {f"{ORIGINALS}/{name}{drawn.suffix}" for name in drawn.all}
    same_displays = earlier.get("displays") == drawn.described()["displays"]
    if not same_displays or _listed_files(options.out / LISTING) != files:
        raise ValueError(
            f"--out '{options.out}' contains other stimuli; allowed: another folder, "
            "or --overwrite"
        )


def _batch(
    options: StimuliOptions,
    drawn: StimulusSet,
    profiles: Mapping[str, Mapping[str, Any]],
) -> Batch:
    frames, states = drawn.frames(options.out / ORIGINALS)
    settings = read_object("--settings", options.settings)
    job = Job(
        profiles=profiles,
        settings=batch_settings(settings, states, drawn.views.distances_dpt),
        states=states,
        format=options.format,
        engine=options.engine,
        render_tolerance=options.render_tolerance,
    )
    details = drawn.described()
    return Batch(job, "stimuli", options.out / ORIGINALS, frames, options.out, details)


def lines_of(summary: dict[str, Any], options: StimuliOptions) -> list[str]:
    """Format the summary as lines of text."""
    pixels = " and ".join(f"{value:.4g}" for value in summary["pixel_arcmin"])
    lines = [
        f"{options.out / ORIGINALS}: {summary['stimuli']} stimuli of {options.size} "
        f"px, {pixels} arcmin per pixel"
    ]
    notes: Notes = {}
    add_notes(notes, summary["stimulus_notes"])
    lines += [f"note: {note_line(one, 'stimuli')}" for one in notes.values()]
    if "seen" in summary:
        lines += report_lines(summary["seen"], options)
    return lines


@with_options
def stimuli(options: StimuliOptions, json_output: Json = False) -> None:
    """Draw stimuli of exact size; filter them through eyes.

    Letters as pictures:

    ocufilter stimuli --letters CDHK --height-arcmin 10,20 --pixel-arcmin 0.5
    --size 128x128 -o letters

    Gratings on a screen, as two persons with two pupils see them:

    ocufilter stimuli --grating-cpd 4,8 --screen-width-mm 531 --screen-width-px 1920
    --distance-m 4 --size 64x64 -p me.json --people 2 --pupil-mm 3,5 -o gratings

    Pictures are DIR/originals/NAME.png, with their parameters, light and hashes in
    DIR/stimuli.json.  What eyes see is in DIR/PROFILE/NAME.png, with a manifest as of
    `ocufilter batch`.  Run the same command again to continue.
    """
    with resumable("stimuli"):
        summary = run(options, quiet=json_output)
    if json_output:
        print_json(summary)
    else:
        print_lines(lines_of(summary, options))
    if print_failures(summary.get("seen", {})):
        raise typer.Exit(EXIT_FAILURE)
