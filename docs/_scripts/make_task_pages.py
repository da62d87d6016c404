"""
Writes a page for each task from its docstring, its scores, pictures and videos.

    python docs/_scripts/make_task_pages.py              pages only
    python docs/_scripts/make_task_pages.py --pictures   also pictures and videos
    python docs/_scripts/make_task_pages.py --scores     also the scores of the reference policies (minutes per task)
"""

import argparse
import csv
import inspect
from pathlib import Path

import cv2
import gymnasium as gym
import imageio.v3 as iio
import numpy as np

import softbody_envs
from sb3_por.evaluation.evaluate import evaluate
from sb3_por.evaluation.reference_policies import REFERENCES
from softbody_envs.experts import EXPERT_IDS, make_expert

PAGES = Path(__file__).parents[1] / "tasks"
SCORES = Path(__file__).parents[2] / "results" / "tasks" / "scores.csv"
N_EPISODES = 20
#: Sizes of the stills: those of observations and that of ``render``.
SIZES = (64, 84, 128, 480)
#: Size of the videos and control steps per frame: small enough to be committed.
VIDEO_SIZE, STEPS_PER_FRAME = 160, 2


def measure_scores() -> None:
    """Evaluate the reference policies on held-out variations and write the table of scores."""
    rows = []
    for env_id in EXPERT_IDS:
        for policy in ("expert", "random", "nothing"):
            result = evaluate(REFERENCES[policy](env_id), env_id, N_EPISODES)
            scores = np.array(result.normalized_performance)
            rows.append((env_id, policy, N_EPISODES, *(f"{x:.3f}" for x in (scores.mean(), scores.min(), scores.max()))))
            print(*rows[-1], flush=True)
    SCORES.parent.mkdir(parents=True, exist_ok=True)
    with SCORES.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("env", "policy", "episodes", "mean", "min", "max"))
        writer.writerows(rows)


def draw(env_id: str) -> None:
    """Draw a strip of stills in all ``SIZES``, and a video of each policy: the expert, if there is one, and random."""
    env = gym.make(env_id, obs_type="state", split="eval").unwrapped
    rng = np.random.default_rng(0)
    policies = ("expert", "random") if env_id in EXPERT_IDS else ("random",)
    for policy in policies:
        expert = make_expert(env_id) if policy == "expert" else None
        if expert is not None:
            expert.reset()
        state, _ = env.reset(options={"variation": 800})
        horizon = gym.spec(env_id).max_episode_steps
        frames = []
        for step in range(horizon):
            if step % STEPS_PER_FRAME == 0:
                frames.append(env._image(VIDEO_SIZE))
            if step == horizon // 3 and policy == policies[0]:
                stills = [cv2.resize(env._image(size), (480, 480), interpolation=cv2.INTER_NEAREST) for size in SIZES]
                iio.imwrite(PAGES / f"{env_id}.png", cv2.resize(np.hstack(stills), (1200, 300), interpolation=cv2.INTER_AREA))
            state = env.step(expert.act(state) if expert is not None else rng.uniform(-1, 1, env.action_space.shape))[0]
        frames += [env._image(VIDEO_SIZE)] * 5
        iio.imwrite(PAGES / f"{env_id}_{policy}.gif", frames, duration=80 * STEPS_PER_FRAME, loop=0)
    env.close()


def write_page(env_id: str, scores: list[dict[str, str]]) -> None:
    """Write the page of one task."""
    env = gym.make(env_id, obs_type="state").unwrapped
    parts = [f"# {env_id}", f"![image sizes 64, 84, 128 and 480]({env_id}.png)", "Images of 64, 84, 128 and 480 pixels."]
    videos = [policy for policy in ("expert", "random") if (PAGES / f"{env_id}_{policy}.gif").exists()]
    parts.append(" ".join(f"![{policy} policy]({env_id}_{policy}.gif)" for policy in videos))
    parts.append("Videos: " + " and ".join(f"{policy} policy" for policy in videos) + ".")
    parts.append(inspect.getdoc(type(env)))
    own = [row for row in scores if row["env"] == env_id]
    if own:
        table = ["| policy | mean | min | max |", "|---|---|---|---|"]
        table += ["| {policy} | {mean} | {min} | {max} |".format(**row) for row in own]
        parts += [
            "## Scores",
            f"`normalized_performance` at the end of {own[0]['episodes']} held-out episodes (variations 800, 801, ...). "
            "Source: `results/tasks/scores.csv`, written by `python docs/_scripts/make_task_pages.py --scores`.",
            "\n".join(table),
        ]
    (PAGES / f"{env_id}.md").write_text("\n\n".join(parts) + "\n")
    env.close()


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", action="store_true", help="also draw pictures and videos")
    parser.add_argument("--scores", action="store_true", help="also measure the scores")
    arguments = parser.parse_args()
    PAGES.mkdir(exist_ok=True)
    if arguments.scores:
        measure_scores()
    scores = list(csv.DictReader(SCORES.open())) if SCORES.exists() else []
    for env_id in softbody_envs.ENV_IDS:
        if arguments.pictures:
            draw(env_id)
        write_page(env_id, scores)


if __name__ == "__main__":
    main()
