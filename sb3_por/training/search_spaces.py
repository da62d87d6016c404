"""Search spaces of ``train.py -optimize``: shared settings of the visual algorithms, and those of each objective."""

from collections.abc import Callable
from typing import Any

import optuna

from sb3_por.objectives.por import ORDER_HEADS

#: Weights of POR that are tried
POR_COEFS: tuple[str | float, ...] = ("auto_0.03", "auto_0.1", "auto_0.3", "auto_1.0", 0.1, 1.0, 10.0, 100.0, 1000.0)

Space = Callable[[optuna.Trial], dict[str, Any]]


def common(trial: optuna.Trial) -> dict[str, Any]:
    """
    :return: learning rate, discount factor, moving averages of Q networks and encoder
    """
    return {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 2e-3, log=True),
        "gamma": trial.suggest_categorical("gamma", [0.9, 0.95, 0.97, 0.99]),
        "tau": trial.suggest_float("tau", 0.005, 0.05, log=True),
        "encoder_tau": trial.suggest_float("encoder_tau", 0.01, 0.1, log=True),
    }


def partial_order(trial: optuna.Trial) -> dict[str, Any]:
    """
    :return: lambda, m (of 50 features), k, pairing and head of the partial-order objective
    """
    return {
        # Ratios of gradients, and fixed weights beside the critic's loss, which grows with the square of what a step can earn:
        # 400 times in our settings
        "por_coef": trial.suggest_categorical("por_coef", POR_COEFS),
        "order_dim": trial.suggest_categorical("order_dim", [1, 5, 10, 25, 40]),
        "k": trial.suggest_int("k", 1, 5),
        "random_k": trial.suggest_categorical("random_k", [False, True]),
        "pairing": trial.suggest_categorical("pairing", ["paper", "swap"]),
        "order_head": trial.suggest_categorical("order_head", list(ORDER_HEADS)),
    }


def augmentations(trial: optuna.Trial) -> dict[str, Any]:
    """
    :return: DrQ's K and M
    """
    return {
        "n_augmentations": trial.suggest_int("n_augmentations", 1, 3),
        "n_target_augmentations": trial.suggest_int("n_target_augmentations", 1, 3),
    }


def _aux_lr_ratio(trial: optuna.Trial) -> float:
    return trial.suggest_float("aux_lr_ratio", 0.1, 10.0, log=True)


def contrastive(trial: optuna.Trial) -> dict[str, Any]:
    """
    :return: step size of CURL's loss
    """
    return {"aux_lr_ratio": _aux_lr_ratio(trial)}


def latent_model(trial: optuna.Trial) -> dict[str, Any]:
    """
    :return: step size and horizon of the loss of SPR or MR.Q
    """
    return {
        "aux_lr_ratio": _aux_lr_ratio(trial),
        "horizon": trial.suggest_int("horizon", 1, 5),
    }


#: The part of the search space that belongs to each algorithm.
SEARCH_SPACES: dict[str, Space] = {
    "sac_por": partial_order,
    "tqc_por": partial_order,
    "sac_drq": augmentations,
    "sac_curl": contrastive,
    "sac_spr": latent_model,
    "sac_mrq": latent_model,
}


def sampler(algo: str) -> Callable[..., dict[str, Any]]:
    """
    :param algo: a name of ``SEARCH_SPACES``
    :return: a function from an Optuna trial (the zoo's other arguments change nothing) to arguments of the algorithm,
        which have the trial's names
    """
    return lambda trial, *_: common(trial) | SEARCH_SPACES[algo](trial)
