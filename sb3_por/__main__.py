"""``python -m sb3_por``: what there is to do with runs and models."""

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sb3_por.common.errors import UserError, exit_code


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> Any:
        raise UserError(f"{message} ({self.prog} --help lists the arguments)")


@dataclass(frozen=True)
class Command:
    """
    A subcommand. What it needs is imported when it runs, so that ``--help`` is quick.

    :param help: one line
    :param example: arguments of a call that works
    :param add_arguments: gives the arguments to its parser
    :param run: carries it out; may return an exit code
    """

    help: str
    example: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], object]


def _seed(text: str) -> int:
    """A seed as numpy takes it."""
    if not text.isdecimal() or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 to {2**32 - 1}, got {text!r}")
    return int(text)


def _model_arguments(parser: argparse.ArgumentParser, required: bool = True) -> None:
    which = parser.add_mutually_exclusive_group(required=required)
    models = "a .zip, a run folder (its best model), random, nothing, or expert"
    which.add_argument("--model", help=models)
    agent = "the trained agent that comes with the package; the best, or that of --algo"
    which.add_argument("--pretrained", action="store_true", help=agent)
    parser.add_argument("--env", required=required, help="environment id")
    parser.add_argument("--algo", help="algorithm that saved the model, if it cannot be told from the file")
    _safe_argument(parser)


def _safe_argument(parser: argparse.ArgumentParser) -> None:
    safe = "run nothing that the model's file or folder holds: for models of strangers"
    parser.add_argument("--safe", action="store_true", help=safe)


def _evaluate_arguments(parser: argparse.ArgumentParser) -> None:
    _model_arguments(parser)
    episodes = "held-out episodes (default 20; with --pretrained those of the published scores)"
    parser.add_argument("-n", "--n-episodes", type=int, help=episodes)
    parser.add_argument("--seed", type=_seed, default=0, help="seed of the first episode (default 0)")
    parser.add_argument("--json", action="store_true", help="print every episode as JSON")


def _load(args: argparse.Namespace) -> tuple[Any, dict[str, Any]]:
    """The model that the arguments name and the environment that it was trained in."""
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


def _evaluate(args: argparse.Namespace) -> None:
    from sb3_por.evaluation.evaluate import evaluate

    model, environment = _load(args)
    published = _published(args) if args.pretrained else None
    if args.n_episodes is None:
        args.n_episodes = 20 if published is None else len(published.returns)
    evaluation = evaluate(model, args.env, args.n_episodes, args.seed, **environment)
    if args.json:
        shown = {"model": str(args.model), "env": args.env, "seed": args.seed, **evaluation.as_dict()}
        print(json.dumps(shown | ({} if published is None else {"published": published.as_dict()}), indent=2))
        return
    print(evaluation)
    if published is not None:
        print(f"published: {published}")


def _published(args: argparse.Namespace) -> Any:
    """The agent's published scores, of the same episodes where they are the same."""
    from sb3_por.sharing.agents import find_agent, read_evaluation

    scores = find_agent(args.env, args.algo).facts["evaluation"]
    return read_evaluation(scores, args.n_episodes if args.seed == scores["seed"] else None)


def _enjoy_arguments(parser: argparse.ArgumentParser) -> None:
    _model_arguments(parser)
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("-o", "--output", help="the video: .gif or .mp4")
    where.add_argument("--human", action="store_true", help="show the episodes in a window instead; pip install '.[human]'")
    parser.add_argument("-n", "--n-episodes", type=int, default=1, help="held-out episodes (default 1)")
    parser.add_argument("--seed", type=_seed, default=0, help="seed of the first episode (default 0)")
    parser.add_argument("--size", type=int, default=480, help="height and width in pixels (default 480)")


def _enjoy(args: argparse.Namespace) -> None:
    from sb3_por.evaluation.show import show_episodes
    from sb3_por.evaluation.video import check_video, record_video

    if args.human:
        model, environment = _load(args)
        print(show_episodes(model, args.env, args.n_episodes, args.seed, args.size, **environment))
        return
    check_video(args.output)
    model, environment = _load(args)
    print(record_video(model, args.env, args.output, args.n_episodes, args.seed, args.size, **environment))
    print(args.output)


def _settings_arguments(parser: argparse.ArgumentParser, use: str) -> None:
    from sb3_por.training.arguments import Settings

    parser.add_argument("--algo", help=f"{use} (default: that of the model; sac_por's for expert)")
    parser.add_argument("-conf", "--conf-file", help="file of these settings, as for train.py")
    changes = "changes to these settings, as for train.py"
    parser.add_argument("-params", "--hyperparams", nargs="+", default={}, action=Settings, metavar="KEY:VALUE", help=changes)
    kwargs = "arguments of the environment, as for train.py"
    parser.add_argument("--env-kwargs", nargs="+", default={}, action=Settings, metavar="KEY:VALUE", help=kwargs)


def _settings(args: argparse.Namespace, needed: bool, demos: bool) -> Any:
    """The environment that the arguments describe; None for that of the model."""
    from sb3_por.training.record import settings_environment

    algo = args.algo or ("sac_por" if needed else None)
    if algo is None and (args.conf_file or args.hyperparams or args.env_kwargs):
        raise UserError("-conf, -params and --env-kwargs are about the settings of an algorithm: give --algo, too")
    changes = args.conf_file, args.hyperparams, args.env_kwargs
    return None if algo is None else settings_environment(algo, args.env, *changes, demos=demos)


def _record_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--model", required=True, help="expert, a .zip, or a run folder (its best model)")
    _safe_argument(parser)
    parser.add_argument("--env", required=True, help="environment id")
    _settings_arguments(parser, "record in the environment that the settings of this algorithm make")
    parser.add_argument("-o", "--output", required=True, help="folder of the new dataset, in Minari's format")
    parser.add_argument("-n", "--n-episodes", type=int, default=50, help="episodes of training scenes (default 50)")
    parser.add_argument("--seed", type=_seed, default=0, help="chooses the scenes (default 0)")


def _record(args: argparse.Namespace) -> None:
    import softbody_envs  # noqa: F401  (registers its ids)
    from sb3_por.evaluation.loading import find_environment
    from sb3_por.training.record import EXPERT, record

    args.env = find_environment(args.env, None if args.model == EXPERT else args.model, args.safe)
    made_of = _settings(args, needed=args.model == EXPERT, demos=True)
    print(record(args.model, args.env, args.output, args.n_episodes, args.seed, made_of, args.safe))
    print(args.output)


def _rank_arguments(parser: argparse.ArgumentParser) -> None:
    from sb3_por.ranking.training import TARGETS

    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("videos", nargs="?", metavar="VIDEOS", help="a Minari dataset, or a folder of .mp4, .gif or .npz files")
    which.add_argument("--model", help="play the videos: expert, a .zip, or a run folder (its best model); needs --env")
    _safe_argument(parser)
    parser.add_argument("--env", help="environment id: its random play in training scenes is what must not rank high")
    _settings_arguments(parser, "play in the environment that the settings of this algorithm make")
    parser.add_argument(
        "-o", "--output", required=True, help="the ranker, .npz; a picture of its potential goes beside it, .png"
    )
    parser.add_argument("-n", "--n-episodes", type=int, default=20, help="videos of --model (default 20)")
    parser.add_argument("--random-episodes", type=int, default=50, help="episodes of random play (default 50)")
    target = "what is learned of two frames: which is the later one, or their distance in time (default order)"
    parser.add_argument("--target", choices=TARGETS, default=TARGETS[0], help=target)
    parser.add_argument("--updates", type=int, default=1500, help="number of updates (default 1500)")
    size = "height and width to which frames are resized (default 64)"
    parser.add_argument("--image-size", type=int, default=64, help=size)
    parser.add_argument("--seed", type=_seed, default=0, help="seed of everything drawn (default 0)")


def _rank(args: argparse.Namespace) -> None:
    from functools import partial

    import softbody_envs  # noqa: F401  (registers its ids)
    from sb3_por.analysis.ranking import rank
    from sb3_por.common.files import check_output
    from sb3_por.evaluation.loading import find_environment
    from sb3_por.ranking.videos import episode_videos, read_videos
    from sb3_por.training.record import EXPERT, find_player, make_training_env, play_training_scenes

    check_output(args.output, (".npz",))
    if not args.env and (args.model or args.algo or args.conf_file or args.hyperparams or args.env_kwargs):
        raise UserError("--model and the settings are about an environment: give --env, too")
    make_env = None
    if args.env:
        trained = args.model if args.model != EXPERT else None
        args.env = find_environment(args.env, trained, args.safe)
        made_of = _settings(args, needed=trained is None, demos=False)
        player, environment = find_player(trained or EXPERT, args.env, made_of, args.safe)
        make_env = partial(make_training_env, args.env, environment["env_kwargs"], environment["env_wrapper"])
    if args.model:
        recording = play_training_scenes(player, args.env, environment, args.n_episodes, args.seed)
        print(f"videos: {recording.evaluation}")
        videos = episode_videos(recording.episodes, recording.env.observation_space, args.image_size)
    else:
        videos = read_videos(args.videos, args.image_size)
    more = {"n_random": args.random_episodes, "target": args.target, "updates": args.updates, "image_size": args.image_size}
    print(rank(videos, args.output, make_env, args.env or "", **more, seed=args.seed))
    print(args.output)


def _plot_arguments(parser: argparse.ArgumentParser) -> None:
    from sb3_por.analysis.names import FIGURES, METRICS, ORDER

    parser.add_argument("paths", nargs="+", metavar="RUN_OR_FOLDER", help="runs, folders of runs, or tables of scores (.csv)")
    output = "the figure: .png, .pdf or .svg; .csv: its numbers; with --kind all a folder for every figure in all formats"
    parser.add_argument("-o", "--output", required=True, help=output)
    kinds = f"which figure (default iqm); {ORDER}: loss and accuracy of POR's classifier, from the runs' TensorBoard files"
    parser.add_argument("--kind", choices=[*FIGURES, ORDER, "all"], default="iqm", help=kinds)
    parser.add_argument("--metric", choices=METRICS, default=METRICS[0], help=f"what to plot (default {METRICS[0]})")
    step = "compare at this step, and leave out runs that end before (default: the end of the shortest run)"
    parser.add_argument("--step", type=int, help=step)
    parser.add_argument("--csv", help="write the table of scores here, too")
    parser.add_argument("--seed", type=_seed, default=0, help="seed of the bootstrap (default 0)")


def _plot(args: argparse.Namespace) -> None:
    from sb3_por.analysis import figures
    from sb3_por.analysis.por_logs import read_order, write_order
    from sb3_por.analysis.scores import read_scores, write_csv
    from sb3_por.common.files import check_output, check_writable

    if args.kind == "all":
        check_writable(args.output)
    else:
        check_output(args.output, figures.SUFFIXES)
    if args.csv:
        check_output(args.csv, (".csv",))
    if args.kind == figures.ORDER:
        if args.step is not None:
            raise UserError(f"--step is where scores are compared; --kind {figures.ORDER} shows all of training")
        order, left_out = read_order(args.paths)
        _print_notes(left_out)
        plot, notes = figures.plot_order(order)
        plot.save(args.output)
    else:
        scores = read_scores(args.paths)
        how = {"metric": args.metric, "step": args.step, "seed": args.seed}
        if args.kind == "all":
            order, left_out = read_order(path for path in args.paths if not path.endswith(".csv"))
            plots, notes = figures.plot_all(scores, order, **how)
            notes = [*left_out, *notes]
            figures.save_all(plots, args.output)
        else:
            plot, notes = figures.plot(scores, args.kind, **how)
            plot.save(args.output)
    _print_notes(notes)
    if args.csv:
        write_order(order, args.csv) if args.kind == figures.ORDER else write_csv(scores, args.csv)
    print(args.output)


def _print_notes(notes: list[str]) -> None:
    for note in notes:
        print(f"note: {note}", file=sys.stderr)


def _diagnose_arguments(parser: argparse.ArgumentParser) -> None:
    runs = "instead of --model and --env: make a table of the last models of all runs in there that learn an order"
    parser.add_argument("paths", nargs="*", metavar="RUN_OR_FOLDER", help=runs)
    parser.add_argument("--csv", help="write that table here, too")
    _model_arguments(parser, required=False)
    parser.add_argument("-n", "--n-episodes", type=int, default=5, help="held-out episodes of each policy (default 5)")
    fresh = "also train fresh heads on the frozen encoder, on an untrained one, and with sham labels, as controls"
    parser.add_argument("--fresh-head", action="store_true", help=fresh)
    parser.add_argument("--seed", type=_seed, default=0, help="seed of the first episode (default 0)")
    parser.add_argument("--json", action="store_true", help="print everything as JSON")


def _diagnose(args: argparse.Namespace) -> None:
    from sb3_por.analysis.diagnostics import check_order, diagnose, diagnose_runs
    from sb3_por.common.files import atomic_write, check_output

    if args.csv:
        check_output(args.csv, (".csv",))
    one = (args.model or args.pretrained) and args.env
    if bool(args.paths) == bool(one) or (args.csv and not args.paths):
        raise UserError("give --model and --env, or folders of runs and perhaps --csv (diagnose --help lists the arguments)")
    if args.paths:
        table = diagnose_runs(args.paths, args.n_episodes, args.seed, args.fresh_head)
        if args.csv:
            with atomic_write(args.csv) as path:
                table.to_csv(path, index=False, float_format="%.5g")
        print(table.to_json(orient="records", indent=2) if args.json else table.round(3).to_string(index=False))
        return
    model, environment = _load(args)
    check_order(model)
    diagnosis = diagnose(model, args.env, args.n_episodes, args.seed, **environment, fresh_head=args.fresh_head)
    if args.json:
        print(json.dumps({"model": str(args.model), "env": args.env, "seed": args.seed, **diagnosis.as_dict()}, indent=2))
    else:
        print(diagnosis)


def _saliency_arguments(parser: argparse.ArgumentParser) -> None:
    _model_arguments(parser)
    parser.add_argument("-o", "--output", required=True, help="the picture: .png or .jpg")
    parser.add_argument("--step", type=int, help="number of the frame (default: where the monotone quantity rises most)")
    parser.add_argument("--seed", type=_seed, default=0, help="seed of the episode (default 0)")


def _saliency(args: argparse.Namespace) -> None:
    from sb3_por.analysis.saliency import draw_saliency

    model, environment = _load(args)
    step = draw_saliency(model, args.env, args.output, args.step, args.seed, **environment)
    print(f"step {step}: {args.output}")


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


def _report_arguments(parser: argparse.ArgumentParser) -> None:
    from sb3_por.analysis.names import METRICS

    parser.add_argument("paths", nargs="+", metavar="RUN_OR_FOLDER", help="runs, folders of runs, or tables of scores (.csv)")
    parser.add_argument("-o", "--output", required=True, help="folder that gets index.html, and figures/ for print")
    parser.add_argument("--metric", choices=METRICS, help="what to compare (default: the first that is recorded)")
    step = "compare at this step, and leave out runs that end before (default: the end of the shortest run)"
    parser.add_argument("--step", type=int, help=step)
    parser.add_argument("--no-videos", action="store_true", help="leave out videos and saliency maps: much quicker")
    parser.add_argument("--seed", type=_seed, default=0, help="seed of the bootstrap (default 0)")


def _report(args: argparse.Namespace) -> None:
    import softbody_envs  # noqa: F401  (registers its ids)
    from sb3_por.analysis.report import write_report

    print(write_report(args.paths, args.output, args.metric, args.step, args.seed, videos=not args.no_videos))


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
    "evaluate": Command(
        help="play held-out episodes and print the scores",
        example="--model logs/sac_por/PourWater-v0_1 --env PourWater-v0 -n 20 --json",
        add_arguments=_evaluate_arguments,
        run=_evaluate,
    ),
    "enjoy": Command(
        help="record a video of a model, or show it in a window",
        example="--model logs/sac_por/PourWater-v0_1 --env PourWater-v0 -o pour.gif",
        add_arguments=_enjoy_arguments,
        run=_enjoy,
    ),
    "record": Command(
        help="record demonstrations in the training environment, for train.py --demos",
        example="--model expert --env PourWater-v0 -n 50 -o demos",
        add_arguments=_record_arguments,
        run=_record,
    ),
    "rank": Command(
        help="learn from videos how far a task is done, for train.py --ranker",
        example="--model expert --env FoldCloth-v0 -n 20 -o fold.npz",
        add_arguments=_rank_arguments,
        run=_rank,
    ),
    "plot": Command(
        help="draw learning curves and comparisons with 95 %% stratified bootstrap intervals",
        example="logs/sac_por logs/sac --kind tasks -o tasks.pdf --csv scores.csv",
        add_arguments=_plot_arguments,
        run=_plot,
    ),
    "diagnose": Command(
        help="measure what a model's classifier has learned: order, or which encoder it looks at",
        example="--model logs/sac_por/PourWater-v0_1 --env PourWater-v0",
        add_arguments=_diagnose_arguments,
        run=_diagnose,
    ),
    "saliency": Command(
        help="draw which pixels the classifier looks at",
        example="--model logs/sac_por/PourWater-v0_1 --env PourWater-v0 -o map.png",
        add_arguments=_saliency_arguments,
        run=_saliency,
    ),
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
    "suite": Command(
        help="run what is left to do of a grid of algorithms, environments and seeds",
        example="smoke --dry-run",
        add_arguments=_suite_arguments,
        run=_suite,
    ),
    "report": Command(
        help="write a page with what a set of runs was and has shown: figures, tables, videos, settings, failures",
        example="runs/smoke -o report",
        add_arguments=_report_arguments,
        run=_report,
    ),
}


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    typed = (sys.argv[1:] if arguments is None else arguments)[:1]
    parser = Parser(prog="python -m sb3_por", description=__doc__)
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    for name, command in COMMANDS.items():
        subparser = subparsers.add_parser(
            name,
            help=command.help,
            description=command.help,
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
