"""User errors and notes to users, and the function that prints them."""

import difflib
import os
import reprlib
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

#: A message lists the names there are if they are no more than these.
MAX_LISTED = 20


class UserError(ValueError):
    """Something the user gave cannot be used. The message is one line: what was wrong, what to give instead."""


class UserNote(UserWarning):
    """Something that the user should know of a result. The message is one line."""


def exit_code(command: Callable[[], object], prog: str) -> int:
    """
    Run a command for the shell. Errors and notes of this package are printed as one line each.

    :param command: Function without arguments
    :param prog: The command as the user typed it; begins the message of an error
    :return: The command's result if that is a number, else 0; 2 after a ``UserError``, 130 after Ctrl-C, 141 if nobody reads
        the output any more (``| head``)
    """
    try:
        with _notes_as_lines():
            result = command()
        sys.stdout.flush()
    except UserError as error:
        print(f"{prog}: error: {one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        print(f"{prog}: {interrupt or 'interrupted'}", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Python flushes once more when it ends, which must not fail again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return result if isinstance(result, int) else 0


@contextmanager
def _notes_as_lines() -> Iterator[None]:
    """Print a ``UserNote`` without the line of code that it comes from."""
    with warnings.catch_warnings():
        show = warnings.showwarning

        def show_note(message: Any, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, UserNote):
                print(f"note: {message}", file=sys.stderr)
            else:
                show(message, category, *where, **more)

        warnings.showwarning = show_note
        warnings.simplefilter("always", UserNote)
        yield


def check_known(kind: str, name: str, known: Iterable[str]) -> None:
    """
    :param kind: Kind of thing that is named, for the message
    :param name: Name that the user gave
    :param known: Known names
    :raises UserError: If the name is not known; the message has the nearest one
    """
    names = sorted(known)
    if name in names:
        return
    # Compared without case, since to difflib "pourwater-v0" and "PourWater-v0" are two letters apart.
    folded = {candidate.casefold(): candidate for candidate in names}
    nearest = difflib.get_close_matches(name.casefold(), folded, n=1)
    if nearest:
        hint = f"did you mean {folded[nearest[0]]}?"
    else:
        hint = f"choose from {', '.join(names)}" if len(names) <= MAX_LISTED else "no name is near it"
    raise UserError(f"unknown {kind} {name!r}; {hint}")


def short(value: Any) -> str:
    """Any value from a file for a message: a few elements of what is nested, however large, and 80 characters of a text."""
    shortened = reprlib.Repr()
    shortened.maxstring = 80
    return shortened.repr(value)


def one_line(error: BaseException) -> str:
    """The message of an error of another package, as one line."""
    return " ".join(str(error).split()) or type(error).__name__
