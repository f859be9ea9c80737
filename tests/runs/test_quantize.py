"""An export in int8 of a small model on simulated data."""

import json

import jax
import numpy as np
import pytest

from radejax import Detector, UserError, load_config, models
from radejax.inference import exported_loader
from radejax.inference.saved import SavedModel
from radejax.runs import quantize
from radejax.runs.data import located, simulate_missing

from .. import small_models as small

SETTINGS = {"kind": "onnx", "radar_input": "projection", "batch_size": None}


@pytest.fixture(scope="module")
def detector(tmp_path_factory):
    """Detector with random weights on a dataset of four frames to train on and three others."""
    config = small.shrink_run(load_config("quickstart:short"))
    sizes = {"train_sequences": 2, "test_sequences": 3, "frames_per_sequence": 1}
    root = tmp_path_factory.mktemp("data") / "simulated"
    config = located(config.replace(simulation=sizes, data={"roots": (str(root),)}))
    simulate_missing(config)
    grid = config.simulation.make_grid()
    inputs = np.zeros((1, *grid.projection_shape), np.float32)
    variables = small.drawn(models.build(config.model), inputs)
    return Detector(SavedModel(config, grid, variables))


def test_other_programs_are_rejected_before_data_are_read(tmp_path):
    radar, two = small.detector(), small.detector(num_frames=2)
    text = "needs --format onnx, --input projection, batch size 1"
    for given, settings, message in (
        (radar, {"kind": "stablehlo"}, text),
        (radar, {"radar_input": "tensor"}, text),
        (radar, {"batch_size": 2}, text),
        (two, {}, "only for radar-only models of one frame"),
        (radar, {}, r"no split to evaluate on; give --data ROOT"),
    ):
        with pytest.raises(UserError, match=message):
            quantize.export_int8(given, tmp_path, **SETTINGS | settings)
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_convolutions_are_int8_and_the_readme_has_both_aps(detector, tmp_path):
    onnx = pytest.importorskip("onnx")
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("jax2onnx")
    num_bytes, _ = quantize.export_int8(detector, tmp_path, **SETTINGS)
    assert num_bytes > 1e5
    for file in ("network.onnx", "detector.onnx"):
        model = onnx.load(tmp_path / file)
        onnx.checker.check_model(model, full_check=True)
        types = {x.name: x.data_type for x in model.graph.initializer}
        scaled = {x.output[0]: x for x in model.graph.node if "Dequantize" in x.op_type}
        convolutions = [x for x in model.graph.node if x.op_type == "Conv"]
        assert len(convolutions) > 5
        for node in convolutions:
            kernel = scaled[node.input[1]]
            assert types[kernel.input[0]] == onnx.TensorProto.INT8
            assert kernel.attribute[0].i == 0  # a scale per output channel
            assert node.input[0] in scaled
        assert "classes" in {x.key for x in model.metadata_props}
    entry = json.loads((tmp_path / "config.json").read_text())["int8"]
    assert entry["ranges"] == "2 frames of the train split"
    assert entry["ap"]["int8"].keys() == entry["ap"]["float32"].keys()
    # The loader checks the checksums of the new files.
    _, data = quantize.data_of_run(detector.saved)
    frame = data.split("test")[0]
    projection = quantize.decode(data.records[frame.key])[None]
    found = exported_loader.load(tmp_path)(projection, score_threshold=0.3)
    assert found["is_valid"].any()
    runtime = onnxruntime.InferenceSession(tmp_path / "network.onnx")
    logits, _ = runtime.run(None, {"projection": projection})
    maps = jax.jit(detector.model.apply)(detector.variables, projection)
    exact = np.asarray(maps.heatmap_logits)
    assert 0.9 < np.corrcoef(logits.ravel(), exact.ravel())[0, 1] < 1 - 1e-6
