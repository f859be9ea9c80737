"""Inputs and outputs of the modules that a detector calls."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import flax.linen as nn


@dataclasses.dataclass(frozen=True)
class ModuleCall:
    """One call of a module.

    Attributes:
        module: The unbound module; apply it with its own part of the variables.
        args: Arrays of the call.
        kwargs: Other arguments, such as `train=False`.
        output: Result of the call.
    """

    module: nn.Module
    args: tuple[Any, ...]
    kwargs: Mapping[str, Any]
    output: Any


def module_calls(run: Callable[[], Any], depth: int = 1) -> dict[str, ModuleCall]:
    """The calls of a model's parts while it runs, by their names in the parameters.

    Args:
        run: Applies or initializes a model, also while it is traced.
        depth: Most levels of parts: 1 for those of the model itself.

    Returns:
        In the order in which the calls end: "backbone", "neck", "heads", and with depth
        2 "backbone/stem"; the last call of a part that is called several times.

    Examples:
        >>> calls = module_calls(lambda: model.apply(variables, projection))  # doctest: +SKIP
        >>> calls["neck"].output.shape  # doctest: +SKIP
        (1, 256, 112, 128)
    """
    found: dict[str, ModuleCall] = {}

    def record(call: Callable[..., Any], args: Any, kwargs: Any, context: Any) -> Any:
        output = call(*args, **kwargs)
        path = context.module.path
        if context.method_name == "__call__" and 1 <= len(path) <= depth:
            module = context.module.clone(parent=None)
            found["/".join(path)] = ModuleCall(module, args, kwargs, output)
        return output

    with nn.intercept_methods(record):
        run()
    return found
