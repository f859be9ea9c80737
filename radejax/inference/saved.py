"""Loading and saving of trained models.

Runs, exported folders and official PyTorch files are all loaded as a `SavedModel`. An
exported folder has the files that the Hugging Face Hub expects:

    config.json          the config of the run, its origin, the grid, checksums of the files
    model.safetensors    variables by name, "params/backbone/..."

It contains the weights of DINOv3 only on request, because their license restricts
redistribution.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

import numpy as np
import safetensors.numpy
from flax.traverse_util import flatten_dict, unflatten_dict
from flax.typing import VariableDict

from radejax import models
from radejax.config import Config
from radejax.core import files
from radejax.core.errors import DataError, UserError, require
from radejax.core.files import JsonObject, PathLike
from radejax.core.manifest import read_checked
from radejax.core.options import class_thresholds
from radejax.core.version import __version__, radejax_commit
from radejax.data.kradar.labels import LABEL_CLASSES
from radejax.data.options import CameraOptions, DataOptions
from radejax.detection.decode import DecodeOptions
from radejax.evaluation.protocols import RECOMMENDED
from radejax.evaluation.results import HOW_TO_CHOOSE
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.exported_loader import FORMAT
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.models.lifting import OFFICIAL_OFFSET_M
from radejax.models.options import DinoRadeOptions, RadeNetOptions
from radejax.models.radenet import RadeNet
from radejax.weights import dinorade_torch, image_backbone, radenet_torch
from radejax.weights.convert import (
    StateDict,
    check_finite,
    read_state_dict,
    variable_shapes,
)

_log = logging.getLogger(__name__)

CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"
CALIBRATION_FILE = "calibration.json"

FROZEN_BACKBONE = "sha256 of the frozen image backbone"
"""Key of the first 16 digits of the checksum in a checkpoint's description of its run."""

MAX_SHIFT = 1.0
"""Largest plausible difference of the mean input from that of the training, in standard
deviations of that. Those of simulated frames differ by up to 0.35; a gain of 8 to 11 dB is 1."""

MAX_SPREAD = 2.0
"""Largest plausible ratio of standard deviations; for simulated frames, it is up to 1.4."""

Step = int | Literal["best"] | None
"""Step of a checkpoint, "best" by the metric of the run, or None for the latest."""


@dataclasses.dataclass(frozen=True)
class SavedModel:
    """A trained model with its config and radar grid.

    Attributes:
        config: Config that the model was trained with; for weights of the authors' code, the
            corresponding config.
        grid: Axes of the sensor.
        variables: Parameters and other collections of the model as NumPy arrays.
        step: Step of the checkpoint; None if the model is not from a checkpoint.
        run: Data, frozen weights and versions of the run, see
            `radejax.runs.experiment.checkpoint_info`; empty if the model is not from a
            checkpoint.
        usual_input: Mean and standard deviation of the projections that the model was
            trained on; None if they are not known.
        identity: Name of the run, step, date, commit, versions, data, metrics and checksum
            of the frozen image backbone, as far as they are known.
    """

    config: Config
    grid: RadarGrid
    variables: VariableDict
    step: int | None = None
    run: JsonObject = dataclasses.field(default_factory=dict)
    usual_input: Sequence[float] | None = None
    identity: JsonObject = dataclasses.field(default_factory=dict)

    @property
    def model(self) -> RadeNet:
        """The Flax module, without parameters."""
        return models.build(self.config.model, self.config.data.num_frames)

    def check_input(self, mean: float, spread: float) -> bool:
        """Returns whether the input is similar to that of the training; warns if it is not.

        Args:
            mean: Mean of some projections.
            spread: Their standard deviation.
        """
        usual, scale = self.usual_input or (mean, spread)
        is_near = abs(mean - usual) <= MAX_SHIFT * scale
        is_near = is_near and scale <= MAX_SPREAD * spread <= MAX_SPREAD**2 * scale
        if not is_near:
            _log.warning(
                "the input is %.3f ± %.3f, and %.3f ± %.3f in the training: detections are "
                "not reliable; expected linear power of a radar with the same gain",
                mean,
                spread,
                usual,
                scale,
            )
        return is_near


def load_model(
    path: PathLike, *, step: Step = None, image_backbone: PathLike | None = None
) -> SavedModel:
    """Loads the model of a run, a checkpoint, an exported folder or an official file.

    Checkpoints do not contain a frozen image backbone, so it is read from the files that
    the run was trained with. If they do not exist, the model accepts embedded images only.

    Args:
        path: Workdir of a run, its `checkpoints`, one of them, a folder of
            `radejax export`, or an official file, see `load_torch`.
        step: Step of the checkpoint, or "best"; the latest if None. Only for a workdir
            or its `checkpoints`.
        image_backbone: Weights of the image backbone, instead of those of the run: the
            folder or file of DINOv3 or DINOv2, or torchvision's ResNet-50 file.

    Raises:
        FileNotFoundError: There is no model, or no such checkpoint.
        UserError: A step is given, but the path contains one model only; or the backbone
            is not the one that the run was trained with, or was fine-tuned in the run.
        DataError: A file is corrupted, or config and weights do not fit each other.
    """
    path = files.as_path(path).absolute()
    if not path.exists():
        raise FileNotFoundError(f"no such file or folder: {path}")
    is_exported = (path / WEIGHTS_FILE).is_file()
    if step is not None and (path.is_file() or is_exported or _is_checkpoint(path)):
        raise UserError(f"{path} holds one model only, but step={step} is given")
    if path.is_file():
        return load_torch(path, image_backbone=image_backbone)
    saved = _read_exported(path) if is_exported else _read_checkpoint(path, step)
    check_finite(saved.variables, path)
    return _with_backbone(saved, image_backbone)


def load_torch(
    path_or_state_dict: PathLike | StateDict,
    *,
    image_backbone: PathLike | None = None,
    **model_overrides: object,
) -> SavedModel:
    """Loads official RADE-Net or DinoRADE weights on the grid of K-Radar.

    Args:
        path_or_state_dict: `.pth`, `.pt` or `.safetensors` file, or a mapping of names
            to arrays. If any name begins with `rad_backbone.`, the weights are DinoRADE's.
        image_backbone: Folder of DINOv3, for a DinoRADE file without its weights.
        **model_overrides: Fields of the model that cannot be derived from the names and
            shapes of the arrays.

    Raises:
        UserError: An image backbone is given, but the model is RADE-Net.
        DataError: Tensors are missing, unexpected or of another shape.
    """
    parts = radenet_torch.PART, dinorade_torch.PART
    tensors, source = read_state_dict(path_or_state_dict, *parts)
    model: RadeNetOptions
    camera = None
    if any(name.startswith(dinorade_torch.PART) for name in tensors):
        model, variables = dinorade_torch.read(
            tensors, source, image_backbone, **model_overrides
        )
        camera = CameraOptions(
            projection="pinhole",
            radar_from_lidar_m=OFFICIAL_OFFSET_M,
            calibration="common",
        )
    elif image_backbone is not None:
        raise UserError("image_backbone is given, but the model is RADE-Net")
    else:
        model, variables = radenet_torch.read(tensors, source, **model_overrides)
    config = Config(
        model=model,
        classes=LABEL_CLASSES[: model.num_classes],
        data=DataOptions(azimuth_mapping="stretched", camera=camera),
        decode=DecodeOptions(threshold_inclusive=False),
    )
    return SavedModel(
        config,
        RadarGrid.kradar(),
        variables,
        identity={"run": files.as_path(source).name},
    )


# Exported folders --------------------------------------------------------------------


def save_model(
    saved: SavedModel,
    folder: PathLike,
    *,
    with_backbone: bool = False,
    half: bool = False,
    programs: Mapping[str, bytes] | None = None,
    jax_versions: Mapping[str, str] | None = None,
) -> JsonObject:
    """Writes a model to a folder as `config.json` and `model.safetensors`.

    Args:
        saved: Model to write.
        folder: Folder, which is created if missing. Existing files of the same names are
            replaced.
        with_backbone: Keep the weights of the image transformer.
        half: Store weights as float16; `load_model` converts them to float32.
        programs: Contents of further files by name.
        jax_versions: Versions of JAX that a program is for, if there is one.

    Returns:
        The content of `config.json`.

    Raises:
        UserError: The image transformer was fine-tuned, so that the model is incomplete
            without its weights, and `with_backbone` is False.
    """
    folder = files.as_path(folder)
    variables = {name: dict(tree) for name, tree in saved.variables.items()}
    params = variables["params"]
    model = saved.config.model
    is_incomplete = False
    if isinstance(model, DinoRadeOptions) and model.image.kind == "vit":
        if IMAGE_BACKBONE in params and not (with_backbone or model.image.freeze):
            raise UserError(
                "the image backbone was fine-tuned, so its weights are required. If it "
                "started from DINOv3, its license restricts redistribution; otherwise "
                "pass --with-backbone"
            )
        if not with_backbone:
            params.pop(IMAGE_BACKBONE, None)
        is_incomplete = IMAGE_BACKBONE not in params
    flat = flatten_dict(variables, sep="/")
    dtype = np.float16 if half else None
    arrays = {name: np.ascontiguousarray(x, dtype) for name, x in flat.items()}
    weights = safetensors.numpy.save(arrays, {"format": "jax"})
    contents = {WEIGHTS_FILE: weights, **(programs or {})}
    for name, data in contents.items():
        with files.atomic_write(folder / name) as file:
            file.write(data)
    description = {
        "format": FORMAT,
        "radejax": __version__,
        "commit": radejax_commit(),
        "identity": saved.identity,
        **({"jax": dict(jax_versions)} if jax_versions else {}),
        "config": saved.config.without_data_paths(),
        "grid": saved.grid.to_dict(),
        "input": saved.usual_input,
        "left_out": [f"params/{IMAGE_BACKBONE}"] if is_incomplete else [],
        "sha256": {k: hashlib.sha256(v).hexdigest() for k, v in contents.items()},
    }
    files.write_json(folder / CONFIG_FILE, description)
    return description


def _read_exported(folder: pathlib.Path) -> SavedModel:
    """Reads a folder that `save_model` wrote."""
    path = folder / CONFIG_FILE
    weights = folder / WEIGHTS_FILE
    content = files.read_object(path)
    data = weights.read_bytes()
    try:
        if (found := content.get("format")) != FORMAT:
            raise ValueError(
                f"format is {found!r}, expected {FORMAT!r}: export the run again with "
                f"radejax {__version__}"
            )
        if hashlib.sha256(data).hexdigest() != content["sha256"][WEIGHTS_FILE]:
            raise DataError(
                f"{weights} is corrupted or of another model: its sha256 differs from "
                f"the one in {CONFIG_FILE}; export or download it again"
            )
        arrays = safetensors.numpy.load(data)
        arrays = {name: value.astype(np.float32) for name, value in arrays.items()}
        variables = unflatten_dict(arrays, sep="/")
        config = Config(**content["config"])
        saved = SavedModel(
            config,
            RadarGrid.from_dict(content["grid"]),
            variables,
            usual_input=content.get("input"),
            identity=content["identity"],
        )
        image_backbone.check_fits(saved.model, variables, weights)
        return saved
    # These are raised for a file that was edited by hand.
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: {error}") from None


# Checkpoints -------------------------------------------------------------------------


def _is_checkpoint(path: pathlib.Path) -> bool:
    return path.name.isdigit() and (path / "state").is_dir()


def _read_checkpoint(path: pathlib.Path, step: Step) -> SavedModel:
    """Reads the model of a workdir, its `checkpoints`, or one of them."""
    if _is_checkpoint(path):
        folder = path.parent
        step = int(path.name)
    elif (path / "checkpoints").is_dir():
        folder = path / "checkpoints"
    elif any(map(_is_checkpoint, path.iterdir())):
        folder = path
    else:
        raise FileNotFoundError(
            f"no model in {path}: expected {CONFIG_FILE} and {WEIGHTS_FILE}, the workdir "
            "of a run that has trained, its checkpoints, or one of them"
        )
    # Orbax takes a second to import, and the other kinds of models do not need it.
    from radejax.training.checkpoints import Checkpoints
    from radejax.training.step import merge_variables

    with Checkpoints(folder, read_only=True) as checkpoints:
        chosen = checkpoints.best_step() if step == "best" else step
        state, info, number = checkpoints.restore_variables(chosen)
    trained = state["ema_params"] if state.get("ema_params") else state["params"]
    params = merge_variables(trained, state.get("frozen") or {})
    try:
        config = Config(**info["config"])
    except UserError as error:
        version = info["run"].get("versions", {}).get("radejax")
        if version == __version__:
            raise
        raise UserError(
            f"{folder}: {error}; the run is of radejax {version}, and this is radejax "
            f"{__version__}: train again, or use that version"
        ) from None
    config.check_parts(info["run"].get("parts", {}), folder.parent)
    run = {**info["same"], **info["run"]}
    identity = _identity(folder.parent, number, run)
    if fit := _calibration(folder.parent, number):
        by_class = fit.pop("classes")
        pairs = [by_class[cls] for cls in config.classes]
        config = config.replace(decode={"calibration": pairs})
        identity["probability"] = fit
    return SavedModel(
        config,
        RadarGrid.from_dict(info["grid"]),
        {"params": params, **(state.get("model_state") or {})},
        number,
        run,
        info["run"].get("input"),
        identity,
    )


def _calibration(workdir: pathlib.Path, step: int) -> JsonObject | None:
    """Returns the calibration of the run if it is that of the step."""
    path = workdir / CALIBRATION_FILE
    if not path.exists():
        return None
    found = files.read_object(path, "step", "classes")
    if found["step"] != step:
        text = "%s is of step %s, not %s, and not used: run `radejax calibrate` again"
        _log.warning(text, path, found["step"], step)
        return None
    return found


def _identity(workdir: pathlib.Path, step: int, run: JsonObject) -> JsonObject:
    """Returns what identifies a checkpoint, without paths of this machine."""
    metrics = None
    for evaluation, found in _evaluations(workdir, step):
        if metrics is None and found["split"] == "test":
            shown = found["options"]["protocols"][0], RECOMMENDED
            aps = {
                row["name"]: row["ap"]
                for row in found["ap"]
                if row["num_gt"]
                and row["condition"] == "all"
                and row["protocol"] in shown
            }
            names = ("data", "split", "num_frames")
            metrics = {"evaluation": evaluation, **{n: found[n] for n in names}}
            metrics["ap"] = aps
    wanted = ("date", "commit", "radejax_commit", "versions", "data", FROZEN_BACKBONE)
    known = {name: run[name] for name in wanted if name in run}
    is_seed = workdir.name.startswith("seed")  # of `run_seeds`
    name = "/".join(workdir.parts[-2:]) if is_seed else workdir.name
    return {"run": name, "step": step, **known, "metrics": metrics}


def _evaluations(
    workdir: pathlib.Path, step: int | None
) -> Iterator[tuple[str, JsonObject]]:
    """Yields the folders of the evaluations of a step and the content of metrics.json.

    Those with files of another evaluation are left out with a warning.
    """
    for path in sorted(workdir.glob("evaluation*/metrics.json")):
        if files.read_object(path).get("step") != step:
            continue
        try:
            found = read_checked(path)
        except DataError as error:
            _log.warning("an evaluation is left out: %s", error)
        else:
            yield path.parent.name, found


def with_chosen_thresholds(
    saved: SavedModel, workdir: PathLike, rule: str
) -> SavedModel:
    """Returns a model of a run with the score thresholds that an evaluation chose.

    It is the first evaluation that chose them on the validation split, or else on its own
    frames. Classes without a threshold keep that of the config, which is logged and in the
    model's identity.

    Args:
        saved: Model of the run.
        workdir: Workdir of the run.
        rule: "best_f1" or "wanted_precision", see `scores.choose_thresholds`.

    Raises:
        UserError: No evaluation of the step chose thresholds.
    """
    reports = dict(_evaluations(files.as_path(workdir), saved.step))
    found = {n: x["thresholds"] for n, x in reports.items() if "thresholds" in x}
    chosen = [name for name, x in found.items() if x["chosen"]]
    chosen.sort(key=lambda name: found[name]["chosen_on"] != "the validation split")
    if not chosen:
        raise UserError(
            f"{workdir}: no evaluation of step {saved.step} chose score thresholds: "
            f"{HOW_TO_CHOOSE}"
        )
    thresholds = found[chosen[0]]
    rows = [entry for entry in thresholds["chosen"] if entry["rule"] == rule]
    by_class = {entry["cls"]: entry["threshold"] for entry in rows}
    config = saved.config
    usual = config.decode.score_threshold
    least = class_thresholds(by_class, config.classes, usual)
    chosen_on = thresholds["chosen_on"]
    origin = {"rule": rule, "evaluation": chosen[0], "chosen on": chosen_on}
    if rule == "wanted_precision":
        origin["rule"] += f" of {reports[chosen[0]]['options'][rule]:g}"
    origin |= {"matches": {x["cls"]: f"{x['count']} of {x['num_gt']}" for x in rows}}
    _log.info("score thresholds %s of %s", by_class, origin)
    if kept := ", ".join(cls for cls in config.classes if cls not in by_class):
        origin["not reached, threshold of the config kept"] = kept
        text = "%s: no threshold by the rule %s, that of the config is kept: choose another "
        text += "rule or precision (radejax evaluate RUN --wanted-precision)"
        _log.warning(text, kept, origin["rule"])
    config = config.replace(decode={"score_threshold": least})
    identity = saved.identity | {"thresholds": origin}
    return dataclasses.replace(saved, config=config, identity=identity)


def _with_backbone(saved: SavedModel, given: PathLike | None) -> SavedModel:
    """Adds the weights of the image backbone to a model, if they are available.

    They are read from the given file or folder, else from the one that the run was
    trained with, else from the weights that the run started from.

    Raises:
        UserError: The given weights are not those that the model was trained with, or
            would replace fine-tuned ones.
    """
    params = saved.variables["params"]
    config = saved.config
    is_complete = IMAGE_BACKBONE in params and given is None
    if is_complete or not isinstance(config.model, DinoRadeOptions):
        return saved
    if IMAGE_BACKBONE in params and not config.model.image.freeze:
        raise UserError(
            f"image_backbone is {given}, but the model has a fine-tuned image backbone "
            "(config.model.image.freeze is False): leave image_backbone out "
            "(--image-backbone)"
        )
    source = given or config.data.image_backbone
    start = saved.run.get("init_from")
    found: VariableDict | None = None
    if given is not None or (source and files.as_path(source).exists()):
        found = image_backbone.load_image_backbone(source, saved.model)
    elif start and files.as_path(start).exists() and not config.data.embeddings:
        source = start
        found = _fitting_variables(start, saved.model)
    if source is None:
        return saved
    backbone = found["params"].get(IMAGE_BACKBONE) if found else None
    if backbone is None:
        _log.warning(
            "image backbone weights not found at %s; the model accepts embedded images "
            "only",
            source,
        )
        return saved
    if (sha256 := saved.identity.get(FROZEN_BACKBONE)) is not None:
        image_backbone.check_same_backbone(backbone, sha256, source)
    params = {**params, IMAGE_BACKBONE: backbone}
    return dataclasses.replace(saved, variables={**saved.variables, "params": params})


# Weights that a training starts from -------------------------------------------------


def starting_weights(
    model: RadeNet,
    init_from: PathLike | None = None,
    image_backbone_path: PathLike | None = None,
    embeddings_sha256: str | None = None,
) -> tuple[VariableDict, str | None]:
    """Reads the weights that a training starts from, including frozen ones.

    Args:
        model: Model that is trained.
        init_from: Path of a model that `load_model` accepts; None initializes all weights
            randomly, except those of the image backbone.
        image_backbone_path: Weights of the image backbone, see
            `image_backbone.load_image_backbone`.
        embeddings_sha256: Checksum of the weights with which `radejax embed` computed the
            embeddings that replace the frozen backbone; None without embeddings.

    Returns:
        Those variables of the model that replace initialized ones, and the checksum of
        the frozen image backbone, or None if there is none.

    Raises:
        UserError: The weights do not fit the model; the message names the differences.
    """
    from radejax.training.step import merge_variables  # optax takes long to import

    weights: VariableDict = {"params": {}}
    if init_from is not None:
        weights = _fitting_variables(init_from, model)
    if IMAGE_BACKBONE not in weights["params"]:
        pretrained = image_backbone.load_image_backbone(
            image_backbone_path, model, embeddings_sha256
        )
        weights = merge_variables(weights, pretrained or {})
    digest = embeddings_sha256
    if digest is None and models.has_camera(model) and model.options.image.freeze:
        digest = image_backbone.weights_sha256(weights["params"][IMAGE_BACKBONE])
    return weights, digest


def _fitting_variables(path: PathLike, model: RadeNet) -> VariableDict:
    """Reads the weights of another run or an official file, which must fit a model."""
    wanted = model.options.to_dict()
    if files.as_path(path).is_dir():
        other = load_model(path)
        found = other.config.model.to_dict()
        if lines := files.differences(found, wanted, "config.model"):
            raise UserError(f"weights of {path} do not fit: {'; '.join(lines)}")
        variables = other.variables
    elif models.has_camera(model):
        variables = load_torch(path).variables
    else:
        del wanted["name"]
        variables = load_torch(path, **wanted).variables
    image_backbone.check_fits(model, variables, path)
    return variables


def matching_weights(path: PathLike, model: RadeNet) -> VariableDict:
    """Reads those weights of another model that have the name and shape of a model's.

    The numbers of arrays, and the parts of the model with arrays that do not match, are
    logged. Weights of a frozen image backbone are not taken.

    Args:
        path: Path of a model that `load_model` accepts.
        model: Model that is trained.

    Raises:
        UserError: No weights match.
    """
    wanted = variable_shapes(model)
    other = load_model(path)
    found = flatten_dict(other.variables, sep="/")
    there, here = (
        {name: getattr(options, name) for name in ("doppler_bins", "elevation_bins")}
        for options in (other.config.model, model.options)
    )
    if lines := files.differences(there, here, "config.model"):
        text = "weights of %s are of another radar, so that the first convolution does not fit: %s"
        _log.warning(text, path, "; ".join(lines))
    own = tuple(f"params/{part}/" for part in models.external_parts(model))
    found = {name: x for name, x in found.items() if not name.startswith(own)}
    same = {name: x for name, x in found.items() if wanted.get(name) == x.shape}
    require(len(same) > 0, "--init-partial", path, "a model with some equal parts")
    _log.info("weights of %s: %d of %d arrays are used", path, len(same), len(found))
    left = {
        "of another shape, which are initialized": wanted.keys()
        & (found.keys() - same),
        "only in this model, which are initialized": wanted.keys() - found.keys(),
        "only in that model, which are not used": found.keys() - wanted.keys(),
    }
    for kind, names in left.items():
        if names := {name for name in names if not name.startswith(own)}:
            parts = sorted({name.rpartition("/")[0] for name in names})
            _log.info("%d arrays are %s: %s", len(names), kind, ", ".join(parts))
    part: VariableDict = unflatten_dict(same, sep="/")
    return part
