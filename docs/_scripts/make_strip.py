"""
Draw the README's strip: the first held-out scene of each of the five tasks, solved by scripted experts or by models.

    python docs/_scripts/make_strip.py
    python docs/_scripts/make_strip.py --model PourWater-v0=sb3_por/pretrained/plain-PourWater-v0.zip

A caption names what plays, and its score.
"""

import argparse
import tempfile
from pathlib import Path

import cv2
import imageio.v3 as iio
import matplotlib.font_manager
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import softbody_envs  # noqa: F401  (registers its ids)
from sb3_por.evaluation.loading import resolve
from sb3_por.evaluation.reference_policies import REFERENCES
from sb3_por.evaluation.video import record_video
from softbody_envs.experts import EXPERT_IDS

OUTPUT = Path(__file__).parents[1] / "tasks" / "strip.gif"
#: Sizes in pixels: a task's images, the space between two, the caption.
SIZE, GAP, CAPTION = 176, 6, 38
#: Control steps of 0.08 s per frame, the speed-up, and for how long the last frame stays, ms.
STEPS_PER_FRAME, SPEED, HOLD_MS = 1, 2, 1500
COLORS = 256


def play(env_id: str, model: str | None) -> tuple[list[np.ndarray], str]:
    """
    Play the first held-out scene.

    :param env_id: task
    :param model: a run folder or the path of a model; None for the scripted expert
    :return: frames, uint8 ``(SIZE, SIZE, 3)``, and who plays
    """
    played, environment = (REFERENCES["expert"](env_id), {}) if model is None else resolve(model, env_id)
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "video.mp4"
        evaluation = record_video(played, env_id, video, size=2 * SIZE, **environment)
        frames = [*iio.imiter(video)]
    name = "scripted expert" if model is None else f"{type(played).__name__}, trained"
    kept = [*frames[:-1:STEPS_PER_FRAME], frames[-1]]
    small = [cv2.resize(frame, (SIZE, SIZE), interpolation=cv2.INTER_AREA) for frame in kept]
    return small, f"{name}: {evaluation.normalized_performance[0]:.2f}"


def caption(env_id: str, player: str) -> np.ndarray:
    """Write a task's name and who plays it, uint8 ``(CAPTION, SIZE, 3)``."""
    image = Image.new("RGB", (SIZE, CAPTION), "white")
    draw = ImageDraw.Draw(image)
    for text, weight, y in ((env_id.partition("-")[0], "bold", 11), (player, "normal", 28)):
        path = matplotlib.font_manager.findfont(matplotlib.font_manager.FontProperties(family="DejaVu Sans", weight=weight))
        draw.text((SIZE / 2, y), text, "black", ImageFont.truetype(path, 13), anchor="mm")
    return np.asarray(image)


def main() -> None:
    """Parse the command line and write the strip."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", action="append", default=[], metavar="TASK=MODEL", help="a model instead of the expert")
    parser.add_argument("-o", "--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    models = dict(pair.split("=", 1) for pair in arguments.model)
    if unknown := set(models) - set(EXPERT_IDS):
        parser.error(f"no such task: {', '.join(sorted(unknown))}; there are {', '.join(EXPERT_IDS)}")
    columns = []
    for env_id in EXPERT_IDS:
        frames, player = play(env_id, models.get(env_id))
        print(env_id, player, flush=True)
        columns.append([np.vstack([frame, caption(env_id, player)]) for frame in frames])
    length = max(map(len, columns))
    gap = np.full((SIZE + CAPTION, GAP, 3), 255, np.uint8)
    strips = []
    for i in range(length):
        tiles = [column[min(i, len(column) - 1)] for column in columns]
        strips.append(Image.fromarray(np.hstack([part for tile in tiles for part in (tile, gap)][:-1])))
    # One palette for all frames, so that nothing flickers: that of the first and the last.
    palette = Image.fromarray(np.vstack([strips[0], strips[-1]])).quantize(COLORS)
    images = [strip.quantize(palette=palette, dither=Image.Dither.NONE) for strip in strips]
    durations = [80 * STEPS_PER_FRAME // SPEED] * (length - 1) + [HOLD_MS]
    images[0].save(arguments.output, save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=True)
    print(f"{arguments.output}: {arguments.output.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
