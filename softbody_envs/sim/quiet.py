"""Keeps Bullet's own messages out of the terminal, and above all out of ``--json`` output."""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet() -> Iterator[None]:
    """
    Send what C code prints to nowhere, for the time of a ``with`` block.

    PyBullet prints its build time (standard error) on import and ``argv[0]=`` (standard output) on connect through C's
    ``printf``, out of the reach of ``contextlib.redirect_stdout``; C's buffers are flushed before and after, or the
    text would appear at exit.
    """
    flush = ctypes.CDLL(None).fflush
    flush(None)
    saved = os.dup(1), os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        yield
    finally:
        flush(None)
        os.dup2(saved[0], 1)
        os.dup2(saved[1], 2)
        for descriptor in (*saved, nowhere):
            os.close(descriptor)
