"""Render the images of the environments in README and docs/scan_nav.md: ``python tools/make_images.py``."""

from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import sb3_abisim  # noqa: F401  (registers the environments)

IMAGES = Path(__file__).parent.parent / "docs" / "images"
# (id, seed, steps of random actions before the image)
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


def render_environments() -> None:
    """An image of each environment, side by side."""
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


def render_scan_observations() -> None:
    """First observations of a few episodes of ScanNav, colors above depth, enlarged twice."""
    env = gym.make("ScanNav-v0")
    columns = []
    for seed in SCAN_SEEDS:
        observation, _ = env.reset(seed=seed)
        colors, depth = observation[:3].transpose(1, 2, 0), np.repeat(observation[3][..., None], 3, axis=-1)
        columns.append(np.concatenate([colors, depth]))
    side = observation.shape[-1]
    sheet = np.full((2 * side + GAP // 2, len(columns) * (side + GAP // 2) - GAP // 2, 3), 255, np.uint8)
    for i, column in enumerate(columns):
        left = i * (side + GAP // 2)
        sheet[:side, left : left + side], sheet[side + GAP // 2 :, left : left + side] = column[:side], column[side:]
    Image.fromarray(sheet.repeat(2, axis=0).repeat(2, axis=1)).save(IMAGES / "scan_frames.png", optimize=True)


if __name__ == "__main__":
    render_environments()
    render_scan_observations()
