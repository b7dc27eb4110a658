"""What Vulkan's validation layers say about our frames, beneath zink.

Two runs, for the two exclude each other: one watches that what a command writes is
ordered before what reads it (synchronization), one that no pass leaves its buffers
(GPU-assisted: the layer rewrites each pass to look).  Each is proved first on a fault,
see `between.c`, so that no message means something.
"""

import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from tests.gl_witness.drivers import FETCHED, Driver, environment
from tests.source_tree import ROOT

SOURCE = Path(__file__).with_name("between.c")
OUR_LAYER = "VK_LAYER_OCUFILTER_between"
MANIFEST = """{"file_format_version": "1.1.2", "layer": {
 "name": "%s", "type": "GLOBAL", "library_path": "%s", "api_version": "1.1.0",
 "implementation_version": "1", "description": "ocufilter's gl-witness"}}
"""

WATCHES = {
    "synchronization": "SYNCHRONIZATION_VALIDATION_EXT",
    "GPU-assisted": "GPU_ASSISTED_EXT,"
    "VK_VALIDATION_FEATURE_ENABLE_GPU_ASSISTED_RESERVE_BINDING_SLOT_EXT",
}
SETTINGS = """khronos_validation.enables = VK_VALIDATION_FEATURE_ENABLE_{enables}
khronos_validation.debug_action = VK_DBG_LAYER_ACTION_LOG_MSG
khronos_validation.log_filename = {log}
khronos_validation.report_flags = error,warn,info
khronos_validation.enable_message_limit = false
"""

LEVELS = "ERROR|WARN|INFO"
MESSAGE = re.compile(rf"^([A-Z][\w.\- ]+)\(({LEVELS}) / \w+\): (.*)$", re.MULTILINE)
ENABLED = re.compile(r"Current Enables: (.*)\.$", re.MULTILINE)

FAULTS = {
    "synchronization": "SYNC-HAZARD-READ-AFTER-WRITE",
    "GPU-assisted": "VUID-vkCmdDispatch-None-02706",
}
"""Kinds of message about the deliberate faults."""

OF_ZINK = re.compile(
    "|".join(
        (
            r"vkCmdCopyBuffer: Hazard WRITE_AFTER_WRITE for dstBuffer .*prior_usage: "
            r"SYNC_COMPUTE_SHADER_SHADER_STORAGE_WRITE, write_barriers: 0",
            r"vkCmdDispatch: Hazard WRITE_AFTER_WRITE for .*prior_usage: "
            r"SYNC_COPY_TRANSFER_WRITE, write_barriers: .*SHADER_STORAGE_READ",
        )
    )
)
"""WORK, sent anew between two passes that read it.  zink declares all buffers of a pass
as one array, so the layer takes each for written where one is; zink knows better, and
orders the copy after a read and the read after the copy.  With a buffer of its own for
each list of work there is no message."""


@dataclass(frozen=True)
class Messages:
    """What the layers said of one process.

    Attributes
    ----------
    enabled : str
        What they say they watch.
    counts : dict
        Errors and warnings by kind.
    of_zink : int
        Further ones, that zink's way of declaring buffers makes: `OF_ZINK`.
    examples : dict
        The first of each kind, its beginning.
    """

    enabled: str
    counts: dict[str, int]
    of_zink: int
    examples: dict[str, str]

    @classmethod
    def read(cls, log: str) -> "Messages":
        """Messages of a log."""
        every = [m for m in MESSAGE.findall(log) if m[1] != "INFO"]
        found = [m for m in every if not OF_ZINK.search(m[2])]
        examples = {kind: text[:600] for kind, _, text in reversed(found)}
        banner = ENABLED.search(log)
        return cls(
            enabled=banner[1] if banner else "",
            counts=dict(Counter(kind for kind, _, _ in found)),
            of_zink=len(every) - len(found),
            examples=examples,
        )


def build_layer() -> Path:
    """Compile `between.c`; its folder."""
    folder = FETCHED / "layer"
    folder.mkdir(exist_ok=True)
    library = folder / "libbetween.so"
    headers = FETCHED / "usr" / "include"
    compiler = ("cc", "-O1", "-shared", "-fPIC", "-I", headers)
    subprocess.run((*compiler, "-o", library, SOURCE), check=True)
    manifest = MANIFEST % (OUR_LAYER, library)
    (folder / "between.json").write_text(manifest, encoding="utf-8")
    return folder


def watched(
    watch: str, shaders: str, arguments: tuple[str, ...], **more: str
) -> Messages:
    """Run a module of ours with zink beneath the layers, and return what they said."""
    layers = FETCHED / "usr" / "share" / "vulkan" / "explicit_layer.d"
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        settings = SETTINGS.format(enables=WATCHES[watch], log=log)
        (Path(folder) / "vk_layer_settings.txt").write_text(settings, encoding="utf-8")
        chosen = {
            **environment(Driver("zink", shaders)),
            # the order of the layers is, by age of the loader, that of one of these
            "VK_LAYER_PATH": os.pathsep.join((str(build_layer()), str(layers))),
            "VK_INSTANCE_LAYERS": os.pathsep.join(
                (OUR_LAYER, "VK_LAYER_KHRONOS_validation")
            ),
            "VK_LAYER_SETTINGS_PATH": folder,
            "GL_WITNESS_SPIRV_OPT": str(FETCHED / "usr" / "bin" / "spirv-opt"),
            "GL_WITNESS_FOLDER": folder,
            "MESA_VK_VERSION_OVERRIDE": "1.2",  # dynamic rendering is part of 1.3
            # nothing that was compiled without the layers
            "MESA_SHADER_CACHE_DISABLE": "1",
            **more,
        }
        command = (sys.executable, "-m", *arguments)
        subprocess.run(command, cwd=ROOT, env=chosen, check=True)
        return Messages.read(log.read_text(encoding="utf-8", errors="replace"))


def prove(watch: str, frames: tuple[str, ...]) -> Messages:
    """What the layers say of a deliberate fault.

    Raises
    ------
    RuntimeError
        They do not see it: what they say of other frames then means nothing.
    """
    if watch == "synchronization":
        said = watched(watch, "hardware", frames, GL_WITNESS_DROP_BARRIERS="1")
    else:
        said = watched(watch, "hardware", ("tests.gl_witness.out_of_bounds",))
    wanted = WATCHES[watch].split("_EXT")[0]
    if FAULTS[watch] not in said.counts or wanted not in said.enabled:
        raise RuntimeError(
            f"the layers do not see a deliberate fault ({watch}): {said}"
        )
    return said
