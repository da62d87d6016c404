"""One thread for small networks, unless the user has chosen another number."""

import os

import torch as th

#: PyTorch's default (a thread for every core), or the user's choice before the import
_DEFAULT = th.get_num_threads()
_is_first = True


def use_one_thread() -> None:
    """
    Let PyTorch compute with one thread, in the whole process, once the first model is built.

    PyTorch's default is a thread for every core. OpenMP's barriers wait for all of them, so that one other busy process makes
    the updates of small networks ten times slower, while two threads gain 7 % on a quiet machine. Nothing changes if
    ``OMP_NUM_THREADS`` is set, or if the number of threads is not the default any more. A later ``torch.set_num_threads()``
    wins, too.
    """
    global _is_first
    if _is_first and "OMP_NUM_THREADS" not in os.environ and th.get_num_threads() == _DEFAULT == os.cpu_count():
        th.set_num_threads(1)
    _is_first = False
