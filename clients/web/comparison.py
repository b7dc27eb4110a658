"""Two states of one person, A and B: names of what is shown, and what differs.

A is the person's eye as entered; B starts as a copy of it.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from clients.web.controls import (
    AGE,
    AXIS,
    CONDITIONS,
    CORRECTION,
    CYLINDER,
    PRESCRIPTION,
    SPHERE,
    NumberField,
)
from clients.web.eye_form import (
    DESIGNS,
    HAZES,
    KINDS,
    SIDES,
    YELLOWINGS,
    EyeSide,
    preset_titles,
)
from clients.web.picture import png_of

EyeName = Literal["OD", "OS", "OD_B", "OS_B"]
"""An eye that is shown: one of the person, or state B of one."""

B_OF: dict[EyeSide, EyeName] = {"OD": "OD_B", "OS": "OS_B"}
EYE_NAMES: tuple[EyeName, ...] = ("OD", "OS", "OD_B", "OS_B")

CORRECTION_PREFIX = "correction."
NONE = "none"

_FIELDS: dict[str, NumberField] = {
    field.name: field for field in (*CONDITIONS, *CORRECTION, *PRESCRIPTION)
}
_LABELS = {
    "kind": "Kind of entries",
    "name": "Preset",
    "higher_order": "Higher-order aberrations of this age",
    "correction": "Correction",
    "correction.kind": "Correction",
    "correction.design": "Design",
    "correction.adds_dpt": "Additions of the implant",
    "correction.zone_adds_dpt": "Additions of the zones",
    "correction.zone_diameters_mm": "Diameters of the zones",
    "correction.rigid": "Rigid lens",
    "straylight": "Straylight",
    "yellowing": "Yellowing of the lens",
}
GONE_CATARACT = "gone with the natural lens"
_LABEL_HEIGHT_PX, _GAP_PX = 32, 8


class Difference(NamedTuple):
    """An entry that differs between A and B.

    Attributes
    ----------
    path : name of the profile field, within the correction with a prefix
    label, a, b : as displayed
    """

    path: str
    label: str
    a: str
    b: str


def side_of(name: EyeName) -> EyeSide:
    """Return which eye of the person a name belongs to."""
    return "OD" if name.startswith("OD") else "OS"


def title_of(name: EyeName, *, is_comparing: bool) -> str:
    """Return the name of an eye as displayed."""
    if not is_comparing:
        return SIDES[side_of(name)]
    return "B" if name.endswith("_B") else "A"


def differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[Difference]:
    """Return the fields in which two profiles differ.

    Corrections of different kinds or designs are one difference.
    """
    flat_a, flat_b = _flat(a), _flat(b)
    kinds = [
        tuple(flat.get(f"{CORRECTION_PREFIX}{field}") for field in ("kind", "design"))
        for flat in (flat_a, flat_b)
    ]
    if kinds[0] != kinds[1]:
        for flat in (flat_a, flat_b):
            shown = _correction_text(flat)
            for path in [path for path in flat if path.startswith(CORRECTION_PREFIX)]:
                del flat[path]
            flat["correction"] = shown
    paths = dict.fromkeys((*flat_a, *flat_b))
    return [
        Difference(path, _label(path), _text(path, flat_a), _text(path, flat_b))
        for path in paths
        if flat_a.get(path) != flat_b.get(path)
    ]


def _flat(body: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the fields of a profile by their path."""
    found: dict[str, Any] = {}
    if prefix == CORRECTION_PREFIX:
        found[f"{prefix}kind"] = "spectacles"  # without a kind
    if "sphere_dpt" in body:
        found |= {f"{prefix}cylinder_dpt": 0.0, f"{prefix}axis_deg": 0.0}
    if body.get("kind") in ("contact_lens", "iol", "laser"):
        found[f"{prefix}spherical_aberration_um"] = 0.0
    has_implant = (body.get("correction") or {}).get("kind") == "iol"
    for name, value in body.items():
        if name == "straylight":
            is_gone = has_implant and "cataract" in value
            found[name] = GONE_CATARACT if is_gone else _haze_text(value)
        elif isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found


def _haze_text(straylight: Mapping[str, Any]) -> str:
    if "log_s" in straylight:
        return f"log s {straylight['log_s']:.2f}"
    haze = straylight.get("cataract", "age")
    return HAZES.get(haze, haze)


def _correction_text(flat: Mapping[str, Any]) -> str:
    kind = flat.get("correction.kind")
    if kind is None:
        return NONE
    parts = [KINDS.get(kind, kind)]
    if kind == "iol":
        design = flat.get("correction.design", "monofocal")
        parts.append(DESIGNS.get(design, design).lower())
    powers = _powers_text(flat, CORRECTION_PREFIX)
    residual = _powers_text(flat, f"{CORRECTION_PREFIX}residual_")
    parts += [powers] if powers else []
    parts += [f"residual {residual}"] if residual else []
    if flat.get("correction.add_dpt") and kind == "progressive":
        parts.append(f"addition {_text('correction.add_dpt', flat)}")
    return ", ".join(parts)


def _powers_text(flat: Mapping[str, Any], prefix: str) -> str:
    """Return sphere, cylinder and axis as people write them; empty without power."""
    sphere_dpt, cylinder_dpt, axis_deg = (
        flat.get(f"{prefix}{name}") or 0.0
        for name in ("sphere_dpt", "cylinder_dpt", "axis_deg")
    )
    if not cylinder_dpt:
        return SPHERE.describe(sphere_dpt) if sphere_dpt else ""
    powers = f"{SPHERE.show(sphere_dpt)} {CYLINDER.show(cylinder_dpt)}"
    return f"{powers} x {AXIS.describe(axis_deg)}"


def _label(path: str) -> str:
    if path in _LABELS:
        return _LABELS[path]
    name = path.removeprefix(CORRECTION_PREFIX)
    label = _FIELDS[name].label if name in _FIELDS else name.replace("_", " ")
    is_worn = path.startswith(CORRECTION_PREFIX)
    return f"{label} of the correction" if is_worn else label


def _text(path: str, flat: Mapping[str, Any]) -> str:
    """Return a value as displayed."""
    if path not in flat:
        return NONE
    value, name = flat[path], path.rpartition(".")[2]
    if isinstance(value, list | tuple):
        return ", ".join(f"{part:g}" for part in value)
    if name in _FIELDS and isinstance(value, int | float):
        return _FIELDS[name].describe(value)
    known: Mapping[str, str] = {}
    if path == "yellowing":
        known = dict(YELLOWINGS)  # type: ignore[arg-type]
    elif path == "name":
        known = preset_titles()
    elif path.startswith(CORRECTION_PREFIX):
        known = dict(KINDS) | DESIGNS
    return known.get(value, str(value)) if isinstance(value, str) else f"{value}"


def joined_png(pictures: Sequence[bytes], labels: Sequence[str]) -> bytes:
    """Return encoded pictures of one height beside each other, each with its label."""
    decoded: list[Image.Image] = []
    for data in pictures:
        with Image.open(io.BytesIO(data)) as image:
            decoded.append(image.convert("RGB"))
    height_px = max(image.height for image in decoded)
    width_px = sum(image.width for image in decoded) + _GAP_PX * (len(decoded) - 1)
    label_px = max(_LABEL_HEIGHT_PX, height_px // 16)
    sheet = Image.new("RGB", (width_px, height_px + label_px), "white")
    draw, left_px = ImageDraw.Draw(sheet), 0
    font = ImageFont.load_default(0.6 * label_px)
    for picture, label in zip(decoded, labels, strict=True):
        sheet.paste(picture, (left_px, 0))
        draw.text(
            (left_px + 6, height_px + label_px // 8), label, fill="black", font=font
        )
        left_px += picture.width + _GAP_PX
    return png_of(np.asarray(sheet))


def label_of(name: EyeName, body: Mapping[str, Any]) -> str:
    """Return a line about a state for a picture: its letter, refraction and lens."""
    flat = _flat(body)
    parts = [f"{title_of(name, is_comparing=True)}: {SIDES[side_of(name)].lower()}"]
    if "name" in flat and flat.get("kind") == "preset":
        parts.append(_text("name", flat))
    powers = _powers_text(flat, "")
    is_surgery = flat.get("correction.kind") in ("iol", "laser")
    parts.append(f"{powers} before surgery" if powers and is_surgery else powers)
    parts.append(f"correction: {_correction_text(flat)}")
    if AGE.name in flat:
        parts.append(_text(AGE.name, flat))
    return ", ".join(filter(None, parts))


def short_label_of(name: EyeName, body: Mapping[str, Any]) -> str:
    """Return the letter of a state and its lens, for the headings of a report."""
    kind = _flat(body).get("correction.kind")
    design = (body.get("correction") or {}).get("design", "monofocal")
    lens = KINDS.get(kind, kind).lower() if kind else "no correction"
    if kind == "iol":
        lens = f"{DESIGNS.get(design, design).lower()} implant"
    return f"{title_of(name, is_comparing=True)} ({lens})"
