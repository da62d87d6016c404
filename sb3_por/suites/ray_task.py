"""What a machine of a Ray cluster does with a run. Imports no PyTorch: every worker of the cluster waits for this module."""

import platform
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import ray

from sb3_por.runs.versions import current_versions
from sb3_por.suites.folder_sync import Changes, Stamps, read_changes, write_changes
from sb3_por.suites.run import Run, start_process

#: Seconds between two messages of a run about the files that it has written
SEND_S = 2.0


@dataclass(frozen=True)
class Message:
    """
    :param changes: Files of the run's folder that are new, have changed or are gone since the last message
    :param returncode: That of the run's process; None before it has ended
    :param machine: Name of the machine, in the first message
    :param versions: Those of its code and packages, in the first message
    """

    changes: Changes
    returncode: int | None = None
    machine: str = ""
    versions: dict[str, str] | None = None


@ray.remote(num_returns="streaming", max_retries=0)
def do_run(run: Run, threads: int, files: Changes) -> Iterator[Message]:
    """
    Do a run in a temporary folder, and report every change there.

    :param run: The run
    :param threads: Threads of its process
    :param files: Files of the run's folder at the start
    :return: Messages, the last one with the return code
    """
    with tempfile.TemporaryDirectory(prefix="sb3_por_") as folder:
        here = replace(run, folder=Path(folder))
        write_changes(here, files)
        known: Stamps = {}
        read_changes(here, known)
        process = start_process(here, threads)
        try:
            yield Message(read_changes(here, known), machine=platform.node(), versions=current_versions())
            while process.returncode is None:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(SEND_S)
                yield Message(read_changes(here, known), process.returncode)
        finally:
            process.kill()
            process.wait()
