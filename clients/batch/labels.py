"""Labels of results: a row per image with its eye, for training.

`labels.csv` in the output folder has the columns `COLUMNS`.  It is written from the
manifest, so it contains the images of all runs.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from clients.batch.manifest import LABELS, Manifest, text_of
from clients.batch.refraction import POWER_VECTOR, WAVELENGTH_NM
from clients.batch.source import Constant, SourceFrame
from filter_service import FilterSettings
from filter_service.atomic_files import write_atomically

COLUMNS = (
    "output",
    "source",
    "eye",
    "person",
    "profile_sha256",
    *(f"refraction_{name.lower()}" for name in POWER_VECTOR),
    "refraction_wavelength_nm",
    "pupil_diameter_mm",
    "focus_dpt",
    "distance_m",
    "gaze_h_deg",
    "gaze_v_deg",
    "mode",
)
"""Refraction is that of the relaxed eye at the cornea, by least squares over the pupil
of the row; J45 is in the frame of the eye.  Cells without a value are empty: of the
person, if none was drawn, and of the distance, if the image has depth."""


def write_labels(
    out: Path,
    manifest: Manifest,
    frames: Sequence[SourceFrame],
    *,
    settings: FilterSettings,
    source: Path,
) -> None:
    """Write the labels of all finished frames atomically, for their owner only.

    Parameters
    ----------
    out : Path
        Output folder.
    manifest : Manifest
        Record of the finished frames.
    frames : sequence of SourceFrame
        Frames with eyes of their own.
    settings : FilterSettings
    source : Path
        Folder of the frames, relative to which they are named.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for frame in frames:
        assert frame.eye is not None
        record = manifest.record(frame.eye.name, frame.name)
        if record is not None and record["ok"]:
            writer.writerow(_row(frame, record, settings, source))
    write_atomically(out / LABELS, text.getvalue())


def _row(
    frame: SourceFrame, record: dict[str, Any], settings: FilterSettings, source: Path
) -> list[Any]:
    eye, form, color = record["source"]["eye"], frame.depth_form, frame.color
    if color.is_relative_to(source) and color != source:
        color = color.relative_to(source)
    distance_m = None
    if isinstance(form, Constant):
        distance_m = 1.0 / form.distance_dpt if form.distance_dpt else "inf"
    power = record.get("refraction") or dict.fromkeys(POWER_VECTOR)
    return [
        record["file"],
        text_of(color.as_posix()),
        eye["name"],
        eye["person"],
        eye["sha256"],
        *(power[name] for name in POWER_VECTOR),
        WAVELENGTH_NM,
        record["pupil_mm"],
        record["focus_dpt"],
        distance_m,
        *(eye["gaze_deg"] or settings.gaze_deg),
        settings.mode,
    ]
