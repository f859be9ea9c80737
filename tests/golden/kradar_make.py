"""Makes kradar_official.npz: AP of a made-up scene by K-Radar's own evaluation code.

    git clone https://github.com/kaist-avelab/K-Radar
    NUMBA_ENABLE_CUDASIM=1 python tests/golden/kradar_make.py K-Radar

The scene is `kradar_scene` of tests/evaluation/scenes.py: boxes from a seed, no K-Radar data. The
code is that of commit 97fe0a6, unchanged, with numba 0.68.1 and NumPy 2.4.6, and its kernel for
the overlaps runs in numba's CUDA simulator. Needs radejax, numba and scikit-image.

    ap: [variant, score cut, condition, space, IoU, class], percent.
    scores, precision: [variant, space, IoU, class, 41] of all frames without a cut.

Variants: "revised" and "legacy" evaluation, and "corrected", which is the revised one on boxes
with length and width exchanged (K-Radar's issue 81).
"""

import pathlib
import sys
import tempfile

import numpy as np

HERE = pathlib.Path(__file__).parent
KEYS = ("sed", "bus", "ped", "mot", "bic")
NUMBERS = {"sed": 0, "bus": 1, "mot": 2, "bic": 3, "ped": 5}
IOUS = (0.3, 0.5, 0.7)
CUTS = (0.0, 0.35)
CONDITIONS = ("all", "normal", "fog", "rain")
VARIANTS = ("revised", "legacy", "corrected")


def main(clone: pathlib.Path) -> None:
    """Writes the file."""
    sys.path[:0] = [str(clone), str(HERE.parents[1]), str(HERE.parent / "evaluation")]
    import scenes
    from utils.kitti_eval import eval_revised, kitti_common

    from radejax.evaluation import kitti

    _remember(eval_revised)
    shape = (len(VARIANTS), len(CUTS), len(CONDITIONS), 2, len(IOUS), len(KEYS))
    ap = np.zeros(shape)
    curves = np.zeros((2, len(VARIANTS), 2, len(IOUS), len(KEYS), 41))
    with tempfile.TemporaryDirectory() as folder:
        for c, cut in enumerate(CUTS):
            kitti.write_kitti(folder, *scenes.kradar_scene(), score_threshold=cut)
            for k, condition in enumerate(CONDITIONS):
                place = pathlib.Path(folder) / str(cut) / condition
                ids = [int(line) for line in (place / "val.txt").read_text().split()]
                both = [
                    kitti_common.get_label_annos(str(place / kind), ids)
                    for kind in ("gts", "preds")
                ]
                for v, variant in enumerate(VARIANTS):
                    for s in (0, 1):
                        found = _curves(eval_revised, both, variant, metric=s + 1)
                        step = 4 if variant == "legacy" else 1
                        samples = found["precision"][:, 0, :, ::step]
                        mean = 100 * samples.sum(-1) / samples.shape[-1]
                        ap[v, c, k, s] = mean.T
                        if (c, k) == (0, 0):
                            for i, name in enumerate(("thresholds", "precision")):
                                curves[i, v, s] = found[name][:, 0].swapaxes(0, 1)
                    print(cut, condition, variant, flush=True)
    np.savez_compressed(
        HERE / "kradar_official.npz",
        ap=ap,
        scores=curves[0].astype(np.float32),
        precision=curves[1].astype(np.float32),
        ious=np.array(IOUS),
        cuts=np.array(CUTS),
        conditions=np.array(CONDITIONS),
    )


def _curves(module, both, variant, metric):
    if variant == "corrected":
        both = [[_exchanged(frame) for frame in frames] for frames in both]
    overlaps = np.broadcast_to(np.array(IOUS)[:, None, None], (3, 3, 8))
    numbers = [NUMBERS[key] for key in KEYS]
    z_center = 1.0 if variant == "legacy" else 0.5
    return module.eval_class(
        *both, numbers, (0,), metric, overlaps[:, :, numbers], z_center=z_center
    )


def _exchanged(frame):
    """A frame whose boxes have length and width exchanged."""
    return {**frame, "dimensions": frame["dimensions"][:, [2, 1, 0]]}


def _remember(module):
    """Let the slow overlaps of equal boxes be computed once."""
    compute, known = module.rotate_iou_gpu_eval, {}

    def overlaps(boxes, others, criterion=-1):
        key = boxes.tobytes(), others.tobytes(), criterion
        if key not in known:
            known[key] = compute(boxes, others, criterion)
        return known[key].copy()

    module.rotate_iou_gpu_eval = overlaps


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
