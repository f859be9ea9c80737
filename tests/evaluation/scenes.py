"""Random scenes that provoke every special case: ties, crowds, empty frames, misses."""

import numpy as np

NAMES = np.array(["Sedan", "Bus or Truck", "Pedestrian", "Motorcycle", "Bicycle"])


def random_scene(seed, *, num_frames=12, num_objects=30, num_classes=2, ties=True):
    """Ground truth, predictions and frames; overlaps keep clear of round thresholds."""
    rng = np.random.default_rng(seed)
    # Half of the frames hold everything, so that boxes crowd and compete.
    frame = np.sort(rng.integers(0, max(num_frames // 2, 1), num_objects))
    cls = rng.integers(0, num_classes, num_objects)
    box = np.column_stack(
        [
            rng.uniform(5, 20, num_objects),
            rng.uniform(-5, 5, num_objects),
            rng.normal(0, 0.3, num_objects),
            rng.uniform(3, 5, num_objects),
            rng.uniform(1.5, 3, num_objects),
            rng.uniform(1.2, 2, num_objects),
            rng.uniform(-4, 4, num_objects),
        ]
    )
    copies = rng.choice([0, 1, 2, 3], num_objects, p=[0.2, 0.4, 0.25, 0.15])
    source = np.repeat(np.arange(num_objects), copies)
    noise = [0.5, 0.4, 0.2, 0.3, 0.2, 0.1, 0.2]
    found = box[source] + rng.normal(0, noise, (source.size, 7))
    num_false = num_objects // 3
    false = box[rng.integers(0, num_objects, num_false)]
    false = false + rng.normal(0, 2, (num_false, 7)) * [1, 1, 0.2, 0, 0, 0, 1]
    pred_frame = np.concatenate([frame[source], rng.integers(0, num_frames, num_false)])
    pred_cls = np.concatenate([cls[source], rng.integers(0, num_classes, num_false)])
    pred_box = np.concatenate([found, false])
    pred_box[:, 3:6] = np.maximum(np.abs(pred_box[:, 3:6]), 0.2)
    score = rng.uniform(0.01, 0.99, pred_frame.size)
    if ties:
        score = np.round(score, 1).clip(0.1, 0.9)
    order = rng.permutation(pred_frame.size)
    truth = {"frame": frame, "box": box, "cls": NAMES[cls]}
    predictions = {
        "frame": pred_frame[order],
        "box": pred_box[order],
        "cls": NAMES[pred_cls[order]],
        "score": score[order],
    }
    frames = {
        "frame": np.arange(num_frames),
        "sequence": np.arange(num_frames) // 3,
        "name": np.array([f"{i:05d}_{i:05d}" for i in range(num_frames)]),
        "weather": np.array(["normal", "fog", "rain"])[np.arange(num_frames) // 3 % 3],
        "environment": np.array(["urban", "highway"])[np.arange(num_frames) % 2],
        "time": np.array(["day", "night"])[np.arange(num_frames) // 6 % 2],
    }
    return truth, predictions, frames


def kradar_scene():
    """The scene that K-Radar's own code evaluated; every weather has at least ten frames."""
    return random_scene(7, num_frames=72, num_objects=300, num_classes=5)
