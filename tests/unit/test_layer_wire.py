"""Messages of the OpenXR layer have the same layout in C and in Python."""

import ctypes
import subprocess

import pytest

from clients.openxr_layer import wire
from tests.native_build import COMPILER
from tests.source_tree import ROOT

STRUCTURES = {
    "wire_hello": wire.Hello,
    "wire_welcome": wire.Welcome,
    "wire_memory": wire.Memory,
    "wire_image": wire.Image,
    "wire_view": wire.View,
    "wire_quad": wire.QuadLayer,
    "wire_frame": wire.Frame,
    "wire_result": wire.Result,
}
CONSTANTS = {
    "WIRE_MAGIC": wire.MAGIC,
    "WIRE_VERSION": wire.VERSION,
    "WIRE_HELLO": wire.HELLO,
    "WIRE_WELCOME": wire.WELCOME,
    "WIRE_MEMORY": wire.MEMORY,
    "WIRE_FRAME": wire.FRAME,
    "WIRE_RESULT": wire.RESULT,
    "WIRE_SRGB8": wire.SRGB8,
    "WIRE_LINEAR8": wire.LINEAR8,
    "WIRE_LINEAR16F": wire.LINEAR16F,
    "WIRE_LINEAR10": wire.LINEAR10,
    "WIRE_HAS_HEAD": wire.HAS_HEAD,
    "WIRE_HAS_GAZE": wire.HAS_GAZE,
    "WIRE_IS_BLENDED": wire.IS_BLENDED,
    "WIRE_TOP_FIRST": wire.TOP_FIRST,
    "WIRE_IS_BGR": wire.IS_BGR,
    "WIRE_IS_UNPREMULTIPLIED": wire.IS_UNPREMULTIPLIED,
    "WIRE_QUADS": wire.N_QUADS,
    "WIRE_QUAD_PIXELS": wire.MAX_QUAD_PIXELS,
}


@pytest.mark.skipif(COMPILER is None, reason="no C compiler")
def test_c_and_python_agree(tmp_path):
    lines = ["#include <stddef.h>", "#include <stdio.h>", '#include "wire.h"']
    lines.append("int main(void) {")
    expected = []
    for name, structure in STRUCTURES.items():
        lines.append(f'printf("%zu\\n", sizeof({name}));')
        expected.append(ctypes.sizeof(structure))
        for member in (own[0] for own in structure._fields_):
            lines.append(f'printf("%zu\\n", offsetof({name}, {member}));')
            expected.append(getattr(structure, member).offset)
    for name, value in CONSTANTS.items():
        lines.append(f'printf("%llu\\n", (unsigned long long){name});')
        expected.append(value)
    source = tmp_path / "layout.c"
    source.write_text("\n".join([*lines, "return 0;", "}"]))
    program = tmp_path / "layout"
    folder = ROOT / "clients/openxr_layer/source"
    subprocess.run(
        [COMPILER, f"-I{folder}", str(source), "-o", str(program)], check=True
    )
    found = subprocess.run([str(program)], check=True, capture_output=True, text=True)
    assert list(map(int, found.stdout.split())) == expected


@pytest.mark.parametrize("data", [b"", b"\1", bytes(4), bytes(10_000), b"\4\0\0\0" * 9])
def test_other_messages_are_refused(data):
    with pytest.raises(ValueError, match="unknown message"):
        wire.parsed(data)
