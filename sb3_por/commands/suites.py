"""The command that does many runs: suite."""

import argparse

from sb3_por.commands.command import Command


def _suite_arguments(parser: argparse.ArgumentParser) -> None:
    names = "a file with algos, envs, seeds and more, or the name of a suite that comes along, such as main"
    parser.add_argument("suite", metavar="SUITE.yml|NAME", help=names)
    parser.add_argument("--root", default="runs", help="runs go to <root>/<suite>/<env>/<algo>/seed_<seed> (default runs)")
    parser.add_argument("--dry-run", action="store_true", help="print the runs and their states, and do nothing")
    parser.add_argument(
        "--ray",
        nargs="?",
        const="auto",
        metavar="ADDRESS",
        help="do the runs on a Ray cluster: the one that this machine is of, or that of ADDRESS, such as 10.0.0.1:6379",
    )


def _suite(args: argparse.Namespace) -> int:
    from sb3_por.suites.run_suite import run_suite

    return run_suite(args.suite, args.root, args.dry_run, args.ray)


COMMANDS = {
    "suite": Command(
        help="run what is left to do of a grid of algorithms, environments and seeds",
        example="smoke --dry-run",
        add_arguments=_suite_arguments,
        run=_suite,
    ),
}
