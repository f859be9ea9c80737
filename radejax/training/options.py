"""Options of the training and its logs: the sections `config.train` and `config.logging`."""

from __future__ import annotations

from typing import Literal

import pydantic

from radejax.core.errors import require
from radejax.core.options import (
    AtLeastOne,
    BelowOne,
    Count,
    NotNegative,
    Options,
    Positive,
    find_function,
)

_KNOWN = {"optimizer": ("adamw",), "schedule": ("cosine", "cyclic_cosine")}


class TrainOptions(Options, section="config.train"):
    """Batches, learning rate, checkpoints and evaluations of a training."""

    batch_size: AtLeastOne = 10
    """Frames per step over all devices."""
    num_epochs: AtLeastOne = 10
    """Passes over the training data, unless `max_steps` is given."""
    max_steps: AtLeastOne | None = None
    """Steps of the training, however many epochs they take. None: those of `num_epochs`."""
    optimizer: str = "adamw"
    """adamw (with torch's defaults, as in the paper) or module:function."""
    learning_rate: Positive = 1e-3
    """Peak learning rate."""
    final_learning_rate: NotNegative = 1e-4
    """Final learning rate, at most the peak."""
    schedule: str = "cosine"
    """Learning rate per step: cosine (decreases once, over the training), cyclic_cosine
    (decreases in one epoch and increases in the next, as released) or module:function."""
    weight_decay: NotNegative = 0.01
    """Weight decay on every parameter."""
    freeze: tuple[str, ...] = ()
    """Parts or parameters that are not trained: patterns of their paths, such as
    "backbone/encoder*"; empty: none but those that the model freezes."""
    warmup_steps: Count = 0
    """Steps of a linear warm-up from 0; fewer than the steps of the training."""
    gradient_clip_norm: Positive | None = None
    """Global norm to which the gradient is clipped; None: not clipped."""
    ema_decay: BelowOne | None = None
    """Decay per step of the exponential moving average of the parameters; None: no
    average."""
    gradient_accumulation_steps: AtLeastOne = 1
    """Batches per update of the parameters."""
    parameter_sharding: Literal["replicated", "fsdp"] = "replicated"
    """replicated, or fsdp to shard the parameters over the devices."""
    log_every_steps: AtLeastOne = 20
    """Steps between logged metrics."""
    checkpoint_every_steps: AtLeastOne = 500
    """Steps between checkpoints."""
    checkpoints_to_keep: AtLeastOne | None = 2
    """Number of newest checkpoints that are kept; None: all."""
    evaluate_every_epochs: Count = 0
    """Epochs between evaluations; 0: only after the training."""
    best_metric: str = "map_3d_iou30"
    """Metric that selects the best checkpoint: a mean over classes in the first
    protocol."""
    max_skipped_steps: Count = 20
    """The run stops after more than this number of consecutive steps whose loss or
    gradient is not finite."""
    hooks: tuple[str, ...] = ()
    """Functions module:function that are called after every step."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> TrainOptions:
        final = self.final_learning_rate
        peak = self.learning_rate
        expected = f"at most config.train.learning_rate, {peak}"
        require(final <= peak, "config.train.final_learning_rate", final, expected)
        for name, known in _KNOWN.items():
            value = getattr(self, name)
            is_name = value in known or ":" in value
            expected = f"{' or '.join(known)} or module:function"
            require(is_name, f"config.train.{name}", value, expected)
        return self

    def find_functions(self) -> None:
        """Imports the optimizer, the schedule and the hooks that are named as module:function.

        Raises:
            UserError: One of them cannot be imported.
        """
        for name in ("optimizer", "schedule", "hooks"):
            value = getattr(self, name)
            for place in (value,) if isinstance(value, str) else value:
                if place not in _KNOWN.get(name, ()):
                    find_function(place, f"config.train.{name}")


class LoggingOptions(Options, section="config.logging"):
    """Logs of a training in addition to `metrics.jsonl` and TensorBoard."""

    num_visualizations: Count = 4
    """Number of figures of fixed frames at every evaluation during training."""
    wandb: bool = False
    """Log to Weights & Biases in addition to TensorBoard."""
    wandb_project: str = "radejax"
    """Project at Weights & Biases."""
    profile_steps: tuple[Count, Count] = (2, 5)
    """First and last step of a profiler trace (`--profile`), counted from the step at
    which the command starts or continues."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> LoggingOptions:
        first, last = self.profile_steps
        expected = "two integers, the first not above the last"
        require(
            first <= last, "config.logging.profile_steps", self.profile_steps, expected
        )
        return self
