"""A profile on its way: the request, and what the service says until it is ready."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from filter_service.wire.checks import (
    MAX_ID,
    check_float,
    take_bool,
    take_choice,
    take_float,
    take_int,
    take_list,
    take_map,
    take_pair,
    take_range,
    take_text,
    unpack_profile,
)
from filter_service.wire.images import (
    MAX_GAZE_DEG,
    MAX_PREPARED_PUPIL_MM,
    MAX_VERGENCE_DPT,
    Camera,
    Limits,
    Part,
    expect_parts,
)
from filter_service.wire.text import clip, clip_notes, take_notes

EYE_MODELS = ("traced", "wavefront")
ACCURACIES = ("fast", "balanced", "exact")
DEFAULT_ACCURACY = "exact"
MODES = ("on-axis", "quality", "dynamic")
GRIDS = ("planned", "paper")
TOLERANCES = ("loose", "normal", "fine")


@dataclass(frozen=True)
class ProfileSettings:
    """How the PSFs of a profile are computed; PROTOCOL.md explains each."""

    mode: str = "dynamic"
    grid: str = "planned"
    tolerance: str = "normal"
    pupil_range_mm: tuple[float, float] = (2.0, 7.0)
    focus_range_dpt: tuple[float, float] = (0.0, 6.0)
    object_range_dpt: tuple[float, float] = (0.0, 10.0)
    gaze_deg: tuple[float, float] = (0.0, 0.0)
    gaze_range_deg: tuple[float, float] = (0.0, 0.0)
    diffraction: bool = True
    chromatic: bool = True
    lateral_color: bool = False
    eye_model: str = "traced"
    accuracy: str = DEFAULT_ACCURACY
    age_years: float | None = None

    @property
    def follows_field(self) -> bool:
        """Return whether PSFs differ over the visual field."""
        return self.mode != "on-axis"

    def fields(self) -> dict[str, Any]:
        """Return the map that travels."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @classmethod
    def parse(cls, source: Mapping[str, Any]) -> ProfileSettings:
        """Return the settings; what is not given keeps its default."""
        default = cls()
        ranges = {
            name: take_range(
                source,
                name,
                low=low,
                high=high,
                path=f"settings.{name}",
                default=getattr(default, name),
            )
            for name, low, high in (
                ("pupil_range_mm", 0.5, MAX_PREPARED_PUPIL_MM),
                ("focus_range_dpt", 0.0, MAX_VERGENCE_DPT),
                ("object_range_dpt", 0.0, MAX_VERGENCE_DPT),
            )
        }
        gazes = {
            name: take_pair(
                source,
                name,
                low=low,
                high=MAX_GAZE_DEG,
                path=f"settings.{name}",
                default=getattr(default, name),
            )
            for name, low in (("gaze_deg", -MAX_GAZE_DEG), ("gaze_range_deg", 0.0))
        }
        switches = {
            name: take_bool(
                source, name, path=f"settings.{name}", default=getattr(default, name)
            )
            for name in ("diffraction", "chromatic", "lateral_color")
        }
        age_years = take_float(
            source,
            "age_years",
            low=3,
            high=120,
            path="settings.age_years",
            default=None,
        )
        choices = {
            name: take_choice(
                source,
                name,
                choices=allowed,
                path=f"settings.{name}",
                default=getattr(default, name),
            )
            for name, allowed in (
                ("mode", MODES),
                ("grid", GRIDS),
                ("tolerance", TOLERANCES),
                ("eye_model", EYE_MODELS),
                ("accuracy", ACCURACIES),
            )
        }
        return cls(**choices, **ranges, **gazes, **switches, age_years=age_years)


@dataclass(frozen=True)
class ProfileRequest:
    """A new eye; its body is a message part of its own."""

    profile_id: int
    body: dict[str, Any]
    settings: ProfileSettings = ProfileSettings()
    cameras: tuple[Camera, ...] = ()

    type_name: ClassVar[str] = "profile"

    def fields(self) -> dict[str, Any]:
        """Return the header fields."""
        return {
            "profile_id": self.profile_id,
            "settings": self.settings.fields(),
            "views": [camera.fields() for camera in self.cameras],
        }

    @classmethod
    def parse(
        cls, header: Mapping[str, Any], parts: Sequence[Part], limits: Limits
    ) -> ProfileRequest:
        """Return the checked message; the body is only unpacked, not understood."""
        profile_id = take_int(header, "profile_id", low=0, high=MAX_ID)
        settings = ProfileSettings.parse(take_map(header, "settings", default={}))
        views = take_list(
            header, "views", min_items=0, max_items=limits.max_views, default=[]
        )
        cameras = tuple(
            Camera.parse(view, f"views[{i}]", limits) for i, view in enumerate(views)
        )
        expect_parts(parts, 1)
        body = unpack_profile(parts[0], limits.max_profile_bytes)
        return cls(profile_id, body, settings, cameras)


@dataclass(frozen=True)
class Accepted:
    """A profile is well formed; ``is_building`` is false while no camera is known.

    ``n_cameras`` counts the cameras that it is being prepared for.
    """

    profile_id: int
    generation: int
    is_building: bool
    n_cameras: int = 1

    type_name: ClassVar[str] = "accepted"

    def fields(self) -> dict[str, Any]:
        """Return the header fields."""
        return dict(vars(self))

    @classmethod
    def parse(cls, header: Mapping[str, Any], parts: Sequence[Part]) -> Accepted:
        """Return the checked message."""
        expect_parts(parts, 0)
        return cls(
            profile_id=take_int(header, "profile_id", low=0, high=MAX_ID),
            generation=take_int(header, "generation", low=0, high=MAX_ID),
            is_building=take_bool(header, "is_building", default=True),
            n_cameras=take_int(header, "n_cameras", low=0, high=1000, default=1),
        )


@dataclass(frozen=True)
class Progress:
    """How far the PSFs of a profile are."""

    profile_id: int
    generation: int
    stage: str
    fraction: float

    type_name: ClassVar[str] = "progress"

    def fields(self) -> dict[str, Any]:
        """Return the header fields."""
        return dict(vars(self)) | {"stage": clip(self.stage, 100)}

    @classmethod
    def parse(cls, header: Mapping[str, Any], parts: Sequence[Part]) -> Progress:
        """Return the checked message."""
        expect_parts(parts, 0)
        return cls(
            profile_id=take_int(header, "profile_id", low=0, high=MAX_ID),
            generation=take_int(header, "generation", low=0, high=MAX_ID),
            stage=take_text(header, "stage", max_characters=100),
            fraction=take_float(header, "fraction", low=0, high=1),
        )


@dataclass(frozen=True)
class Ready:
    """The PSFs of a profile are in place; frames are filtered with them from now on.

    ``is_complete`` is false for a preview: good for what the last frame looked at, and
    followed by another Ready.
    """

    profile_id: int
    generation: int
    build_ms: float
    psf_count: int
    memory_mb: float
    pixel_pitch_mrad: tuple[float, float]
    notes: tuple[str, ...] = ()
    is_complete: bool = True

    type_name: ClassVar[str] = "ready"

    def fields(self) -> dict[str, Any]:
        """Return the header fields."""
        return dict(vars(self)) | {
            "pixel_pitch_mrad": list(self.pixel_pitch_mrad),
            "notes": clip_notes(self.notes),
        }

    @classmethod
    def parse(cls, header: Mapping[str, Any], parts: Sequence[Part]) -> Ready:
        """Return the checked message."""
        expect_parts(parts, 0)
        pitch = take_list(header, "pixel_pitch_mrad", min_items=2, max_items=2)
        pitch_x, pitch_y = (
            check_float(item, low=0, high=1e6, path=f"pixel_pitch_mrad[{i}]")
            for i, item in enumerate(pitch)
        )
        return cls(
            profile_id=take_int(header, "profile_id", low=0, high=MAX_ID),
            generation=take_int(header, "generation", low=0, high=MAX_ID),
            build_ms=take_float(header, "build_ms", low=0, high=1e12),
            psf_count=take_int(header, "psf_count", low=0, high=MAX_ID),
            memory_mb=take_float(header, "memory_mb", low=0, high=1e9),
            pixel_pitch_mrad=(pitch_x, pitch_y),
            notes=take_notes(header),
            is_complete=take_bool(header, "is_complete", default=True),
        )
