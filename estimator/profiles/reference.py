"""Reference of profile bodies, from their types: JSON Schema, tables and limits.

Rules that concern several fields (an axis that a cylinder requires, surfaces in order)
are in neither; `parse_profile` checks them.
"""

from typing import Any

import msgspec
from msgspec import inspect

from estimator.profiles import (
    bodies,
    coefficients,
    correction_bodies,
    given_bodies,
)
from estimator.profiles.validation import ALLOWED, KIND, allowed_values

SCHEMA_DRAFT = "https://json-schema.org/draft/2020-12/schema"

INTRODUCTIONS: dict[type[msgspec.Struct], str] = {
    bodies.CommonBody: "Fields of every kind of profile.",
    bodies.FileNoteBody: "Each entry of `notes`.",
    bodies.PresetBody: "Kind `preset`: an eye by its name.",
    bodies.PrescriptionBody: "Kind `prescription`.",
    bodies.ZernikeBody: "Kind `zernike`: one measured wavefront on the axis.",
    bodies.ZernikeSetBody: "Kind `zernike_set`: wavefronts of one eye.",
    bodies.MeasurementBody: "Each entry of `measurements`.",
    coefficients.OrderedZernikeBody: "`zernike` of a measurement.",
    bodies.RetinaBody: "`retina`.",
    bodies.StraylightBody: "`straylight`; an empty object uses the defaults.",
    correction_bodies.PowersBody: "`correction`: fields of every kind.",
    correction_bodies.SpectaclesBody: "`correction` of kind `spectacles` (default).",
    correction_bodies.ProgressiveBody: "`correction` of kind `progressive`.",
    correction_bodies.LensletsBody: "`correction` of kind `lenslets`.",
    correction_bodies.ContactLensBody: "`correction` of kind `contact_lens`.",
    correction_bodies.IntraocularBody: "`correction` of kind `iol`: every design.",
    correction_bodies.DiffractiveBody: "`correction` of kind `iol`: designs `bifocal`, "
    "`trifocal` and `edof`.",
    correction_bodies.BifocalBody: "Design `bifocal`.",
    correction_bodies.TrifocalBody: "Design `trifocal`.",
    correction_bodies.ExtendedDepthBody: "Design `edof`.",
    correction_bodies.ZonesBody: "Design `zones`.",
    correction_bodies.LaserBody: "`correction` of kind `laser`: the eye after laser "
    "surgery of the cornea.",
    bodies.EyeBody: "Kind `eye`: the eye model by its parameters.",
    bodies.ParametersBody: "`parameters`.",
    given_bodies.SurfacesBody: "Kind `surfaces`: an eye by its surfaces and media.",
    given_bodies.RetinalSurfaceBody: "`retina` of kind `surfaces`, and fields of "
    "every surface.",
    given_bodies.SurfaceBody: "Each entry of `surfaces`.",
    given_bodies.StateBody: "Each entry of `states`.",
    given_bodies.PseudophakicBody: "Kind `pseudophakic`: an eye with an intraocular "
    "lens by its geometry.",
    given_bodies.ImplantBody: "`implant`.",
    given_bodies.PublishedBody: "Kind `published`: a schematic eye by its name.",
    given_bodies.SyntEyesBody: "Kind `synteyes`: an eye drawn from a statistical model "
    "of biometry.",
}
"""Tables of the reference in their order, with the line above each."""


def profile_schema() -> dict[str, Any]:
    """Return the JSON Schema of a profile body."""
    schema, parts = msgspec.json.schema_components(
        [given_bodies.ProfileBody], ref_template="#/$defs/{name}"
    )
    for part in parts.values():
        _separate_design(part)
        _require_either(part)
    (root,) = schema
    return {
        "$schema": SCHEMA_DRAFT,
        "title": "Eye profile",
        "oneOf": root["anyOf"],
        "$defs": {name: _without_discriminators(parts[name]) for name in sorted(parts)},
    }


def _require_either(part: dict[str, Any]) -> None:
    """Require exactly one of two fields of a measurement."""
    pairs = [
        {"oneOf": [{"required": [name]}, {"required": [other]}]}
        for name, (other, _) in coefficients.EITHER.items()
        if {name, other} <= set(part.get("properties", {}))
    ]
    if pairs:
        part["allOf"] = pairs


def _separate_design(part: dict[str, Any]) -> None:
    """Turn the tag of an intraocular lens into its kind and its design."""
    properties = part.get("properties", {})
    tags = properties.get(KIND, {}).get("enum", [])
    kind, _, design = (tags or [""])[0].partition("/")
    if design:
        properties[KIND] = {"enum": [kind]}
        properties["design"] = {"enum": [design]}
        if design != "monofocal":  # the default
            part["required"] = [*part["required"], "design"]
    elif kind == "spectacles":
        part["required"].remove(KIND)


def _without_discriminators(schema: Any) -> Any:
    """Return a schema without OpenAPI's hints, which name tags that are not sent."""
    if isinstance(schema, dict):
        kept = {k: v for k, v in schema.items() if k != "discriminator"}
        return {key: _without_discriminators(value) for key, value in kept.items()}
    if isinstance(schema, list | tuple):
        return [_without_discriminators(item) for item in schema]
    return schema


def profile_tables() -> str:
    """Return Markdown tables of all fields: default, allowed values, meaning."""
    blocks = []
    for body, introduction in INTRODUCTIONS.items():
        rows = ["| field | default | allowed | meaning |", "|---|---|---|---|"]
        rows += [_row(field) for field in _own_fields(body)]
        blocks.append("\n".join([introduction, "", *rows]))
    for introduction, kinds in given_bodies.TABLES.items():
        rows = ["| kind | fields (default) | definition |", "|---|---|---|"]
        rows += [_kind_row(kind) for kind in kinds]
        blocks.append("\n".join([introduction, "", *rows]))
    return "\n\n".join(blocks) + "\n"


def _kind_row(body: type[msgspec.Struct]) -> str:
    fields = [
        f"`{field.encode_name}`"
        + ("" if field.required else f" ({_default(field) or 'none'})")
        for field in _fields(body)
    ]
    tag = body.__struct_config__.tag
    return f"| `{tag}` | {', '.join(fields) or 'none'} | {body.__doc__} |"


def field_limits(body: type[msgspec.Struct], name: str) -> tuple[float, float]:
    """Return the range of a number, or of the numbers of a list, in a body.

    Raises
    ------
    KeyError
        The body has no number of that name.
    """
    kind = _bare({f.encode_name: f.type for f in _fields(body)}[name])
    if isinstance(kind, inspect.TupleType):
        kind = _bare(kind.item_types[0])
    if not isinstance(kind, inspect.FloatType) or kind.ge is None or kind.le is None:
        raise KeyError(name)
    return kind.ge, kind.le


def _fields(body: type[msgspec.Struct]) -> tuple[inspect.Field, ...]:
    described = inspect.type_info(body)
    assert isinstance(described, inspect.StructType)
    return described.fields


def _own_fields(body: type[msgspec.Struct]) -> list[inspect.Field]:
    """Return the fields that the tables of the body's bases do not list."""
    listed = {
        field.encode_name
        for base in body.__mro__[1:]
        if base in INTRODUCTIONS
        for field in _fields(base)
    }
    if body in (
        bodies.PresetBody,
        given_bodies.PublishedBody,
    ):  # its name selects the eye
        listed.discard("name")
    return [field for field in _fields(body) if field.encode_name not in listed]


def _row(field: inspect.Field) -> str:
    cells = [
        f"`{field.encode_name}`",
        _default(field),
        _allowed(field),
        _meaning(field.type),
    ]
    return "| " + " | ".join(cells) + " |"


def _default(field: inspect.Field) -> str:
    if field.required:
        return "required"
    if field.encode_name in coefficients.EITHER:
        return f"required, or `{coefficients.EITHER[field.encode_name][0]}`"
    value = field.default
    match value:
        case msgspec.NODEFAULT | msgspec.UNSET | None:
            return ""
        case bool():
            return "`true`" if value else "`false`"
        case tuple():
            return "[" + ", ".join(f"{v:g}" for v in value) + "]"
    return f"`{value}`" if isinstance(value, str) else f"{value:g}"


def _allowed(field: inspect.Field) -> str:
    kind = field.type
    is_stated = isinstance(kind, inspect.Metadata) and ALLOWED in (kind.extra or {})
    match _bare(kind):
        case inspect.LiteralType(values=values):
            return ", ".join(f"`{value}`" for value in sorted(map(str, values)))
        case inspect.AnyType():
            return "text"
        case _ if is_stated:
            return allowed_values(kind)
        case inspect.StructType() | inspect.UnionType() | inspect.DictType():
            return "an object"
        case inspect.BoolType():
            return "`true`, `false`"
    return allowed_values(kind).removeprefix("a number from ")


def _meaning(kind: inspect.Type) -> str:
    """Return the description of a type, or of the first member that has one."""
    found = ""
    while isinstance(kind, inspect.Metadata):
        found = found or str((kind.extra_json_schema or {}).get("description", ""))
        kind = kind.type
    if isinstance(kind, inspect.UnionType):
        return found or next(filter(None, map(_meaning, kind.types)), "")
    return found


def _bare(kind: inspect.Type) -> inspect.Type:
    """Return a type without annotations and without ``None``."""
    if isinstance(kind, inspect.Metadata):
        return _bare(kind.type)
    if isinstance(kind, inspect.UnionType):
        members = [t for t in kind.types if not isinstance(t, inspect.NoneType)]
        return _bare(members[0]) if len(members) == 1 else kind
    return kind
