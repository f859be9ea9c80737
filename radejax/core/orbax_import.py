"""orbax, imported without a change of the program's logging.

The first message that orbax logs by absl, at its import, would configure the root logger if it
has no handlers. `logging.basicConfig` of the program would then have no effect.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator


@contextlib.contextmanager
def keep_root_logger() -> Iterator[None]:
    """Keeps absl from configuring the root logger while a block runs."""
    handler = logging.NullHandler()
    logging.root.addHandler(handler)
    try:
        yield
    finally:
        logging.root.removeHandler(handler)


with keep_root_logger():
    import orbax.checkpoint as ocp
    from orbax.checkpoint import checkpoint_managers as policies

__all__ = ["keep_root_logger", "ocp", "policies"]
