"""Draw the pictures of the environments in README and docs/scan_nav.md: ``python tools/make_pictures.py``."""

from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import sb3_abisim  # noqa: F401  (registers the environments)

IMAGES = Path(__file__).parent.parent / "docs" / "images"
# (id, seed, steps of random actions before the picture)
SHOTS = (
    ("Nav2D-v0", 1, 0),
    ("Nav2DCorridor-v0", 0, 0),
    ("Nav2DMaze-v0", 0, 0),
    ("PointMaze-v0", 0, 0),
    ("DistractorPointMaze-v0", 4, 0),
    ("ScanNav-v0", 9, 0),
)
WIDTH, GAP, CAPTION = 232, 10, 26
SCAN_SEEDS = (3, 4, 5, 9)


def draw_environments() -> None:
    """A picture of each environment, side by side."""
    sheet = Image.new("RGB", (len(SHOTS) * (WIDTH + GAP) - GAP, WIDTH + CAPTION), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(16)
    for i, (env_id, seed, steps) in enumerate(SHOTS):
        env = gym.make(env_id, render_mode="rgb_array")
        env.reset(seed=seed)
        env.action_space.seed(seed)
        for _ in range(steps):
            env.step(env.action_space.sample())
        left = i * (WIDTH + GAP)
        sheet.paste(Image.fromarray(env.render()).resize((WIDTH, WIDTH), Image.Resampling.LANCZOS), (left, CAPTION))
        draw.text((left + WIDTH / 2, CAPTION / 2), env_id, fill="black", font=font, anchor="mm")
    sheet.save(IMAGES / "environments.png", optimize=True)


def draw_scan_frames() -> None:
    """First frames of a few episodes of ScanNav, colors above depth, two screen pixels for one of theirs."""
    env = gym.make("ScanNav-v0")
    columns = []
    for seed in SCAN_SEEDS:
        frame, _ = env.reset(seed=seed)
        columns.append(np.concatenate([frame[:3].transpose(1, 2, 0), np.repeat(frame[3][..., None], 3, axis=-1)]))
    side = frame.shape[-1]
    sheet = np.full((2 * side + GAP // 2, len(columns) * (side + GAP // 2) - GAP // 2, 3), 255, np.uint8)
    for i, column in enumerate(columns):
        left = i * (side + GAP // 2)
        sheet[:side, left : left + side], sheet[side + GAP // 2 :, left : left + side] = column[:side], column[side:]
    Image.fromarray(sheet.repeat(2, axis=0).repeat(2, axis=1)).save(IMAGES / "scan_frames.png", optimize=True)


if __name__ == "__main__":
    draw_environments()
    draw_scan_frames()
