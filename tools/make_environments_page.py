"""Write ``docs/environments.md`` from the table of ids, the docstrings and the committed results.

``python tools/make_environments_page.py`` writes the page alone. ``--measure`` first lets a random agent act for some
episodes in each environment and writes ``benchmarks/results/random_agent.json``; ``--images`` renders the GIFs anew.
"""

import argparse
import inspect
import json
import re
from collections.abc import Iterator
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from PIL import Image

from sb3_abisim.benchmark.report.groups import STANDARD
from sb3_abisim.envs import ENV_IDS
from sb3_abisim.registry import get_traits
from sb3_abisim.zoo.runs import find_runs

ROOT = Path(__file__).resolve().parent.parent
PAGE, IMAGES = ROOT / "docs" / "environments.md", ROOT / "docs" / "images" / "environments"
RANDOM, COMPARISONS = ROOT / "benchmarks" / "results" / "random_agent.json", "benchmarks/results/comparison"
N_EPISODES, N_COPIES, SEED = 500, 50, 0
# Fewer would let a lucky run be the best.
MIN_RUNS = 3
PIXELS, N_FRAMES, MILLISECONDS = 144, 24, 120
# Those that render like another one.
SAME_IMAGE = {
    env_id: env_id.removeprefix("Continuous") for env_id in ENV_IDS if env_id.startswith("Continuous")
}  # fmt: skip
HEAD = """# Environments

Importing `sb3_abisim` registers these ids. `tools/make_environments_page.py` makes this page of the table of ids, the
docstrings and the committed results.

    import gymnasium as gym
    import sb3_abisim

    env = gym.make("PointMaze-v0")
    batch = gym.make_vec("PointMaze-v0", num_envs=64, vectorization_mode="vector_entry_point")

| id | | observation | actions | steps |
|---|---|---|---|---:|
{spaces}

Which file fits an environment, and what is in it: [shipped encoders](../encoders/README.md).

## Returns

"Random" is the mean return of uniformly random actions, with half its 95 % interval, over {n_episodes} episodes
([random_agent.json](../benchmarks/results/random_agent.json)). "Best" is the highest mean final return of a method in
the committed comparisons, of the stochastic policy over three runs or more. Distractor environments show clips there
that training never showed. "Best" is the best of many and therefore somewhat too high. An empty place means that no
committed result has it.

| id | possible | random | best |
|---|---|---:|---|
{returns}
"""
SPECIFICATIONS = (
    ("Nav2D", "nav2d"),
    ("PointMaze", "point_maze.env"),
    ("DistractorPointMaze", "point_maze.distractors"),
    ("ScanNav", "scan_nav.env"),
)
MORE = {
    "Nav2D": "Speed: [envs.md](../benchmarks/results/envs.md). Exact metric: [exact_metric.md](exact_metric.md).",
    "PointMaze": "`sb3_abisim.PointMazePixels` shows gymnasium-robotics' own mazes in the same way.",
    "DistractorPointMaze": "Custom videos, splits and licenses: [distractors.md](distractors.md).",
    "ScanNav": "Scans of your own, maps and results: [scan_nav.md](scan_nav.md). It needs the extra `[scan]`.",
}


def measure() -> None:
    """Let a random agent act, and write what it got."""
    returns: dict[str, Any] = {}
    for env_id in ENV_IDS:
        envs = gym.make_vec(env_id, num_envs=N_COPIES, vectorization_mode="vector_entry_point")
        envs.reset(seed=SEED)
        envs.action_space.seed(SEED)
        # As many of each copy: the first to end would be the short ones.
        counts, totals, done = np.zeros(N_COPIES, int), np.zeros(N_COPIES), []
        while (counts < N_EPISODES // N_COPIES).any():
            _, rewards, ended, truncated, _ = envs.step(envs.action_space.sample())
            totals += rewards
            for i in np.flatnonzero(ended | truncated):
                if counts[i] < N_EPISODES // N_COPIES:
                    done.append(float(totals[i]))
                counts[i] += 1
                totals[i] = 0
        envs.close()
        half = 1.96 * np.std(done, ddof=1) / np.sqrt(len(done))
        returns[env_id] = {"mean": round(float(np.mean(done)), 3), "half_width": round(float(half), 3)}
    record = {
        "command": "python tools/make_environments_page.py --measure", "episodes": N_EPISODES, "seed": SEED,
        "returns": returns, "versions": {name: metadata.version(name) for name in ("gymnasium", "mujoco", "numpy")},
    }  # fmt: skip
    RANDOM.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def render() -> None:
    """A GIF of random actions in each environment."""
    IMAGES.mkdir(exist_ok=True)
    for env_id in ENV_IDS:
        if env_id in SAME_IMAGE:
            continue
        env = gym.make(env_id, render_mode="rgb_array")
        env.reset(seed=SEED)
        env.action_space.seed(SEED)
        frames = []
        while len(frames) < N_FRAMES:
            shown = Image.fromarray(env.render()).resize((PIXELS, PIXELS), Image.Resampling.BOX)
            frames.append(shown.quantize(method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE))
            _, _, ended, truncated, _ = env.step(env.action_space.sample())
            if ended or truncated:
                env.reset()
        rest = {"save_all": True, "append_images": frames[1:], "duration": MILLISECONDS, "loop": 0}
        frames[0].save(IMAGES / f"{env_id}.gif", **rest)
        env.close()


def best_returns() -> dict[str, tuple[float, int, str, str]]:
    """Of each id: the highest mean final return, its number of runs, the method, and the folder of the comparison."""
    best: dict[str, tuple[float, int, str, str]] = {}
    for folder in sorted((ROOT / COMPARISONS).iterdir()):
        groups: dict[tuple[str, str], list[float]] = {}
        for run in find_runs(folder):
            split = get_traits(run.env_id).eval_split or STANDARD
            final = run.final() or {}
            if run.env_id in ENV_IDS and f"stochastic/{split}/results" in final:
                groups.setdefault((run.env_id, run.label), []).append(
                    float(final[f"stochastic/{split}/results"].mean())
                )
        for (env_id, method), means in groups.items():
            if len(means) < MIN_RUNS:
                continue
            found = (float(np.mean(means)), len(means), method, folder.name)
            best[env_id] = max(best.get(env_id, found), found)
    return best


def space_words(space: gym.Space[Any]) -> str:
    """A space in a few words."""
    if isinstance(space, spaces.Box):
        shape = " x ".join(map(str, space.shape))
        if space.dtype == np.uint8:
            return f"{shape}, uint8"
        return f"`Box({space.low.min():g}, {space.high.max():g}, ({shape},))`"
    return f"`{space}`"


def space_rows() -> Iterator[str]:
    """Of the table of ids."""
    for env_id in ENV_IDS:
        env = gym.make(env_id)
        image = f"![{env_id}](images/environments/{SAME_IMAGE.get(env_id, env_id)}.gif)"
        yield (
            f"| `{env_id}` | {image} | {space_words(env.observation_space)} | {space_words(env.action_space)} | "
            f"{env.spec.max_episode_steps} |"
        )
        env.close()


def return_rows() -> Iterator[str]:
    """Of the table of returns."""
    random, best = json.loads(RANDOM.read_text(encoding="utf-8"))["returns"], best_returns()
    for env_id in ENV_IDS:
        traits = get_traits(env_id)
        low, high = traits.return_range or (None, None)
        returns = "" if low is None else f"{low:g} to {high:g}"
        digits = 1 if low is not None else 2
        by_chance = f"{random[env_id]['mean']:.{digits}f} ± {random[env_id]['half_width']:.{digits}f}"
        reached = ""
        if env_id in best:
            mean, n_runs, method, folder = best[env_id]
            reached = f"{mean:.1f}, {n_runs} runs of `{method}` ([{folder}](../{COMPARISONS}/{folder}/benchmark.json))"
        yield f"| `{env_id}` | {returns} | {by_chance} | {reached} |"


def in_markdown(docstring: str) -> str:
    """A docstring's prose and a table of its parameters."""
    prose, *fields = re.split(r"^:(param|raises) ", docstring, flags=re.MULTILINE)
    text = re.sub(r":\w+:`~?([^`]+)`", lambda m: f"`{m[1].rpartition('.')[2]}`", prose).replace("``", "`").rstrip()
    table = ["", "", "| argument | meaning |", "|---|---|"]
    for kind, field in zip(fields[::2], fields[1::2], strict=True):
        name, _, meaning = field.partition(":")
        if kind == "param":
            words = re.sub(r":\w+:`~?([^`]+)`", lambda m: f"`{m[1].rpartition('.')[2]}`", " ".join(meaning.split()))
            table.append(f"| `{name}` | {words.replace('``', '`')} |")
    return text + "\n".join(table) + "\n"


def page() -> str:
    """The whole text."""
    n_episodes = json.loads(RANDOM.read_text(encoding="utf-8"))["episodes"]
    text = HEAD.format(n_episodes=n_episodes, spaces="\n".join(space_rows()), returns="\n".join(return_rows()))
    for name, module in SPECIFICATIONS:
        made = import_module(f"sb3_abisim.envs.{module}")
        docstring = inspect.getdoc(getattr(made, f"{name}VectorEnv")) or ""
        source = f"sb3_abisim/envs/{module.replace('.', '/')}.py"
        text += f"\n## {name}\n\n{in_markdown(docstring)}\n{MORE[name]} Source: [{source}](../{source}).\n"
    return text


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--measure", action="store_true")
    parser.add_argument("--images", action="store_true")
    args = parser.parse_args()
    if args.measure:
        measure()
    if args.images:
        render()
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
