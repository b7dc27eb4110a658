"""The eye as a layer of PyTorch: gradients, batches, workers and the same results."""

import copy
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from estimator import thread_count
from filter_service import (
    Camera,
    EyeBank,
    EyeFilter,
    FilterSettings,
    RgbdView,
    image_derivatives,
)
from ocufilter.torch import SeeThrough
from tests.loader_workers import SeenPictures, digest, loaded_by_torch
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


EYES = [{"kind": "prescription", "sphere_dpt": -1.0}, "emmetropia"]
PUPILS_MM, FOCI_DPT = [4.0, 3.0], torch.tensor([0.5, 1.0])
DEPTHS_M = np.stack([DEPTH_M, DEPTH_M[:, ::-1]])
MANY = {"pupil_diameter_mm": PUPILS_MM, "focus_dpt": FOCI_DPT, "settings": SETTINGS}


@pytest.fixture(scope="module")
def two():
    """Return a module with two eyes, states and depths."""
    module = SeeThrough(EYES, CAMERA, DEPTHS_M, **MANY, worker=False)
    yield module
    module.close()


def single(see, number):
    """Return a module with the parameters of one of the items."""
    return SeeThrough(
        *(EYES[number], CAMERA, np.ascontiguousarray(DEPTHS_M[number])),
        pupil_diameter_mm=PUPILS_MM[number],
        focus_dpt=FOCI_DPT[number].item(),
        settings=SETTINGS,
        worker=False,
    )


@pytest.mark.parametrize("method", ["A", "A_adjoint", "A_dagger"])
def test_items_of_a_batch_may_have_eyes_states_and_depths_of_their_own(two, method):
    color = rand(2, 2)
    images = getattr(two, method)(color)
    for number in range(2):
        one = single(two, number)
        assert torch.equal(images[number], getattr(one, method)(color[number]))
        assert not torch.equal(
            images[1 - number], getattr(one, method)(color[1 - number])
        )
        one.close()
    assert torch.equal(getattr(two, method)(color), images)
    assert torch.equal(getattr(pickle.loads(pickle.dumps(two)), method)(color), images)


def test_depth_may_be_a_tensor(two):
    """As loaders return it."""
    color, own = rand(2), copy.deepcopy(two)
    own.depth_m = torch.from_numpy(np.ascontiguousarray(DEPTHS_M))
    assert torch.equal(own(color), two(color))
    assert own.operator(1) is own.operator(1)
    own.profile, own.pupil_diameter_mm, own.focus_dpt = EYES[0], 4.0, 0.5
    own.depth_m = torch.from_numpy(DEPTH_M)
    assert torch.equal(own(color)[0], two(color)[0])
    own.close()


def test_operators_of_items_are_kept_until_their_parameters_change(two):
    first = [two.operator(number) for number in range(2)]
    own = copy.deepcopy(two)
    for parameters, n_kept in (({}, 2), ({"pupil_diameter_mm": [4.0, 4.0]}, 1)):
        for name, value in parameters.items():
            setattr(two, name, value)
        again = [two.operator(number) for number in range(2)]
        assert sum(a is b for a, b in zip(first, again, strict=True)) == n_kept
    two.pupil_diameter_mm = PUPILS_MM
    with pytest.raises(IndexError):
        two.operator(2)
    own.close()


@pytest.mark.parametrize("shape", [(2, 3), (2, 1)])
@pytest.mark.parametrize("method", ["A", "A_adjoint"])
def test_gradients_of_two_eyes_by_the_image(two, method, shape):
    given = rand(2)[:, : shape[1]].double().requires_grad_()
    function = getattr(two, method)
    torch.autograd.gradcheck(function, given, eps=1e-2, atol=1e-4, rtol=1e-4)


def test_gradients_of_two_eyes_by_their_foci(two):
    """They are those of each eye, also if the next sample comes before `backward`."""
    color = rand(2, seed=4)
    foci_dpt = torch.tensor([3.2, 3.4], requires_grad=True)
    own = copy.deepcopy(two)
    own.focus_dpt = foci_dpt
    loss = own(color).square().sum()
    own.focus_dpt, own.profile = FOCI_DPT, EYES[::-1]
    own(color)
    loss.backward()
    own.close()
    for number in range(2):
        one = single(two, number)
        one.focus_dpt = foci_dpt[number].detach().requires_grad_()
        one(color[number]).square().sum().backward()
        torch.testing.assert_close(one.focus_dpt.grad, foci_dpt.grad[number])
        assert abs(one.focus_dpt.grad) > 0.01
        one.close()


def test_wrong_parameters_name_their_item(two):
    color = rand(2)
    for name, values, message in (
        (
            "pupil_diameter_mm",
            [4.0, 40.0],
            r"samples\[1\].pupil_diameter_mm: it is 40.0",
        ),
        ("focus_dpt", torch.tensor([-1.0, 1.0]), r"samples\[0\].focus_dpt: it is -1.0"),
        ("profile", ["myopia", "no such eye"], r"samples\[1\]: .*no such eye"),
        ("profile", ["myopia", {"kind": "new"}], r"samples\[1\]: .*new"),
        ("profile", EYES[:1], "same items, got profile of 1, depth_m of 2"),
        ("profile", [], "same items, got profile of 0"),
    ):
        own = copy.deepcopy(two)
        setattr(own, name, values)
        with pytest.raises(ValueError, match=message):
            own(color)
        own.close()
    for wrong in (rand(), rand(3), rand(1, 2)):
        with pytest.raises(ValueError, match=r"expected a batch of 2 items"):
            two(wrong)


def test_gray_images_are_the_luminance_of_three_channels(see):
    gray = rand(2)[:, :1].clone()
    image = see(gray)
    assert image.shape == gray.shape
    with EyeFilter("myopia", CAMERA, SETTINGS) as eye_filter:
        for own, found in zip(gray, image, strict=True):
            seen = eye_filter.filter(
                np.repeat(own.permute(1, 2, 0).numpy(), 3, axis=2),
                DEPTH_M,
                **STATE,
                output="linear",
                merge=False,
                bright_pixels=False,
                whole=True,
            )
            wanted = seen.color @ np.array([0.2126, 0.7152, 0.0722], np.float32)
            np.testing.assert_allclose(found[0].numpy(), wanted, rtol=2e-6, atol=1e-6)
    assert torch.equal(see(gray[0]), image[0])
    assert torch.equal(see(gray[0, 0]), image[0, 0])
    found = see.A_dagger(image, max_iter=100, tol=1e-7)
    assert (see(found) - image).norm() < 0.02 * image.norm()


def test_gradients_of_gray_images_by_focus(see):
    """Of the luminance of three channels that are the same."""
    own, slopes = copy.deepcopy(see), []
    weights = torch.tensor([0.2126, 0.7152, 0.0722])[:, None, None]
    own.profile = "emmetropia"  # the other does not accommodate at these distances
    gray = rand()[:1]
    for color, weighed in ((gray, 1.0), (gray.expand(3, HEIGHT, WIDTH), weights)):
        own.focus_dpt = torch.tensor(3.2, requires_grad=True)
        image = (own(color) * weighed).sum(dim=0)
        image.square().sum().backward()
        slopes.append(own.focus_dpt.grad)
    torch.testing.assert_close(*slopes, rtol=1e-4, atol=0.0)
    assert abs(slopes[0]) > 0.1
    own.close()


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


class Process(Dataset):
    """Threads of a process, and whether another one estimates its eyes."""

    def __len__(self):
        return 2

    def __getitem__(self, index):
        with EyeFilter(engine="native") as eye_filter:
            has_process = eye_filter.builder.worker.has_process
        return torch.tensor([thread_count(), has_process])


@pytest.mark.parametrize(
    ("method", "variable", "count"),
    [("fork", "", 1), ("spawn", "", 1), ("fork", "2", 2)],
)
def test_workers_use_one_thread_and_no_other_process(
    monkeypatch, method, variable, count
):
    monkeypatch.setenv("OCUFILTER_THREADS", variable)
    loader = DataLoader(Process(), num_workers=1, multiprocessing_context=method)
    assert torch.cat(list(loader)).tolist() == [[count, False]] * 2


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_return_the_same(see, method):
    pictures = Pictures(see, rand(4))
    wanted = torch.stack(list(pictures))  # the filter is open before workers start
    loader = DataLoader(pictures, 2, num_workers=2, multiprocessing_context=method)
    assert torch.equal(torch.cat(list(loader)), wanted)


@pytest.mark.parametrize("n_workers", [1, 2])
def test_workers_return_the_images_of_a_filter(n_workers):
    color = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    states = [STATE, STATE | {"pupil_diameter_mm": 3.0}] * 4
    pictures = SeenPictures((color, DEPTH_M), CAMERA, SETTINGS, EYES * 4, states)
    found = loaded_by_torch(pictures, "fork", n_workers)
    assert found["images"] == digest([pictures[number][1] for number in range(8)])
    assert found["processes"] == found["workers"] == n_workers


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
    own.profile, own.render_tolerance = "emmetropia", 0.0
    own.focus_dpt = torch.nn.Parameter(torch.tensor(3.2))
    own.pupil_diameter_mm = torch.tensor(4.0, requires_grad=True)
    assert [name for name, _ in own.named_parameters()] == ["focus_dpt"]
    color = rand(2)
    own(color).square().sum().backward()
    exact = copy.deepcopy(see)
    exact.profile, exact.render_tolerance = "emmetropia", 0.0

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
        assert abs(slope) > 0.1
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


def test_the_lines_of_the_page_of_ways_run():
    text = (ROOT / "docs/how-to/choose.md").read_text(encoding="utf-8")
    (python, *_) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (lines,) = re.findall(r"```py\n(import torch.*?)```", text, re.DOTALL)
    names = {}
    exec(compile(python, "choose.md", "exec"), names)
    exec(compile(lines, "choose.md", "exec"), names)
    assert names["light"].grad.abs().sum() > 0.0
    names["see"].close()
