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
        module: The unbound module, which is applied with its own part of the variables.
        args: Positional arguments of the call.
        kwargs: Keyword arguments of the call, such as `train=False`.
        output: Result of the call.
    """

    module: nn.Module
    args: tuple[Any, ...]
    kwargs: Mapping[str, Any]
    output: Any


def module_calls(run: Callable[[], Any], depth: int = 1) -> dict[str, ModuleCall]:
    """Records the calls of a model's submodules while it runs.

    Args:
        run: Function that applies or initializes a model; it may be traced.
        depth: Maximum depth of the submodules; 1 for the direct submodules of the model.

    Returns:
        Calls by the path of the submodule in the parameters, such as "backbone", or
        "backbone/stem" with depth 2, in the order in which their first calls end. Of a
        submodule that is called several times, the last call is kept.

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
