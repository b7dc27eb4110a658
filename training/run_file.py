"""Run files: one TOML per network, with all parameters of its training."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from estimator.bounded_files import InvalidFile, read_text, read_toml
from training.datasets import Recipe
from training.models import ModelSettings
from training.tasks import TASKS

LOSSES = ("standard", "physical")
EYE_LOSSES = ("parameters", "discriminator", "tracer")
DEFAULT_FOLDER = Path("out/training")

MAX_RUN_BYTES = 100_000
_KINDS = {
    **{"task": str, "seed": int, "output_folder": str},
    **{"data": dict, "model": dict, "training": dict},
}
_FROM_FILE: Any = None


class RunFileError(ValueError):
    """A run file is invalid; the message has the key and the allowed values."""


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of a training.

    Attributes
    ----------
    loss : str
        ``standard``: mean absolute error of standardized targets; ``physical``: of um
        or mm. For the eye: ``parameters``, ``discriminator`` or ``tracer``.
    n_epochs : float
        Epochs over the training rows; may be a fraction.
    decay_per_epoch : float
        Factor of learning rate and weight decay.
    final_ratio : float
        Last part of the training, in which both fall to zero.
    validation_ratio : float
    is_mixed : bool
        bfloat16 products in the layers, on a GPU, until the final part.
    is_fresh : bool
        Draw and trace new rows for every step instead of reading shards.
    discriminator : str
        Checkpoint, for the eye's loss ``discriminator``.
    prior_weight : float
        Weight of the mean squared deviation from the mean eye of a refraction, in
        deviations of the prior, against an error in um: for the eye's losses by light.
    start_from : str
        Checkpoint with the initial weights of the network.
    """

    loss: str = "standard"
    batch_size: int = 1024
    n_epochs: float = 30.0
    learning_rate: float = 0.01
    weight_decay: float = 0.1
    decay_per_epoch: float = 0.8
    final_ratio: float = 0.0
    validation_ratio: float = 0.15
    is_mixed: bool = True
    is_fresh: bool = False
    discriminator: str = ""
    prior_weight: float = 0.0
    start_from: str = ""


@dataclass(frozen=True)
class Run:
    """A parsed run file; see the dataclasses of its tables."""

    name: str
    task: str
    seed: int = 548
    recipe: Recipe = _FROM_FILE
    data_folder: Path = _FROM_FILE
    output_folder: Path = _FROM_FILE
    model: ModelSettings = field(default_factory=ModelSettings)
    training: TrainingSettings = field(default_factory=TrainingSettings)
    text: str = ""


_Settings = TypeVar("_Settings", Recipe, ModelSettings, TrainingSettings)


def read_run(file: Path) -> Run:
    """Read and check a run file.

    Raises
    ------
    RunFileError
        The file is invalid; the message has the table, the key and the allowed values.
    """
    try:
        text = read_text(file, max_bytes=MAX_RUN_BYTES)
        body = read_toml(file, max_bytes=MAX_RUN_BYTES)
    except InvalidFile as error:
        raise RunFileError(str(error)) from None
    for key, kind in _KINDS.items():
        if not isinstance(body.get(key, kind()), kind):
            raise RunFileError(
                f"{key} {body[key]!r:.60}: must be of type {kind.__name__}"
            )
    _only(body, ("task", "seed", "output_folder", "data", "model", "training"), "")
    task = body.get("task")
    if task not in TASKS:
        raise RunFileError(f"task '{task}': allowed are {', '.join(TASKS)}")
    data = dict(body.get("data", {}))
    folder = data.pop("folder", "")
    if not isinstance(folder, str):
        raise RunFileError(f"data.folder {folder!r:.60}: must be of type str")
    domain = TASKS[task].domain.name
    if data.setdefault("domain", domain) != domain:
        raise RunFileError(
            f"data.domain '{data['domain']}': the task '{task}' needs '{domain}'"
        )
    training = _table(TrainingSettings, body.get("training", {}), "training")
    allowed = EYE_LOSSES if task == "eye" else LOSSES
    if training.loss not in allowed:
        raise RunFileError(
            f"training.loss '{training.loss}': allowed are {', '.join(allowed)}"
        )
    model = _table(ModelSettings, body.get("model", {}), "model")
    if "n_rows" not in data:
        raise RunFileError("data.n_rows: missing; expected the number of rows to draw")
    recipe = _table(Recipe, data, "data")
    return Run(
        name=file.stem,
        task=task,
        seed=body.get("seed", 548),
        recipe=recipe,
        data_folder=Path(folder) if folder else default_data_folder(recipe),
        output_folder=Path(body.get("output_folder", DEFAULT_FOLDER / file.stem)),
        model=model,
        training=training,
        text=text,
    )


def default_data_folder(recipe: Recipe) -> Path:
    """Return the default folder of a data set."""
    kind = "_population" if recipe.population_ratio else ""
    return DEFAULT_FOLDER / "data" / (recipe.domain + kind)


def _only(body: dict[str, Any], allowed: tuple[str, ...], table: str) -> None:
    for key in body:
        if key not in allowed:
            raise RunFileError(f"{table}{key}: allowed are {', '.join(allowed)}")


def _table(kind: type[_Settings], body: dict[str, Any], table: str) -> _Settings:
    known = {f.name: f for f in fields(kind)}
    _only(body, tuple(known), f"{table}.")
    for key, value in body.items():
        wanted: Any = known[key].type
        good = (int, float) if wanted is float else wanted
        if isinstance(value, bool) != (wanted is bool) or not isinstance(value, good):
            raise RunFileError(
                f"{table}.{key} {value!r:.60}: must be of type {wanted.__name__}"
            )
    try:
        return kind(**body)
    except ValueError as error:
        raise RunFileError(f"{table}: {error}") from error
