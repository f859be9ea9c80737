"""The training loop of RADE-Net in thirty lines, without checkpoints, logs and signals.

    python examples/own_loop.py

Copy it to change what a step does. `radejax train` has the rest: it continues after an
interruption, logs, evaluates, and uses all devices.
"""

import click
import jax
import optax

from radejax import Detector, SavedModel, load_config, models
from radejax.losses.detection import detection_loss
from radejax.runs.data import located, open_data


def train(name: str = "quickstart:short", num_steps: int = 50) -> Detector:
    """Trains a model on simulated frames, and prints what it detects in one of them."""
    config = located(load_config(name))
    data = open_data(config)  # simulates and preprocesses what is missing
    frames = data.split("train")
    batches = data.training_batches()
    model = models.build(config.model)
    grid = models.map_grid(data.records.grid, model, config.data.azimuth_mapping)
    inputs = next(batches).model_inputs()
    params = jax.jit(model.init)(jax.random.key(0), *inputs)["params"]
    optimizer = optax.adamw(optax.cosine_decay_schedule(1e-3, num_steps))
    state = optimizer.init(params)

    @jax.jit
    def step(params, state, batch):
        def loss(params):
            maps = model.apply({"params": params}, *batch.model_inputs(), train=True)
            return detection_loss(maps, batch, grid, config.loss)

        (_, terms), gradient = jax.value_and_grad(loss, has_aux=True)(params)
        updates, state = optimizer.update(gradient, state, params)
        return optax.apply_updates(params, updates), state, terms

    for number in range(num_steps):
        params, state, terms = step(params, state, next(batches))
        if number % 10 == 0:
            print(number, {term: round(float(x), 3) for term, x in terms.items()})
    detector = Detector(SavedModel(config, data.records.grid, {"params": params}))
    for box in detector(data.records[frames[0].key]).to_list()[0]:
        print(box)
    return detector


@click.command()
@click.option("--config", default="quickstart:short", help="Config to train.")
@click.option("--steps", default=50, help="Number of steps.")
def main(config: str, steps: int) -> None:
    """Train for a few steps, and print the boxes of a frame."""
    train(config, steps)


if __name__ == "__main__":
    main()
