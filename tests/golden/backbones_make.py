"""Golden numbers for image backbones in the names of all sources, and how to repeat them.

`backbones.npz` holds, per source, the names and shapes of a tiny model's tensors as its file has
them, and the features that the original code computed from seeded weights and images on a CPU:
Hugging Face transformers 5.24.0, timm 1.0.31, Meta's DINOv3 (facebookresearch/dinov3, commit
6876159) and torch 2.13.0. It also holds torch's bicubic resampling. Weights and images are not
stored: they follow from names and seeds as in `dinorade_make.py`.

    python tests/golden/backbones_make.py CHECKOUT_OF_DINOV3

timm imports torchvision, of which it needs nothing here: an empty module is enough.
"""

import json
import pathlib
import sys
import tempfile

import numpy as np

from radejax.config import load_module

HERE = pathlib.Path(__file__).parent
SEEDS = load_module(HERE / "dinorade_make.py")
_DINOV3_SIZES = ((32, 64), (48, 32))
_DINOV2_SIZES = ((56, 56), (70, 112), (42, 28))  # the pretraining size, larger, smaller
_TIMM = {"embed_dim": 128, "depth": 2, "num_heads": 2}
_META = {
    "embed_dim": 32,
    "depth": 2,
    "num_heads": 2,
    "n_storage_tokens": 4,
    "mask_k_bias": True,
    "layerscale_init": 1e-5,
    "norm_layer": "layernormbf16",
    "pos_embed_rope_dtype": "fp32",
}
_HUGGING_FACE = {
    "hidden_size": 32,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "patch_size": 14,
    "image_size": 56,
}
SOURCES = {
    "dinov2": _HUGGING_FACE | {"model_type": "dinov2"},
    "dinov2_swiglu": _HUGGING_FACE | {"model_type": "dinov2", "use_swiglu_ffn": True},
    "dinov2_registers": _HUGGING_FACE | {"model_type": "dinov2_with_registers"},
    "meta": _META,
    "meta_swiglu": _META
    | {"ffn_layer": "swiglu", "untie_global_and_local_cls_norm": True},
    "timm": {"architecture": "vit_small_patch16_dinov3"},
    "timm_qkvb": {"architecture": "vit_small_patch16_dinov3_qkvb"},
    "timm_swiglu": {"architecture": "vit_small_plus_patch16_dinov3"},
}
"""Arguments of the tiny model of each source; for Hugging Face and timm, those of its config."""


def tensors(listing: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """The seeded tensors of a file with these names and shapes."""
    found = {name: SEEDS.seeded_tensor(name, tuple(s)) for name, s in listing.items()}
    for name, value in found.items():
        if name == "rope_embed.periods":  # a function of the model's size
            found[name] = np.float32(100 ** (np.arange(value.size) / value.size))
        if name.endswith("bias_mask"):  # no bias of the key
            found[name] = np.repeat(np.float32([1, 0, 1]), value.size // 3)
    return found


def image(height: int, width: int) -> np.ndarray:
    """A normalized image [1, 3, H, W]."""
    return SEEDS.normal_input(height * width, (1, 3, height, width))


def _load(model, values) -> None:
    import torch

    state = {name: torch.from_numpy(np.array(value)) for name, value in values.items()}
    model.load_state_dict(state)
    model.eval()


def _meta(name):
    from dinov3.models.vision_transformer import DinoVisionTransformer

    model = DinoVisionTransformer(**SOURCES[name])
    listing = {n: tuple(t.shape) for n, t in model.state_dict().items()}
    _load(model, tensors(listing))

    def features(x):
        found = model.forward_features(x)
        parts = ("x_norm_clstoken", "x_storage_tokens", "x_norm_patchtokens")
        first, *rest = (found[part] for part in parts)
        return np.concatenate([first[:, None], *rest], 1)

    return listing, features


def _timm(name):
    import timm

    model = timm.create_model(SOURCES[name]["architecture"], num_classes=0, **_TIMM)
    listing = {n: tuple(t.shape) for n, t in model.state_dict().items()}
    _load(model, tensors(listing))
    return listing, model.forward_features


def _hugging_face(name):
    import safetensors.numpy
    import transformers

    config = dict(SOURCES[name])
    config = transformers.AutoConfig.for_model(config.pop("model_type"), **config)
    # The names in a file differ from those in memory.
    with tempfile.TemporaryDirectory() as folder:
        transformers.AutoModel.from_config(config).save_pretrained(folder)
        path = pathlib.Path(folder, "model.safetensors")
        listing = {n: t.shape for n, t in safetensors.numpy.load_file(path).items()}
        safetensors.numpy.save_file(tensors(listing), path, {"format": "pt"})
        model = transformers.AutoModel.from_pretrained(folder).eval()
        written = json.loads(pathlib.Path(folder, "config.json").read_text())
    SOURCES[name].update(written)
    return listing, lambda x: model(x).last_hidden_state


def main(dinov3: str) -> None:
    import torch

    sys.path.insert(0, dinov3)
    makers = {"meta": _meta, "timm": _timm, "dinov2": _hugging_face}
    arrays, info = {}, {}
    for name in SOURCES:
        kind = name.partition("_")[0]
        listing, features = makers[kind](name)
        info[name] = {"tensors": listing, "config": SOURCES[name]}
        for size in _DINOV2_SIZES if kind == "dinov2" else _DINOV3_SIZES:
            with torch.no_grad():
                tokens = np.asarray(features(torch.from_numpy(image(*size))))
            arrays[f"{name}__{size[0]}x{size[1]}"] = tokens[0, :, ::4]
    identity = torch.eye(7)[None, :, None]  # [1, samples as channels, 1, 7]
    for antialias in (False, True):
        for new in (3, 7, 12):
            found = torch.nn.functional.interpolate(
                identity, (1, new), mode="bicubic", antialias=antialias
            )
            arrays[f"bicubic__{new}__{antialias}"] = found[0, :, 0].T.numpy()
    np.savez_compressed(HERE / "backbones.npz", info=json.dumps(info), **arrays)


if __name__ == "__main__":
    main(sys.argv[1])
