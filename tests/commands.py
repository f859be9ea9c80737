"""Commands of `radejax` in this process."""

from click.testing import CliRunner

from radejax.cli.main import main


def run(*words, code=0):
    """Result of `radejax WORDS...`, which has to end with this exit code."""
    done = CliRunner().invoke(main, [str(word) for word in words])
    assert done.exit_code == code, done.output
    assert "Traceback" not in done.output
    return done
