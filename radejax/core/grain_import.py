"""grain, which imports orbax, without a change of the program's logging."""

from radejax.core.orbax_import import keep_root_logger

with keep_root_logger():
    import grain as grain
