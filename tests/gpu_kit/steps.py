"""What a run of the kit measures, in order of worth, and how long each may take."""

from dataclasses import dataclass
from pathlib import Path

BENCHES = "tests.benchmarks."
KIT = "tests.gpu_kit."
GL = ("--json", "--engine", "gl")
FIELD = ("--eyes", "myopia", "--sizes", "1280x720", "--scenes", "courtyard")
RADIUS = ("--json", "--plot", "--sweeps", "radius")


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
        Arguments; ``{pictures}`` stands for the folder of pictures.
    full, quick : tuple of str
        More of them at full size, or with small frames.
    limit_s : float
        It is ended then, unless this is a quick run.
    is_json : bool
        Whether it prints one JSON object.
    rows_file : str
        Where it keeps rows as they come, for a run that is ended early.
    pictures : tuple of str
        Pictures that it writes into the tree.
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
    pictures: tuple[str, ...] = ()
    needs_torch: bool = False

    def command(self, pictures: Path, *, is_quick: bool) -> tuple[str, ...]:
        """Return module and arguments."""
        words = (*self.words, *(self.quick if is_quick else self.full))
        return (self.module, *(word.format(pictures=pictures) for word in words))


def all_steps(tree: Path) -> tuple[Step, ...]:
    """Return every step of a run, in order."""
    return (
        Step("machine", "what is here", KIT + "machine", limit_s=60.0),
        Step(
            "compile",
            "numba's loops, once on a machine",
            "filter_service.filtering.compile_loops",
            limit_s=120.0,
            is_json=False,
        ),
        Step(
            "gpu",
            "frames at 720p",
            BENCHES + "bench_gpu",
            limit_s=80.0,
            words=("--json", "--views", "1280x720"),
            quick=("--quick",),
        ),
        Step(
            "stereo",
            "frames of two eyes at 1832x1920",
            BENCHES + "bench_gpu",
            limit_s=80.0,
            words=("--json", "--views", "2 x 1832x1920"),
            quick=("--quick",),
        ),
        Step(
            "tests",
            "tests marked gpu",
            "pytest",
            limit_s=60.0,
            words=("-q", "-m", "gpu", *gpu_test_files(tree)),
            is_json=False,
        ),
        Step(
            "render",
            "passes, beside the sorted gather",
            BENCHES + "bench_render",
            limit_s=90.0,
            words=GL,
            quick=("--quick",),
        ),
        Step(
            "pictures",
            "pictures through three eyes",
            KIT + "pictures",
            limit_s=40.0,
            words=("{pictures}", "--size"),
            full=("1280x720",),
            quick=("192x108",),
        ),
        Step(
            "switch",
            "from a profile to the first frame",
            BENCHES + "bench_switch",
            limit_s=70.0,
            words=("--json", "--mode", "dynamic", "--eyes", "keratoconus"),
            quick=("--quick",),
        ),
        Step(
            "training",
            "a data set, a short training",
            KIT + "short_training",
            limit_s=70.0,
            full=("tests/gpu_kit/short.toml",),
            quick=("tests/gpu_kit/quick.toml",),
            needs_torch=True,
        ),
        Step(
            "field",
            "rows at 720p against the dense reference",
            BENCHES + "bench_field",
            limit_s=90.0,
            words=(*GL, "--plot"),
            full=(*FIELD, "--methods", "ours"),
            quick=("--quick", "--methods", "ours on-axis", "ours dynamic"),
            rows_file="out/field_rows.jsonl",
            pictures=("out/field.png",),
        ),
        Step(
            "cost",
            "time against blur radius",
            BENCHES + "bench_cost",
            limit_s=70.0,
            words=RADIUS,
            quick=("--quick",),
            pictures=("out/cost.png",),
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
