r"""Put recordings of two agents side by side, episode by episode, in the same mazes.

That of README (run with ``abisim`` and with ``vanilla`` in place of METHOD)::

    sb3-abisim train --algo ppo --env DistractorPointMaze-v0 --conf-file METHOD -n 163840 --seed 0 --num-threads 1 \
        --eval-freq -1 -f METHOD -params n_steps:128 batch_size:256 n_epochs:4 learning_rate:3e-4
    python tools/make_agents_gif.py "pretrained encoder=abisim/ppo/DistractorPointMaze-v0_1" \
        "from scratch=vanilla/ppo/DistractorPointMaze-v0_1" -o docs/images/agents.gif
"""

import argparse
import tempfile
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont, ImageSequence

from sb3_abisim.zoo.record import MILLISECONDS, record

CAPTION, GAP, N_LAST = 22, 8, 10
# Enough for the built-in photographs at this size; with 256 the file is a third larger.
N_COLORS = 48


def episode_frames(run: Path, seed: int) -> list[Image.Image]:
    """What ``sb3-abisim record`` shows of one episode, without the repeated last frame.

    :param run: zoo run folder
    :param seed: of the episode
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "agent.gif"
        record(run, path, n_episodes=1, seed=seed)
        with Image.open(path) as image:
            return [frame.convert("RGB") for frame in ImageSequence.Iterator(image)]


def main() -> None:
    """Write the GIF."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("agents", nargs="+", metavar="LABEL=RUN")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="of the episodes")
    parser.add_argument("--every", type=int, default=2, help="show one frame of so many")
    parser.add_argument("--max-frames", type=int, default=64, help="of an episode")
    args = parser.parse_args()
    agents = [word.partition("=")[::2] for word in args.agents]
    sheets: list[Image.Image] = []
    for seed in args.seeds:
        recordings = [episode_frames(Path(run), seed) for _, run in agents]
        shown = [[*frames[:: args.every], frames[-1]] for frames in recordings]
        length = min(max(map(len, shown)), args.max_frames)
        for i in [*range(length), *[length - 1] * N_LAST]:
            sheets.append(side_by_side([frames[min(i, len(frames) - 1)] for frames in shown], [a for a, _ in agents]))
    # One palette for all of it: frames then compress against each other, and colors do not flicker.
    palette = sheets[len(sheets) // 2].quantize(N_COLORS, method=Image.Quantize.FASTOCTREE)
    frames = [sheet.quantize(palette=palette, dither=Image.Dither.NONE) for sheet in sheets]
    frames[0].save(
        args.output, save_all=True, append_images=frames[1:], duration=MILLISECONDS, loop=0, optimize=True
    )  # fmt: skip


def side_by_side(images: list[Image.Image], labels: list[str]) -> Image.Image:
    """A row of images, each under its label."""
    width, height = images[0].size
    sheet = Image.new("RGB", (len(images) * (width + GAP) - GAP, height + CAPTION), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for i, (image, label) in enumerate(zip(images, labels, strict=True)):
        left = i * (width + GAP)
        sheet.paste(image, (left, CAPTION))
        draw.text((left + width / 2, CAPTION / 2), label, fill="black", font=font, anchor="mm")
    return sheet


if __name__ == "__main__":
    main()
