"""Do something with runs and models. To train one: python train.py --help (installed: sb3-por-train)."""

import argparse
import sys
from typing import Any

from sb3_por.commands import analysis, playing, sharing, suites
from sb3_por.common.errors import UserError, exit_code

COMMANDS = playing.COMMANDS | analysis.COMMANDS | sharing.COMMANDS | suites.COMMANDS


class Parser(argparse.ArgumentParser):
    """Parser whose errors are one line."""

    def error(self, message: str) -> Any:
        raise UserError(f"{message} ({self.prog} --help lists the arguments)")


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    typed = (sys.argv[1:] if arguments is None else arguments)[:1]
    if typed == ["train"]:
        raise UserError("training is a program of its own: python train.py --help (installed: sb3-por-train)")
    parser = Parser(prog="python -m sb3_por", description=__doc__)
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    for name, command in COMMANDS.items():
        subparser = subparsers.add_parser(
            name,
            help=command.help,
            description=command.help.replace("%%", "%"),  # argparse formats help, but no description
            epilog=f"example: python -m sb3_por {name} {command.example}",
        )
        if name in typed:  # the others' arguments are not asked for, and cost imports
            command.add_arguments(subparser)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """
    :param arguments: Arguments of the command; ``sys.argv[1:]`` by default
    :return: the exit code
    """

    def command() -> object:
        args = _parse(arguments)
        return COMMANDS[args.command].run(args)

    return exit_code(command, "python -m sb3_por")


if __name__ == "__main__":
    sys.exit(main())
