"""What the witnesses of the OpenGL renderer make of logs and pictures."""

import numpy as np
import pytest

from tests.gl_witness.compare import differences, summary
from tests.gl_witness.filter_frames import Filtered
from tests.gl_witness.layers import Messages

pytestmark = pytest.mark.tools

BANNER = """UNASSIGNED-khronos-validation-instance(INFO / SPEC): msgNum: 1 - Active:
    Current Enables: VK_VALIDATION_FEATURE_ENABLE_GPU_ASSISTED_EXT.
    Current Disables: None.

"""
BEYOND = (
    "VUID-vkCmdDispatch-None-02706(WARN / SPEC): msgNum: 2 - access out of bounds\n"
    "    Objects: 1\n"
)
SETUP = (
    "UNASSIGNED-GPU-Assisted Validation Setup Error.(ERROR / SPEC): msgNum: 3 - no\n"
)
HAZARD = (
    "SYNC-HAZARD-WRITE-AFTER-WRITE(ERROR / SPEC): msgNum: 4 - {command}: Hazard "
    "WRITE_AFTER_WRITE for {what} VkBuffer 0x5a[]. Access info (usage: {usage}, "
    "prior_usage: {prior}, write_barriers: {barriers}, command: x).\n"
)
STORAGE_WRITE = "SYNC_COMPUTE_SHADER_SHADER_STORAGE_WRITE"
STORAGE_READ = "SYNC_COMPUTE_SHADER_SHADER_STORAGE_READ"


def test_messages_are_counted_by_kind_without_what_informs():
    said = Messages.read(BANNER + BEYOND + SETUP + BEYOND)
    assert said.enabled == "VK_VALIDATION_FEATURE_ENABLE_GPU_ASSISTED_EXT"
    assert said.counts == {
        "VUID-vkCmdDispatch-None-02706": 2,
        "UNASSIGNED-GPU-Assisted Validation Setup Error.": 1,
    }
    assert "out of bounds" in said.examples["VUID-vkCmdDispatch-None-02706"]
    assert said.of_zink == 0


@pytest.mark.parametrize(
    ("barriers", "of_zink"), [("0", 0), (f"X|{STORAGE_READ}|Y", 1)]
)
def test_a_read_that_zink_has_ordered_is_its_own_and_one_that_it_has_not_is_ours(
    barriers, of_zink
):
    said = Messages.read(
        HAZARD.format(
            command="vkCmdDispatch",
            what="",
            usage=STORAGE_WRITE,
            prior="SYNC_COPY_TRANSFER_WRITE",
            barriers=barriers,
        )
    )
    assert said.of_zink == of_zink
    assert sum(said.counts.values()) == 1 - of_zink


def filtered(picture, **counts):
    return Filtered(
        counts={"frame": counts},
        stores={"frame": "same"},
        arrays={"frame": picture},
    )


def test_differences_are_in_light_and_name_the_counts():
    here, there = np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2, 3), np.uint8)
    there[0, 0, 0] = 51
    (frame,) = differences(
        filtered(here, entry_count=3, kernel_count=1),
        filtered(there, entry_count=4, kernel_count=1),
    )
    assert frame.largest == pytest.approx(0.2)
    assert frame.psnr_db == pytest.approx(-10 * np.log10(0.04 / 12), abs=0.1)
    assert frame.counts == {"entry_count": (3, 4)}
    assert not frame.is_none
    told = summary([frame])
    assert told["other entry_count"] == 1
    assert told["byte for byte"] == 0


def test_what_was_filtered_comes_back_from_its_file(tmp_path):
    sent = filtered(np.arange(12, dtype=np.uint8).reshape(2, 2, 3), entry_count=3)
    sent.save(tmp_path / "frames.npz")
    found = Filtered.load(tmp_path / "frames.npz")
    assert found.counts == sent.counts
    assert found.stores == sent.stores
    assert np.array_equal(found.arrays["frame"], sent.arrays["frame"])
    assert all(difference.is_none for difference in differences(found, sent))


def test_eyes_that_differ_are_not_compared():
    here, there = (filtered(np.zeros((1, 1, 3), np.uint8)) for _ in range(2))
    there.stores["frame"] = "another"
    with pytest.raises(ValueError, match="different things"):
        differences(here, there)
