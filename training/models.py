"""The networks: the paper's modified ResNet, the one it came from, and a plain one.

Csoba & Kunkli 2023, section 5.3 and Table 3.  A network stands between two scalings,
so that physical units go in and come out.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from training.features import make_features

KINDS = ("ours", "resnet", "ffn")
BLOCKS_PER_STACK = 3
LAYERS_PER_BLOCK = 3
LAYER_NORM_EPSILON = 1e-3


@dataclass(frozen=True)
class ModelSettings:
    """What a network is made of.

    Attributes
    ----------
    kind : {"ours", "resnet", "ffn"}
        Mish, and layer norm after it and before the shortcut joins; ReLU and batch
        norm before it (Chen et al.); dense layers with batch norm and ReLU in a row.
    width : int
        Neurons of every hidden layer.
    n_stacks : int
        Of one dense and two identity blocks each; a plain network has as many layers.
    features : {"raw", "physical"}
        See `features`.
    """

    kind: str = "ours"
    width: int = 256
    n_stacks: int = 2
    features: str = "raw"

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(f"kind '{self.kind}': allowed are {', '.join(KINDS)}")
        if self.width < 1 or self.n_stacks < 1:
            raise ValueError(
                f"width {self.width}, n_stacks {self.n_stacks}: both at least 1"
            )
        if self.features not in ("raw", "physical"):
            raise ValueError(
                f"features '{self.features}': allowed are raw and physical"
            )


def _dense(n_in: int, n_out: int) -> nn.Linear:
    layer = nn.Linear(n_in, n_out)
    nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
    nn.init.zeros_(layer.bias)
    return layer


class MishBlock(nn.Module):
    """{dense, Mish, norm} twice, {dense, norm}, plus the shortcut; then Mish, norm.

    The shortcut is {dense, norm} where ``is_dense``, else the input itself.
    """

    def __init__(self, n_in: int, width: int, *, is_dense: bool):
        super().__init__()

        def norm():
            return nn.LayerNorm(width, eps=LAYER_NORM_EPSILON)

        self.body = nn.Sequential(
            *(_dense(n_in, width), nn.Mish(), norm()),
            *(_dense(width, width), nn.Mish(), norm()),
            *(_dense(width, width), norm()),
        )
        self.shortcut = (
            nn.Sequential(_dense(n_in, width), norm()) if is_dense else nn.Identity()
        )
        self.head = nn.Sequential(nn.Mish(), norm())

    def forward(self, x: Tensor) -> Tensor:
        """Block (N, n_in) to (N, width)."""
        return self.head(self.body(x) + self.shortcut(x))


class ReluBlock(nn.Module):
    """{dense, batch norm, ReLU} twice, {dense, batch norm}, shortcut; then ReLU."""

    def __init__(self, n_in: int, width: int, *, is_dense: bool):
        super().__init__()
        self.body = nn.Sequential(
            *(_dense(n_in, width), nn.BatchNorm1d(width), nn.ReLU()),
            *(_dense(width, width), nn.BatchNorm1d(width), nn.ReLU()),
            *(_dense(width, width), nn.BatchNorm1d(width)),
        )
        self.shortcut = (
            nn.Sequential(_dense(n_in, width), nn.BatchNorm1d(width))
            if is_dense
            else nn.Identity()
        )

    def forward(self, x: Tensor) -> Tensor:
        """Block (N, n_in) to (N, width)."""
        return torch.relu(self.body(x) + self.shortcut(x))


def _residual(block, n_in: int, width: int, n_stacks: int) -> list[nn.Module]:
    """Stacks of a block with a dense shortcut and two with an identity."""
    return [
        block(width if stack or k else n_in, width, is_dense=k == 0)
        for stack in range(n_stacks)
        for k in range(BLOCKS_PER_STACK)
    ]


def _plain(n_in: int, width: int, n_stacks: int) -> list[nn.Module]:
    """As many dense layers as the residual networks have, shortcuts included."""
    n_layers = n_stacks * (BLOCKS_PER_STACK * LAYERS_PER_BLOCK + 1) - 1
    layers = []
    for k in range(n_layers):
        layers += [_dense(width if k else n_in, width), nn.BatchNorm1d(width)]
        layers.append(nn.ReLU())
    return layers


class Network(nn.Module):
    """A network in physical units: features, standardised, layers, scaled outputs.

    Parameters
    ----------
    task : str
        One of `tasks.TASKS`.
    n_inputs, n_outputs : int
    settings : ModelSettings
    is_bounded : bool
        A last tanh, so that outputs stay in a range: the eye estimator's.
    """

    def __init__(
        self,
        task: str,
        *,
        n_inputs: int,
        n_outputs: int,
        settings: ModelSettings,
        is_bounded: bool = False,
    ):
        super().__init__()
        self.features = make_features(settings.features, task=task, n_inputs=n_inputs)
        n_features, width = self.features.n_features, settings.width
        if settings.kind == "ffn":
            layers = _plain(n_features, width, settings.n_stacks)
        else:
            block = MishBlock if settings.kind == "ours" else ReluBlock
            layers = _residual(block, n_features, width, settings.n_stacks)
        self.layers = nn.Sequential(*layers, _dense(width, n_outputs))
        self.bound = nn.Tanh() if is_bounded else nn.Identity()
        for name, size in (("input", n_features), ("output", n_outputs)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))

    def set_scaling(self, inputs: tuple, outputs: tuple) -> None:
        """Take mean and scale, arrays (n,), of features and of encoded outputs."""
        for name, values in (("input", inputs), ("output", outputs)):
            for part, array in zip(("mean", "scale"), values, strict=True):
                buffer = getattr(self, f"{name}_{part}")
                buffer.copy_(torch.as_tensor(array, dtype=buffer.dtype))

    def standard(self, x: Tensor) -> Tensor:
        """Return outputs (N, n_outputs) in standard units."""
        features = (self.features(x) - self.input_mean) / self.input_scale
        return self.bound(self.layers(features))

    def to_standard(self, x: Tensor, y: Tensor) -> Tensor:
        """Targets in the units of `standard`."""
        return (self.features.encode(x, y) - self.output_mean) / self.output_scale

    def forward(self, x: Tensor) -> Tensor:
        """Physical inputs (N, n_inputs) to physical outputs (N, n_outputs)."""
        y = self.standard(x) * self.output_scale + self.output_mean
        return self.features.decode(x, y)

    @property
    def n_parameters(self) -> int:
        """Number of trained parameters."""
        return sum(p.numel() for p in self.parameters())
