"""Commands that play episodes: evaluate, enjoy, record, rank."""

import argparse
import json
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

from sb3_por.commands.command import Command, load_model_and_environment, model_arguments, safe_argument, seed
from sb3_por.common.errors import UserError


def _evaluate_arguments(parser: argparse.ArgumentParser) -> None:
    model_arguments(parser)
    episodes = "held-out episodes (default 20; with --pretrained those of the published scores)"
    parser.add_argument("-n", "--n-episodes", type=int, help=episodes)
    parser.add_argument("--seed", type=seed, default=0, help="seed of the first episode (default 0)")
    parser.add_argument("--json", action="store_true", help="print every episode as JSON")


def _evaluate(args: argparse.Namespace) -> None:
    from sb3_por.evaluation.evaluate import evaluate

    model, environment = load_model_and_environment(args)
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
    model_arguments(parser)
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("-o", "--output", help="the video: .gif or .mp4")
    where.add_argument("--human", action="store_true", help="show the episodes in a window instead; pip install '.[human]'")
    parser.add_argument("-n", "--n-episodes", type=int, default=1, help="held-out episodes (default 1)")
    parser.add_argument("--seed", type=seed, default=0, help="seed of the first episode (default 0)")
    parser.add_argument("--size", type=int, default=480, help="height and width in pixels (default 480)")


def _enjoy(args: argparse.Namespace) -> None:
    from sb3_por.evaluation.show import show_episodes
    from sb3_por.evaluation.video import check_video, record_video

    if args.human:
        model, environment = load_model_and_environment(args)
        print(show_episodes(model, args.env, args.n_episodes, args.seed, args.size, **environment))
        return
    check_video(args.output)
    model, environment = load_model_and_environment(args)
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
    from sb3_por.training.arguments import add_ranker_arguments

    parser.add_argument("--model", required=True, help="expert, a .zip, or a run folder (its best model)")
    safe_argument(parser)
    parser.add_argument("--env", required=True, help="environment id")
    _settings_arguments(parser, "record in the environment that the settings of this algorithm make")
    add_ranker_arguments(parser)
    parser.add_argument("-o", "--output", required=True, help="folder of the new dataset, in Minari's format")
    parser.add_argument("-n", "--n-episodes", type=int, default=50, help="episodes of training scenes (default 50)")
    disturbances = "probability that a step is followed by random ones, which are not recorded (default 0)"
    parser.add_argument("--disturbed", type=float, default=0.0, metavar="P", help=disturbances)
    parser.add_argument("--seed", type=seed, default=0, help="chooses the scenes (default 0)")


def _record(args: argparse.Namespace) -> None:
    import softbody_envs  # noqa: F401  (registers its ids)
    from sb3_por.evaluation.loading import find_environment
    from sb3_por.runs.environment import with_ranker
    from sb3_por.training.arguments import check_ranker
    from sb3_por.training.record import EXPERT, record

    check_ranker(args)
    args.env = find_environment(args.env, None if args.model == EXPERT else args.model, args.safe)
    made_of = _settings(args, needed=args.model == EXPERT, demos=True)
    if args.ranker:
        if made_of is None:
            raise UserError("--ranker adds to the settings of an algorithm: give --algo, too")
        made_of = replace(made_of, env_wrapper=with_ranker(made_of.env_wrapper, args.ranker, args.ranker_kwargs))
    print(record(args.model, args.env, args.output, args.n_episodes, args.seed, made_of, args.safe, args.disturbed))
    print(args.output)


def _rank_arguments(parser: argparse.ArgumentParser) -> None:
    from sb3_por.ranking.training import TARGETS

    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("videos", nargs="?", metavar="VIDEOS", help="a Minari dataset, or a folder of .mp4, .gif or .npz files")
    which.add_argument("--model", help="play the videos: expert, a .zip, or a run folder (its best model); needs --env")
    safe_argument(parser)
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
    parser.add_argument("--seed", type=seed, default=0, help="seed of everything drawn (default 0)")


def _rank(args: argparse.Namespace) -> None:
    import softbody_envs  # noqa: F401  (registers its ids)
    from sb3_por.analysis.ranking import rank
    from sb3_por.common.files import check_output
    from sb3_por.evaluation.loading import find_environment
    from sb3_por.ranking.ranker import Ranker
    from sb3_por.ranking.videos import episode_videos, image_of, read_videos
    from sb3_por.training.record import EXPERT, find_player, make_training_env, play_training_scenes

    check_output(args.output, (".npz",))
    if not args.env and (args.model or args.algo or args.conf_file or args.hyperparams or args.env_kwargs):
        raise UserError("--model and the settings are about an environment: give --env, too")
    if args.updates < 1:
        raise UserError(f"--updates must be at least 1, got {args.updates}")
    Ranker(args.image_size)  # refuses a size before anything is played
    make_env = None
    if args.env:
        trained = args.model if args.model != EXPERT else None
        args.env = find_environment(args.env, trained, args.safe)
        made_of = _settings(args, needed=trained is None, demos=False)
        player, environment = find_player(trained or EXPERT, args.env, made_of, args.safe)
        make_env = partial(make_training_env, args.env, environment["env_kwargs"], environment["env_wrapper"])
    if args.model:
        assert make_env is not None  # a model has --env, see above
        with closing(make_env()) as env:
            image_of(env.observation_space)  # says so before anything is played
        recording = play_training_scenes(player, args.env, environment, args.n_episodes, args.seed)
        print(f"videos: {recording.evaluation}")
        videos = episode_videos(recording.episodes, recording.env.observation_space, args.image_size)
    else:
        videos = read_videos(args.videos, args.image_size)
    more = {"n_random": args.random_episodes, "target": args.target, "updates": args.updates, "image_size": args.image_size}
    print(rank(videos, args.output, make_env, args.env or "", **more, seed=args.seed))
    print(args.output)


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
}
