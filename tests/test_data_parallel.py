"""What devices exchange when they share a batch, for every kind of model.

One step of training is compiled for 1, 2, 4 and 8 devices. Each device has to compute its own
frames only, and to send no part of a frame to another.
"""

import functools
import math
import re

import chex
import jax
import optax
import pytest

from radejax import models
from radejax.config import Config
from radejax.core import devices
from radejax.inference.inputs import Settings
from radejax.training.step import create_state, make_train_step

from . import small_models

BATCH_SIZE = 16
COLLECTIVES = "all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter"
KINDS = {
    "radenet": {"neck": "dilated", "heads": "expanded"},
    "dinorade": {"image.freeze": True},
    "dinorade_not_frozen": {"image.freeze": False},
    "dinorade_resnet50": {"image.kind": "resnet50", "image.resnet_width": 4},
}
KEY = jax.random.key(7)


@functools.cache
def _case(kind):
    """Model, batch, state and step of one kind of model of small width."""
    has_camera = kind != "radenet"
    config = small_models.camera_config() if has_camera else small_models.radar_config()
    model = models.build(config.model.with_fields(KINDS[kind]))
    images = small_models.images(BATCH_SIZE) if has_camera else None
    batch = small_models.labeled_batch(small_models.projections(BATCH_SIZE), images)
    inputs = jax.tree.map(lambda x: x[:1], batch).model_inputs()
    variables = small_models.drawn(model, *inputs)
    # Gradient descent, because the optimizer's work on each device is that of one device.
    optimizer = optax.sgd(1e-3)
    state = create_state(variables, optimizer, use_ema=False, model=model)
    grid = models.map_grid(small_models.small_grid(), model, "true")
    step = make_train_step(model, optimizer, grid, loss=config.loss)
    return model, batch, state, step


@functools.cache
def _compiled(kind, num_devices, parameters="replicated"):
    """A step that is compiled for some devices, and its arguments on them."""
    _, batch, state, step = _case(kind)
    mesh = devices.make_mesh(num_devices)
    whole = devices.replicated(mesh)
    placement = devices.state_sharding(state, mesh, parameters, min_size=64)
    placed, key = jax.device_put(state, placement), jax.device_put(KEY, whole)
    arguments = placed, devices.put_batch(batch, mesh), key
    sharded = jax.jit(step, out_shardings=(placement, whole))
    return sharded.lower(*arguments).compile(), arguments


def _moved(program):
    """Numbers of elements of the arrays that devices exchange, by the kind of exchange."""
    moved = {kind: [] for kind in COLLECTIVES.split("|")}
    pattern = rf"= (.*?) ({COLLECTIVES})(?:-start)?\("
    for result, kind in re.findall(pattern, program.as_text()):
        for shape in re.findall(r"\w+\[([\d,]*)\]", result):
            moved[kind].append(math.prod(map(int, filter(None, shape.split(",")))))
    return moved


def _num_operations(program):
    return program.cost_analysis()["flops"]


@pytest.mark.parametrize(
    ("kind", "num_devices"),
    [
        ("radenet", 8),
        pytest.param("dinorade", 8, marks=pytest.mark.slow),
        pytest.param("dinorade", 2, marks=pytest.mark.slow),
        pytest.param("dinorade_not_frozen", 8, marks=pytest.mark.slow),
        pytest.param("dinorade_resnet50", 8, marks=pytest.mark.slow),
    ],
)
def test_devices_share_the_work_of_a_step_and_send_only_gradients(kind, num_devices):
    one, arguments = _compiled(kind, 1)
    program, shared = _compiled(kind, num_devices)
    moved = _moved(program)
    state = arguments[0]
    num_parameters = sum(x.size for x in jax.tree.leaves(state.params))
    # Besides the gradients: sums of losses and counts, and of batch normalization, whose
    # statistics are those of the whole batch.
    num_statistics = sum(x.size for x in jax.tree.leaves(state.model_state))
    others = sum(moved.pop("all-reduce")) - num_parameters
    assert 0 <= others <= 100 + 4 * num_statistics
    assert not any(moved.values()), moved
    share = _num_operations(program) / _num_operations(one)
    assert share <= 1.1 / num_devices
    expected, expected_metrics = one(*arguments)
    actual, metrics = program(*shared)
    chex.assert_trees_all_close(metrics, expected_metrics, rtol=1e-4, atol=1e-5)
    chex.assert_trees_all_close(actual.params, expected.params, rtol=1e-4, atol=1e-5)


# For a transformer that is trained, XLA also gathers the tokens of one layer, to compute the
# gradient of its kernel. At this size the tokens are as small as the kernel.
@pytest.mark.parametrize(
    "kind",
    [
        "radenet",
        pytest.param("dinorade", marks=pytest.mark.slow),
        pytest.param("dinorade_resnet50", marks=pytest.mark.slow),
    ],
)
def test_only_parameters_are_gathered_if_they_are_split(kind):
    program, arguments = _compiled(kind, 4, "fsdp")
    moved = _moved(program)
    parameters = [x.size for x in jax.tree.leaves(arguments[0].params)]
    frozen = [x.size for x in jax.tree.leaves(arguments[0].frozen)]
    assert set(moved.pop("all-gather")) <= {*parameters, *frozen}
    assert not moved.pop("all-to-all")
    assert not moved.pop("collective-permute")
    one, alone = _compiled(kind, 1)
    expected, actual = one(*alone)[0], program(*arguments)[0]
    chex.assert_trees_all_close(actual.params, expected.params, rtol=1e-4, atol=1e-5)


def test_devices_share_the_work_of_inference_and_gather_only_detections():
    inputs = _case("dinorade")[1].model_inputs()
    settings = Settings.of(Config(), {"score_threshold": 0.1})
    programs = []
    for num_devices in (1, 4):
        mesh = devices.make_mesh(num_devices)
        sharding = devices.batch_sharding(mesh)
        detector = small_models.detector("camera", sharding=sharding)
        arguments = detector.variables, *jax.tree.map(detector.put, inputs), settings
        program = detector._run.lower(*arguments).compile()
        programs.append((program, program(*arguments)))
    (one, expected), (four, found) = programs
    moved = _moved(four)
    num_results = sum(x.size for x in jax.tree.leaves(expected))
    assert sum(moved.pop("all-gather")) <= num_results
    assert not any(moved.values()), moved
    assert _num_operations(four) <= 1.1 / 4 * _num_operations(one)
    chex.assert_trees_all_close(found, expected, rtol=1e-4, atol=1e-5)
