"""The eye as a layer of PyTorch: gradients, batches, workers and the same results."""

import copy
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from filter_service import (
    Camera,
    EyeBank,
    EyeFilter,
    FilterSettings,
    RgbdView,
    image_derivatives,
)
from ocufilter.torch import SeeThrough
from tests.source_tree import ROOT

SETTINGS = FilterSettings(mode="on-axis", eye_model="wavefront")
STATE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
WIDTH, HEIGHT = 12, 8
CAMERA = Camera.from_fov(1.0, width_px=WIDTH, height_px=HEIGHT)
DEPTH_M = np.where(np.arange(WIDTH) < 6, 0.4, 3.0) * np.ones((HEIGHT, 1))
DEPTH_M = DEPTH_M.astype(np.float32)


@pytest.fixture(scope="module")
def see():
    module = SeeThrough("myopia", CAMERA, DEPTH_M, **STATE, settings=SETTINGS)
    yield module
    module.close()


def rand(*batch, seed=0, **more):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*batch, 3, HEIGHT, WIDTH, generator=generator, **more)


def test_images_are_those_of_the_filter(see):
    color = rand(2)
    with EyeFilter("myopia", CAMERA, SETTINGS) as eye_filter:
        for own, image in zip(color, see(color), strict=True):
            seen = eye_filter.filter(
                own.permute(1, 2, 0).numpy().copy(),
                DEPTH_M,
                **STATE,
                output="linear",
                merge=False,
                bright_pixels=False,
                whole=True,
            )
            wanted = seen.color.transpose(2, 0, 1)
            np.testing.assert_allclose(image.numpy(), wanted, rtol=2e-6, atol=1e-6)
    assert (see(color) - color).abs().max() > 0.05  # it is blurred


def test_each_sample_may_have_another_eye_of_a_bank(tmp_path):
    people = [
        {"kind": "prescription", "sphere_dpt": sphere_dpt, "age_years": 30.0}
        for sphere_dpt in (-1.0, -3.0)
    ]
    settings = SETTINGS.changed(
        pupil_range_mm=(4.0, 4.0), focus_range_dpt=(0.5, 0.5), object_range_dpt=(0.3, 3)
    )
    bank = EyeBank.build(tmp_path / "bank", people, CAMERA, settings, workers=1)
    color, images = rand(), []
    see = SeeThrough(bank[0], CAMERA, DEPTH_M, **STATE, settings=settings, worker=False)
    for profile in (*bank, people[0]):
        see.profile = profile
        images.append(see(color))
    see.close()
    other = SeeThrough(people[1], CAMERA, DEPTH_M, **STATE, settings=settings)
    torch.testing.assert_close(images[1], other(color), rtol=0.0, atol=0.0)
    other.close()
    torch.testing.assert_close(images[2], images[0], rtol=0.0, atol=0.0)
    assert (images[1] - images[0]).abs().max() > 0.01


@pytest.mark.parametrize("method", ["A", "A_adjoint"])
def test_gradients_by_the_image(see, method):
    """The map is linear: steps may be long, which float32 needs."""
    given = rand(2, dtype=torch.float64).requires_grad_()
    function = getattr(see, method)
    torch.autograd.gradcheck(function, given, eps=1e-2, atol=1e-4, rtol=1e-4)


def test_second_derivatives_by_the_image(see):
    """Of the square of A x: twice A' A."""
    x, v = rand(seed=1).requires_grad_(), rand(seed=2)
    (first,) = torch.autograd.grad(see(x).square().sum(), x, create_graph=True)
    (second,) = torch.autograd.grad(first, x, v)
    torch.testing.assert_close(second, 2.0 * see.A_adjoint(see.A(v)))


def test_items_of_a_batch_do_not_depend_on_each_other(see):
    color = rand(2, 3)
    images = see(color)
    assert images.shape == color.shape
    for index in np.ndindex(2, 3):
        assert torch.equal(images[index], see(color[index]))
    assert torch.equal(images, see(color))
    assert see(rand(0)).shape == (0, 3, HEIGHT, WIDTH)
    assert torch.equal(see(color.to(memory_format=torch.channels_last_3d)), images)


def test_types_stay(see):
    assert see(rand(dtype=torch.float64)).dtype == torch.float64
    half = see(rand().half())
    assert half.dtype == torch.float16
    torch.testing.assert_close(half.float(), see(rand()), atol=2e-3, rtol=0.0)


def test_least_squares_restore_what_the_eye_transmits(see):
    color = rand(2)
    image = see(color)
    found = see.A_dagger(image, max_iter=200, tol=1e-7)
    assert not found.requires_grad
    errors = [(see(x) - image).norm() / image.norm() for x in (found, image)]
    assert errors[0] < 0.01 * errors[1]
    few = see.A_dagger(image, max_iter=2)
    assert (see(few) - image).norm() > 10.0 * (see(found) - image).norm()


def test_a_hidden_layer_has_colors_of_its_own():
    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    view = RgbdView(black, DEPTH_M, CAMERA.tangents)
    hidden_m = np.where(DEPTH_M < 1.0, np.float32(3.0), np.float32(0.0))
    view = replace(view, hidden_color=black, hidden_depth_m=hidden_m)
    layers = SeeThrough("myopia", CAMERA, view, **STATE, settings=SETTINGS)
    color = rand(2, 2).requires_grad_()
    image = layers(color)
    assert image.shape == (2, 3, HEIGHT, WIDTH)
    image.sum().backward()
    assert color.grad.shape == color.shape
    assert (color.grad != 0).any(dim=(0, 2, 3, 4)).all()
    layers.close()


def test_other_depth_and_states_make_another_operator(see):
    own = copy.deepcopy(see)
    color = rand()
    first, operator = own(color), own.operator()
    assert own.operator() is operator
    own.pupil_diameter_mm = 3.0
    assert not torch.equal(own(color), first)
    own.pupil_diameter_mm = 4.0
    own.depth_m = np.full_like(DEPTH_M, 0.33)  # in focus
    assert (own(color) - color).abs().max() < (first - color).abs().max()
    own.depth_m = DEPTH_M
    assert torch.equal(own(color), first)
    own.close()


def test_a_pickled_module_returns_the_same(see):
    color = rand()
    other = pickle.loads(pickle.dumps(see))
    assert torch.equal(other(color), see(color))
    other.close()


class Pictures(Dataset):
    def __init__(self, see, colors):
        self.see, self.colors = see, colors

    def __len__(self):
        return len(self.colors)

    def __getitem__(self, index):
        color = self.colors[index].clone().requires_grad_()
        image = self.see(color)
        image.square().sum().backward()
        return torch.stack([image.detach(), color.grad])


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_return_the_same(see, method):
    pictures = Pictures(see, rand(4))
    wanted = torch.stack(list(pictures))  # the filter is open before workers start
    loader = DataLoader(pictures, 2, num_workers=2, multiprocessing_context=method)
    assert torch.equal(torch.cat(list(loader)), wanted)


def test_other_shapes_and_types_raise(see):
    with pytest.raises(ValueError, match=r"\(\.\.\., 3, 8, 12\), got \(8, 12, 3\)"):
        see(torch.zeros(HEIGHT, WIDTH, 3))
    with pytest.raises(ValueError, match=r"floats in linear light, got torch\.uint8"):
        see(torch.zeros(3, HEIGHT, WIDTH, dtype=torch.uint8))
    with pytest.raises(ValueError, match="in linear light, got float32"):
        see(np.zeros((3, HEIGHT, WIDTH), np.float32))


def test_gradients_by_pupil_and_focus(see):
    """Of a batch, against differences of the filter's images."""
    own = copy.deepcopy(see)
    own.render_tolerance = 0.0
    own.focus_dpt = torch.nn.Parameter(torch.tensor(3.2))
    own.pupil_diameter_mm = torch.tensor(4.0, requires_grad=True)
    assert [name for name, _ in own.named_parameters()] == ["focus_dpt"]
    color = rand(2)
    own(color).square().sum().backward()
    exact = copy.deepcopy(see)
    exact.render_tolerance = 0.0

    def loss(**state):
        for name, value in {
            "pupil_diameter_mm": 4.0,
            "focus_dpt": 3.2,
            **state,
        }.items():
            setattr(exact, name, value)
        return float(exact(color).double().square().sum())

    for name, step in (("pupil_diameter_mm", 0.05), ("focus_dpt", 0.05)):
        value = getattr(own, name).item()
        high, low = (loss(**{name: value + k * step}) for k in (1, -1))
        slope = float(getattr(own, name).grad)
        assert slope == pytest.approx((high - low) / (2.0 * step), rel=0.05)
    own.focus_dpt.grad = None
    own.pupil_diameter_mm = 4.0
    color.requires_grad_()
    own(color).sum().backward()
    assert color.grad.abs().sum() > 0.0
    own.close()
    exact.close()


def test_fine_gradients_are_those_of_fine_derivatives():
    settings = replace(SETTINGS, chromatic=False)
    depth_m = np.full((HEIGHT, WIDTH), 0.2, np.float32)
    own = SeeThrough(
        *("myopia", CAMERA, depth_m), **STATE, settings=settings, accuracy="fine"
    )
    own.pupil_diameter_mm = torch.tensor(4.0, requires_grad=True)
    color = rand()
    own(color).square().sum().backward()
    with EyeFilter("myopia", CAMERA, settings) as eye_filter:
        slopes = image_derivatives(
            eye_filter,
            color.permute(1, 2, 0).numpy().copy(),
            *(depth_m, ["pupil_diameter_mm"]),
            **STATE,
            accuracy="fine",
        )
    slope = torch.from_numpy(slopes["pupil_diameter_mm"]).permute(2, 0, 1)
    wanted = float((2.0 * own(color).detach() * slope).sum())
    assert float(own.pupil_diameter_mm.grad) == pytest.approx(wanted, rel=1e-4)
    own.close()


def test_training_finds_the_focus():
    """That makes a near target sharp: 3.7 dpt, as a scan of the focus shows."""
    depth_m = np.full_like(DEPTH_M, 0.25)
    start = torch.nn.Parameter(torch.tensor(3.3))
    state = {"pupil_diameter_mm": 4.0, "focus_dpt": start}
    see = SeeThrough("emmetropia", CAMERA, depth_m, **state, settings=SETTINGS)
    optimizer = torch.optim.Adam(see.parameters(), lr=0.1)
    color = rand()
    losses = []
    for _ in range(8):
        optimizer.zero_grad()
        loss = (see(color) - color).square().sum()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert start.item() == pytest.approx(3.7, abs=0.3)
    assert min(losses) < 0.2 * losses[0]
    see.close()


def test_the_examples_of_the_page_run(capsys):
    text = (ROOT / "docs/how-to/gradients.md").read_text(encoding="utf-8")
    names = {}
    for example in re.findall(r"```py(?:thon)?\n(.*?)```", text, re.DOTALL):
        exec(compile(example, "gradients.md", "exec"), names)
    assert capsys.readouterr().out == "True\n(32, 48, 3) True\n"
    assert names["x"].grad.abs().sum() > 0.0
    assert abs(names["focus_dpt"].item() - 1.5) > 0.01  # a step of the optimizer
    names["see"].close()
