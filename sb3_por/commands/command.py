"""A command, and the arguments that several commands share."""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Command:
    """
    A command.

    :param help: one line
    :param example: arguments of a call that works
    :param add_arguments: gives the arguments to its parser
    :param run: carries it out; may return an exit code
    """

    help: str
    example: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], object]


def seed(text: str) -> int:
    """
    :param text: What was typed
    :return: A seed as numpy takes it
    :raises argparse.ArgumentTypeError: If it is none
    """
    if not text.isdecimal() or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 to {2**32 - 1}, got {text!r}")
    return int(text)


def model_arguments(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """
    Add the arguments that name a model and its environment.

    :param parser: Parser of a command
    :param required: Whether the command needs a model
    """
    which = parser.add_mutually_exclusive_group(required=required)
    models = "a .zip, a run folder (its best model), random, nothing, or expert"
    which.add_argument("--model", help=models)
    agent = "the trained agent that comes with the package; the best, or that of --algo"
    which.add_argument("--pretrained", action="store_true", help=agent)
    parser.add_argument("--env", required=required, help="environment id")
    algo = "algorithm that saved the model, if it cannot be told from the file; with --pretrained the agent's, or its label"
    parser.add_argument("--algo", help=algo)
    safe_argument(parser)


def safe_argument(parser: argparse.ArgumentParser) -> None:
    """
    Add ``--safe``.

    :param parser: Parser of a command
    """
    safe = "run nothing that the model's file or folder holds: for models of strangers"
    parser.add_argument("--safe", action="store_true", help=safe)


def load_model_and_environment(args: argparse.Namespace) -> tuple[Any, dict[str, Any]]:
    """
    :param args: Parsed arguments; ``env`` becomes the full id, and ``model`` the file of ``--pretrained``
    :return: The model, and the environment that it was trained in as arguments of ``evaluate``
    :raises UserError: If there is no such model or environment
    """
    import softbody_envs  # noqa: F401  (registers its ids)
    from sb3_por.evaluation.loading import find_environment, resolve
    from sb3_por.evaluation.reference_policies import REFERENCES

    is_reference = args.model in REFERENCES
    args.env = find_environment(args.env, None if is_reference or args.pretrained else args.model, args.safe)
    if args.pretrained:
        from sb3_por.sharing.agents import find_agent

        args.model = find_agent(args.env, args.algo).model
        return resolve(args.model, args.env)
    if is_reference:
        return REFERENCES[args.model](args.env), {}
    return resolve(args.model, args.env, algo=args.algo, safe=args.safe)
