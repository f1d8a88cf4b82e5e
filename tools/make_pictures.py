"""Draw the pictures of the environments that README shows: ``python tools/make_pictures.py``."""

from pathlib import Path

import gymnasium as gym
from PIL import Image, ImageDraw, ImageFont

import sb3_abisim  # noqa: F401  (registers the environments)

OUTPUT = Path(__file__).parent.parent / "docs" / "images" / "environments.png"
# (id, seed, steps of random actions before the picture)
SHOTS = (
    ("Nav2D-v0", 1, 0),
    ("Nav2DCorridor-v0", 0, 0),
    ("Nav2DMaze-v0", 0, 0),
    ("PointMaze-v0", 0, 0),
    ("DistractorPointMaze-v0", 4, 0),
)
WIDTH, GAP, CAPTION = 232, 10, 26


def main() -> None:
    """Write the picture."""
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
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(OUTPUT, optimize=True)


if __name__ == "__main__":
    main()
