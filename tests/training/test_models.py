"""Networks: their sizes are the paper's, their layers stand where they should."""

import pytest
import torch
from torch import nn

from training.datasets import Recipe, draw
from training.models import ModelSettings, Network, Quadratic
from training.run_file import RunFileError, read_run
from training.tasks import DOMAINS


def _network(kind, *, width, n_inputs=47, n_outputs=27, task="discriminator"):
    settings = ModelSettings(kind=kind, width=width)
    return Network(task, n_inputs=n_inputs, n_outputs=n_outputs, settings=settings)


@pytest.mark.parametrize("kind", ["ours", "resnet", "ffn"])
@pytest.mark.parametrize(
    ("task", "n_in", "n_out", "width", "millions"),
    [("discriminator", 47, 27, 2000, 72), ("eye", 29, 45, 3500, 221)],
)
def test_parameter_counts_are_those_of_table_3(
    kind, task, n_in, n_out, width, millions
):
    with torch.device("meta"):
        network = _network(kind, width=width, n_inputs=n_in, n_outputs=n_out, task=task)
    assert network.n_parameters / 1e6 == pytest.approx(millions, rel=0.01)


def test_norm_follows_the_activation_and_precedes_the_shortcut():
    block = _network("ours", width=8).layers[0]
    kinds = [type(layer) for layer in block.body]
    assert kinds == [nn.Linear, nn.Mish, nn.LayerNorm] * 2 + [nn.Linear, nn.LayerNorm]
    assert [type(layer) for layer in block.shortcut] == [nn.Linear, nn.LayerNorm]
    assert [type(layer) for layer in block.head] == [nn.Mish, nn.LayerNorm]
    shortcuts = [type(b.shortcut) for b in _network("ours", width=8).layers[:6]]
    assert shortcuts == [nn.Sequential, nn.Identity, nn.Identity] * 2


def test_scaling_is_part_of_the_network():
    network = _network("ours", width=8).eval().double()
    x, y = (torch.randn(500, n, dtype=torch.float64) for n in (47, 27))
    x, y = 3.0 + 2.0 * x, 1.0 + 4.0 * y
    network.fit_scaling(x, y)
    x_mean, x_scale = x.mean(dim=0), x.std(dim=0, correction=0)
    y_mean, y_scale = y.mean(dim=0), y.std(dim=0, correction=0)
    plain = network.layers((x - x_mean) / x_scale)
    torch.testing.assert_close(network(x), plain * y_scale + y_mean)
    wanted = (y - y_mean) / y_scale
    torch.testing.assert_close(network.to_standard(x, y), wanted)


def test_a_quadratic_form_is_found_at_once():
    x = torch.randn(2000, 6)
    y = torch.stack([1.0 + x[:, 0] * x[:, 1], x[:, 2] ** 2 - x[:, 3]], dim=1)
    form = Quadratic(6, 2)
    form.fit(x, y)
    fresh = torch.randn(50, 6)
    wanted = torch.stack(
        [1.0 + fresh[:, 0] * fresh[:, 1], fresh[:, 2] ** 2 - fresh[:, 3]], dim=1
    )
    torch.testing.assert_close(form(fresh), wanted, atol=1e-4, rtol=1e-4)


def test_layers_learn_what_the_quadratic_form_leaves():
    settings = ModelSettings(width=8, baseline="quadratic")
    network = Network("focus", n_inputs=4, n_outputs=1, settings=settings).eval()
    x = torch.randn(3000, 4)
    y = x[:, :1] * x[:, 1:2] + 0.01 * torch.sin(5.0 * x[:, 2:3])
    network.fit_scaling(x, y)
    left = network.to_standard(x, y) * network.output_scale
    assert left.abs().max() < 0.03
    for parameter in network.layers[-1].parameters():
        torch.nn.init.zeros_(parameter)
    assert (network(x) - y).abs().max() < 0.03


def test_mixed_precision_spares_the_optics_and_the_quadratic_form():
    settings = ModelSettings(width=16, features="physical", baseline="quadratic")
    network = Network("discriminator", n_inputs=47, n_outputs=27, settings=settings)
    recipe = Recipe("on_axis", 2000, 2000, seed=3)
    x = draw(recipe, 0)
    x, y = (torch.from_numpy(part).float() for part in (x, DOMAINS["on_axis"].label(x)))
    network.fit_scaling(x, y)
    network.train()
    exact_um = network(x).detach()
    network.is_mixed = True
    layers_alone_um = (network(x) - exact_um).abs().mean()
    with torch.autocast("cpu", torch.bfloat16):
        all_of_it_um = (network(x) - exact_um).abs().mean()
    left_by_the_form_um = (exact_um - y).abs().mean()
    # measured: 0.0001, 0.026 and 0.0037 um
    assert 0.0 < layers_alone_um < 0.1 * left_by_the_form_um < 0.1 * all_of_it_um
    network.eval()
    torch.testing.assert_close(network(x), exact_um)


def test_a_bounded_network_keeps_to_its_range():
    settings = ModelSettings(width=8)
    network = Network(
        "eye", n_inputs=27, n_outputs=45, settings=settings, is_bounded=True
    )
    network.fit_scaling(1e-3 * torch.randn(100, 27), torch.randn(100, 45))
    network.set_output_range(torch.full((45,), 3.0), torch.full((45,), 7.0))
    started = network(torch.randn(64, 27))
    assert torch.all(torch.abs(started - 5.0) < 0.5)  # in the middle of its range
    network.layers[-1].weight.data *= 1e3
    found = network(1e3 * torch.randn(64, 27))
    assert 3.0 <= found.min() < 3.5 < 6.5 < found.max() <= 7.0


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('task = "moon"', "allowed are discriminator"),
        ('task = "eye"\n[training]\nloss = "physical"', "allowed are parameters"),
        (
            'task = "focus"\n[model]\nwidth = "wide"',
            "model.width 'wide': must be of type int",
        ),
        ('task = "focus"\n[model]\ndepth = 3', "model.depth: allowed are kind"),
        ('task = "focus"\n[model]\nkind = "svm"', "kind 'svm': allowed are ours"),
        ('task = "focus"\n[data]\nn_rows = 0', "must be positive"),
        ('task = "focus"\n[data]', "n_rows"),
        (
            'task = "focus"\n[data]\ndomain = "focus"',
            "data.domain 'focus': the task 'focus' needs 'lens'",
        ),
        ("task = ", "Invalid value"),
        ("a = " + "[" * 5000, "not TOML"),
        ('task = ["eye"]', "task ['eye']: must be of type str"),
        ('task = "eye"\ntraining = 3', "training 3: must be of type dict"),
        ('task = "focus"\n[data]\nfolder = 3', "data.folder 3: must be of type str"),
        ('task = "focus"\n[model]\nwidth = false', "model.width False: must be"),
    ],
)
def test_a_run_file_that_is_wrong_says_where(tmp_path, text, says):
    file = tmp_path / "run.toml"
    file.write_text(text)
    with pytest.raises(RunFileError, match=says.replace("[", r"\[")):
        read_run(file)
