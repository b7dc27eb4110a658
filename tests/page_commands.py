"""The commands that pages and help texts show, and the files that they read."""

from __future__ import annotations

import ast
import json
import re
import shlex
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from PIL import Image

from tests.exports import irx3_export, vision_prescription
from tests.source_tree import ROOT

FOLDERS = (
    *("", "clients/cpp", "clients/js", "docs", "examples", "filter_service"),
    *("filter_service/native", "shaders", "tests", "tests/gpu_kit", "training"),
)
PAGES = tuple(
    path.relative_to(ROOT).as_posix()
    for folder in FOLDERS
    for path in sorted((ROOT / folder).glob("**/*.md" if folder == "docs" else "*.md"))
    if path.name not in ("CHANGELOG.md", "LOG.md")  # commands of other versions
)
SHELLS = ("sh", "console", "powershell")
OTHER = ("{", "client     ", "[header]", "# an .abp file")
"""How indented blocks begin that are no commands: JSON, diagrams, files."""

WAYS_PAGE = "docs/how-to/choose.md"
"""The first lines of each way to use ocufilter."""

ENDPOINT = "tcp://127.0.0.1:5577"
ENDLESS = ("serve", "web", "layer serve", "layer run", "headset --left")
"""Commands that run until they are stopped, or need a headset."""

SLOW = (
    *("doctor", "report", "batch", "latency", "best-lens", "headset --simulated"),
    *(r"field .* --people", r"stimuli .* -p ", "scenario .* -o"),
)
"""Commands, as patterns, that take seconds."""

LACKING = {
    r"report .*\.pdf": "ocufilter[report]",
    r"batch .*\.mp4": "ocufilter[batch]",
    "layer": "install",
}
"""What the one line names that a command prints where packages or headers lack."""

LIST_ITEM = re.compile(r"\s*(\d+\.|[-*])\s+")


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes
    ----------
    page : str
        Path of its page in the repository.
    line : int
    text : str
        In one line, without comment.
    """

    page: str
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"

    @property
    def words(self) -> list[str]:
        """The program and its arguments."""
        return shlex.split(self.text)

    @property
    def arguments(self) -> list[str] | None:
        """Arguments of `ocufilter`, if this command runs it."""
        if "ocufilter" not in self.text:
            return None
        words = self.words
        while words and (re.fullmatch(r"\w+=.*", words[0]) or words[0] in AS_ANOTHER):
            words = words[AS_ANOTHER.get(words[0], 1) :]
        if not words or Path(words[0]).name != "ocufilter":
            return None
        return [word for word in words[1:] if word != "&"]

    @property
    def ends(self) -> bool:
        """Whether it runs `ocufilter` until it ends, with files of `make_files`."""
        return (
            self.text.startswith("ocufilter ")
            and not self.is_one_of(ENDLESS)
            and "lab.example" not in self.text
        )

    @property
    def copies(self) -> bool:
        """Whether it copies a file of the installed package."""
        return self.text.startswith(("unit=", "install -D", "cp "))

    def is_one_of(self, patterns) -> bool:
        """Whether its arguments begin with one of the patterns."""
        return any(re.match(rf"ocufilter {pattern}", self.text) for pattern in patterns)

    def check(self, code: int, errors: str, *, may_lack: bool) -> None:
        """Check that a run succeeded, or said in a line what to install."""
        names = [name for pattern, name in LACKING.items() if self.is_one_of([pattern])]
        if code != 0 and may_lack and names:
            lines = errors.strip().splitlines()
            assert len(lines) == 1, f"{self}: {errors}"
            assert names[0] in lines[0], f"{self}: {errors}"
        else:
            assert code == 0, f"{self}: {self.text}\n{errors}"
        assert "Traceback" not in errors, f"{self}: {errors}"


AS_ANOTHER = {"sudo": 1, "env": 1, "runuser": 4}
"""Words before a command that run it as another account (`runuser -u NAME --`)."""


def _blocks(text: str):
    """Yield the first line's number and the lines of each block of commands."""
    fence, language, block, start, offset = "", "", [], 0, 0
    is_after_blank = True
    for number, line in enumerate([*text.split("\n"), ""], 1):
        opening = re.match(r"\s*(```+)(\w*)", line)
        if fence:
            if line.strip() == fence:
                if language in SHELLS:
                    yield start, block
                fence, block = "", []
            else:
                block.append(line.strip())
            continue
        if opening:
            fence, language = opening.groups()
            block, start = [], number + 1
            continue
        indent = len(line) - len(line.lstrip())
        if line.strip() and indent >= offset + 4 and (block or is_after_blank):
            start = start if block else number
            block.append(line.strip())
        else:
            if block:
                yield start, block
                block = []
            item = LIST_ITEM.match(line)
            if item:
                offset = len(item[0])
            elif line.strip() and indent == 0:
                offset = 0
        is_after_blank = not line.strip()


@cache
def commands_of(page: str) -> tuple[Command, ...]:
    """Return the commands of a page's blocks, in their order."""
    found = []
    for start, block in _blocks((ROOT / page).read_text(encoding="utf-8")):
        if block[0].startswith(OTHER):
            continue
        whole, first = "", start
        for number, line in enumerate(block, start):
            first = first if whole else number
            whole += line.removesuffix("\\")
            if not line.endswith("\\"):
                text = re.sub(r"(^|\s+)# .*", "", whole)
                found += [Command(page, first, text)] if text else []
                whole = ""
    return tuple(found)


def ways_in() -> dict[str, list[Command]]:
    """Return the commands of each way to use ocufilter on the page that lists them.

    A way is a heading, or bold text at the beginning of a line; the commands below a
    heading that contains others, such as "Service", end at the first of those.
    """
    lines = (ROOT / WAYS_PAGE).read_text(encoding="utf-8").split("\n")
    found: dict[str, list[Command]] = {}
    starts = []
    for number, line in enumerate(lines, 1):
        name = re.match(r"###? (.*)|\*\*(.*?)\.\*\*", line)
        if name:
            starts.append((number, name[1] or name[2]))
    for (start, name), (end, _) in pairwise([*starts, (len(lines), "")]):
        found[name] = [c for c in commands_of(WAYS_PAGE) if start < c.line < end]
    return found


def commands_of_help() -> list[Command]:
    """Return the examples in the docstrings of `clients`, which ``--help`` prints."""
    found = []
    for path in sorted((ROOT / "clients").rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            text = node.value if isinstance(node, ast.Constant) else None
            if not isinstance(text, str) or "\n" not in text:
                continue
            for block in re.split(r"\n\s*\n", text.replace("\\\n", " ").strip()):
                lines = [" ".join(line.split()) for line in block.split("\n")]
                if not lines[0].startswith("ocufilter "):
                    continue
                for line in lines:
                    if line.startswith(("ocufilter ", "python ")):
                        found.append(Command(name, node.lineno, line))
                    else:  # an option, on a line of its own
                        whole = f"{found.pop().text} {line}"
                        found.append(Command(name, node.lineno, whole))
    return found


def make_files(folder: Path) -> None:
    """Write the files that the commands of pages read, with tiny contents."""
    from tests.numerical.optiland_eye import FROZEN_FILES

    rows, columns = np.indices((36, 64))
    squares = (255 * ((rows // 6 + columns // 6) % 2)).astype(np.uint8)
    color = Image.fromarray(np.repeat(squares[..., None], 3, axis=2))
    millimeters = Image.fromarray(np.where(columns < 32, 800, 4000).astype(np.uint16))
    for kind, name, image in (("color", "rgb", color), ("depth", "depth", millimeters)):
        (folder / "room" / kind).mkdir(parents=True)
        image.save(folder / "room" / kind / "0.png")
        tum = folder / "rgbd_dataset_freiburg1_desk"
        (tum / name).mkdir(parents=True)
        image.resize((640, 480), Image.Resampling.NEAREST).save(tum / name / "1.0.png")
        (tum / f"{name}.txt").write_text(f"1.0 {name}/1.0.png\n")
    (folder / "photos").mkdir()
    for name in ("photo.jpg", "room.png", "photos/a.jpg"):
        color.save(folder / name)
    (folder / "eyes.csv").write_text("image,profile,pupil_mm\n*,me.json,3\n")
    np.save(folder / "room.npy", np.asarray(millimeters, np.float32) / 1000)
    np.save(folder / "scene.npy", np.repeat(squares[..., None], 4, 2) / np.float32(255))
    for name, sphere_dpt in (("eye", -2), ("me", -1), ("before", -4), ("after", 0)):
        body = {"kind": "prescription", "sphere_dpt": sphere_dpt}
        (folder / f"{name}.json").write_text(json.dumps(body))
    terms = "Z[2, 0] = 3.2\nZ[3, -1] = 0.25\n"
    (folder / "prescription.json").write_text(json.dumps(vision_prescription()))
    export = irx3_export(**{"Wavelength (nm)": "780"})
    (folder / "irx3_export.txt").write_text(export, encoding="utf-8")
    (folder / "eye.abp").write_text(f"Ap = 6.0\nWa = 555\n{terms}")
    eye = json.loads(FROZEN_FILES.read_text("utf-8"))["files"]["even asphere, centered"]
    (folder / "eye.zmx").write_text(eye["zmx"], encoding="utf-8")
    (folder / "optiland_eye.json").write_text(json.dumps(eye["json"]), encoding="utf-8")
    _write_videos(folder, color, millimeters)


def _write_videos(folder: Path, color: Image.Image, millimeters: Image.Image) -> None:
    import av

    for name, codec, pixels, image, source in (
        ("walk.mp4", "libx264", "yuv420p", color, "rgb24"),
        ("walk_depth.mkv", "ffv1", "gray16le", millimeters, "gray16le"),
    ):
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=25)
            stream.width, stream.height, stream.pix_fmt = *image.size, pixels
            frame = av.VideoFrame.from_ndarray(np.asarray(image), format=source)
            container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
