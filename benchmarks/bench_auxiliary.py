"""What an auxiliary objective costs: PPO on ``DistractorPointMaze-v0`` with and without, in turns within one run.

The hyperparameters are those of ``hyperparams/`` (with shorter rollouts, so that a turn holds several), the encoder is
trained from scratch, and ``AuxiliaryObjective`` has its default settings. Speed is steps per second of processor time
on one thread, which load on the machine disturbs less than the clock. Load still makes both slower, so each turn is
compared with the one without an objective in the same round. ``make bench``.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.tables import machine, use_one_core, write_page

RESULTS = Path(__file__).parent / "results" / "auxiliary.md"
ENV_ID = "DistractorPointMaze-v0"
N_ENVS, N_STEPS = 16, 128
# Of PPO's time without an objective.
MOST = 0.25


def make_model() -> Any:
    """PPO with the zoo's hyperparameters, from scratch."""
    import gymnasium as gym
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize
    from torch import nn

    from sb3_abisim import BatchedVecEnv
    from sb3_abisim.rl.extractors import VanillaExtractor

    env = VecNormalize(BatchedVecEnv([lambda: gym.make(ENV_ID)] * N_ENVS), norm_obs=False)
    policy_kwargs = {"net_arch": [256], "activation_fn": nn.ReLU, "features_extractor_class": VanillaExtractor}
    return PPO(
        "CnnPolicy", env, n_steps=N_STEPS, batch_size=256, learning_rate=2.5e-5, policy_kwargs=policy_kwargs,
        device="cpu", seed=0,
    )  # fmt: skip


def turns(objective: str | None) -> Callable[[], float]:
    """A function that trains for some rollouts and returns the steps per second of processor time.

    :param objective: None for PPO alone
    """
    from sb3_abisim import AuxiliaryObjective

    model, n_steps = make_model(), 2 * N_ENVS * N_STEPS

    def run() -> float:
        callback = None if objective is None else AuxiliaryObjective(objective)
        start = time.process_time()
        model.learn(n_steps, callback, reset_num_timesteps=False)
        return n_steps / (time.process_time() - start)

    run()
    return run


def main(argv: list[str] | None = None) -> None:
    """Measure and write the table."""
    from sb3_abisim.registry import methods

    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_auxiliary", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=7, help="turns of each contender (default: %(default)s)")
    args = parser.parse_args(argv)
    use_one_core()
    objectives = [None, *(name for name, method in methods().items() if method.is_pretrained)]
    runs = {objective: turns(objective) for objective in objectives}
    speeds: dict[str | None, list[float]] = {objective: [] for objective in runs}
    for _ in range(args.rounds):
        for objective, run in runs.items():
            speeds[objective].append(run())
    rows = []
    for objective, found in speeds.items():
        more = [plain / speed - 1 for plain, speed in zip(speeds[None], found, strict=True)]
        cells = "| |" if objective is None else f"{statistics.median(more):.0%} | {min(more):.0%} to {max(more):.0%} |"
        name = "none" if objective is None else f"`{objective}`"
        rows.append(f"| {name} | {statistics.median(found):,.0f} | {cells}")
    print("\n".join(rows), flush=True)
    text = (
        f"`python -m benchmarks.bench_auxiliary` on {machine()}: environment steps per second of processor time, "
        f"median of {args.rounds} turns of {2 * N_ENVS * N_STEPS:,} steps, and the median of the time that they take "
        f"more than the turn without an objective in the same round. PPO on `{ENV_ID}` from scratch, "
        "`AuxiliaryObjective` with its defaults. Other work on the machine moves single turns."
    )
    header = ["| auxiliary objective | steps per second | more time than without | all turns |", "|---|---:|---:|---:|"]
    tail = (f"At most {MOST:.0%} was asked for.", "")
    write_page(args.output, "What an auxiliary objective costs", text, header, rows, tail)


if __name__ == "__main__":
    main()
