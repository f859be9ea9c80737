"""Trains a detector, then evaluates it.

    python train.py --config configs/quickstart.py
    python train.py --config configs/radenet.py:official --data /data/kradar1,/data/kradar2
    python train.py --config configs/radenet.py --config.train.batch_size=4 ...

Run the same command again to continue where an earlier start ended. On several hosts
start it once on each, with --distributed (docs/training.md, examples/slurm.sh).
"""

from absl import app, flags
from ml_collections import config_flags

from radejax.cli import entry

_CONFIG = config_flags.DEFINE_config_file("config", None, "Config file, with :words.")
_WORKDIR = flags.DEFINE_string(
    "workdir", None, "Folder of the run; runs/<name of the config> by default."
)
_DATA = flags.DEFINE_multi_string(
    "data",
    None,
    "Root folders of K-Radar: A,B or repeated. Without it, configs with a `simulation` "
    "section simulate one under data/.",
)
_LABELS = flags.DEFINE_string(
    "labels", None, "Folder or zip of a label revision; the sequences' own by default."
)
_SEQUENCES = flags.DEFINE_multi_string(
    "sequences", None, "Only these, 1,58: --config.data.sequences."
)
_WEATHER = flags.DEFINE_multi_string(
    "weather", None, "Only sequences of these, fog,rain: --config.data.weather."
)
_RECORDS = flags.DEFINE_string(
    "records", None, "Folder of projected frames; made beside the data if missing."
)
_INIT = flags.DEFINE_string(
    "init_from", None, "Start from these weights: official .pth, or another workdir."
)
_EMBEDDINGS = flags.DEFINE_string(
    "embeddings", None, "Folder of `radejax embed`, to train from in place of images."
)
_BACKBONE = flags.DEFINE_string(
    "image_backbone",
    None,
    "Weights of the image backbone: a DINOv3 folder from Hugging Face, or torchvision's "
    "ResNet-50 file.",
)
_CALIBRATION = flags.DEFINE_string(
    "camera_calibration",
    None,
    "Folder of camera calibrations (calib_seq_v2/ and common/ of K-Radar's repository); "
    "the roots' own by default.",
)
_DISTRIBUTED = flags.DEFINE_bool(
    "distributed", False, "One of several processes, as Slurm and others start them."
)
_COORDINATOR = flags.DEFINE_string(
    "coordinator", None, "host:port of process 0, where no cluster tells."
)
_NUM_PROCESSES = flags.DEFINE_integer("num_processes", None, "Likewise.")
_PROCESS_ID = flags.DEFINE_integer("process_id", None, "Likewise, from 0.")
_DEBUG = flags.DEFINE_bool("debug", False, "Show tracebacks of user errors.")
flags.mark_flag_as_required("config")


def main(arguments: list[str]) -> None:
    """Runs the whole way from data to metrics."""
    with entry.exit_codes(debug=_DEBUG.value):
        entry.check_leftovers(arguments[1:])
        entry.set_up_jax()
        place = _COORDINATOR.value, _NUM_PROCESSES.value, _PROCESS_ID.value
        if _DISTRIBUTED.value or place != (None,) * 3:
            entry.join_processes(*place)
        from radejax.core.config import config_name
        from radejax.runs import experiment, seeds
        from radejax.runs.sources import Sources

        config = _CONFIG.value
        if _SEQUENCES.value is not None:
            config.data.sequences = entry.numbers("--sequences", _SEQUENCES.value)
        if _WEATHER.value is not None:
            config.data.weather = entry.words(_WEATHER.value)
        sources = Sources(
            data=entry.words(_DATA.value or ()),
            labels=_LABELS.value,
            records=_RECORDS.value,
            embeddings=_EMBEDDINGS.value,
            image_backbone=_BACKBONE.value,
            camera_calibration=_CALIBRATION.value,
        )
        run = seeds.run_seeds if config.seeds else experiment.run
        run(
            config,
            name=config_name(flags.FLAGS["config"].config_filename),
            sources=sources,
            workdir=_WORKDIR.value,
            init_from=_INIT.value,
        )


if __name__ == "__main__":
    app.run(main, flags_parser=entry.parse_flags)
