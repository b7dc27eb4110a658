"""What a run of the kit measures, in order of worth, and how long each may take."""

from dataclasses import dataclass
from pathlib import Path

BENCHES = "tests.benchmarks"
KIT = "tests.gpu_kit."
TEXTURE_TESTS = (
    "tests/numerical/test_textures.py",
    "tests/numerical/test_waiting_textures.py",
    "tests/end_to_end/test_texture_filter.py",
)
SHARING_TESTS = ("tests/end_to_end/test_shared_textures.py",)


@dataclass(frozen=True)
class Step:
    """One program of the kit.

    Attributes
    ----------
    name : str
        Of its files, and in goals.json.
    what : str
        What it measures, in a few words.
    module : str
    words : tuple of str
        Arguments.
    full, quick : tuple of str
        More of them at full size, or with small frames.
    limit_s : float
        It is ended then, unless this is a quick run.
    is_json : bool
        Whether it prints one JSON object.
    rows_file : str
        Where it keeps rows as they come, for a run that is ended early.
    needs_torch : bool
    """

    name: str
    what: str
    module: str
    limit_s: float
    words: tuple[str, ...] = ()
    full: tuple[str, ...] = ()
    quick: tuple[str, ...] = ()
    is_json: bool = True
    rows_file: str = ""
    needs_torch: bool = False

    def command(self, *, is_quick: bool) -> tuple[str, ...]:
        """Return module and arguments."""
        return (self.module, *self.words, *(self.quick if is_quick else self.full))


def all_steps(tree: Path) -> tuple[Step, ...]:
    """Return every step of a run, in order."""
    return (
        Step("machine", "what is here", KIT + "machine", limit_s=15.0),
        Step(
            "gpu",
            "frames at 720p, in textures and arrays",
            BENCHES,
            limit_s=75.0,
            words=("gpu", "--json", "--views", "1280x720"),
            quick=("--quick",),
            rows_file="out/gpu_rows.jsonl",
        ),
        Step(
            "stereo",
            "the same of two eyes at 1832x1920",
            BENCHES,
            limit_s=95.0,
            words=("gpu", "--json", "--views", "2 x 1832x1920"),
            quick=("--quick",),
            rows_file="out/gpu_rows.jsonl",
        ),
        Step(
            "tests",
            "tests marked gpu",
            "pytest",
            limit_s=30.0,
            words=("-q", "-m", "gpu", *gpu_test_files(tree)),
            is_json=False,
        ),
        Step(
            "textures",
            "tests of frames in textures",
            "pytest",
            limit_s=35.0,
            words=("-q", *TEXTURE_TESTS),
            is_json=False,
        ),
        Step(
            "sharing",
            "tests of textures between processes",
            "pytest",
            limit_s=25.0,
            words=("-q", *SHARING_TESTS),
            is_json=False,
        ),
        Step(
            "headset",
            "a headset's frames, in textures and arrays, and by a service",
            BENCHES,
            limit_s=55.0,
            words=("headset", "--json"),
            full=("--sizes", "1832x1920"),
            quick=("--quick",),
            rows_file="out/headset_rows.jsonl",
        ),
        Step(
            "periphery",
            "merging that follows the gaze",
            BENCHES,
            limit_s=20.0,
            words=("periphery", "--json", "--quick"),
        ),
        Step(
            "training",
            "a data set, a short training",
            KIT + "short_training",
            limit_s=40.0,
            full=("tests/gpu_kit/short.toml",),
            quick=("tests/gpu_kit/quick.toml",),
            needs_torch=True,
        ),
    )


def gpu_test_files(tree: Path) -> list[str]:
    """Files with tests that need a hardware GPU: the others need not be read."""
    found = (tree / "tests").glob("*/test_*.py")
    return sorted(
        str(path.relative_to(tree))
        for path in found
        if "@pytest.mark.gpu" in path.read_text(encoding="utf-8")
    )
