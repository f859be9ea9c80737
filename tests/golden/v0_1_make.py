"""How `v0.1.zip` was made by the code of 0.1, in a checkout of a84f22f.

    python v0_1_make.py OUT && cd OUT && zip -9 -X ../v0.1.zip $(find . -type f | sort)

The name of its temporary folder was replaced afterwards by one of the same length.

A run of one step with its records, and a packed model and embeddings of small detectors.
"""

import pathlib
import shutil
import subprocess
import sys
import tempfile

import numpy as np

OVERRIDES = {
    "simulation.train_sequences": 1,
    "simulation.test_sequences": 1,
    "simulation.frames_per_sequence": 2,
    "simulation.grid.num_range": 16,
    "simulation.grid.num_azimuth": 12,
    "simulation.grid.num_doppler": 2,
    "simulation.grid.num_elevation": 3,
    "model.doppler_bins": 2,
    "model.elevation_bins": 3,
    "model.widths": (4, 4),
    "model.decoder_width": 4,
    "model.num_groups": 2,
    "model.neck": "plain",
    "model.heads": "default",
    "train.batch_size": 2,
    "train.num_epochs": 1,
    "evaluation.num_pictures": 0,
}


def main(out: pathlib.Path) -> None:
    """Writes every kind of file."""
    words = [f"--config.{name}={value}" for name, value in OVERRIDES.items()]
    with tempfile.TemporaryDirectory() as folder:
        run, data = pathlib.Path(folder) / "run", pathlib.Path(folder) / "data"
        command = [sys.executable, "train.py", "--config=configs/quickstart.py:short"]
        command += [*words, f"--workdir={run}", f"--data={data}"]
        subprocess.run(command, check=True)
        shutil.copytree(run / "checkpoints", out / "run" / "checkpoints")
        shutil.copy(run / "config.json", out / "run" / "config.json")
        shutil.copytree(data / "records", out / "records")

        sys.path.insert(0, str(pathlib.Path.cwd()))
        from radejax import checkpoint_files, embed
        from radejax.data.kradar import KRadar
        from tests import small_models as small

        detector = small.detector()
        checkpoint_files.write_packed(out / "packed", detector)
        found = detector(small.projections(1))
        names = ("boxes", "scores", "classes", "is_valid")
        arrays = {name: np.asarray(getattr(found, name)) for name in names}
        np.savez_compressed(out / "packed_found.npz", **arrays)
        camera, config = small.detector("camera"), small.camera_config()
        frames = KRadar([data])
        arguments = camera.model, camera.variables, config.model.image.to_dict(), frames
        embed.embed_dataset(*arguments, out / "embeddings", resize=True, progress=False)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]).resolve())
