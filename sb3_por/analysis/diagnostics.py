"""Diagnosis of a trained partial-order objective: order or encoder leak, and physical quantity or time."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch as th
from stable_baselines3.common.utils import set_random_seed

from sb3_por.analysis import controls
from sb3_por.analysis.controls import MEASURES, Controls
from sb3_por.analysis.fresh_heads import judgement, train_head
from sb3_por.analysis.played import Played, encode, play
from sb3_por.common.errors import UserError
from sb3_por.common.plain import LACKS_VALUES
from sb3_por.evaluation.episodes import evaluation_episodes
from sb3_por.evaluation.environment import make_evaluation_env
from sb3_por.evaluation.loading import resolve
from sb3_por.objectives.por import PartialOrder
from sb3_por.runs.environment import EnvWrapper, VecEnvWrapper
from sb3_por.runs.facts import run_identity
from sb3_por.runs.folder import find_runs, is_finished, last_model

#: Pairs in a batch, and number of batches that a metric is averaged over.
BATCH_SIZE, N_BATCHES = 256, 4
#: Episodes that fresh heads are trained on.
N_HEAD_EPISODES = 20
#: Order -> its name in the printed table. The first is the model's own; the last three need ``fresh_head``.
ORDERS = {
    "own": "its own head",
    "clock": "clock: the frame's number",
    "fresh": "fresh head",
    "untrained": "fresh head, untrained encoder",
    "sham": "fresh head, order by chance",
}
#: Names of the measures in the printed table, and their values at chance.
HEADER = ("r", "r given time", "r at equal time", "pairs", "unchanged", "changed", "at equal time")
CHANCE = (np.nan, 0.0, 0.0, 0.5, 0.5, 0.5, 0.5)


@dataclass(frozen=True)
class Diagnosis:
    """
    Losses are per term, so chance is ln 2 = 0.693. Accuracies are fractions, chance 0.5.

    :param loss: POR loss on pairs of the policy's own frames, as in training
    :param accuracy: accuracy of the classifier on them
    :param leak_loss: POR loss on pairs of a frame with itself (k = 0); below ln 2 the classifier tells the encoders apart
    :param leak_accuracy: accuracy on them
    :param random_loss: POR loss on frames of a random policy
    :param random_accuracy: accuracy on them
    :param grad_norm_critic: norm of the critic loss's gradient with respect to the encoder, for the task's own rewards even
        where ``VecNormalize`` scales them in training; NaN for an exported model, which holds no Q networks
    :param grad_norm_por: norm of the weighted POR loss's gradient with respect to the encoder; NaN for an exported model, and
        where a weight balances gradients but was not read (safe loading)
    :param feature_std: standard deviation of the encoder's features over the policy's own frames, mean over features; near 0
        the encoder has collapsed to a constant
    :param n_unchanged: pairs of an episode, k steps apart, with equal quantities
    :param n_changed: the other pairs
    :param n_equal_time: pairs of two episodes at the same step with different quantities
    :param orders: key of ``ORDERS`` -> agreement of that order with time and quantity, on frames that one encoder encodes
    :param correlations: Spearman correlation of the learned potential and ``info["monotone"]`` in each episode; NaN where the
        quantity is constant
    """

    loss: float
    accuracy: float
    leak_loss: float
    leak_accuracy: float
    random_loss: float
    random_accuracy: float
    grad_norm_critic: float
    grad_norm_por: float
    feature_std: float
    n_unchanged: int
    n_changed: int
    n_equal_time: int
    orders: dict[str, Controls]
    correlations: list[float]

    def as_dict(self) -> dict[str, Any]:
        """
        Flatten for JSON and tables.

        :return: the fields, ``None`` for NaN; measures of the model's own order under their names, those of the other orders
            under ``<order>_<measure>``
        """
        plain = asdict(self)
        orders, correlations = plain.pop("orders"), plain.pop("correlations")
        for order, measured in orders.items():
            plain |= {name if order == "own" else f"{order}_{name}": value for name, value in measured.items()}
        return {name: _none_for_nan(value) for name, value in plain.items()} | {
            "correlations": [_none_for_nan(value) for value in correlations]
        }

    def __str__(self) -> str:
        pairs = {
            "frames of its own policy": (self.loss, self.accuracy),
            "frames of a random policy": (self.random_loss, self.random_accuracy),
            "leak control (k = 0)": (self.leak_loss, self.leak_accuracy),
            "chance": (np.log(2), 0.5),
        }
        norms = [f"{norm:.3g}" if np.isfinite(norm) else "unknown" for norm in (self.grad_norm_critic, self.grad_norm_por)]
        orders = {ORDERS[name]: [getattr(order, measure) for measure in MEASURES] for name, order in self.orders.items()}
        return "\n".join(
            (
                _printed(pairs, ("loss", "accuracy")),
                f"gradient norm with respect to the encoder: critic {norms[0]}, POR {norms[1]}",
                f"standard deviation of the encoder's features over frames: {self.feature_std:.3g}",
                "",
                "Spearman correlation r with the monotone quantity, and accuracy on pairs:",
                _printed(orders | {"chance": CHANCE}, HEADER),
                f"pairs: {self.n_unchanged} unchanged, {self.n_changed} changed, {self.n_equal_time} at equal time",
            )
        )


def check_order(model: Any) -> PartialOrder:
    """
    Get a model's partial-order objective.

    :raises UserError: if it has none
    """
    objective = getattr(getattr(model, "policy", None), "objective", None)
    if not isinstance(objective, PartialOrder):
        how = "use a model of sac_por or tqc_por (with --pretrained, name one by --algo)"
        raise UserError(f"{type(model).__name__} learns no order; {how}")
    return objective


def diagnose(
    model: Any,
    env_id: str,
    n_episodes: int = 5,
    seed: int = 0,
    env_kwargs: dict[str, Any] | None = None,
    vec_normalize: str | None = None,
    env_wrapper: EnvWrapper | None = None,
    vec_env_wrapper: VecEnvWrapper | None = None,
    fresh_head: bool = False,
) -> Diagnosis:
    """
    Play held-out episodes with a model and at random, and measure its partial-order objective on their frames.

    :param model: a run folder, the path of a model, or a model; trained with a ``PartialOrder`` objective
    :param env_id: a Gymnasium id; the controls need its ``info["monotone"]``
    :param n_episodes: number of episodes of each policy
    :param seed: seed of the first episode, the random policy, and the pairs; the global generators are set to it
    :param env_kwargs: as in :func:`sb3_por.evaluation.evaluate`
    :param vec_normalize: as in :func:`sb3_por.evaluation.evaluate`
    :param env_wrapper: as in :func:`sb3_por.evaluation.evaluate`
    :param vec_env_wrapper: as in :func:`sb3_por.evaluation.evaluate`
    :param fresh_head: also train fresh heads on other episodes of the policy and measure them on the same held-out frames: on
        the frozen encoder, on an untrained one, and with sham labels
    :raises UserError: if the model learns no order, or was not trained on this environment
    """
    model, environment = resolve(model, env_id, env_kwargs, vec_normalize, env_wrapper, vec_env_wrapper)
    objective = check_order(model)
    if n_episodes < 1:
        raise UserError(f"a diagnosis needs at least 1 episode, got {n_episodes}")
    env = make_evaluation_env(model, env_id, **environment)
    set_random_seed(seed)
    env.action_space.seed(seed)
    model.policy.set_training_mode(False)
    episodes = evaluation_episodes(env_id, n_episodes + N_HEAD_EPISODES, seed)
    try:
        own = play(model, env, episodes[:n_episodes])
        random = play(model, env, episodes[:n_episodes], at_random=True)
        others = play(model, env, episodes[n_episodes:]) if fresh_head else None
    finally:
        env.close()

    batches = [model.sample(BATCH_SIZE, own.transitions) for _ in range(N_BATCHES)]
    measured = [model.objective_metrics(batch) for batch in batches]
    leaks = [model.control_metrics(batch) for batch in batches]
    at_random = [model.objective_metrics(model.sample(BATCH_SIZE, random.transitions)) for _ in range(N_BATCHES)]
    # What was exported holds no Q networks, and a weight may follow their gradients
    norms = {} if getattr(model, LACKS_VALUES, False) else model.encoder_grad_norms(model.losses(batches[0]))
    features = encode(model.critic, own.observations, model.device)
    potential, belief = judgement(objective, features)
    k = _distances(objective)[-1]
    orders = {"own": controls.measure_controls(own.frames, potential, belief, k), "clock": controls.clock(own.frames, k)}
    if others is not None:
        orders |= _fresh_orders(model, own, others)
    unchanged, changed = controls.by_change(own.frames, *controls.pairs_within_episodes(own.frames, [k]))
    return Diagnosis(
        loss=_mean(measured, "loss"),
        accuracy=_mean(measured, "accuracy"),
        leak_loss=_mean(leaks, "leak_loss"),
        leak_accuracy=_mean(leaks, "leak_accuracy"),
        random_loss=_mean(at_random, "loss"),
        random_accuracy=_mean(at_random, "accuracy"),
        grad_norm_critic=float(norms.get("critic", np.nan)),
        grad_norm_por=float(norms.get(objective.name, np.nan)),
        feature_std=float(features.std(dim=0).mean()),
        n_unchanged=int(unchanged.sum()),
        n_changed=int(changed.sum()),
        n_equal_time=len(controls.pairs_at_equal_time(own.frames)[0]),
        orders=orders,
        correlations=controls.within_episodes(own.frames, potential).tolist(),
    )


def diagnose_runs(
    folders: Iterable[str | Path], n_episodes: int = 5, seed: int = 0, fresh_head: bool = False, safe: bool = False
) -> pd.DataFrame:
    """
    Diagnose the last model of every finished run that learns an order.

    :param folders: run folders, or folders that hold some at any depth
    :param n_episodes: see :func:`diagnose`
    :param seed: see :func:`diagnose`
    :param fresh_head: see :func:`diagnose`
    :param safe: Run nothing that the models' files hold
    :return: one row for each model: env, algo (or label), seed, step, and ``Diagnosis.as_dict()`` without single episodes
    :raises UserError: if there is no such model
    """
    rows = []
    for run in find_runs(folders):
        identity = run_identity(run)
        file = run / last_model(identity["env"])
        if not is_finished(run, identity["env"]):
            continue
        model, environment = resolve(file, identity["env"], safe=safe)
        if not isinstance(getattr(model.policy, "objective", None), PartialOrder):
            continue
        measured = diagnose(model, identity["env"], n_episodes, seed, **environment, fresh_head=fresh_head).as_dict()
        del measured["correlations"]
        rows.append({**identity, "step": model.num_timesteps, **measured})
    if not rows:
        raise UserError("none of these runs has ended with a model that learns an order; give runs of sac_por or tqc_por")
    return pd.DataFrame(rows).sort_values(["env", "algo", "seed"], ignore_index=True)


def _fresh_orders(model: Any, held_out: Played, others: Played) -> dict[str, Controls]:
    """Train fresh heads on the frames of other episodes, and measure them on held-out ones."""
    trained = model.policy.objective
    distances = _distances(trained)
    pairs = controls.pairs_within_episodes(others.frames, distances)
    orders = {}
    for name, critic in (("fresh", model.critic), ("untrained", model.policy.make_critic()), ("sham", model.critic)):
        critic.set_training_mode(False)
        settings = {**model.policy.objective_kwargs, "pairing": "paper"}
        head = type(trained)(trained.features_dim, trained.action_dim, **settings).to(model.device)
        train_head(head, encode(critic, others.observations, model.device), *pairs, sham=name == "sham")
        potential, belief = judgement(head, encode(critic, held_out.observations, model.device))
        orders[name] = controls.measure_controls(held_out.frames, potential, belief, distances[-1])
    return orders


def _distances(objective: PartialOrder) -> range:
    """All distances k of the objective's pairs."""
    shortest, longest = objective.future or (1, 1)
    return range(shortest, longest + 1)


def _printed(rows: dict[str, Any], header: tuple[str, ...]) -> str:
    """A table of numbers, one row for each name."""
    lines = ["".join(f"  {title:>8s}" for title in header)]
    for values in rows.values():
        cells = ("-" if np.isnan(value) else f"{value:.3f}" for value in values)
        lines.append("".join(f"  {cell:>{max(len(title), 8)}s}" for cell, title in zip(cells, header, strict=True)))
    return "\n".join(f"{name:30s}{line}" for name, line in zip(["", *rows], lines, strict=True))


def _none_for_nan(value: Any) -> Any:
    return None if isinstance(value, float) and np.isnan(value) else value


def _mean(metrics: list[dict[str, th.Tensor]], name: str) -> float:
    return float(np.mean([float(one[name]) for one in metrics]))
