"""PROTOCOL.md shows every message, and the code reads what it shows."""

import json
import re
from pathlib import Path
from typing import get_args

import jsonschema
import msgpack
import pytest

from estimator.eye.checked_fields import ProfileError
from estimator.eye.parameters import PARAMETERS, EyeParameters
from estimator.profiles import bodies, reference
from estimator.profiles.bodies import MEASURED_KINDS, TRACED_KINDS, CorrectionBody
from estimator.profiles.given_bodies import KINDS, ProfileBody
from estimator.profiles.parse import parse_profile, preset_names
from filter_service import errors, messages
from filter_service import protocol_schema as schema
from filter_service.wire import replies
from tests.source_tree import ROOT
from tests.unit.test_profile_bodies import WRONG

IN_ORDER = (
    *("preset", "prescription", "zernike", "zernike_set", "eye", "surfaces"),
    "pseudophakic",
    "published",
    "synteyes",
)

PAGE = (Path(messages.__file__).parent / "PROTOCOL.md").read_text(encoding="utf-8")


def examples():
    """Return {type: header} of the indented maps, comments removed."""
    found = {}
    for block in re.findall(r"(?:^    .*\n)+", PAGE, flags=re.MULTILINE):
        if '"type"' in block:
            text = re.sub(r"#[^\n]*", "", block)
            header = json.loads(text)
            found[header["type"]] = header
    return found


EXAMPLES = examples()


def shown():
    """Return the profiles that the page shows; the eye's parameters are written out."""
    eye = json.dumps(EyeParameters.mean_eye().to_mapping())
    found = []
    for block in re.findall(r"(?:^    .*\n)+", PAGE, flags=re.MULTILINE):
        if block.strip().startswith('{"kind"'):
            found.append(json.loads(re.sub(r'\{"eye_length_mm".*?\}', eye, block)))
    return found


def parts_of(header):
    """Return zeros of the sizes that a header asks for."""
    parts = []
    if "memory" in header:
        return parts
    for view in header.get("views", []) if header["type"] != "profile" else []:
        n_pixels = view["width_px"] * view["height_px"]
        parts.append(bytes(3 * n_pixels))
        if header["type"] == "frame":
            parts.append(bytes(4 * n_pixels))
    return parts if header["type"] != "profile" else [b'{"kind": "preset"}']


def decode(header):
    decoder = (
        messages.decode_request
        if header["type"] in messages.REQUESTS
        else messages.decode_reply
    )
    return decoder([msgpack.packb(header), *parts_of(header)])


def test_every_message_type_is_shown():
    assert set(EXAMPLES) == {*messages.REQUESTS, *messages.REPLIES}


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_read_and_shows_every_field(name):
    header = EXAMPLES[name]
    message = decode(header)
    assert set(message.fields()) | {"type", "version"} == set(header)
    again = msgpack.unpackb(messages.encode(message)[0])
    assert again == msgpack.unpackb(msgpack.packb(header))


def test_kinds_are_measured_or_traced():
    """The second are listed by hand, because their bodies load slowly."""
    assert sorted(KINDS) == sorted(MEASURED_KINDS + TRACED_KINDS)


def test_the_settings_shown_are_the_defaults():
    shown = dict(EXAMPLES["profile"]["settings"])
    shown.pop("age_years")
    defaults = messages.FilterSettings().fields()
    assert json.loads(json.dumps(defaults)) == shown


def test_the_codes_of_notes_are_those_of_the_code():
    section = PAGE[PAGE.index("| codes of `ready`") : PAGE.index("**shared** answers")]
    rows = [line.split("|")[1] for line in section.splitlines() if line[:3] == "| `"]
    shown = set(re.findall(r"`(\w+)`", "".join(rows)))
    sources = [
        path.read_text(encoding="utf-8")
        for package in ("estimator", "filter_service")
        for path in (ROOT / package).rglob("*.py")
    ]
    named = set(re.findall(r'\bNote\(\s*"(\w+)"', "".join(sources)))
    not_of_a_frame = {"directions_outside", "steep_wavefronts"}
    assert named - shown == not_of_a_frame
    assert all(f'"{code}"' in "".join(sources) for code in shown)


def test_the_stage_times_of_the_example_are_of_the_stated_form():
    result = decode(EXAMPLES["result"])
    assert {"decode_ms", "queue_ms", "other_ms"} <= set(result.stage_times_ms)


def test_every_error_code_that_the_service_sends_is_explained():
    base_or_client = {
        errors.ProtocolError,
        errors.SessionError,
        errors.RenderError,
        errors.TransportError,
        errors.ServiceTimeout,
        errors.ConnectionLost,
        errors.AuthenticationFailed,
    }
    sent = {
        code
        for code, error_class in errors.ERROR_CLASSES.items()
        if error_class not in base_or_client
    }
    table = PAGE[PAGE.index("## 6. Errors") : PAGE.index("## 7.")]
    assert sent == set(re.findall(r"`([a-z]+_[a-z_]+)`", table)) - {"allowed", "field"}


def test_every_drop_reason_is_explained():
    for reason in replies.DROP_REASONS:
        assert f"`{reason}`" in PAGE


def test_the_page_states_the_version():
    assert f"**Version {messages.PROTOCOL_VERSION}.**" in PAGE


def test_schemas_and_tables_are_those_of_the_code():
    for path, text in schema.generated_files().items():
        assert path.read_text(encoding="utf-8") == text, path.name


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_schema_has_the_fields_that_the_page_shows(name):
    kind = {**messages.REQUESTS, **messages.REPLIES}[name]
    properties = schema.protocol_schema()["$defs"][kind.__name__]["properties"]
    assert set(EXAMPLES[name]) == set(properties)
    assert properties["type"] == {"const": name}


def test_every_kind_of_profile_is_shown_and_can_be_read():
    found = shown()
    kinds = dict.fromkeys(body["kind"] for body in found)
    assert list(kinds) == sorted(KINDS, key=IN_ORDER.index)
    for body in found:
        assert parse_profile(body).kind in KINDS


def test_the_presets_are_named():
    for name in preset_names():
        assert f"`{name}`" in PAGE


def test_the_tables_list_every_field_of_a_profile():
    tables = reference.profile_tables()
    for kind in (*get_args(ProfileBody), *get_args(CorrectionBody)):
        for name in kind.__struct_fields__:
            assert f"| `{name}` |" in tables


@pytest.mark.parametrize(
    ("body", "kind", "name"),
    [
        (body, kind, name)
        for body, kind in (
            (
                {"kind": "prescription", "sphere_dpt": -1, "axis_deg": 10},
                bodies.PrescriptionBody,
            ),
            (
                {
                    "kind": "zernike",
                    "pupil_diameter_mm": 5,
                    "wavelength_nm": 555,
                    "zernike_um": {"2,0": 1},
                },
                bodies.ZernikeBody,
            ),
        )
        for name in kind.__struct_fields__
        if name.endswith(("_dpt", "_mm", "_nm", "_deg", "_years"))
    ],
)
def test_the_limits_of_a_number_are_those_that_are_kept(body, kind, name):
    low, high = reference.field_limits(kind, name)
    if name == "pupil_radius_mm":
        del (body := {**body})["pupil_diameter_mm"]
    for inside in (low, high):
        parse_profile({**body, name: inside})
    for outside in (low - 0.01, high + 0.01):
        with pytest.raises(ProfileError) as caught:
            parse_profile({**body, name: outside})
        assert caught.value.field == name


def test_the_parameters_of_an_eye_are_listed_with_their_ranges():
    for row in PARAMETERS:
        limits = reference.field_limits(bodies.ParametersBody, row.name)
        assert limits == row.allowed


@pytest.mark.long("300 profiles are validated by an independent validator")
def test_the_schema_of_profiles_accepts_and_refuses_as_the_parser_does():
    """The standard's own keywords, read by an independent validator."""
    validator = jsonschema.Draft202012Validator(reference.profile_schema())
    for body in shown():
        assert validator.is_valid(body)
    for body in bodies.PRESETS.values():
        assert validator.is_valid(body)
    for row in WRONG:
        assert validator.is_valid(row["profile"]) != row["is_in_schema"], row
