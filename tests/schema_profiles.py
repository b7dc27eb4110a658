"""Random profiles from the project's JSON Schema, and values that no field expects."""

import json
import math
import random
from functools import cache
from typing import Any

from estimator.optics.zernike import nm_from_index
from estimator.profiles.reference import profile_schema

OPTIONAL_RATIO = 0.35
"""Probability that a profile has an optional field."""

TERMS = [f"{n},{m}" for n, m in map(nm_from_index, range(28))]
MEDIA = ("cornea", "aqueous", "lens", "vitreous", "air", "medium_1", "medium_2")
TEXTS = ("", "eye", "a\nb", "\0", "\u202e\x1b[2J", "é" * 300, "x" * 100_000)

EXTREMES = (
    *(5e-324, -5e-324, 2.2e-308, 1e-9, -1e-9, 0, -0.0, 1e9, -1e9, 1e154, -1e155),
    *(1e200, 1e308, -1e308, math.nan, math.inf, -math.inf),
    *(2**31, 2**53 + 1, 2**63, -(2**63), 2**64 - 1),
)
"""Numbers at which arithmetic overflows, underflows or divides by zero."""


def strange_value(chance: random.Random) -> Any:
    """Return something that a field does not expect, in a form that JSON has."""
    kind = chance.randrange(5)
    if kind < 2:
        return chance.choice(EXTREMES)
    if kind == 2:
        return chance.choice((None, True, False, [], {}, [12, {}], [[]], {"a": 1}))
    if kind == 3:
        return chance.choice(TEXTS)
    made: Any = chance.choice(EXTREMES)
    for _ in range(chance.choice((1, 3, 20, 33))):
        made = [made] if chance.random() < 0.5 else {"a": made}
    return made


def disturbed(value: Any, chance: random.Random, count: int = 1) -> Any:
    """Return a copy of a JSON value with strange, missing or additional parts."""
    root = [json.loads(json.dumps(value))]
    for _ in range(count):
        at, key = chance.choice(_places(root))
        how = chance.random()
        if how < 0.75:
            at[key] = strange_value(chance)
        elif how < 0.85 and at is not root:
            del at[key]
        elif isinstance(at, list):
            at += [at[key]] * chance.choice((1, 2, 300))
        else:
            at[chance.choice((str(key) + "x", *TEXTS[:4]))] = at[key]
    return root[0]


def _places(root: list[Any]) -> list[tuple[Any, Any]]:
    """Return all containers with the key or index of each of their values."""
    found: list[tuple[Any, Any]] = []
    waiting: list[Any] = [root]
    while waiting:
        at = waiting.pop()
        for key in at if isinstance(at, dict) else range(len(at)):
            found.append((at, key))
            if isinstance(at[key], dict | list):
                waiting.append(at[key])
    return found


@cache
def _schema() -> dict[str, Any]:
    return profile_schema()


def drawn_profile(chance: random.Random) -> dict[str, Any]:
    """Return a profile that the schema allows.

    Rules that no schema expresses, such as the order of surfaces, are kept as well in
    nine of ten profiles.
    """
    body: dict[str, Any] = _drawn(_schema(), "", chance)
    if chance.random() < 0.1:
        return body
    if body.get("cylinder_dpt"):
        body.setdefault("axis_deg", 20.0)
    if body.get("yellowing"):
        body.setdefault("age_years", 40.0)
    for name in ("spectacle_magnification", "periphery", "sample"):
        body.pop(name, None)
    if (body.get("correction") or {}).get("cylinder_dpt"):
        body["correction"]["axis_deg"] = 90.0
    if body["kind"] in ("surfaces", "pseudophakic", "published", "synteyes"):
        body.pop("correction", None)
    if body["kind"] in ("published", "synteyes"):
        body.pop("retina", None)
    if body["kind"] == "surfaces":
        _settle_surfaces(body, chance)
    if body["kind"] == "pseudophakic":
        _settle_implant(body, chance)
    return body


def _settle_surfaces(body: dict[str, Any], chance: random.Random) -> None:
    names = (*MEDIA[:5], *(body.get("media") or ()), *(body.get("indices") or ()))
    states = body.get("states", [])
    states.sort(key=lambda state: state["accommodation_dpt"])
    for state in (body, *states):
        depths_mm = sorted(chance.uniform(0.0, 8.0) for _ in state["surfaces"])
        for surface, z_mm in zip(state["surfaces"], depths_mm, strict=True):
            surface["z_mm"] = z_mm - depths_mm[0]
            surface["medium_after"] = chance.choice(names)
            surface["radius_mm"] = _larger(surface["radius_mm"])
            if surface.get("offset_mm"):
                surface["offset_mm"] = (surface["offset_mm"] * 28)[:28]
    body["stop_z_mm"] = chance.uniform(0.1, 8.0)
    body["retina"]["z_mm"] = chance.uniform(10.0, 40.0)
    body["retina"]["radius_mm"] = _larger(body["retina"]["radius_mm"])


def _larger(radius_mm: Any) -> Any:
    """Return a radius, or two, of at least 0.5 mm."""
    if isinstance(radius_mm, list):
        return [_larger(one) for one in radius_mm]
    if radius_mm is None or abs(radius_mm) >= 0.5:
        return radius_mm
    return math.copysign(0.5 + 30.0 * abs(radius_mm), radius_mm)


def _settle_implant(body: dict[str, Any], chance: random.Random) -> None:
    body.setdefault("keratometry_axis_deg", 20.0)
    if chance.random() < 0.5:
        body["lens_center_mm"] = chance.uniform(4.0, 6.0)
        body.pop("lens_thickness_mm", None)
    else:
        body.pop("lens_center_mm", None)
        body["acd_mm"] = chance.uniform(2.5, 4.0)
        body["lens_thickness_mm"] = chance.uniform(3.0, 5.0)
    body.pop("iris_depth_mm", None)
    implant = body["implant"]
    radii = ("anterior_radius_mm", "posterior_radius_mm")
    if "power_dpt" in implant or not all(name in implant for name in radii):
        low = chance.choice((0.0, 5e-324, 1e-17, 1e-9, 20.0))
        implant["power_dpt"] = implant.get("power_dpt", low)
        for name in radii:
            implant.pop(name, None)
    for name in radii:
        if name in implant:
            implant[name] = _larger(implant[name])


def _drawn(schema: dict[str, Any], name: str, chance: random.Random) -> Any:
    while "$ref" in schema:
        schema = _schema()["$defs"][schema["$ref"].rpartition("/")[2]]
    for key in ("oneOf", "anyOf"):
        if key in schema:
            return _drawn(chance.choice(schema[key]), name, chance)
    if "enum" in schema:
        return chance.choice(schema["enum"])
    kind = schema.get("type", "string")
    if kind == "object":
        return _drawn_object(schema, chance)
    if kind == "array":
        return _drawn_array(schema, name, chance)
    if kind in ("number", "integer"):
        return _drawn_number(schema, is_whole=kind == "integer", chance=chance)
    if kind == "string":
        return chance.choice(MEDIA if name == "medium_after" else TEXTS)
    return {"boolean": chance.random() < 0.5, "null": None}[kind]


def _drawn_object(schema: dict[str, Any], chance: random.Random) -> dict[str, Any]:
    if "properties" not in schema:  # a map: coefficients by term, or media by name
        inner = schema["additionalProperties"]
        names = TERMS if inner.get("type") == "number" else MEDIA
        if inner.get("minimum", -1.0) > 0.0:
            names = MEDIA
        chosen = chance.sample(names, chance.randrange(1, 6))
        return {name: _drawn(inner, name, chance) for name in chosen}
    return {
        name: _drawn(inner, name, chance)
        for name, inner in schema["properties"].items()
        if name in schema.get("required", ()) or chance.random() < OPTIONAL_RATIO
    }


def _drawn_array(schema: dict[str, Any], name: str, chance: random.Random) -> list[Any]:
    if "prefixItems" in schema:
        return [_drawn(inner, name, chance) for inner in schema["prefixItems"]]
    low = schema.get("minItems", 0)
    high = min(schema.get("maxItems", 28), low + chance.choice((2, 4, 400)))
    count = chance.choice((low, high, chance.randint(low, min(high, low + 6))))
    return [_drawn(schema["items"], name, chance) for _ in range(count)]


def _drawn_number(
    schema: dict[str, Any], *, is_whole: bool, chance: random.Random
) -> float:
    low, high = schema.get("minimum", -1e9), schema.get("maximum", 1e9)
    if is_whole:
        return chance.choice((low, high, chance.randint(int(low), int(high))))
    how = chance.random()
    if how < 0.1:
        return float(chance.choice((low, high)))
    if how < 0.25:
        inside = [value for value in EXTREMES if low <= value <= high]
        return float(chance.choice(inside or [low]))
    if high - low > 1e3:  # most such fields mean small numbers
        size = 10.0 ** chance.uniform(-3.0, 2.0)
        return min(max(chance.choice((-size, size)), low), high)
    return chance.uniform(low, high)
