"""Networks: the paper's modified ResNet, the original one, and a plain network.

Csoba & Kunkli 2023, section 5.3 and Table 3. Inputs and outputs are in physical units:
networks include their scaling.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from training.features import make_features

KINDS = ("ours", "resnet", "ffn")
BLOCKS_PER_STACK = 3
LAYERS_PER_BLOCK = 3
LAYER_NORM_EPSILON = 1e-3

SMALL_WEIGHT = 1e-3
FIT_CHUNK = 8192
FIT_RIDGE = 1e-7
"""Ridge of the quadratic form, against nearly collinear features."""


@dataclass(frozen=True)
class ModelSettings:
    """Architecture of a network.

    Attributes
    ----------
    kind : {"ours", "resnet", "ffn"}
        Mish, followed by layer norm, which also precedes the shortcut's addition; ReLU
        preceded by batch norm (Chen et al.); a sequence of dense layers with batch norm
        and ReLU.
    width : int
        Neurons of every hidden layer.
    n_stacks : int
        Stacks of one dense and two identity blocks each; a plain network has as many
        layers.
    features : {"raw", "physical"}
        See `features`.
    baseline : {"none", "quadratic"}
        Whether the layers learn the residual of a quadratic form of the features.
    """

    kind: str = "ours"
    width: int = 256
    n_stacks: int = 2
    features: str = "raw"
    baseline: str = "none"

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind '{self.kind}': allowed are {', '.join(KINDS)}")
        if self.width < 1 or self.n_stacks < 1:
            raise ValueError(
                f"width {self.width}, n_stacks {self.n_stacks}: both at least 1"
            )
        for name, allowed in (
            ("features", ("raw", "physical")),
            ("baseline", ("none", "quadratic")),
        ):
            if getattr(self, name) not in allowed:
                raise ValueError(
                    f"{name} '{getattr(self, name)}': allowed are {allowed}"
                )


def _dense(n_in: int, n_out: int) -> nn.Linear:
    layer = nn.Linear(n_in, n_out)
    nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
    nn.init.zeros_(layer.bias)
    return layer


class MishBlock(nn.Module):
    """{dense, Mish, norm} twice, {dense, norm}, plus the shortcut; then Mish, norm.

    The shortcut is {dense, norm} if ``is_dense``, otherwise the input itself.
    """

    def __init__(self, n_in: int, width: int, *, is_dense: bool):
        super().__init__()

        def norm() -> nn.Module:
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
        """Map (N, n_in) to (N, width)."""
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
        """Map (N, n_in) to (N, width)."""
        return torch.relu(self.body(x) + self.shortcut(x))


def _residual(
    block: type[MishBlock] | type[ReluBlock], n_in: int, width: int, n_stacks: int
) -> list[nn.Module]:
    """Return stacks of a block with a dense shortcut and two with an identity."""
    return [
        block(width if stack or k else n_in, width, is_dense=k == 0)
        for stack in range(n_stacks)
        for k in range(BLOCKS_PER_STACK)
    ]


def _plain(n_in: int, width: int, n_stacks: int) -> list[nn.Module]:
    """Return as many dense layers as the residual networks have, shortcuts included."""
    n_layers = n_stacks * (BLOCKS_PER_STACK * LAYERS_PER_BLOCK + 1) - 1
    layers = []
    for k in range(n_layers):
        layers += [_dense(width if k else n_in, width), nn.BatchNorm1d(width)]
        layers.append(nn.ReLU())
    return layers


class Quadratic(nn.Module):
    """A quadratic form of standardized features, fitted by least squares.

    It is not trained further: for 27 outputs and 53 features it has 40,000 weights, for
    which least squares are much faster than training.
    """

    def __init__(self, n_features: int, n_outputs: int):
        super().__init__()
        first, second = torch.triu_indices(n_features, n_features)
        self.register_buffer("first", first, persistent=False)
        self.register_buffer("second", second, persistent=False)
        n_terms = 1 + n_features + len(first)
        self.register_buffer("weight", torch.zeros(n_terms, n_outputs))

    def terms(self, x: Tensor) -> Tensor:
        """Return one, features and their products (N, n_terms)."""
        products = x[:, self.first] * x[:, self.second]
        return torch.cat([torch.ones_like(x[:, :1]), x, products], dim=1)

    def forward(self, x: Tensor) -> Tensor:
        """Return outputs (N, n_outputs) for standardized features (N, n_features)."""
        return self.terms(x) @ self.weight

    @torch.no_grad()
    def fit(self, x: Tensor, y: Tensor) -> None:
        """Fit by least squares to rows (N, n_features), (N, n_outputs)."""
        n_terms = len(self.weight)
        square = torch.zeros(n_terms, n_terms, dtype=torch.float64)
        right = torch.zeros(n_terms, y.shape[1], dtype=torch.float64)
        for part, wanted in zip(x.split(FIT_CHUNK), y.split(FIT_CHUNK), strict=True):
            terms = self.terms(part)
            square += (terms.T @ terms).double()
            right += (terms.T @ wanted).double()
        ridge = FIT_RIDGE * len(x) * torch.eye(n_terms, dtype=torch.float64)
        self.weight.copy_(torch.linalg.solve(square + ridge, right))


class Network(nn.Module):
    """A network in physical units: features, standardization, layers, scaled outputs.

    Parameters
    ----------
    task : str
        One of `tasks.TASKS`.
    n_inputs, n_outputs : int
    settings : ModelSettings
    is_bounded : bool
        Final tanh, so that outputs stay in a range: for the eye estimator.

    Attributes
    ----------
    is_mixed : bool
        In training, compute the layers in bfloat16 where that is safe.
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
        self.features = make_features(
            settings.features, task=task, n_inputs=n_inputs, n_outputs=n_outputs
        )
        n_features, n_encoded = self.features.n_features, self.features.n_encoded
        width = settings.width
        if settings.kind == "ffn":
            layers = _plain(n_features, width, settings.n_stacks)
        else:
            block = MishBlock if settings.kind == "ours" else ReluBlock
            layers = _residual(block, n_features, width, settings.n_stacks)
        self.layers = nn.Sequential(*layers, _dense(width, n_encoded))
        self.is_mixed = False
        self.bound = nn.Tanh() if is_bounded else nn.Identity()
        if is_bounded:  # start at the center of the range, where tanh is not saturated
            nn.init.uniform_(self.layers[-1].weight, -SMALL_WEIGHT, SMALL_WEIGHT)
        is_quadratic = settings.baseline == "quadratic"
        self.baseline = Quadratic(n_features, n_encoded) if is_quadratic else None
        for name, size in (("input", n_features), ("output", n_encoded)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))

    @torch.no_grad()
    def fit_scaling(self, x: Tensor, y: Tensor) -> None:
        """Fit scales, and the baseline, to rows (N, n_inputs), (N, n_outputs)."""
        self.input_mean.copy_(torch.zeros(()))
        self.input_scale.copy_(torch.ones(()))
        features = self.features(x)
        encoded = self.features.encode(x, y, features)
        _set_scaling(self.input_mean, self.input_scale, features)
        if self.baseline is not None:
            standard = self._standard(features)
            self.baseline.fit(standard, encoded)
            encoded = encoded - self.baseline(standard)
        _set_scaling(self.output_mean, self.output_scale, encoded)

    @torch.no_grad()
    def set_output_range(self, low: Tensor, high: Tensor) -> None:
        """Map -1 and 1 to these outputs (n_outputs,): for a bounded network."""
        self.output_mean.copy_((low + high) / 2.0)
        self.output_scale.copy_((high - low) / 2.0)

    def _standard(self, features: Tensor) -> Tensor:
        return (features - self.input_mean) / self.input_scale

    def _start(self, standard: Tensor) -> Tensor:
        """Return the encoded values to which the layers' outputs are added."""
        if self.baseline is None:
            return self.output_mean
        return self.output_mean + self.baseline(standard)

    @torch.no_grad()
    def _wanted(self, x: Tensor, y: Tensor, features: Tensor) -> Tensor:
        encoded = self.features.encode(x, y, features)
        return (encoded - self._start(self._standard(features))) / self.output_scale

    def to_standard(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the layers' targets (N, n_encoded), in standard units."""
        return self._wanted(x, y, self.features(x))

    def standard_error(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the layers' errors (N, n_encoded), in standard units."""
        features = self.features(x)
        found = self._through_layers(self._standard(features))
        return found - self._wanted(x, y, features)

    def _through_layers(self, standard: Tensor) -> Tensor:
        """Return the outputs (N, n_encoded) of the layers.

        If ``is_mixed``, the layers are in bfloat16 during training. The optics and the
        quadratic form are not: layers could not learn the error of an 8-bit mantissa.
        """
        if not (self.is_mixed and self.training):
            return self.bound(self.layers(standard))
        with torch.autocast(standard.device.type, torch.bfloat16):
            found = self.layers(standard)
        return self.bound(found.float())

    def forward(self, x: Tensor) -> Tensor:
        """Map physical inputs (N, n_inputs) to physical outputs (N, n_outputs)."""
        features = self.features(x)
        standard = self._standard(features)
        y = self._through_layers(standard) * self.output_scale
        return self.features.decode(x, y + self._start(standard), features)

    @property
    def n_parameters(self) -> int:
        """Return the number of fitted weights, including those of the baseline."""
        fitted = 0 if self.baseline is None else self.baseline.weight.numel()
        return fitted + sum(p.numel() for p in self.parameters())


def _set_scaling(mean: Tensor, scale: Tensor, rows: Tensor) -> None:
    """Set mean and deviation of columns; 1 for a constant column."""
    rows = rows.double()
    deviation = rows.std(dim=0, correction=0)
    mean.copy_(rows.mean(dim=0))
    scale.copy_(torch.where(deviation > 1e-12, deviation, 1.0))
