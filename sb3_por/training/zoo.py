"""
The RL Zoo's ``train`` command with our algorithms, tasks, evaluation and checkpoints.

Importing this module imports ``rl_zoo3``, which replaces Gymnasium's ``TimeLimit``: nothing else in the package does.
"""

import sys
import types

import rl_zoo3.train
from rl_zoo3 import ALGOS
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

import softbody_envs  # noqa: F401  (registers its ids)
from sb3_por import ALGORITHMS
from sb3_por.common.errors import exit_code
from sb3_por.training.arguments import Parser, Settings
from sb3_por.training.experiment import Experiment
from sb3_por.training.search_spaces import sampler

for _name, _class in ALGORITHMS.items():
    ALGOS[_name] = _class
    # A trial's parameters are the algorithm's arguments.
    HYPERPARAMS_SAMPLER[_name], HYPERPARAMS_CONVERTER[_name] = sampler(_name), dict  # type: ignore[assignment]  # a dict


def main(arguments: list[str] | None = None) -> int:
    """
    Train with the arguments of a command line.

    :param arguments: Arguments of the command; ``sys.argv[1:]`` by default
    :return: the exit code
    """
    if arguments is not None:
        sys.argv = ["train.py", *arguments]
    # The zoo's train() has no hooks: it finds these three by name in its module.
    rl_zoo3.train.argparse = types.SimpleNamespace(ArgumentParser=Parser)  # type: ignore[assignment]  # a patch
    rl_zoo3.train.StoreDict = Settings  # type: ignore[misc]  # a patch
    rl_zoo3.train.ExperimentManager = Experiment  # type: ignore[misc]  # a patch
    return exit_code(rl_zoo3.train.train, "train.py")


if __name__ == "__main__":
    sys.exit(main())
