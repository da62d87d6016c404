"""Commands that give models to others, and take theirs: export, push, pull."""

import argparse

from sb3_por.commands.command import Command


def _export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="a run's folder")
    parser.add_argument("-o", "--output", required=True, help="folder of agents, which gets <algo>-<env>.zip and .json")
    parser.add_argument("-n", "--n-episodes", type=int, default=50, help="held-out episodes that score it (default 50)")
    parser.add_argument("--last", action="store_true", help="the last model instead of the best")


def _export(args: argparse.Namespace) -> None:
    import softbody_envs  # noqa: F401  (registers its ids)
    from sb3_por.sharing.export import export_run

    agent = export_run(args.run, args.output, args.n_episodes, args.last)
    print(agent.evaluation)
    print(agent.model)


def _push_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="a run's folder; its best model is published")
    parser.add_argument("--repo", required=True, metavar="USER/NAME", help="repository on the hub; made if there is none")
    parser.add_argument("-n", "--n-episodes", type=int, default=10, help="held-out episodes that score it (default 10)")
    parser.add_argument("--private", action="store_true", help="make the repository private")


def _push(args: argparse.Namespace) -> None:
    import softbody_envs  # noqa: F401  (registers its ids)
    from sb3_por.sharing.hub import push

    print(push(args.run, args.repo, args.n_episodes, args.private))


def _pull_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("repo", metavar="USER/NAME", help="repository on the hub")
    parser.add_argument("-o", "--output", required=True, help="new folder, for --model of the other commands")
    parser.add_argument("--env", help="environment id, with its package (package:Name-v0) if need be")
    unsafe = "keep the model's file as it is: loading it runs the code that is pickled in it"
    parser.add_argument("--unsafe", action="store_true", help=unsafe)


def _pull(args: argparse.Namespace) -> None:
    import softbody_envs  # noqa: F401  (registers its ids)
    from sb3_por.sharing.hub import pull

    print(pull(args.repo, args.output, args.env, args.unsafe))


COMMANDS = {
    "export": Command(
        help="write a run's model for others: without pickled code and optimizers, with its settings and scores",
        example="logs/sac_por/PourWater-v0_1 -o agents",
        add_arguments=_export_arguments,
        run=_export,
    ),
    "push": Command(
        help="publish a run's best model on the hub, with its scores, curve, video and settings",
        example="logs/sac_por/PourWater-v0_1 --repo user/sac_por-PourWater-v0",
        add_arguments=_push_arguments,
        run=_push,
    ),
    "pull": Command(
        help="fetch a model from the hub, without running anything that its files hold",
        example="user/sac_por-PourWater-v0 -o sac_por-PourWater-v0",
        add_arguments=_pull_arguments,
        run=_pull,
    ),
}
