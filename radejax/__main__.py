"""The program `radejax` as `python -m radejax`."""

from radejax.cli.main import main

main(prog_name="radejax")
