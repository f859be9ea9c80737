"""Exported folders give the same boxes without this package."""

import dataclasses
import json
import os
import re
import subprocess
import sys

import jax
import numpy as np
import pytest
from jax.extend import backend
from jaxlib import _jax as jaxlib_client

import radejax
from radejax import DataError, Detector, UserError, load_model, models
from radejax.data.projection import encode
from radejax.geometry.camera import stack_cameras
from radejax.inference import export, exported_loader
from radejax.inference.detector import network_input
from radejax.inference.saved import SavedModel

from .. import small_models as small

# jax, flatbuffers and numpy only: radejax cannot be imported.
ISOLATED = """
import pathlib, sys
folder, inputs, out = map(pathlib.Path, sys.argv[1:])
class Isolate:
    def find_spec(self, name, path=None, target=None):
        if name in ("radejax", "flax", "safetensors"):
            raise ImportError(name)
sys.meta_path.insert(0, Isolate())
sys.path.insert(0, str(folder))
import numpy as np
from load import load
detect = load()
with np.load(inputs) as arrays:
    arrays = dict(arrays)
camera = {k[7:]: v for k, v in arrays.items() if k.startswith("camera_")}
found = {}
for n in (1, 3):
    args = [arrays["projection"][:n]]
    if camera:
        args += [arrays["image"][:n], {k: v[:n] for k, v in camera.items()}]
    for key, value in detect(*args).items():
        found[f"{key}_{n}"] = np.asarray(value)
    if n == 3:
        thresholds = [0.5, 0.3, 0.9, 0.5, 0.2]  # by class
        strict = detect(*args, score_threshold=thresholds, roi=(0, 20, -5, 5, -9, 9))
        found.update({f"{k}_strict": np.asarray(v) for k, v in strict.items()})
np.savez(out, **found)
"""


def _run_elsewhere(folder, arrays):
    inputs, out = folder.parent / "inputs.npz", folder.parent / "found.npz"
    np.savez(inputs, **arrays)
    unset = ("PYTHONPATH", "JAX_NUM_CPU_DEVICES")
    environment = {k: v for k, v in os.environ.items() if k not in unset}
    done = subprocess.run(
        [sys.executable, "-c", ISOLATED, str(folder), str(inputs), str(out)],
        env={**environment, "JAX_PLATFORMS": "cpu"},
        cwd=folder.parent,
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    with np.load(out) as found:
        return dict(found)


def _camera_inputs(detector, count, *, embedded):
    """Arguments of a detector with a camera, and the arrays by the names of ONNX."""
    projection, image = small.projections(count), small.images(count)
    camera = stack_cameras([small.calibration().camera()] * count)
    if embedded:
        image = detector.model.apply(detector.variables, image, method="embed")
    arrays = {"projection": projection, "image": np.asarray(image)}
    arrays |= {f"camera_{name}": array for name, array in vars(camera).items()}
    return (projection, arrays["image"], camera), arrays


def _tensors(grid):
    power = 10 ** np.random.default_rng(0).uniform(2, 15, (1, *grid.shape_drea))
    return power.astype(np.float32)


def _check(found, suffix, expected):
    is_valid = np.asarray(expected.is_valid)
    assert is_valid.any()
    np.testing.assert_array_equal(found[f"is_valid_{suffix}"], is_valid)
    np.testing.assert_array_equal(found[f"classes_{suffix}"], expected.classes)
    floats = {"scores": expected.scores, "boxes": expected.boxes} | expected.outputs
    for name, x in floats.items():
        np.testing.assert_allclose(found[f"{name}_{suffix}"], x, atol=1e-4, rtol=1e-4)


def _calibrated(detector):
    """The detector with probabilities as a further output."""
    config = detector.saved.config.replace(decode={"calibration": [(0.4, -0.5)] * 5})
    return Detector(dataclasses.replace(detector.saved, config=config))


@pytest.mark.slow
def test_a_fresh_process_without_radejax_finds_the_same_boxes(tmp_path):
    detector, projection = small.detector(), small.projections(3)
    folder = tmp_path / "exported"
    num_bytes, _ = export.export(detector, folder)
    assert num_bytes > (folder / "model.safetensors").stat().st_size
    exported = jax.export.deserialize((folder / "detector.stablehlo").read_bytes())
    assert exported.platforms == ("cpu", "cuda", "tpu")
    assert str(exported.in_avals[-4].shape[0]) == "b"
    found = _run_elsewhere(folder, {"projection": projection})
    _check(found, "1", detector(projection[:1]))
    _check(found, "3", detector(projection))
    region = (0, 20, -5, 5, -9, 9)
    thresholds = (0.5, 0.3, 0.9, 0.5, 0.2)
    strict = detector(projection, score_threshold=thresholds, roi=region)
    assert 0 < strict.is_valid.sum() < detector(projection).is_valid.sum()
    _check(found, "strict", strict)
    config = json.loads((folder / "config.json").read_text())
    assert config["config"]["decode"]["score_threshold"] == 0.1
    np.save(tmp_path / "uint8.npy", encode(projection[0], "uint8"))
    command = [sys.executable, folder / "load.py", tmp_path / "uint8.npy"]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert printed.count("\n") > 3  # a record of uint8 has objects as well
    command[2] = "--help"
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "usage: load.py [-h] ARRAY.npy [ARRAY.npy ...]" in printed
    again = Detector.from_workdir(folder, batch_sizes=(4,))
    _check(found, "3", again(projection))


def test_a_program_of_two_frames_and_an_own_output(tmp_path):
    detector = small.detector_with_output(num_frames=2)
    export.export(detector, tmp_path, platforms=("cpu",))
    rows = json.loads((tmp_path / "inputs.json").read_text())
    assert rows[-4]["shape"] == [None, 16, 14, 10]
    frames = small.projections(2)
    parts = [frames[..., :2], frames[..., 2:]]
    stacked = np.concatenate([part[i] for part in parts for i in (0, 1)], -1)
    detect = exported_loader.load(tmp_path)
    found = {f"{name}_1": x for name, x in detect(stacked[None]).items()}
    stacked[:, :, 0] = np.nan  # the first frame
    assert detect(stacked[None])["num_invalid"] == 1
    again = Detector.from_workdir(tmp_path)
    assert again.num_frames == 2
    _check(found, "1", again(frames))
    rows = json.loads((tmp_path / "outputs.json").read_text())
    (row,) = (row for row in rows if row["name"] == "velocity")
    assert row["shape"] == [None, 100, 2]
    assert row["unit"] == "output of the model's own"
    assert np.abs(found["velocity_1"]).max() > 0


@pytest.mark.slow
@pytest.mark.parametrize("axis", ["doppler", "elevation"])
def test_an_onnx_file_begins_with_the_tensor_of_a_radar_without_an_axis(axis, tmp_path):
    pytest.importorskip("jax2onnx")
    runtime = pytest.importorskip("onnxruntime")
    none = np.array([])
    grid = small.uneven_grid(elevation_rad=np.linspace(-0.1, 0.1, 3))
    grid = dataclasses.replace(
        grid, **{{"doppler": "doppler_mps", "elevation": "elevation_rad"}[axis]: none}
    )
    bins = {"doppler_bins": grid.num_doppler, "elevation_bins": grid.num_elevation}
    config = small.radar_config().replace(model=bins)
    model = models.build(config.model)
    variables = small.drawn(model, np.zeros((1, *grid.projection_shape), np.float32))
    saved = SavedModel(config, grid, variables)
    detector = Detector(saved, score_threshold=0.1, batch_sizes=(1,))
    tensor = _tensors(grid)
    options = {"kind": "onnx", "radar_input": "tensor"}
    export.export(detector, tmp_path, **options)
    wanted = detector(tensor)
    found = exported_loader.load(tmp_path)(tensor)
    _check({f"{name}_": x for name, x in found.items()}, "", wanted)
    session = runtime.InferenceSession(tmp_path / "network.onnx")
    logits, _ = session.run(None, {"tensor": tensor})
    levels = network_input(tensor, grid)
    maps = jax.jit(model.apply)(variables, levels)
    np.testing.assert_allclose(logits, maps.heatmap_logits, atol=1e-4)


def test_a_program_of_one_batch_size_and_platform_has_static_shapes(tmp_path):
    detector = _calibrated(small.detector())
    export.export(detector, tmp_path, platforms=("cpu",), batch_size=2)
    exported = jax.export.deserialize((tmp_path / "detector.stablehlo").read_bytes())
    assert exported.in_avals[-4].shape == (2, *detector.grid.projection_shape)
    # PJRT compiles neither dynamic shapes nor the index of a platform.
    text = exported.mlir_module()
    assert "dynamic_broadcast" not in text
    assert "_platform_index" not in text
    # The bytecode alone gives the same boxes, with the inputs that are listed.
    rows = json.loads((tmp_path / "inputs.json").read_text())
    assert [row["index"] for row in rows] == list(range(len(rows)))
    names = ["projection", "score_threshold", "nms_iou", "roi"]
    assert [row["name"] for row in rows[-4:]] == names
    projection = small.projections(2)
    weights = (tmp_path / "model.safetensors").read_bytes()
    given = dict(exported_loader.read_weights(weights))
    settings = [0.1] * len(detector.classes), 0.3, (-99, 99) * 3
    given |= dict(zip(names, (projection, *settings), strict=True))
    inputs = [np.asarray(given[row["name"]], row["dtype"]) for row in rows]
    assert [list(x.shape) for x in inputs] == [row["shape"] for row in rows]
    found = _run_bytecode(tmp_path, inputs)
    wanted = detector(projection, roi=(-99, 99) * 3)
    expected = vars(wanted) | wanted.outputs
    assert (wanted.outputs["probability"] > wanted.scores).any()
    rows = json.loads((tmp_path / "outputs.json").read_text())
    for row, value in zip(rows, found, strict=True):
        np.testing.assert_allclose(value, expected[row["name"]], atol=1e-4)
        assert [list(value.shape), str(value.dtype)] == [row["shape"], row["dtype"]]


def _run_bytecode(folder, inputs):
    """Compile and run StableHLO bytecode through PJRT, without `jax.export`."""
    kind = type(backend.get_compile_options(num_replicas=1, num_partitions=1))
    options = kind.ParseFromString((folder / "compile_options.pb").read_bytes())
    devices = jaxlib_client.DeviceList(tuple(jax.devices("cpu")[:1]))
    program = (folder / "detector.mlirbc").read_bytes()
    loaded = backend.get_backend("cpu").compile_and_load(program, devices, options)
    results = loaded.execute_sharded([jax.device_put(x) for x in inputs])
    return [np.asarray(x[0]) for x in results.disassemble_into_single_device_arrays()]


def test_a_program_that_begins_with_the_tensor(tmp_path):
    detector = small.detector()
    tensors = _tensors(detector.grid)
    options = {"platforms": ("cpu",), "batch_size": 1, "radar_input": "tensor"}
    export.export(detector, tmp_path, **options)
    found = exported_loader.load(tmp_path)(tensors)
    wanted = detector(tensors)
    assert wanted.is_valid.any()
    np.testing.assert_allclose(found["boxes"], wanted.boxes, atol=1e-4)
    rows = json.loads((tmp_path / "inputs.json").read_text())
    assert rows[-4]["name"] == "tensor"
    assert rows[-4]["unit"] == "linear power"
    # Another export into the same folder removes what it does not write.
    export.export(detector, tmp_path, platforms=("cpu",))
    assert not (tmp_path / "detector.mlirbc").exists()
    rows = json.loads((tmp_path / "inputs.json").read_text())
    assert (rows[-4]["name"], rows[-4]["shape"][0]) == ("projection", None)
    with pytest.raises(TypeError, match=r"unknown {'iou'}, expected \['nms_iou',"):
        exported_loader.load(tmp_path)(small.projections(1), iou=0.5)
    detect = exported_loader.load(tmp_path)
    for region in ((0, 20, None, None, -9, 9), (20, 0, -5, 5, -9, 9)):
        with pytest.raises(ValueError, match=r"roi .* expected x0 < x1"):
            detect(small.projections(1), roi=region)
    for name, value in (("score_threshold", np.nan), ("nms_iou", 1.5)):
        with pytest.raises(ValueError, match=rf"{name} \[?{value}.*: expected a num"):
            detect(small.projections(1), **{name: value})
    projection = small.projections(1)
    for given, settings, text in (
        (projection, {"roi": (0, 9) * 2}, r"roi is float32 \[4\], expected float32"),
        (encode(projection, "uint8"), {}, r"n is uint8 .*, expected float32 \[any, 16"),
        (projection[:, :8], {}, r"float32 \[1, 8, 14, 5\], expected float32 \[any, 16"),
    ):
        with pytest.raises(ValueError, match=text):
            detect(given, **settings)
    half = detect(projection.astype(np.float16))  # converted
    np.testing.assert_allclose(half["scores"], detect(projection)["scores"], atol=1e-2)
    _, left_out = export.export(small.detector("camera"), tmp_path, kind="huggingface")
    assert left_out == ["params/image_backbone"]
    assert "DINOv3" in (tmp_path / "README.md").read_text()
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"README.md", "config.json", "model.safetensors"}


def _spoiled(frames, are_tensors):
    """Frames, of which only those of the first name are radar data."""
    cases = {"valid": frames}
    for value in (np.nan, np.inf, -np.inf, -1.0):
        cases[str(value)] = frames.copy()
        cases[str(value)][(0, *[1] * (frames.ndim - 1))] = value
    decibels = 10 * np.log10(frames) if are_tensors else 184.3 * frames - 1.2
    cases |= {"decibels": decibels.astype(np.float32), "zeros": np.zeros_like(frames)}
    return cases | {"constant": np.full_like(frames, 0.5)}


@pytest.mark.parametrize("radar_input", export.INPUTS)
def test_a_program_tells_of_values_that_are_not_radar_data(radar_input, tmp_path):
    detector, frames = small.detector(), small.projections(1)
    if are_tensors := radar_input == "tensor":
        frames = _tensors(detector.grid)
    options = {"batch_size": 1, "radar_input": radar_input}
    export.export(detector, tmp_path, platforms=("cpu",), **options)
    detect = exported_loader.load(tmp_path)
    for name, given in _spoiled(frames, are_tensors).items():
        expected = detector(given).num_invalid.tolist()
        found = np.asarray(detect(given)["num_invalid"]).tolist()
        assert found == [int(name != "valid")] == expected, name


def test_a_folder_is_checked_before_it_runs(tmp_path, monkeypatch):
    origin = {"run": "a", "step": 7, "commit": "abc", "data": {"license": "free"}}
    origin["metrics"] = {"evaluation": "evaluation", "num_frames": 3, "split": "test"}
    origin["metrics"] |= {"data": "drives", "ap": {"mean/x": 12.3}}
    saved = dataclasses.replace(small.detector().saved, identity=origin)
    export.export(Detector(saved), tmp_path, platforms=("cpu",))
    assert load_model(tmp_path).identity == origin
    config = json.loads((tmp_path / "config.json").read_text())
    monkeypatch.setattr(jax, "__version__", "0.9.1")
    text = r"JAX 0\.9\.1, expected 0\.9\.2 to .*: pip install jax==0\."
    with pytest.raises(ImportError, match=text):
        exported_loader.load(tmp_path)
    monkeypatch.setattr(jax, "__version__", "1.0.0.dev3")
    with pytest.warns(UserWarning, match=r"JAX 1\.0.*if loading fails, export again"):
        exported_loader.load(tmp_path)
    for name in config["sha256"]:
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        with pytest.raises(ValueError, match=f"{name}: corrupted, its sha256 differs"):
            exported_loader.load(tmp_path)
        (tmp_path / name).write_bytes(data)
    (tmp_path / "config.json").write_text(json.dumps({**config, "format": "radejax-2"}))
    with pytest.raises(ValueError, match=r"format 'radejax-2', .*'radejax-3': export"):
        exported_loader.load(tmp_path)
    with pytest.raises(DataError, match=r"format is 'radejax-2'.*export the run again"):
        load_model(tmp_path)


@pytest.mark.parametrize(
    ("files", "named"),
    [
        ({"config.json": '{"format": "radejax-2"}', "load.py": "", ".git": ""}, None),
        ({"config.json": "{}", "model.safetensors": ""}, "config.json"),  # DINOv3
        ({"config.json": "{}", "metrics.jsonl": ""}, "config.json"),  # a run
        ({"README.md": "", "notes.txt": ""}, "notes.txt"),
    ],
)
def test_only_an_earlier_export_is_replaced(tmp_path, files, named):
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    if named is None:
        export.export(small.detector(), tmp_path, kind="huggingface")
        names = {".git", "README.md", "config.json", "model.safetensors"}
        assert {path.name for path in tmp_path.iterdir()} == names
        return
    with pytest.raises(UserError, match=f"not of an export, such as {named}: choose"):
        export.export(small.detector(), tmp_path, kind="huggingface")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == files


@pytest.mark.slow
def test_a_radar_camera_model_too(tmp_path):
    detector = small.detector("camera")
    inputs, arrays = _camera_inputs(detector, 3, embedded=False)
    folder = tmp_path / "exported"
    _, left_out = export.export(detector, folder, with_backbone=True)
    assert not left_out
    found = _run_elsewhere(folder, arrays)
    _check(found, "3", detector(*inputs))
    first = jax.tree.map(lambda x: x[:1], inputs)
    _check(found, "1", detector(*first))


def test_wrong_options_are_named_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jax2onnx", None)
    radar, two = small.detector(), small.detector(num_frames=2)
    onnx = {"kind": "onnx", "with_backbone": True}
    for detector, options, message in (
        (radar, {"kind": "tflite"}, "format is 'tflite'"),
        (radar, {"platforms": ("cpu", "metal")}, "platforms is .* expected some of"),
        (small.detector(dtype="bfloat16"), {"kind": "onnx"}, "is not supported"),
        (radar, {"half": True}, "--half is only supported with --format huggingface"),
        (radar, {"radar_input": "power"}, "input is 'power', expected one of"),
        (two, {"radar_input": "tensor"}, "input is 'tensor', expected projection, as"),
        (radar, {"kind": "onnx"}, r"needs jax2onnx and onnx.*: pip install -e"),
        (small.detector("camera"), onnx, "image backbone cannot be exported"),
    ):
        with pytest.raises(UserError, match=message):
            export.export(detector, tmp_path, **options)
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["radar", "camera"])
def test_onnx_files_give_the_same_boxes(kind, tmp_path, monkeypatch):
    pytest.importorskip("jax2onnx")
    runtime = pytest.importorskip("onnxruntime")
    onnx = pytest.importorskip("onnx")
    detector, count = _calibrated(small.detector(kind)), 2
    arguments = (small.projections(count),)
    inputs = {"projection": arguments[0]}
    if kind == "camera":
        arguments, inputs = _camera_inputs(detector, count, embedded=True)
    export.export(detector, tmp_path, kind="onnx", batch_size=count)
    inputs_of_loader = (*arguments[:2], *(dict(vars(x)) for x in arguments[2:]))

    def run(file, feed):
        session = runtime.InferenceSession(tmp_path / file)
        names = [output.name for output in session.get_outputs()]
        return dict(zip(names, session.run(None, feed), strict=True))

    for file in ("network.onnx", "detector.onnx"):
        model = onnx.load(tmp_path / file)
        onnx.checker.check_model(model, full_check=True)
        versions = [(x.domain, x.version) for x in model.opset_import]
        assert (model.ir_version, versions) == (8, [("", 18)])
        assert {node.domain for node in model.graph.node} == {""}
        constants = {array.name for array in model.graph.initializer}
        kernels = [x.input[1] for x in model.graph.node if x.op_type == "Conv"]
        assert len(kernels) > 5
        assert constants.issuperset(kernels)  # as the quantization needs it

    by_class = [0.5, 0.3, 0.9, 0.5, 0.2]
    for score, roi in (([0.1] * 5, (-99, 99) * 3), (by_class, (0, 20, -5, 5, -9, 9))):
        settings = {"score_threshold": score, "nms_iou": 0.3, "roi": roi}
        feed = {name: np.asarray(value, np.float32) for name, value in settings.items()}
        found = run("detector.onnx", inputs | feed)
        expected = detector(*arguments, **settings)
        _check({f"{name}_": x for name, x in found.items()}, "", expected)
    maps = jax.jit(detector.model.apply)(detector.variables, *arguments)
    rows = json.loads((tmp_path / "inputs.json").read_text())
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    detect = exported_loader.load(tmp_path, session_options=options)
    found = detect(*inputs_of_loader, score_threshold=0.1)
    _check({f"{name}_": x for name, x in found.items()}, "", detector(*arguments))
    session = runtime.InferenceSession(tmp_path / "detector.onnx")
    told = session.get_modelmeta().custom_metadata_map
    assert json.loads(told["classes"]) == list(detector.classes)
    assert json.loads(told["decode"])["score_threshold"] == 0.1
    assert json.loads(told["grid"]) == detector.grid.to_dict()
    assert json.loads(told["radejax"]) == radejax.__version__
    assert json.loads(told["onnxruntime"]) == ">=1.19"
    for name, value in (("score_threshold", by_class), ("roi", (20, 0, -5, 5, -9, 9))):
        feed[name] = np.asarray(value, np.float32)  # as the page says, no error
    assert not run("detector.onnx", inputs | feed)["is_valid"].any()
    assert [row["name"] for row in rows] == [x.name for x in session.get_inputs()]
    assert [row["shape"] for row in rows] == [x.shape for x in session.get_inputs()]
    rows = json.loads((tmp_path / "outputs.json").read_text())
    assert [row["name"] for row in rows] == [x.name for x in session.get_outputs()]
    for name, values in run("network.onnx", inputs).items():
        np.testing.assert_allclose(values, getattr(maps, name), atol=1e-4)


def test_a_program_in_bfloat16_is_lowered_for_accelerators(tmp_path):
    detector = small.detector(dtype="bfloat16")
    export.export(detector, tmp_path, platforms=("cuda", "tpu"), batch_size=1)
    exported = jax.export.deserialize((tmp_path / "detector.stablehlo").read_bytes())
    assert exported.platforms == ("cuda", "tpu")
    found = re.findall(r"stablehlo.convolution.*: (.*) ->", exported.mlir_module())
    assert len(found) > 5
    assert all(types.count("xbf16>") == 2 for types in found)
    assert {str(x.dtype) for x in exported.in_avals} == {"float32"}
    config = json.loads((tmp_path / "config.json").read_text())
    assert config["config"]["model"]["dtype"] == "bfloat16"
