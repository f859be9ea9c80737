"""Makes `released.npz`: extracts of the reference dataset, for tests without `../shared`.

    python tests/golden/released_make.py ../shared/fixtures

The reference numbers are outputs of the released RADE-Net and DinoRADE code (commit 9a94d64), of
Hugging Face transformers 5.23.0 and of `torch.save`, from seeded weights and inputs
(`seeded_tensor` of `dinorade_make.py`), with PyTorch 2.13.0 on a CPU. The file keeps every fourth
row, column and token, and the names and shapes of the official tensors.
"""

import json
import pathlib
import sys

import numpy as np

RADENET = ("default", "base", "no_cbam", "stem", "expand256", "default_heads")
RADENET += ("default_neck",)
LISTINGS = (
    *(f"radenet/{variant}" for variant in RADENET),
    *("dinorade/end_to_end", "dinov3/vits16"),
)
TORCH_FILES = ("nested_checkpoint", "mixed_dtypes", "channel_attention_legacy")


def thinned(file, name, rows="rows", cols="cols"):
    """A map `[C, rows, cols]` on fewer rows and columns, which are kept as well."""
    return {
        name: file[name][:, ::4, ::4],
        rows: file[rows][::4],
        cols: file[cols][::4],
    }


def main(fixtures: pathlib.Path) -> None:
    """Writes the file."""
    arrays: dict[str, np.ndarray] = {}

    def keep(group: str, found: dict[str, np.ndarray]) -> None:
        arrays.update({f"{group}/{name}": value for name, value in found.items()})

    for name in LISTINGS:
        content = json.loads((fixtures / f"{name}_params.json").read_text())
        shapes = {t["name"]: t["shape"] for t in content["tensors"]}
        arrays[f"{name}/tensors"] = np.array(json.dumps(shapes))
    for variant in RADENET:
        file = np.load(fixtures / f"radenet/{variant}.npz")
        for name in ("heatmap", "regression"):
            keep(f"radenet/{variant}", thinned(file, name))
            keep(f"radenet/{variant}", {f"{name}_stats": file[f"{name}_stats"]})
    file = np.load(fixtures / "dinorade/end_to_end.npz")
    for name in ("heatmap", "regression"):
        keep("dinorade/end_to_end", thinned(file, name))
    file = np.load(fixtures / "dinorade/geometry.npz")
    names = ("valid_packed", "near_mask_border_packed")
    keep("dinorade/geometry", {name: file[name] for name in names})
    file = np.load(fixtures / "dinov3/vits16.npz")
    config = json.loads((fixtures / "dinov3/vits16_config.json").read_text())
    arrays["dinov3/config"] = np.array(json.dumps(config))
    names = ("token_index", "last_hidden_state")
    keep("dinov3/720x1280", {k: file[f"720x1280__{k}"][::4] for k in names})
    file = np.load(fixtures / "deform_attn/deform_attn.npz")
    name = "initial_bias__d128_l1_h4_p8"
    keep("deform_attn", {name: file[name]})
    for name in TORCH_FILES:
        content = (fixtures / f"torch_files/{name}.pth").read_bytes()
        arrays[f"torch_files/{name}"] = np.frombuffer(content, np.uint8)
    for name in ("channel_attention", "mixed_dtypes"):
        file = np.load(fixtures / f"torch_files/{name}_expected.npz")
        keep(f"torch_expected/{name}", dict(file))
    np.savez_compressed(pathlib.Path(__file__).with_name("released.npz"), **arrays)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
