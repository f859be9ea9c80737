"""Program of the second process of `rival.py`, which runs the PyTorch networks."""

import functools
import multiprocessing.connection

import numpy as np
import torch
import torch_dinorade
import torch_radenet
from case import timed
from rival import ATTENTION
from torch_losses import Losses


def serve(address, key, device):
    """Builds and runs networks on request until None is received."""
    connection = multiprocessing.connection.Client(address, authkey=bytes.fromhex(key))
    connection.send(device == "cpu" or torch.cuda.is_available())
    torch.set_float32_matmul_precision("highest")
    calls = {}
    while (message := connection.recv()) is not None:
        kind, name, *arguments = message
        try:
            if kind == "build":
                calls.clear()
                calls.update(BUILDERS[name](device, *arguments))
                answer = list(calls)
            elif kind == "time":
                answer = timed(calls[name])
            else:
                answer = [x.detach().float().cpu().numpy() for x in calls[name]()]
        except Exception as error:  # the other process raises it
            answer = RuntimeError(f"torch, {name}: {error!r}")
        connection.send(answer)


def _tensors(state):
    return {name: torch.tensor(value) for name, value in state.items()}


def _channels_first(x):
    """Converts `[B, R, A, C]` to `[B, C, R, A]` with azimuth padded to a multiple of 8."""
    x = np.pad(x, ((0, 0), (0, 0), (0, -x.shape[2] % 8), (0, 0)))
    return np.ascontiguousarray(x.transpose(0, 3, 1, 2))


def _calls(device, network, dtype, losses, is_compiled, inputs):
    """Returns functions by column name that run a forward pass or a training step.

    A step is a forward pass, the gradient of the losses, and an AdamW update; it returns their
    plain weighted sum. `losses` is None for forward passes, or the arguments of `Losses`.
    """
    torch.backends.cuda.matmul.allow_tf32 = dtype == "tf32"
    torch.backends.cudnn.allow_tf32 = dtype == "tf32"
    torch.backends.cudnn.benchmark = True
    network = network.to(device)
    if device == "cuda":
        network = network.to(memory_format=torch.channels_last)
    inputs = [torch.tensor(x, device=device) for x in inputs]
    trained = [p for p in network.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, 1e-4, weight_decay=0.01)
    network.train(losses is not None)
    losses = losses and Losses(*losses, device)
    half = functools.partial(
        torch.autocast, device, torch.bfloat16, enabled=dtype == "bfloat16"
    )

    def forward(run):
        with torch.inference_mode(), half():
            outputs = run(*inputs)
        if device == "cuda":
            torch.cuda.synchronize()
        return outputs

    def step(run):
        optimizer.zero_grad(set_to_none=True)
        with half():
            outputs = run(*inputs)
        loss, weighted_sum = losses(*outputs)
        loss.backward()
        optimizer.step()
        if device == "cuda":
            torch.cuda.synchronize()
        return [weighted_sum]

    chosen = step if losses else forward
    networks = {"torch": network}
    if is_compiled and device == "cuda":
        networks["torch.compile"] = torch.compile(network)
    return {name: functools.partial(chosen, run) for name, run in networks.items()}


def radenet(device, config, state, projection, *how):
    """Builds RADE-Net; `how` is dtype, losses and is_compiled as in `_calls`."""
    network = torch_radenet.RadeNet(config)
    network.load_state_dict(_tensors(state))
    return _calls(device, network, *how, [_channels_first(projection)])


def dinorade(device, config, state, points, projection, image, *how):
    """Builds DinoRADE with its image backbone; `how` is as in `radenet`."""
    network = torch_dinorade.DinoRade(config, torch.tensor(points))
    network.load_state_dict(_tensors(state))
    return _calls(device, network, *how, [_channels_first(projection), image])


def attention(device, state, feature, scale, points, value):
    """Builds deformable attention, of which only the float32 forward pass is measured."""
    module = torch_dinorade.Attention(*ATTENTION)
    module.load_state_dict(_tensors(state))
    value = np.ascontiguousarray(value.transpose(0, 3, 1, 2))
    arrays = feature, scale, points[0], value
    calls = _calls(device, module, "float32", None, False, arrays)
    return {name: lambda call=call: [call()] for name, call in calls.items()}


BUILDERS = {"radenet": radenet, "dinorade": dinorade, "attention": attention}
