"""Command-line arguments of train.py: the RL Zoo's, our defaults, and checks before anything is made."""

import argparse
import importlib.util
import inspect
import math
import os
import sys
import warnings
from pathlib import Path
from typing import Any

import torch as th
from rl_zoo3 import ALGOS
from rl_zoo3.utils import StoreDict

import softbody_envs  # noqa: F401  (registers its ids)
from sb3_por import ALGORITHMS
from sb3_por.common.errors import UserError, UserNote, check_known, one_line
from sb3_por.common.files import check_writable
from sb3_por.evaluation.loading import find_environment, import_packages, model_file, read_data
from sb3_por.evaluation.safe_loading import is_plain
from sb3_por.ranking.ranker import Ranker
from sb3_por.runs.checkpoints import (
    latest_checkpoint,
    remove_checkpoints,
)
from sb3_por.runs.folder import (
    ARGUMENTS,
    HYPERPARAMETERS,
    import_names,
    last_model,
    read_settings,
    run_arguments,
    settings_folder,
    the_run,
)
from sb3_por.runs.lock import is_locked
from sb3_por.runs.provenance import current_machine, current_provenance
from sb3_por.runs.versions import current_commit, differences
from sb3_por.training.hyperparameters import hyperparameter_file, read_hyperparameters

EXAMPLE = """example:
  python train.py --algo sac_por --env PourWater-v0 -n 20000 --seed 1 -params por_coef:10.0 pairing:paper

  python train.py --resume logs/sac_por/PourWater-v0_1

  python train.py --algo sac_por --env PourWater-v0 -n 20000 -optimize --n-trials 50 --study-name pour --storage tuning.log

Settings come from zoo_hyperparams/<algo>.yml (with --demos from demos.yml there), else from the RL Zoo's file of the
algorithm. The run goes to <log-folder>/<algo>/<env>_<n>: best_model.zip, evaluations.npz, checkpoints, tb/ for TensorBoard."""


#: Our defaults of the zoo's flags, where they differ; its help does not show them
DEFAULTS = {"algo": "sac_por", "env": "PourWater-v0", "eval_freq": 2000, "save_freq": 10_000}
HELP = {
    "--algo": f"algorithm (default {DEFAULTS['algo']})",
    "--env": f"environment id, or MODULE:ID for one of your own (default {DEFAULTS['env']})",
    "--eval-freq": f"evaluate every N agent steps (default {DEFAULTS['eval_freq']}); never if it is negative",
    "--save-freq": f"write a checkpoint every N agent steps (default {DEFAULTS['save_freq']}); never if it is negative",
    "--num-threads": "threads of PyTorch and of numerical libraries (default: OMP_NUM_THREADS, else 1)",
}

#: Smallest and largest value of the flags with numbers that are not free; -1 stands for the zoo's default, where it has one
RANGES = {
    "n_timesteps": (1, math.inf),
    "eval_episodes": (1, math.inf),
    "n_eval_envs": (1, math.inf),
    "n_trials": (1, math.inf),
    "max_total_trials": (1, math.inf),
    "n_evaluations": (1, math.inf),
    "n_startup_trials": (0, math.inf),
    "n_jobs": (1, math.inf),
    "num_threads": (1, math.inf),
    "seed": (0, 2**32 - 1),
}
#: Flags of which -1 is a value
WITH_DEFAULT = ("n_timesteps", "n_jobs", "num_threads", "seed")


#: What words mean that YAML reads as values; as text, ``false`` would be true
WORDS = {"true": True, "false": False, "null": None, "none": None}


class Settings(StoreDict):
    """
    ``key:value`` pairs whose values are Python, as in the zoo, or else YAML's ``true``, ``false`` and ``null`` or plain words:
    ``pairing:paper``. A flag that is given again adds to its pairs.
    """

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        before = getattr(namespace, self.dest, None)
        stored: dict[str, Any] = {} if before is self.default else dict(before or {})
        for pair in values:
            one = argparse.Namespace()
            try:
                super().__call__(parser, one, [pair], option_string)
                stored |= getattr(one, self.dest)
                key, _, word = pair.partition(":")
                if word.isidentifier() and callable(stored[key]):
                    stored[key] = word  # obs_type:dict means the word, not Python's dict
            except (NameError, SyntaxError):  # no Python: a word
                key, colon, word = pair.partition(":")
                if not colon or not word:
                    parser.error(f"{option_string} takes key:value pairs, got {pair!r}")
                stored[key] = WORDS.get(word.lower(), word)
            except (Exception, SystemExit) as error:
                parser.error(f"{option_string} {pair}: {type(error).__name__}: {one_line(error)}")
        setattr(namespace, self.dest, stored)


class Parser(argparse.ArgumentParser):
    """The zoo's parser with our defaults; it refuses what cannot work before it makes a folder."""

    def __init__(self) -> None:
        super().__init__(
            prog="train.py",
            description="Train an agent, with the RL Zoo's flags.",
            epilog=EXAMPLE,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    def error(self, message: str) -> Any:
        raise UserError(f"{message} (train.py --help lists the flags)")

    def add_argument(self, *names: Any, **options: Any) -> argparse.Action:
        if "--algo" in names:
            del options["choices"]  # checked below, with the nearest name
        options["help"] = next((HELP[name] for name in names if name in HELP), options.get("help"))
        return super().add_argument(*names, **options)

    def parse_args(self, *_: Any) -> argparse.Namespace:  # type: ignore[override]  # as the zoo calls it
        self.set_defaults(**DEFAULTS, progress=sys.stderr.isatty())
        self.add_argument(
            "--resume",
            metavar="RUN_FOLDER",
            help="resume an interrupted run with the settings in its folder, or extend a finished one to -n steps",
        )
        demos = "folder of demonstrations, from which half of each batch is drawn; see python -m sb3_por record"
        self.add_argument("--demos", metavar="FOLDER", help=demos)
        add_ranker_arguments(self)
        self.add_argument("--label", metavar="NAME", help="what tables and figures call the run, instead of its algorithm")
        args = super().parse_args()
        if args.resume is not None:
            if not args.resume:
                self.error("--resume needs the name of a run's folder")
            return self._resumed(Path(args.resume))
        self._check(args)
        if args.trial_id is not None and not (args.storage and args.study_name):
            raise UserError("--trial-id needs the --storage and the --study-name of the search")
        check_known("algorithm", args.algo, ALGOS)
        if args.demos and args.algo not in ALGORITHMS:
            raise UserError(f"{args.algo} cannot learn from demonstrations; --demos needs one of {', '.join(ALGORITHMS)}")
        if package := args.env.rpartition(":")[0]:
            args.gym_packages = [*args.gym_packages, package]  # recorded, so that evaluate finds it
        import_packages(args.gym_packages)
        args.env = find_environment(args.env)
        if args.trained_agent:
            args.trained_agent = str(model_file(args.trained_agent).resolve())  # resumed from any folder
            data = read_data(Path(args.trained_agent))
            if is_plain(data):
                raise UserError(
                    f"{args.trained_agent} only plays: an exported agent holds no Q networks; give its run's model"
                )
            _check_kept(args.algo, args.hyperparams, data)
        args.conf_file = args.conf_file or str(hyperparameter_file(args.algo, args.env, bool(args.demos)))
        if args.conf_file.endswith((".yml", ".yaml")):
            read_hyperparameters(args.conf_file, args.env)  # refuses what the zoo takes apart without a look
        check_writable(args.log_folder)
        if args.tensorboard_log:
            check_writable(args.tensorboard_log)
        _choose_threads(args)
        args.commit = current_commit()
        args.machine = current_machine()
        args.provenance = current_provenance(args.num_threads)
        return args

    def _check(self, args: argparse.Namespace) -> None:
        """
        :raises UserError: If a flag cannot be used, whatever the others are
        """
        for name, (low, high) in RANGES.items():
            value = getattr(args, name)
            if value is None or low <= value <= high or (value == -1 and name in WITH_DEFAULT):
                continue
            limit = f"at least {low}" if high == math.inf else f"between {low} and {high}"
            self.error(f"--{name.replace('_', '-')} must be {limit}, got {value}")
        if args.track and importlib.util.find_spec("wandb") is None:
            raise UserError("--track needs Weights & Biases: pip install wandb")
        if args.device.startswith("cuda") and not th.cuda.is_available():
            raise UserError(f"--device {args.device}: PyTorch finds no CUDA device here; pass --device cpu")
        if not args.log_folder:
            self.error("-f needs the name of a folder")
        check_ranker(args)
        if args.label and ("/" in args.label or "\\" in args.label):
            self.error(f"--label names files: it may hold no slashes, got {args.label}")

    def _resumed(self, run: Path) -> argparse.Namespace:
        """The arguments that a run was started with, changed by those given now."""
        run = the_run(run)
        saved = import_names(run_arguments(run))
        if "env" not in saved:
            raise UserError(f"{run} is not the folder of a run: no */{ARGUMENTS} in it; give <log-folder>/<algo>/<env>_<n>")
        began_with = saved.pop("trained_agent", "")
        self.set_defaults(**{**saved, "progress": sys.stderr.isatty()})
        args = super().parse_args()
        args.resume = str(run)
        if args.trained_agent:
            raise UserError("--resume continues a run with its own model; leave out -i")
        if latest_checkpoint(run) is None and not (run / last_model(saved["env"])).is_file():
            args.trained_agent = began_with  # it had not come far enough for a model of its own
            if began_with and not Path(began_with).is_file():
                raise UserError(f"{run} has no checkpoint yet, and {began_with}, which it began with, is gone")
        for name in ("algo", "env"):
            if getattr(args, name).rpartition(":")[2] != saved.get(name):
                raise UserError(f"--resume continues {saved.get('algo')} on {saved['env']}; leave out --{name}")
        args.env = saved["env"]
        if args.seed != saved.get("seed", args.seed):
            raise UserError(f"--resume continues a run of seed {saved['seed']}; leave out --seed")
        settings = read_settings(settings_folder(run, saved["env"]) / HYPERPARAMETERS)
        _check_kept(args.algo, args.hyperparams, import_names(settings))
        if args.optimize_hyperparameters:
            raise UserError("--resume continues a run, and -optimize makes many: give one of them")
        self._check(args)
        last = run / last_model(saved["env"])
        if last.exists() and latest_checkpoint(run) is None:
            if not is_locked(run):
                remove_checkpoints(run)  # remains of them, if the run was killed while it removed them
            done = read_data(last)["num_timesteps"]
            if args.n_timesteps <= done:
                print(f"{run} is finished: nothing to do. Pass -n with more than its {done} steps to extend it.")
                raise SystemExit(0)
        import_packages(args.gym_packages)
        check_writable(run)
        _choose_threads(args)
        _note_changes(args)
        return args


def add_ranker_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: Parser to which ``--ranker`` and ``--ranker-kwargs`` are added
    """
    ranker = "ranker whose progress is added to the reward; see python -m sb3_por rank (--progress is the zoo's bar)"
    parser.add_argument("--ranker", metavar="FILE", help=ranker)
    kwargs = "arguments of RankedProgress: scale:10.0, and gamma:0.99 for potential-based shaping"
    parser.add_argument("--ranker-kwargs", nargs="+", default={}, action=Settings, metavar="KEY:VALUE", help=kwargs)


def check_ranker(args: argparse.Namespace) -> None:
    """
    :param args: Parsed ``--ranker`` and ``--ranker-kwargs``
    :raises UserError: If the ranker cannot be read, or has arguments without a file
    """
    if args.ranker:
        Ranker.load(args.ranker)
    elif args.ranker_kwargs:
        raise UserError("--ranker-kwargs are about a ranker: give --ranker, too")


def _check_kept(algo: str, changes: dict[str, Any] | None, own: dict[str, Any]) -> None:
    """
    :param algo: Name of the algorithm
    :param changes: Settings that were given
    :param own: Settings that the loaded model was made with, or its attributes
    :raises UserError: If the former ask for other networks or another kind of temperature, which the zoo would write down
        and not make; or if the model's file was edited so that this cannot be told
    """
    changes = changes or {}
    given, made = changes.get("policy_kwargs"), own.get("policy_kwargs") or {}
    if not isinstance(made, dict):
        raise UserError(f"the loaded model's policy_kwargs must be dict, got {made!r}")
    if isinstance(given, dict) and any(made.get(name) != value for name, value in given.items()):
        raise UserError("a loaded model keeps its networks; leave out policy_kwargs")
    parameters = inspect.signature({**ALGOS, **ALGORITHMS}[algo]).parameters
    if "ent_coef" in changes and "ent_coef" in parameters:
        kept = own.get("ent_coef", parameters["ent_coef"].default)
        if isinstance(changes["ent_coef"], str) != isinstance(kept, str):
            kind = "learned" if isinstance(kept, str) else "fixed"
            raise UserError(f"the temperature of a loaded model stays {kind}; leave out ent_coef, or give one that is {kind}")


def _choose_threads(args: argparse.Namespace) -> None:
    """One thread, unless the user has chosen another number; worker processes keep to it, too."""
    if args.num_threads < 1 and "OMP_NUM_THREADS" not in os.environ:
        args.num_threads = 1
    if args.num_threads > 0:
        os.environ["OMP_NUM_THREADS"] = str(args.num_threads)


def _note_changes(args: argparse.Namespace) -> None:
    """Tell what differs from where a resumed run began, and record it in the run's arguments (``resumed_with``)."""
    before = getattr(args, "provenance", None)
    changed = differences(before, current_provenance(args.num_threads)) if before else {}
    if changed:
        told = ", ".join(
            f"{name} {then or 'none'} -> {now or 'none'}" for name, (then, now) in changed.items() if name != "cpu_flags"
        )
        warnings.warn(f"the run continues where its numbers may differ in the last bits: {told or 'cpu_flags'}", UserNote)
        args.resumed_with = [*getattr(args, "resumed_with", []), {name: now for name, (_, now) in changed.items()}]
