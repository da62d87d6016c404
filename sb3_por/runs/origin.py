"""Origin of a run's folder: whether this user's train.py made it, at this place."""

import contextlib
import hashlib
import hmac
import os
import secrets
import warnings
from pathlib import Path

from sb3_por.common.errors import UserNote

#: File in a run's folder that proves its origin; nobody can write it without the user's key
MARKER = ".origin"


def mark_as_own(run: Path) -> None:
    """
    Mark a run's folder as made here. Where the key or the mark cannot be written, it stays unmarked.

    :param run: The folder
    """
    key = _key(create=True)
    if key:
        with contextlib.suppress(OSError):
            (run / MARKER).write_text(_tag(key, run))


def is_own(run: Path) -> bool:
    """
    :param run: A run's folder
    :return: Whether ``mark_as_own`` marked it with this user's key, and it was not moved since
    """
    key = _key(create=False)
    try:
        return bool(key) and hmac.compare_digest((run / MARKER).read_bytes(), _tag(key, run).encode())
    except OSError:
        return False


def note_foreign(model: Path) -> None:
    """
    Warn with a ``UserNote`` of a model that ``train.py`` did not write here.

    :param model: Its ``.zip``
    """
    if not any(is_own(folder) for folder in model.absolute().parents[:3]):  # a checkpoint lies two folders below its run
        message = f"{model} was not written by train.py here, and loading it runs the code that is pickled in it"
        warnings.warn(f"{message}; --safe (load_safe in Python) runs none", UserNote)


def _tag(key: bytes, run: Path) -> str:
    return hmac.new(key, os.fsencode(run.resolve()), hashlib.sha256).hexdigest()


def _key(create: bool) -> bytes:
    """The user's secret, kept among the state of programs; empty if there is none."""
    file = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "sb3_por" / "key"
    try:
        if create and not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            temporary = file.with_name(f"key.{secrets.token_hex(8)}")
            temporary.touch(mode=0o600)
            temporary.write_bytes(secrets.token_bytes(32))
            try:
                os.link(temporary, file)  # the first of two processes wins
            except FileExistsError:
                pass
            finally:
                temporary.unlink()
        return file.read_bytes()
    except (OSError, RuntimeError):
        return b""
