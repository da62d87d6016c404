"""Suppresses the line that PyBullet prints when it is imported."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

BANNER = b"pybullet build time:"


@contextmanager
def no_banner() -> Iterator[None]:
    """
    Drop PyBullet's banner from standard error during a ``with`` block.

    The banner is written by C code, which ``contextlib.redirect_stderr`` does not affect. All other output, including that
    of other threads, is held back and appears when the block ends. Redirecting a file descriptor affects the whole process,
    so use this for the import only.
    """
    try:
        stderr = os.dup(2)
    except OSError:  # it is closed
        yield
        return
    with tempfile.TemporaryFile() as written:
        os.dup2(written.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            written.seek(0)
            with open(stderr, "wb") as file:
                file.writelines(line for line in written if not line.startswith(BANNER))
