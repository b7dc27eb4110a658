"""Every variant of every pass through glslang, the reference compiler of GLSL.

    make check
    python -m tests.shader_check

As OpenGL has it, and as SPIR-V for OpenGL, which spirv-val then looks at: two judges
that are no driver's.  Where they are neither on the path nor in .gl_witness/glslang
(`sh tests/gl_witness/setup.sh glslang`), it says so and leaves it at that.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from filter_service.gl.passes import load_shader
from tests.shader_variants import Variant, all_variants
from tests.source_tree import ROOT

FETCHED = ROOT / ".gl_witness" / "glslang" / "usr" / "bin"
PLACE = re.compile(r"^(ERROR|WARNING): (\d+):(\d+): ", flags=re.MULTILINE)

SPIRV = ("-G", "--auto-map-locations")
"""SPIR-V wants a location for each uniform; OpenGL gives them out itself."""


@dataclass(frozen=True)
class Compilers:
    """Paths of glslangValidator and spirv-val."""

    glslang: str
    spirv_val: str

    @classmethod
    def found(cls) -> "Compilers | None":
        """Those on the path, or else those that were fetched."""
        path = os.pathsep.join((os.environ.get("PATH", ""), str(FETCHED)))
        glslang = shutil.which("glslangValidator", path=path)
        spirv_val = shutil.which("spirv-val", path=path)
        return cls(glslang, spirv_val) if glslang and spirv_val else None


def complaints(
    text: str, files: list[str], compilers: Compilers, stage: str = "comp"
) -> list[str]:
    """What the compilers have to say about a shader, by the names of its files."""
    with tempfile.TemporaryDirectory() as folder:
        source, binary = Path(folder) / f"pass.{stage}", Path(folder) / "pass.spv"
        source.write_text(text, encoding="utf-8")
        runs = (
            (compilers.glslang, source),
            (compilers.glslang, *SPIRV, "-o", binary, source),
            (compilers.spirv_val, "--target-env", "opengl4.5", binary),
        )
        for command in runs:
            ran = subprocess.run(command, capture_output=True, text=True, check=False)
            said = (ran.stdout + ran.stderr).replace(str(source), "").strip()
            if ran.returncode or "WARNING" in said:
                return [PLACE.sub(lambda at: _named(at, files), said)]
    return []


def _named(at: re.Match, files: list[str]) -> str:
    return f"{at[1]}: {files[int(at[2])]}:{at[3]}: "


def check(variant: Variant, compilers: Compilers) -> list[str]:
    """What is wrong with a variant."""
    defines = dict(variant.defines)
    text, files = load_shader(variant.path, **defines)
    said = complaints(text, files, compilers, variant.stage)
    return [f"{variant}\n{line}" for line in said]


def main() -> int:
    """Print what is wrong, and how many variants were looked at."""
    compilers = Compilers.found()
    if compilers is None:
        print("shaders: glslangValidator and spirv-val are missing; not checked")
        return 0
    variants = all_variants()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        answers = pool.map(lambda variant: check(variant, compilers), variants)
        wrong = [said for answer in answers for said in answer]
    print(*wrong, sep="\n", end="\n" if wrong else "")
    passes = len({variant.name for variant in variants})
    print(f"shaders: {len(variants)} variants of {passes} passes, {len(wrong)} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
