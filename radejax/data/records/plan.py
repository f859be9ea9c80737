"""Whose a folder of records is: `plan.json`, which the job that began there wrote."""

from __future__ import annotations

import pathlib
from typing import Any

from radejax.core import files
from radejax.data.encoding import Encoding
from radejax.data.records.arrays import MANIFEST
from radejax.data.records.files import MEND
from radejax.data.records.projections import Manifest, read_manifest

PLAN = "plan.json"
_WHAT = "projections"


_USUAL = {"dtype": "float16", "compress": False}


def encoding_there(folder: pathlib.Path) -> dict[str, Any]:
    """How a folder stores records, "dtype" and "compress"; as usual where none are yet."""
    path = folder / PLAN
    hint = {"dtype": Encoding, "compress?": bool}
    found = files.read_json(path, hint, mend=MEND) if path.is_file() else {}
    return _USUAL | found


def claim_folder(
    folder: pathlib.Path, plan: dict[str, Any]
) -> tuple[Manifest | None, str]:
    """Makes a folder a job's, or finds what a finished job has done of it.

    A finished folder serves all label revisions: what is added for frames that it lacks
    has names of its own. A plan of which nothing is done gives way.

    Args:
        folder: Of the records.
        plan: Type, grid, number and digest of the frames, frames of one file.

    Returns:
        What another job finished there, or None; and how to name files of records.

    Raises:
        UserError: The folder holds another projection.
        DataError: Its plan or manifest is damaged.
    """
    path, is_done = folder / PLAN, (folder / MANIFEST).exists()
    is_same = path.exists() and _renewed(files.read_json(path)) == plan
    is_begun = is_done or any(
        path.name.lstrip(".").startswith(_WHAT) for path in folder.glob("*")
    )
    if path.exists() and not is_begun:
        files.write_json(path, plan)
    files.claim(
        path,
        plan,
        "another projection",
        mend="choose another folder, delete that one, or finish it with the frames that "
        "it was begun with: a finished one serves all label revisions",
        ignore=("num_frames", "frames_sha256", "frames_per_file") if is_done else (),
        renewed=_renewed,
    )
    if is_same or not is_done:
        return None, _WHAT
    return read_manifest(folder), f"{_WHAT}-{plan['frames_sha256'][:8]}"


def _renewed(plan: Any) -> dict[str, Any]:
    """A plan of before records could be compressed."""
    return {"compress": False, **plan}
