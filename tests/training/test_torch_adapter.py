"""The transform of the examples with PyTorch's own tensors and loader."""

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from filter_service import FilterSettings
from tests.source_tree import ROOT

SETTINGS = FilterSettings(mode="on-axis", eye_model="wavefront")


class Pictures(Dataset):
    def __init__(self, pictures, transform):
        self.pictures, self.transform = pictures, transform

    def __len__(self):
        return len(self.pictures)

    def __getitem__(self, index):
        return self.transform(self.pictures[index])


@pytest.fixture
def transform(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "adapters"))
    from ocufilter_torch import SeenThrough

    return SeenThrough(
        "myopia", vertical_fov_deg=10.0, distance_m=2.0, settings=SETTINGS
    )


@pytest.mark.parametrize("n_workers", [0, 2])
def test_a_loader_gives_what_arrays_give(transform, n_workers):
    rng = np.random.default_rng(4)
    arrays = rng.integers(0, 256, (6, 24, 32, 3), dtype=np.uint8)
    pictures = torch.from_numpy(arrays.transpose(0, 3, 1, 2).copy())
    loader = DataLoader(Pictures(pictures, transform), 3, num_workers=n_workers)
    seen = torch.cat(list(loader))
    assert seen.dtype == torch.uint8
    wanted = np.stack([transform(array) for array in arrays])
    np.testing.assert_array_equal(seen.numpy().transpose(0, 2, 3, 1), wanted)
    floats = transform(pictures[0].float() / 255.0)
    assert floats.dtype == torch.float32
    assert np.abs(255.0 * floats.numpy().transpose(1, 2, 0) - wanted[0]).max() < 0.511
