"""A run's card: the folder of files that others find on the hub, in the layout that users of the RL Zoo know."""

import datetime
import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_por.analysis import figures
from sb3_por.analysis.scores import read_scores
from sb3_por.common import plain
from sb3_por.common.errors import UserError
from sb3_por.evaluation.episodes import EVAL_SEED, Evaluation
from sb3_por.evaluation.evaluate import evaluate
from sb3_por.evaluation.loading import find_environment
from sb3_por.evaluation.plain_files import DATA, STATISTICS
from sb3_por.evaluation.video import record_video
from sb3_por.runs import environment
from sb3_por.runs import folder as files
from sb3_por.runs.facts import run_identity
from sb3_por.runs.folder import ARGUMENTS, ENV_KWARGS, HYPERPARAMETERS, run_arguments, write_settings
from sb3_por.sharing.agents import agent_name, describe_evaluation
from sb3_por.sharing.export import load_run, open_run, published_settings, run_facts

#: Files of a card besides the model, by the names that the RL Zoo gives them
README, RESULTS, VIDEO, CURVE = "README.md", "results.json", "replay.mp4", "curve.png"
METRICS, PICKLED_STATISTICS = "train_eval_metrics.zip", "vec_normalize.pkl"
#: Arguments of train.py that name places of the machine
PLACES = (
    *("conf_file", "log_folder", "tensorboard_log", "trained_agent", "storage", "optimization_log_path", "resume", "demos"),
    "ranker",
    *("wandb_entity", "wandb_group", "wandb_project_name", "wandb_tags"),
)


def write_card(run: str | Path, folder: Path, repo: str, n_episodes: int = 10) -> str:
    """
    Write the best model of a run, its settings, scores, curve and video.

    :param run: Folder of a run
    :param folder: Empty folder for the files
    :param repo: Name of the repository, ``user/name``, which the page tells to pull
    :param n_episodes: Held-out episodes that score it
    :return: Name of the model: ``<algo>-<env>``
    :raises UserError: If the run has no model
    """
    run = open_run(run)
    arguments, identity = run_arguments(run), run_identity(run)
    env_id = find_environment(identity["env"], run)
    settings = files.settings_folder(run, env_id)
    model, statistics = load_run(run, env_id)
    name = agent_name(arguments.get("algo", identity["algo"]), env_id)
    _write_model(model, run / files.BEST_MODEL, folder / f"{name}.zip", statistics)
    pickled = next((p for p in (settings / files.BEST_STATISTICS, settings / files.STATISTICS) if p.is_file()), None)
    if pickled is not None:
        shutil.copy(pickled, folder / PICKLED_STATISTICS)
    write_settings(folder / ARGUMENTS, {key: value for key, value in arguments.items() if key not in PLACES})
    hyperparameters = published_settings(run, env_id)
    write_settings(folder / HYPERPARAMETERS, hyperparameters)
    write_settings(folder / ENV_KWARGS, hyperparameters.get("env_kwargs") or {})
    _write_metrics(run, folder / METRICS)

    evaluation = evaluate(run, env_id, n_episodes)
    (folder / RESULTS).write_text(json.dumps(_results(evaluation), indent=1) + "\n")
    shown = [_curve(run, folder / CURVE), _video(run, env_id, folder / VIDEO)]
    facts = {"env": env_id, "class": type(model).__name__, "steps": model.num_timesteps, **run_facts(run, env_id)}
    (folder / README).write_text(_readme(repo, name, facts, evaluation, [text for text in shown if text]))
    return name


def _write_model(model: Any, source: Path, target: Path, statistics: dict[str, Any] | None) -> None:
    """Copy a model without places of this machine, and with the plain form of its statistics."""
    instead = {environment.ATTRIBUTE: vars(model)[environment.ATTRIBUTE]}
    instead |= dict.fromkeys(("tensorboard_log", "environment_made_of", *plain.PLACES))
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as new:
        for member in old.namelist():
            content = old.read(member)
            if member == DATA:
                data = json.loads(content)
                data |= {name: value for name, value in instead.items() if name in data}
                described = data.get(plain.ATTRIBUTE, {}).get("arguments", {})
                described |= dict.fromkeys(described.keys() & set(plain.PLACES))
                content = json.dumps(data, indent=4).encode()
            new.writestr(member, content)
        if statistics is not None:
            new.writestr(STATISTICS, json.dumps(statistics))


def _write_metrics(run: Path, target: Path) -> None:
    """Evaluations and training episodes."""
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in [*run.glob(files.EVALUATIONS), *sorted(run.glob(files.MONITORS))]:
            archive.write(file, file.name)


def _results(evaluation: Evaluation) -> dict[str, Any]:
    """The RL Zoo's names, and beside them all episodes."""
    return {
        "mean_reward": float(np.mean(evaluation.returns)),
        "std_reward": float(np.std(evaluation.returns)),
        "is_deterministic": True,
        "n_eval_episodes": len(evaluation.returns),
        "eval_datetime": datetime.datetime.now().isoformat(timespec="seconds"),
        "evaluation": describe_evaluation(evaluation, EVAL_SEED),
    }


def _curve(run: Path, path: Path) -> str:
    """Draw the learning curve, if the run was evaluated; returns the card's text for it."""
    try:
        scores = read_scores([run])
        metric = next(name for name in ("normalized_performance", "return") if scores[name].notna().any())
        plot, _ = figures.plot(scores, "iqm", metric=metric)
    except (UserError, StopIteration):
        return ""
    plot.save(path)
    return f"![learning curve]({path.name})"


def _video(run: Path, env_id: str, path: Path) -> str:
    """Record the first held-out episode, if the environment renders; returns the card's text for it."""
    try:
        record_video(run, env_id, path)
    except UserError:
        return ""
    return f'<video src="{path.name}" controls autoplay loop muted></video>'


def _metadata(facts: dict[str, Any], evaluation: Evaluation) -> dict[str, Any]:
    """What the hub lists and searches by."""
    env_id, n = facts["env"], len(evaluation.returns)
    values = {"mean_reward": evaluation.returns, "normalized_performance": evaluation.normalized_performance}
    metrics = [
        {
            "type": name,
            "value": f"{np.mean(one):.2f} +/- {np.std(one):.2f}",
            "name": f"{name}, {n} episodes",
            "verified": False,
        }
        for name, one in values.items()
        if not np.isnan(np.mean(one))
    ]
    task = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
    results = [{"task": task, "dataset": {"name": env_id, "type": env_id}, "metrics": metrics}]
    return {
        "library_name": "stable-baselines3",
        "tags": [env_id, "deep-reinforcement-learning", "reinforcement-learning", "stable-baselines3", "sb3-por"],
        "model-index": [{"name": facts["class"], "results": results}],
    }


def _readme(repo: str, name: str, facts: dict[str, Any], evaluation: Evaluation, shown: list[str]) -> str:
    """The page that the hub shows."""
    front = yaml.safe_dump(_metadata(facts, evaluation), sort_keys=False)
    settings = yaml.safe_dump(facts["settings"], sort_keys=True)
    played = "\n\n".join(shown)
    return f"""---
{front}---

# {facts["class"]} on {facts["env"]}

{evaluation}, on held-out scenes, after {facts["steps"]} steps of training (seed {facts["seed"]}).

{played}

## Play

With sb3-por, which runs nothing that a downloaded file holds:

```bash
python -m sb3_por pull {repo} -o {name}
python -m sb3_por enjoy --model {name} --env {facts["env"]} -o video.gif
python -m sb3_por evaluate --model {name} --env {facts["env"]}
```

## Train

```bash
{facts["command"] or "python train.py"}
```

```yaml
{settings}```

Commit {facts["commit"] or "unknown"}; {", ".join(f"{package} {version}" for package, version in facts["versions"].items())}.
"""
