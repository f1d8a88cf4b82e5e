"""What agents reach on ScanNav: ``python -m benchmarks.scan_learning RUN [RUN ...] -o FILE``.

A RUN is the folder of a finished rl-zoo3 run (``logs/ppo/ScanNav-v0_1``). Beside it play an agent that acts at random,
one that walks straight towards the goal, and one that knows the map. All play the same episodes, one per copy of the
environment, so that short episodes count no more than long ones.
"""

import argparse
import json
import platform
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.tables import use_one_core
from sb3_abisim.zoo.evaluate import final_model
from sb3_abisim.zoo.runs import read_run

PACKAGES = ("numpy", "torch", "stable_baselines3", "rl_zoo3", "gymnasium")
# Points of a curve, each the mean over episodes that ended in its share of the training.
N_POINTS = 20

Player = Callable[[Any, Any], NDArray[np.int64]]  # (environment, observations) to actions


def random_player(seed: int) -> Player:
    """Uniformly random actions."""
    generator = np.random.default_rng(seed)
    return lambda env, _: generator.integers(0, env.single_action_space.n, env.num_envs)


def straight_player(env: Any, _: Any) -> NDArray[np.int64]:
    """Turns to the goal, walks, and stops beside it; walls it does not know."""
    factors = env.factors()
    east, north = (factors["goal"] - factors["agent"]).T
    # A heading of 0 is north and of 90 is west.
    off = (np.rad2deg(np.arctan2(-east, north)) - factors["heading"] + 180) % 360 - 180
    code = np.where(abs(off) <= env.turn_angle / 2, 1, np.where(off > 0, 2, 3))
    if env.stop == "auto":
        return code - 1
    # Geodesic distances are a little longer than straight ones.
    return np.where(np.hypot(east, north) < 0.9 * env.success_distance, 0, code)


def oracle_player(env: Any, _: Any) -> NDArray[np.int64]:
    """Knows the map."""
    return np.asarray(env.oracle_actions())


def model_player(model: Any) -> Player:
    """Acts on observations by its stochastic policy, as in training."""
    return lambda _, observations: model.predict(observations, deterministic=False)[0]


def play(player: Player, env_kwargs: dict[str, Any], n_episodes: int, seed: int) -> dict[str, float]:
    """Success and SPL, their standard errors, and the mean number of steps, over one episode of each copy."""
    import gymnasium as gym

    import sb3_abisim  # noqa: F401

    env = gym.make_vec("ScanNav-v0", n_episodes, vectorization_mode="vector_entry_point", **env_kwargs).unwrapped
    observations, _ = env.reset(seed=seed)
    success, spl, steps = np.zeros((3, n_episodes))
    going = np.ones(n_episodes, dtype=bool)
    while going.any():
        observations, _, terminated, truncated, infos = env.step(player(env, observations))
        steps += going
        over = going & (terminated | truncated)
        success[over], spl[over] = infos["success"][over], infos["spl"][over]
        going &= ~over
    error = n_episodes**0.5
    return {
        "success": float(success.mean()),
        "success_error": float(success.std() / error),
        "spl": float(spl.mean()),
        "spl_error": float(spl.std() / error),
        "steps": float(steps.mean()),
    }


def learning_curve(run: Path) -> dict[str, list[float]]:
    """Success and SPL of the episodes of training, by the steps of all copies together."""
    from stable_baselines3.common.monitor import load_results

    episodes = load_results(str(run)).sort_values("t")
    steps = episodes["l"].cumsum().to_numpy()
    share = np.minimum((steps * N_POINTS / steps[-1]).astype(int), N_POINTS - 1)
    curve: dict[str, list[float]] = {"steps": [], "success": [], "spl": []}
    for k in np.unique(share):
        part = share == k
        curve["steps"].append(float(steps[part].mean()))
        curve["success"].append(round(float(episodes["is_success"].to_numpy()[part].mean()), 4))
        curve["spl"].append(round(float(episodes["spl"].to_numpy()[part].mean()), 4))
    return curve


def plot(result: dict[str, Any], path: Path) -> None:
    """Success and SPL during training, beside the agents that do not learn."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(8, 3.6), sharex=True, layout="constrained")
    for axis, name in zip(axes, ("success", "spl"), strict=True):
        for run in result["runs"]:
            axis.plot(run["curve"]["steps"], run["curve"][name], label=f"PPO, {run['name']}")
        for (agent, scores), style in zip(result["agents"].items(), (":", "--", "-."), strict=True):
            axis.axhline(scores[name], color="gray", linestyle=style, label=agent)
        axis.set(xlabel="steps of all environments", ylabel={"spl": "SPL"}.get(name, name), ylim=(0, 1.02))
    handles, labels = axes[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize="small")
    figure.savefig(path, dpi=120)


def main(argv: list[str] | None = None) -> None:
    """Evaluate and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scan_learning", description=__doc__)
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="folder of a run of rl-zoo3")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="JSON file")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="PNG of the learning curves")
    parser.add_argument("--env-kwargs", type=json.loads, metavar="JSON", help="(default: those of the first run)")
    parser.add_argument("--episodes", type=int, default=200, help="of each agent (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1000, help="of the first copy (default: %(default)s)")
    args = parser.parse_args(argv)
    use_one_core()
    runs = [read_run(folder) for folder in args.runs]
    if args.env_kwargs is None:
        args.env_kwargs = runs[0].env_kwargs if runs else {}
    fixed = {"random": random_player(args.seed), "straight line": straight_player, "knows the map": oracle_player}
    result: dict[str, Any] = {
        "env_kwargs": args.env_kwargs,
        "commands": [run.command for run in runs],
        "episodes": args.episodes,
        "seed": args.seed,
        "agents": {n: play(player, args.env_kwargs, args.episodes, args.seed) for n, player in fixed.items()},
        "runs": [
            {
                "name": f"{run.label}, seed {run.seed}",
                "final": play(model_player(final_model(run)), args.env_kwargs, args.episodes, args.seed),
                "curve": learning_curve(run.folder),
            }
            for run in runs
        ],
        "versions": {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}},
    }
    for name, scores in [*result["agents"].items(), *((run["name"], run["final"]) for run in result["runs"])]:
        print(f"{name}: success {scores['success']:.3f}, SPL {scores['spl']:.3f}, {scores['steps']:.0f} steps")
    args.output.write_text(json.dumps(result, indent=1) + "\n")
    if args.figure is not None:
        plot(result, args.figure)


if __name__ == "__main__":
    main()
