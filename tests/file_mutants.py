"""Valid files of each kind that is read, what reads them, and how they are changed."""

import base64
import json
import random
import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

from estimator import InvalidFile, ProfileError
from estimator.profiles.files import InvalidProfileFile
from filter_service.psfs.store_file import PAGE_BYTES, PREAMBLE
from tests.exports import irx3_export, vision_prescription
from tests.schema_profiles import disturbed, drawn_profile
from tests.unit.gltf_bytes import glb, triangle_bytes, triangle_header
from tests.unit.image_bytes import (
    GRAY,
    GRAY_ALPHA,
    RGB,
    RGBA,
    matrix_profile,
    png,
    table_profile,
)

DATA = Path(__file__).parent / "data"
CORPUS = DATA.with_name("corpus")
PEOPLE = DATA / "peripheral_wavefronts.npz"
PUBLISHED = DATA.parents[1] / "estimator" / "profiles" / "published"

SIDES = (48, 64)
SIZES = (0, 1, 2**15, 2**16 - 1, 2**24, 2**31 - 1, 2**31, 2**32 - 1)
NUMBERS = (
    *(b"0", b"-1", b"65536", b"2147483647", b"99999999999999999999", b"1e999"),
    *(b"5e-324", b"-5e-324", b"1e308", b"-1e308", b"nan", b"inf"),
)
WORDS = (b"NaN", b"null", b"[]", b"{}", b'"x"', b"\\ud800", b"\xff\xfe", b"\0")
LONGEST_BYTES = 4_000_000

PROFILE = {
    "kind": "zernike",
    "pupil_diameter_mm": 5.0,
    "wavelength_nm": 555.0,
    "zernike_um": {"2,0": 1.5, "3,-1": 0.2, "4,0": 0.1},
}
EYE = {
    "kind": "prescription",
    "sphere_dpt": -2.0,
    "cylinder_dpt": -1.0,
    "axis_deg": 20,
    "correction": {"sphere_dpt": -2.0, "vertex_mm": 12},
}
ABP = "# an eye\nAp = 5\nWa = 587.56\nZ[2, 0] = 1.4\nZ[3,-1]=0.1\n"
CSV = "# pupil_diameter_mm: 5\n# wavelength_nm: 555\nn,m,um\n2,0,1.5\n3,-1,-0.25\n"
SHEET = (
    "sep=;\n# Frame: examiner\n# eye: left\n# Pupil diameter (mm): 6,0\n"
    "# Wavelength: 555 nm\n# Patient: A\nj;n;m;um\n4;2;0;3,2\n7;3;\u22121;0,25\n"
)
WIDE = (
    '# units: um\n"pupil_diameter_mm","wavelength_nm","eye","Z(2,0)","Z2_2","C3-1"\n'
    "6.0,555,OS,3.2,0.25,-0.125\n"
)
LISTED = {
    "kind": "zernike",
    "pupil_radius_mm": 2.5,
    "wavelength_nm": 632.8,
    "zernike": {"order": "noll", "unit": "waves", "values": [0, 0, 0, 2.5, 0, 0.1]},
}
NUMBERED = (
    "# pupil_radius_mm: 2.5\n# wavelength_nm: 632.8\n# order: fringe\n"
    "# normalization: none\n# positive: ahead\nj,waves\n4,2.5\n8,0.25\n"
)
ZMX_ENDING = (
    'BLNK\nOPDX 0 1 0 9.2E-1\nTOL TOFF   0   0 0\nMNUM 2 1\nMOFF   0   1 ""\n'
    "THIC   2   1 0.5 0 0\n"
)
DISPLAY = "nm,r,g,b\n" + "".join(
    f"{nm},{np.exp(-(((nm - 610) / 20) ** 2)):.4f},"
    f"{np.exp(-(((nm - 540) / 20) ** 2)):.4f},"
    f"{np.exp(-(((nm - 455) / 20) ** 2)):.4f}\n"
    for nm in range(400, 701, 5)
)
CALIBRATION = (
    "cam0=[3997.684 0 1176.728; 0 3997.684 1011.728; 0 0 1]\n"
    "doffs=131.111\nbaseline=193.001\nwidth=2964\nheight=1988\nndisp=280\n"
)
EYES = """image,profile,pupil_mm,focus_dpt,distance_m,gaze_h_deg
cats/*,myopia,3.5,center,1,2
0007,"{""kind"": ""prescription"", ""sphere_dpt"": -3}",,0.5,inf,
"""
STATES = "frame,pupil_mm,focus_dpt\n" + "".join(
    f"{k:06d},{3 + k / 10},{k / 5}\n" for k in range(5)
)
LISTED = "".join(f"{k}.5 rgb/{k}.png {k}.51 depth/{k}.png\n" for k in range(5))


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes
    ----------
    name : str
        Of the kind, as rows of results have it.
    files : dict
        Contents of valid files by the name that each has.
    read : callable
        What reads a file by its path.
    errors : tuple of type
        What `read` may raise, subclasses not included.
    make : callable, optional
        Returns the content of a file instead of a changed one.
    command : callable, optional
        Returns the arguments of `ocufilter` that have a file read, for its path and a
        folder with valid files beside.
    """

    name: str
    files: dict[str, bytes]
    read: Callable[[Path], object]
    command: Callable[[Path, Path], list[str]] | None = None
    errors: tuple[type[Exception], ...] = (InvalidFile, InvalidProfileFile)
    make: Callable[[random.Random], bytes] | None = None


def kinds(folder: Path) -> list[Kind]:
    """Return all kinds; valid files are written to a folder, and read from there."""
    from clients.batch.datasets import read_calibration, tum_frames
    from clients.batch.eye_table import read_eyes
    from clients.batch.manifest import Manifest, ManifestDiffers
    from clients.batch.source import read_states
    from clients.batch.video_reading import VideoReader
    from clients.commands.options import display_of_file
    from clients.headset.gltf_scene import load_gltf
    from clients.web.eye_form import read_profile_file
    from clients.web.page_link import fragment_of, restore
    from clients.web.page_state import PageState
    from clients.web.picture import photo_picture
    from estimator.periphery.population import load_measured_eyes
    from estimator.profiles.files import load_profile
    from estimator.profiles.parse import parse_profile
    from filter_service.image_files import read_color_file, read_depth_file
    from filter_service.keys import load_client_key
    from filter_service.psfs.store_cache import StoreCache
    from filter_service.service.config import load_config
    from training.datasets import DataError, read_manifest, recipe_of

    settings_errors = (ValueError, InvalidFile)
    pictures = _pictures(folder)
    write_beside(folder, pictures)

    def depth(path: Path) -> object:
        return read_depth_file(path, depth_scale=0.001)

    def photo(path: Path) -> object:
        content = path.read_bytes()
        return photo_picture(path.name, content, width_deg=40.0, distance_dpt=1.0)

    def profile(path: Path) -> object:
        read_profile_file(path.name, path.read_bytes())
        return load_profile(path)

    def tum(path: Path) -> object:
        return tum_frames(path.parent)

    def manifest(path: Path) -> object:
        with Manifest(path.parent, JOB):
            return None

    def video(path: Path) -> object:
        with VideoReader(path) as reader:
            return [reader.color(k) for k in (0, reader.count - 1)]

    def link(path: Path) -> object:
        state = PageState()
        restore(state, path.read_text("latin-1"))
        return fragment_of(state, "chart"), state.problems()

    def training_set(path: Path) -> object:
        return recipe_of(read_manifest(path.parent))

    def drawn(path: Path) -> object:
        return parse_profile(json.loads(path.read_bytes()))

    def store(path: Path) -> object:
        cache = StoreCache(str(path.parent), max_mb=100)
        return cache.load(path.stem, check_cancelled=lambda: None)

    def of(*endings: str) -> dict[str, bytes]:
        return {k: v for k, v in pictures.items() if k.endswith(endings)}

    as_color = ("filter", "--fov-deg", "50", "--plan", "--profile")
    return [
        Kind("color", of(".png", ".jpg", ".ppm"), read_color_file, _color_command),
        Kind("depth", of("g16.png", ".tif", ".pfm", ".pgm"), depth, _depth_command),
        Kind("npy", of(".npy"), _either(read_color_file, depth), _color_command),
        Kind("OpenEXR", of(".exr"), _either(read_color_file, depth), _color_command),
        Kind("photo", of("c.png", "_p3.png", "16.png", ".jpg", ".webp", ".tif"), photo),
        Kind(
            "profile",
            {
                "p.json": json.dumps(PROFILE).encode(),
                "e.json": json.dumps(EYE).encode(),
                "p.abp": ABP.encode(),
                "p.csv": CSV.encode(),
                "sheet.csv": SHEET.encode(),
                "windows.csv": SHEET.encode("utf-16"),
                "wide.csv": WIDE.encode(),
                "listed.json": json.dumps(LISTED).encode(),
                "numbered.csv": NUMBERED.encode(),
            },
            profile,
            lambda path, beside: [*as_color, str(path), *_images(beside)],
        ),
        Kind(
            "display",
            {"d.csv": DISPLAY.encode()},
            lambda path: display_of_file(str(path)),
            lambda path, beside: [
                *(*as_color, "myopia", *_images(beside), "--display", str(path)),
            ],
        ),
        Kind("TUM list", {"associations.txt": LISTED.encode()}, tum),
        Kind("calibration", {"calib.txt": CALIBRATION.encode()}, read_calibration),
        Kind(
            "states",
            {"s.csv": STATES.encode()},
            lambda path: read_states(path, [f"{k:06d}" for k in range(5)]),
            _states_command,
        ),
        Kind(
            "eyes",
            {"e.csv": EYES.encode()},
            lambda path: read_eyes(path, named={}),
        ),
        Kind(
            "manifest",
            {"manifest.jsonl": _manifest(folder)},
            manifest,
            errors=(InvalidFile, ManifestDiffers),
        ),
        Kind("video", _videos(folder), video),
        Kind("glTF", _scenes(pictures), load_gltf, _scene_command),
        Kind("stored eye", {"ab-cd.psfs": _store(folder)}, store),
        Kind("lens file", _lens_files(), profile),
        Kind("given eye", _given_eyes(), profile),
        Kind("configuration", _configuration(), load_config, errors=settings_errors),
        Kind("key", _key(), load_client_key, errors=(ValueError,)),
        Kind("link", _links(), link, errors=()),
        Kind("training set", _training_set(), training_set, errors=(DataError,)),
        Kind("people", {"people.npz": PEOPLE.read_bytes()}, load_measured_eyes),
        Kind(
            "profile of the schema",
            {"drawn.json": b""},
            drawn,
            errors=(ProfileError,),
            make=_drawn_profile,
        ),
    ]


JOB = {"made_by": "x", "profiles": {"p": {"kind": "preset", "name": "myopia"}}}


def _either(first: Callable, second: Callable) -> Callable[[Path], object]:
    def read(path: Path) -> object:
        return (first if path.name.startswith("c") else second)(path)

    return read


def _images(beside: Path) -> list[str]:
    color, depth = beside / "c.png", beside / "g16.png"
    return ["--color", str(color), "--depth", str(depth), "-o", str(beside / "o.png")]


def _filtered(color: Path, depth: Path, beside: Path) -> list[str]:
    return [
        *("filter", "--fov-deg", "50", "--plan", "--profile", "myopia"),
        *("--color", str(color), "--depth", str(depth), "-o", str(beside / "o.png")),
    ]


def _color_command(path: Path, beside: Path) -> list[str]:
    if not path.name.startswith("c"):
        return _depth_command(path, beside)
    return _filtered(path, beside / "g16.png", beside)


def _depth_command(path: Path, beside: Path) -> list[str]:
    return _filtered(beside / "c.png", path, beside)


def _states_command(path: Path, beside: Path) -> list[str]:
    return [
        *("batch", str(beside / "set"), "-p", "myopia", "-o", str(beside / "out")),
        *("--fov-deg", "50", "--states", str(path), "--dry-run"),
    ]


def _scene_command(path: Path, beside: Path) -> list[str]:
    return ["headset", "--simulated", "--frames", "1", "--scene", str(path)]


def write_beside(folder: Path, pictures: dict[str, bytes]) -> None:
    """Write valid files that commands need beside the changed one."""
    for name in ("c.png", "g16.png"):
        (folder / name).write_bytes(pictures[name])
    for k in range(5):
        for name, made in (("color", "c.png"), ("depth", "g16.png")):
            (folder / "set" / name).mkdir(parents=True, exist_ok=True)
            (folder / "set" / name / f"{k:06d}.png").write_bytes(pictures[made])


# --- valid files ---------------------------------------------------------------


def _pictures(folder: Path) -> dict[str, bytes]:
    rng = np.random.default_rng(0)
    height, width = SIDES
    color = rng.integers(0, 256, (height, width, 3), np.uint8)
    image, small = Image.fromarray(color), Image.fromarray(color[:20, :20])
    depth = Image.fromarray(rng.integers(500, 3000, SIDES).astype(np.uint16))
    metres = rng.random(SIDES, np.float32)
    made: dict[str, tuple[Image.Image, dict]] = {
        "c.png": (image, {"pnginfo": None}),
        "c_p.png": (image.quantize(16), {"transparency": 3}),
        "c_la.png": (image.convert("LA"), {"icc_profile": bytes(2000)}),
        "c.jpg": (image, {"exif": b"Exif\0\0MM\0*\0\0\0\x08\0\0"}),
        "c_progressive.jpg": (image, {"progressive": True}),
        "c.ppm": (image, {}),
        "c.webp": (small, {}),
        "c_lossless.webp": (small, {"lossless": True}),
        "g16.png": (depth, {}),
        "g16.pgm": (depth, {}),
        "g16.tif": (depth, {}),
        "f.tif": (Image.fromarray(metres), {}),
        "f_deflate.tif": (Image.fromarray(metres), {"compression": "tiff_deflate"}),
        "f_lzw.tif": (Image.fromarray(metres), {"compression": "tiff_lzw"}),
        "f.pfm": (Image.fromarray(metres), {}),
    }
    files = {}
    for name, (picture, how) in made.items():
        picture.save(folder / name, **how)
        files[name] = (folder / name).read_bytes()
    files["plain.pgm"] = b"P2\n# c\n8 4 65535\n" + b"1200 " * 32
    files["odd.pgm"] = b"P5 8 4 4000 " + bytes([4, 176]) * 32
    files["c16.ppm"] = b"P6\n8 4\n1023\n" + bytes([1, 44]) * 96
    files |= _deep_pictures(folder, color)
    for name, array in {
        "c.npy": color,
        "c_float.npy": color / np.float64(255.0),
        "c_fortran.npy": np.asfortranarray(color.astype(np.float32)),
        "d.npy": metres,
        "d_integers.npy": np.asarray(depth),
    }.items():
        np.save(folder / name, array)
        files[name] = (folder / name).read_bytes()
    linear = color.astype(np.float32)
    for name, compression, type_, channels in (
        ("c.exr", OpenEXR.ZIP_COMPRESSION, OpenEXR.scanlineimage, {"RGB": linear}),
        ("c_half.exr", OpenEXR.PIZ_COMPRESSION, OpenEXR.scanlineimage, {"RGB": "half"}),
        ("c_dwa.exr", OpenEXR.DWAA_COMPRESSION, OpenEXR.scanlineimage, {"RGB": linear}),
        ("c_b44.exr", OpenEXR.B44_COMPRESSION, OpenEXR.scanlineimage, {"RGB": "half"}),
        ("d_rle.exr", OpenEXR.RLE_COMPRESSION, OpenEXR.scanlineimage, {"Z": metres}),
        ("d.exr", OpenEXR.NO_COMPRESSION, OpenEXR.scanlineimage, {"Z": metres}),
        ("d_tiled.exr", OpenEXR.PXR24_COMPRESSION, OpenEXR.tiledimage, {"Z": metres}),
    ):
        header = {"type": type_, "compression": compression}
        if type_ == OpenEXR.tiledimage:
            header["tiles"] = OpenEXR.TileDescription()
        arrays = {
            k: linear.astype(np.float16) if isinstance(v, str) else v
            for k, v in channels.items()
        }
        with OpenEXR.File(header, arrays) as file:
            file.write(str(folder / name))
        files[name] = (folder / name).read_bytes()
    header = {
        "type": OpenEXR.scanlineimage,
        "dataWindow": ((3, 2), (width + 2, height + 1)),
        "displayWindow": ((0, 0), (99, 79)),
        "pixelAspectRatio": 2.0,
        "chromaticities": (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.3217, 0.3377),
    }
    with OpenEXR.File(header, {"RGBA": np.dstack([linear, metres])}) as file:
        file.write(str(folder / "c_part.exr"))
    files["c_part.exr"] = (folder / "c_part.exr").read_bytes()
    return files


def _deep_pictures(folder: Path, color: np.ndarray) -> dict[str, bytes]:
    """Return PNGs of 16 bits, and pictures with color profiles and tags."""
    deep = color.astype(np.uint16) * 257
    four = np.dstack([deep, deep[..., 0]])
    profile = zlib.compress(matrix_profile())
    gama, cicp = (b"gAMA", struct.pack(">L", 100000)), (b"cICP", bytes([9, 16, 0, 1]))
    made = {
        "c_gray16.png": (deep[..., :1], GRAY, ()),
        "c_rgb16.png": (deep, RGB, ((b"iCCP", b"p\0\0" + profile),)),
        "c_la16.png": (four[..., 2:], GRAY_ALPHA, ()),
        "c_rgba16.png": (four, RGBA, (cicp,)),
        "c_key16.png": (deep, RGB, ((b"tRNS", bytes(6)),)),
        "c_p3.png": (color, RGB, ((b"iCCP", b"p\0\0" + profile), gama)),
        "c_gama.png": (color, RGB, (gama,)),
        "c_cicp.png": (color, RGB, (cicp,)),
    }
    files = {}
    for name, (values, kind, chunks) in made.items():
        files[name] = png(folder / name, values, kind, *chunks).read_bytes()
    ink = Image.fromarray(color).convert("CMYK")
    ink.save(folder / "c_ink.jpg", icc_profile=table_profile(b"CMYK", [50] * 16))
    files["c_ink.jpg"] = (folder / "c_ink.jpg").read_bytes()
    return files


def _manifest(folder: Path) -> bytes:
    from clients.batch.manifest import Manifest

    out = folder / "out_manifest"
    out.mkdir(exist_ok=True)
    told = {"name": "a.png", "mtime_ns": 1, "bytes": 5, "sha256": "0" * 64}
    counts = {f"{k}_count": 0 for k in ("missing_depth", "clamped_depth", "overflow")}
    with Manifest(out, JOB) as manifest:
        for k in range(3):
            frame = {"kind": "frame", "profile": "p", "frame": f"{k}", "ok": True}
            done = {"file": f"p/{k}.png", "bytes": 9, "inputs": [told], "notes": ["n"]}
            manifest.append({**frame, **done, **counts})
    content = (out / "manifest.jsonl").read_bytes()
    (out / "manifest.jsonl").unlink()
    return content


def _videos(folder: Path) -> dict[str, bytes]:
    from clients.batch.video_writing import VIDEO_KINDS, join_segments, write_segment

    frames = np.random.default_rng(1).integers(0, 256, (4, *SIDES, 3), np.uint8)
    files = {}
    for kind, name in (("ffv1", "v.mkv"), ("h264", "v.mp4")):
        how = {"kind": VIDEO_KINDS[kind], "rate_hz": 30.0}
        segment = folder / f"{kind}.mkv"
        write_segment(segment, enumerate(frames), **how)
        join_segments(folder / name, [(0, segment)], **how)
        files[name] = (folder / name).read_bytes()
        segment.unlink()
    return files | _tagged_videos(folder, frames)


def _tagged_videos(folder: Path, frames: np.ndarray) -> dict[str, bytes]:
    """Return a turned video, one of HLG with 10 bits, and one with opacity."""
    import av

    hlg = {"colorspace": 9, "color_primaries": 9, "color_trc": 18, "color_range": 1}
    files = {}
    for name, codec, pixels, tags in (
        ("turned.mov", "png", "rgb24", {}),
        ("hlg.mkv", "ffv1", "yuv420p10le", hlg),
        ("opacity.mkv", "ffv1", "bgra", {}),
    ):
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=10)
            stream.width, stream.height, stream.pix_fmt = SIDES[1], SIDES[0], pixels
            stream.set_display_rotation(90)
            for key, value in tags.items():
                setattr(stream.codec_context, key, value)
            for image in frames:
                frame = av.VideoFrame.from_ndarray(image, format="rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
        files[name] = (folder / name).read_bytes()
    return files


def _scenes(pictures: dict[str, bytes]) -> dict[str, bytes]:
    primitive = {
        "attributes": {"POSITION": 0, "TEXCOORD_0": 1},
        "indices": 2,
        "material": 0,
    }
    image = base64.b64encode(pictures["c.png"]).decode()
    nodes = [
        {"children": [1], "scale": [1, 2, 3]},
        {"mesh": 0, "rotation": [0, 0, 0, 1]},
    ]
    header = triangle_header(
        nodes=nodes,
        meshes=[{"primitives": [primitive]}],
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        textures=[{"source": 0}],
        images=[{"uri": f"data:image/png;base64,{image}"}],
    )
    data = base64.b64encode(triangle_bytes()).decode()
    inside = header | {
        "buffers": [{"byteLength": 68, "uri": f"data:a/b;base64,{data}"}]
    }
    plain = triangle_header()
    return {
        "plain.glb": glb(plain, triangle_bytes()),
        "picture.glb": glb(header, triangle_bytes()),
        "inside.gltf": json.dumps(inside).encode(),
    }


def _store(folder: Path) -> bytes:
    from filter_service.camera import Camera
    from filter_service.psfs.store_cache import Stored
    from filter_service.psfs.store_file import write_file

    arrays = {"a": np.arange(1000.0), "b": Camera(8, 8, (-1.0, 1.0, 1.0, -1.0))}
    write_file(folder / "store", Stored(arrays, ("a note",)))
    return (folder / "store").read_bytes()


def _lens_files() -> dict[str, bytes]:
    """Return eyes that optiland saved, .zmx of one of them, and of tilted eyes."""
    eyes = json.loads((DATA / "optiland_files.json").read_bytes())["files"]
    files = {
        f"{name.replace(' ', '_')}.json": json.dumps(eye["json"]).encode()
        for name, eye in eyes.items()
    }
    zmx = eyes["even asphere, centered"]["zmx"]
    files["eye.zmx"] = zmx.encode("latin-1")
    files["windows.zmx"] = (zmx + ZMX_ENDING).encode("utf-16")
    broken = json.loads((DATA / "optiland_breaks.json").read_bytes())["files"]
    zmx = broken["tilted eye"]["zmx"]["several"]
    files["tilted.zmx"] = zmx.encode()
    tilts = "  STOP\n  SCBD 1 0 0 0.1 0.2 2.5 0 1\n  SCBD 2 1 2 -0.1 -0.2 -2.5 0 -1\n"
    files["surface_tilts.zmx"] = zmx.replace("  STOP\n", tilts).encode()
    old = json.loads((DATA / "optiland_old_files.json").read_bytes())["files"]
    for version, eye in old.items():
        files[f"version_{version}.json"] = json.dumps(eye["json"]).encode()
    return files | {
        "fhir.json": json.dumps(vision_prescription()).encode(),
        "irx3.txt": irx3_export().encode("latin-1"),
    }


def _given_eyes() -> dict[str, bytes]:
    """Return eyes by their surfaces, their implant, and several wavefronts."""
    files = {path.name: path.read_bytes() for path in PUBLISHED.glob("*.json")}
    for number, one in enumerate(json.loads((CORPUS / "profiles.json").read_bytes())):
        if one["name"].endswith(".json"):
            files[f"corpus_{number}.json"] = one["text"].encode()
    return files


def _configuration() -> dict[str, bytes]:
    return {"service.toml": (CORPUS / "service.toml").read_bytes()}


def _key() -> dict[str, bytes]:
    """Return a client's key file, with the keys of libzmq's documentation."""
    public, secret = (
        "Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID",
        "D:)Q[IlAW!ahhC2ac:9*A}h:p?([4%wOTJ%JR%cs",
    )
    text = f"name = 'a client'\npublic = '{public}'\nsecret = '{secret}'\n"
    return {"client.key": f"{text}server = '{public}'\n".encode()}


def _links() -> dict[str, bytes]:
    """Return entries of the page; `mutated` encodes them."""
    worn = {"kind": "iol", "design": "trifocal", "texts": {"sphere_dpt": "-2"}}
    right = {
        "preset": "keratoconus",
        "source": "preset",
        "higher_order": False,
        "texts": {"sphere_dpt": "-2.5", "axis_deg": "20"},
        "correction": worn,
    }
    entries = {
        "v": 1,
        "shown": "both",
        "scene": "chart",
        "focus_set": True,
        "values": {"pupil_diameter_mm": 5.5, "focus_dpt": 2},
        "eyes": {"OD": right, "OS": {"source": "file", "file": "a.json"}},
    }
    return {"entries.link": base64.urlsafe_b64encode(json.dumps(entries).encode())}


def _training_set() -> dict[str, bytes]:
    manifest = {"format": 1, "domain": "on_axis", "n_rows": 96, "rows_per_shard": 32}
    manifest |= {"seed": 5, "sampling": "sobol", "population_ratio": 0.25}
    return {"manifest.json": json.dumps(manifest).encode()}


def _drawn_profile(chance: random.Random) -> bytes:
    """Return a valid profile, or one with a few strange values."""
    body = drawn_profile(chance)
    if chance.random() < 0.5:
        body = disturbed(body, chance, chance.choice((1, 1, 2, 3)))
    return json.dumps(body).encode()


# --- changes --------------------------------------------------------------------


def mutant(kind: Kind, number: int) -> tuple[str, bytes]:
    """Return name and content of a changed file; the same for the same number."""
    chance = random.Random(f"{kind.name} {number}")
    name = chance.choice(sorted(kind.files))
    content = kind.files[name]
    if kind.make is not None:
        return name, kind.make(chance)
    if name.endswith(".link") and chance.random() < 0.8:
        entries = mutated(base64.urlsafe_b64decode(content), chance)
        return name, base64.urlsafe_b64encode(entries).rstrip(b"=")
    if name.endswith(".psfs") and chance.random() < 0.7:
        return name, _resealed(content, chance)
    return name, mutated(content, chance)


def _resealed(content: bytes, chance: random.Random) -> bytes:
    """Return a stored eye with another header whose checksum is right."""
    magic, n_header, start, n_bytes, _, data_sum = PREAMBLE.unpack_from(content)
    header = mutated(content[PREAMBLE.size :][:n_header], chance)
    start = max(start, -(-(PREAMBLE.size + len(header)) // PAGE_BYTES) * PAGE_BYTES)
    sums = zlib.crc32(header), data_sum
    head = PREAMBLE.pack(magic, len(header), start, n_bytes, *sums) + header
    return head.ljust(start, b"\0") + content[len(content) - n_bytes :]


def mutated(content: bytes, chance: random.Random) -> bytes:
    """Return a file with one to three changes."""
    if content[:1] == b"{" and chance.random() < 0.6:
        try:
            value = json.loads(content)
        except ValueError:
            value = None
        if value:
            return json.dumps(disturbed(value, chance, chance.choice((1, 2)))).encode()
    changed = bytearray(content)
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        changes = TEXT_CHANGES if _is_text(content) else CHANGES
        changed = chance.choice(changes)(changed, chance)
        if len(changed) > LONGEST_BYTES:
            changed = changed[:LONGEST_BYTES]
    return bytes(changed)


def _is_text(content: bytes) -> bool:
    return b"\0" not in content and all(b < 128 for b in content[:2000])


def _place(data: bytearray, chance: random.Random) -> int:
    """Return a place; half of them near the beginning, where headers are."""
    end = len(data) if chance.random() < 0.5 else min(len(data), 400)
    return chance.randrange(max(1, end))


def _flip(data: bytearray, chance: random.Random) -> bytearray:
    for _ in range(chance.choice((1, 2, 8, 40))):
        if data:
            data[_place(data, chance)] = chance.randrange(256)
    return data


def _cut(data: bytearray, chance: random.Random) -> bytearray:
    return data[: _place(data, chance)]


def _remove(data: bytearray, chance: random.Random) -> bytearray:
    at = _place(data, chance)
    del data[at : at + chance.choice((1, 4, 100))]
    return data


def _repeat(data: bytearray, chance: random.Random) -> bytearray:
    at = _place(data, chance)
    piece = data[at : at + chance.choice((1, 12, 100, 1000))]
    count = chance.choice((1, 2, 50, 5000))
    return data[:at] + piece * count + data[at:]


def _size(data: bytearray, chance: random.Random) -> bytearray:
    """Put a number that claims much where a size may stand."""
    how, limit = chance.choice((("<I", 4), (">I", 4), ("<H", 2), (">H", 2), ("<Q", 8)))
    at, value = _place(data, chance), chance.choice(SIZES)
    data[at : at + limit] = struct.pack(how, value % (1 << (8 * limit)))
    return data


def _window(data: bytearray, chance: random.Random) -> bytearray:
    """Claim a large picture in the header of a format that has one."""
    width, height = chance.choice(SIZES), chance.choice((1, 48, *SIZES))
    if data[1:4] == b"PNG" and len(data) > 33:
        data[16:24] = struct.pack(">II", width, height)
        data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
        return data
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        at = data.find(name)
        if at >= 0:
            at += len(name) + 4
            sides = (0, 0, min(width, 2**31 - 1), min(height, 2**31 - 1))
            data[at : at + 16] = struct.pack("<4i", *sides)
    at = data.find(b"\xff\xc0")
    if data[:2] == b"\xff\xd8" and at > 0:
        data[at + 5 : at + 9] = struct.pack(">HH", height % 65536, width % 65536)
    if data[:6] == b"\x93NUMPY":
        side = str(width).encode()
        return bytearray(re.sub(rb"\d+(?=[,)])", side, bytes(data), count=1))
    return _size(data, chance)


def _number(data: bytearray, chance: random.Random) -> bytearray:
    """Replace one of the numbers or words of a text."""
    found = list(re.finditer(rb"-?\d[\d.]*|\"[^\"]*\"", bytes(data[:200_000])))
    if not found:
        return _flip(data, chance)
    first, last = chance.choice(found).span()
    long = b"9" * chance.choice((20, 400, 5000))
    data[first:last] = chance.choice((*NUMBERS, *WORDS, long))
    return data


def _nest(data: bytearray, chance: random.Random) -> bytearray:
    at, count = _place(data, chance), chance.choice((10, 40, 1200, 100_000))
    opening = chance.choice((b"[", b'{"a":', b"(", b"Z["))
    closing = chance.choice((b"", b"]" * count, b"}" * count))
    return data[:at] + opening * count + closing + data[at:]


def _lines(data: bytearray, chance: random.Random) -> bytearray:
    lines = bytes(data).split(b"\n")
    line = chance.choice(lines)
    count = min(chance.choice((1, 50, 30_000)), LONGEST_BYTES // (len(line) + 1))
    return bytearray(b"\n".join(lines + [line] * count))


CHANGES = (_flip, _flip, _cut, _remove, _repeat, _size, _size, _window, _number)
TEXT_CHANGES = (_flip, _cut, _remove, _repeat, _number, _number, _nest, _lines)
