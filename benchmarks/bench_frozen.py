"""Speed of RL on a frozen encoder: through the pixels and by ``VecEncodeObservations``, in turns within one run.

PPO on ``DistractorPointMaze-v0`` and DQN on ``Nav2D-v0`` with the hyperparameters of ``hyperparams/`` (PPO with shorter
rollouts, so that a turn holds several). The same encoder, fine-tuned, is there for comparison. Speed is steps per
second of processor time on one thread, which load on the machine disturbs less than the clock. The speed of each is
that of its fastest turn. The bound is the speed that ``VecEncodeObservations`` would have if environment and encoder
took no time, so that only Stable-Baselines3's work on the embeddings remained. ``make bench``.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.tables import machine, use_one_core, write_page

RESULTS = Path(__file__).parent / "results" / "frozen.md"
AIM = 5.0
KINDS = ("fine-tuned", "frozen", "encoded")
N_STEPS = 128
PPO = {"n_steps": N_STEPS, "batch_size": 256, "learning_rate": 2.5e-5}
DQN = {
    "batch_size": 32,
    "learning_rate": 1e-4,
    "exploration_initial_eps": 0.9,
    "exploration_final_eps": 0.2,
    "buffer_size": 20_000,
    "learning_starts": 100,
}


def make_model(algo: str, kind: str, device: str = "cpu") -> Any:
    """A model of the zoo's hyperparameters on an encoder.

    :param algo: "ppo" or "dqn"
    :param kind: "fine-tuned" or "frozen" through the pixels, or "encoded" by the environment
    :param device: of the model and of the encoder
    """
    import gymnasium as gym
    import stable_baselines3 as sb3
    from torch import nn

    from sb3_abisim import ActionBisimExtractor, BatchedVecEnv, VecEncodeObservations

    env_id, n_envs = ("DistractorPointMaze-v0", 16) if algo == "ppo" else ("Nav2D-v0", 1)
    vec_env_class = BatchedVecEnv if n_envs > 1 else sb3.common.vec_env.DummyVecEnv
    env = vec_env_class([lambda: gym.make(env_id)] * n_envs)
    policy_kwargs: dict[str, Any] = {"net_arch": [256], "activation_fn": nn.ReLU}
    if kind == "encoded":
        env = VecEncodeObservations(env, f"{env_id}/abisim", device=device)
    else:
        policy_kwargs["features_extractor_class"] = ActionBisimExtractor
        policy_kwargs["features_extractor_kwargs"] = {"encoder": f"{env_id}/abisim", "freeze": kind == "frozen"}
    if algo == "ppo":
        env = sb3.common.vec_env.VecNormalize(env, norm_obs=False)
    policy, kwargs = ("MlpPolicy" if kind == "encoded" else "CnnPolicy"), (PPO if algo == "ppo" else DQN)
    model_class = {"ppo": sb3.PPO, "dqn": sb3.DQN}[algo]
    return model_class(policy, env, policy_kwargs=policy_kwargs, device=device, seed=0, **kwargs)


def turns(model: Any, n_steps: int) -> Callable[[], tuple[float, float]]:
    """A function that trains for ``n_steps`` and returns the steps per second of processor time, also without the time
    of the environment and of the encoder that is part of it."""
    seconds_in_env = 0.0
    plain_step = model.env.step

    def timed_step(actions: Any) -> Any:
        nonlocal seconds_in_env
        start = time.process_time()
        result = plain_step(actions)
        seconds_in_env += time.process_time() - start
        return result

    model.env.step = timed_step
    model.learn(n_steps)

    def run() -> tuple[float, float]:
        nonlocal seconds_in_env
        seconds_in_env, start = 0.0, time.process_time()
        model.learn(n_steps, reset_num_timesteps=False)
        seconds = time.process_time() - start
        return n_steps / seconds, n_steps / (seconds - seconds_in_env)

    return run


def main(argv: list[str] | None = None) -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_frozen", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each contender (default: %(default)s)")
    args = parser.parse_args(argv)
    use_one_core()
    rows = []
    for algo, n_steps, title in (
        ("ppo", 16 * N_STEPS, "PPO, DistractorPointMaze-v0"),
        ("dqn", 1_000, "DQN, Nav2D-v0"),
    ):
        runs = {kind: turns(make_model(algo, kind), n_steps) for kind in KINDS}
        best = dict.fromkeys(runs, (0.0, 0.0))
        for _ in range(args.rounds):
            for kind, run in runs.items():
                best[kind] = max(best[kind], run())
        fine_tuned, frozen, encoded = (best[kind][0] for kind in KINDS)
        bound = best["encoded"][1]
        row = (
            f"| {title} | {fine_tuned:,.0f} | {frozen:,.0f} | {encoded:,.0f} | {encoded / frozen:.1f} | {AIM:.0f} | "
            f"{bound:,.0f} ({bound / frozen:.1f}) |"
        )
        print(row, flush=True)
        rows.append(row)
    text = (
        f"`python -m benchmarks.bench_frozen` on {machine()}: steps per second of processor time, fastest of "
        f"{args.rounds} turns. The ratio is to the frozen encoder through the pixels."
    )
    header = [
        "| algorithm, environment | fine-tuned | frozen, pixels | `VecEncodeObservations` | ratio | aim | bound |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    tail = (
        "The bound is the speed (and the ratio) that `VecEncodeObservations` would have if environment and encoder",
        "took no time at all. What is left is Stable-Baselines3's work on the embeddings (policy, buffers, and",
        "updates of the heads with Adam), which no encoder makes cheaper.",
        "",
    )
    write_page(args.output, "Speed of RL on a frozen encoder", text, header, rows, tail)


if __name__ == "__main__":
    main()
