"""Copies the folder of a running run to another machine, where the run can be resumed from it at any moment."""

import uuid
from pathlib import Path

from sb3_por.common.files import atomic_write
from sb3_por.runs.folder import CHECKPOINTS, discard, latest_checkpoint
from sb3_por.runs.origin import mark_as_own
from sb3_por.suites.run import Run

#: Path in ``Run.folder`` -> content of a file that is new or has changed, ``None`` of one that is gone.
Changes = dict[str, bytes | None]
#: Path in ``Run.folder`` -> time of the last change in ns and size.
Stamps = dict[str, tuple[int, int]]


def read_changes(run: Run, known: Stamps) -> Changes:
    """
    :param run: a run, perhaps at work
    :param known: Stamps of the files in the copy; updated
    :return: what the copy lacks; if that has a checkpoint, all of it
    """
    while True:
        checkpoint = latest_checkpoint(run.run_folder)
        try:
            stamps = _stamps(run.folder)
            new: Changes = {name: (run.folder / name).read_bytes() for name, at in stamps.items() if known.get(name) != at}
        except FileNotFoundError:
            continue  # removed between two lines
        # A checkpoint loses files only after the next one is there.
        if latest_checkpoint(run.run_folder) == checkpoint:
            break
    gone: Changes = {name: None for name in known if name not in stamps}
    known.clear()
    known.update(stamps)
    return new | gone


def _stamps(folder: Path) -> Stamps:
    """Of all files but hidden ones: those are locks and files that are being written."""
    stamps = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder)
        if path.is_file() and not any(part.startswith(".") for part in name.parts):
            stat = path.stat()
            stamps[str(name)] = stat.st_mtime_ns, stat.st_size
    return stamps


def write_changes(run: Run, changes: Changes) -> None:
    """
    Bring a copy up to date. A copy that is interrupted at any point can be resumed from.

    :param run: the run whose folder is the copy
    :param changes: from ``read_changes``
    """
    checkpoints = run.run_folder / CHECKPOINTS
    of_steps: dict[Path, Changes] = {}
    others: Changes = {}
    for name, content in changes.items():
        path = run.folder / name
        step = next((folder for folder in path.parents if folder.parent == checkpoints), None)
        if step is not None and step.name.startswith("step_"):
            of_steps.setdefault(step, {})[str(path.relative_to(step))] = content
        else:
            others[name] = content
    _write_all(run.folder, others)
    for step, files in of_steps.items():
        if None not in files.values():
            # Atomically, and after the blocks that it refers to.
            temporary = checkpoints / f".{uuid.uuid4().hex}"
            _write_all(temporary, files)
            temporary.rename(step)
    for step, files in of_steps.items():
        if None in files.values():
            discard(step)
    for name, content in others.items():
        if content is None:
            (run.folder / name).unlink(missing_ok=True)
    for empty in (checkpoints / "blocks", checkpoints):
        if empty.is_dir() and not any(empty.iterdir()):
            empty.rmdir()
    if run.run_folder.is_dir():
        mark_as_own(run.run_folder)


def _write_all(folder: Path, changes: Changes) -> None:
    for name, content in changes.items():
        if content is not None:
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(path) as temporary:
                temporary.write_bytes(content)
