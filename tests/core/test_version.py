"""The commits that runs, exports and reports name."""

import subprocess

from radejax.core import version


def test_the_commit_of_a_clone_tells_of_changes(tmp_path, monkeypatch):
    assert version.commit(tmp_path) == "not in a repository"

    def git(*words):
        user = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
        command = ["git", "-C", str(tmp_path), *user, *words]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    (tmp_path / "a.txt").write_text("1")
    git("init", "-q")
    assert version.commit(tmp_path).startswith("unknown: ")  # nothing is committed
    git("add", ".")
    git("commit", "-qm", "Add")
    git("tag", "v1")
    assert version.commit(tmp_path) == git("rev-parse", "HEAD")
    (tmp_path / "a.txt").write_text("2")
    (tmp_path / "more").mkdir()
    assert version.commit(tmp_path / "more") == f"{git('rev-parse', 'HEAD')}-dirty"
    # A package in an environment inside of a clone is not that clone's.
    place = tmp_path / "site" / "radejax" / "core" / "version.py"
    monkeypatch.setattr(version, "__file__", str(place))
    version.radejax_commit.cache_clear()
    assert version.radejax_commit() == "not in a repository"
    version.radejax_commit.cache_clear()
    monkeypatch.setenv("PATH", str(tmp_path))
    assert version.commit(tmp_path) == "unknown: git is not installed"
