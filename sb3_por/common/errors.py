"""Errors that a user can mend, and the one place that shows them."""

import difflib
import os
import sys
from collections.abc import Callable, Iterable

#: A message lists the names there are if they are no more than these.
MAX_LISTED = 20


class UserError(ValueError):
    """Something the user gave cannot be used. The message is one line: what was wrong, what to give instead."""


def exit_code(command: Callable[[], object], prog: str) -> int:
    """
    Run a command for the shell.

    :param command: called without arguments
    :param prog: what the user typed, starts the message
    :return: what the command returns if that is a number, else 0; 2 after a ``UserError``, shown as one line on stderr;
        130 after Ctrl-C, 141 when whoever reads the output has gone (``| head``)
    """
    try:
        result = command()
        sys.stdout.flush()
    except UserError as error:
        print(f"{prog}: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        print(f"{prog}: {interrupt or 'interrupted'}", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Python flushes once more when it ends, which must not fail again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return result if isinstance(result, int) else 0


def check_known(kind: str, name: str, known: Iterable[str]) -> None:
    """
    :param kind: what the name is a name of, for the message
    :param name: what the user gave
    :param known: the names there are
    :raises UserError: if the name is not known; says the nearest one
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


def one_line(error: BaseException) -> str:
    """The message of an error of another package, as one line."""
    return " ".join(str(error).split()) or type(error).__name__
