"""The version of radejax, and the commits of clones."""

import functools
import pathlib
import subprocess

__version__ = "0.4.0"


def commit(folder: pathlib.Path) -> str:
    """Returns the commit of a folder's clone, with "-dirty" if tracked files were changed.

    Returns:
        The commit, "not in a repository", or "unknown" with the reason.
    """
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, check=False
        )
    except FileNotFoundError:
        return "unknown: git is not installed"
    if "not a git repository" in done.stderr:
        return "not in a repository"
    return done.stdout.strip() or f"unknown: {done.stderr.strip()}"


@functools.cache
def radejax_commit() -> str:
    """Returns the commit of radejax's own clone, see `commit`.

    An installed package is in no clone, even if its environment is in that of another
    project.
    """
    clone = pathlib.Path(__file__).parents[2]
    return commit(clone) if (clone / ".git").exists() else "not in a repository"
