"""Memory that is freed and taken again."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import ctypes, resource, threading
from radejax.core import memory
memory.keep_freed()
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
libc.free.argtypes = libc.memset.argtypes = None
faults = []
def take():
    for _ in range(4):
        block = ctypes.c_void_p(libc.malloc(400 << 20))
        libc.memset(block, 1, ctypes.c_size_t(400 << 20))
        libc.free(block)
        faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
thread = threading.Thread(target=take)  # as JAX's steps do
thread.start()
thread.join()
print(faults[-1] - faults[0])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's allocator")
@pytest.mark.parametrize("is_said", [False, True])
def test_freed_memory_is_taken_again_without_new_pages(is_said: bool) -> None:
    said = {"MALLOC_TOP_PAD_": "131072"} if is_said else {}
    theirs = ("MALLOC_", "GLIBC_TUNABLES")
    others = {k: v for k, v in os.environ.items() if not k.startswith(theirs)}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=others | said,
        capture_output=True,
        text=True,
        check=True,
    )
    pages = 3 * (400 << 20) // os.sysconf("SC_PAGE_SIZE")
    taken = int(done.stdout)
    assert taken < 0.01 * pages if not is_said else taken > 0.5 * pages
