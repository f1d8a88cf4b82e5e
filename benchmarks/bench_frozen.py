"""Speed of RL on a frozen encoder: through the pixels and by ``VecEncodeObservations``, in turns within one run.

PPO on ``DistractorPointMaze-v0`` and DQN on ``Nav2D-v0`` with the hyperparameters of ``hyperparams/`` (PPO with shorter
rollouts, so that a turn holds several), in the wrappers that the zoo puts around them. The same encoder, fine-tuned, is
there for comparison. The bound is Stable-Baselines3 with an environment and an encoder that take no time: a
:class:`Replay` of what they have returned before. Speed is steps per second of processor time on one thread, which load
on the machine disturbs less than the clock. Shares are of two turns of the same round. ``make bench``.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.tables import machine, use_one_core, write_page

RESULTS = Path(__file__).parent / "results" / "frozen.md"
# Of the bound.
LEAST_SHARE = 0.7
KINDS = ("fine-tuned", "frozen", "encoded", "free")
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


def replay(env: Any) -> Any:
    """A ``VecEnv`` that steps through to another one for a while, and then repeats what that has returned.

    :param env: whose embeddings, rewards and ends of episodes these are
    """
    from stable_baselines3.common.vec_env import VecEnvWrapper

    class Replay(VecEnvWrapper):
        def __init__(self, venv: Any) -> None:
            super().__init__(venv)
            self.steps: list[Any] = []
            self.position = 0

        def reset(self) -> Any:
            return self.venv.reset()

        def step_async(self, actions: Any) -> None:
            if len(self.steps) < N_STEPS:
                self.venv.step_async(actions)

        def step_wait(self) -> Any:
            if len(self.steps) < N_STEPS:
                self.steps.append(self.venv.step_wait())
                return self.steps[-1]
            self.position = (self.position + 1) % N_STEPS
            return self.steps[self.position]

    return Replay(env)


def make_model(algo: str, kind: str, device: str = "cpu") -> Any:
    """A model of the zoo's hyperparameters on an encoder.

    :param algo: "ppo" or "dqn"
    :param kind: "fine-tuned" or "frozen" through the pixels, "encoded" by the environment, or "free" of both
    :param device: of the model and of the encoder
    """
    import stable_baselines3 as sb3
    from stable_baselines3.common.env_util import make_vec_env
    from torch import nn

    from sb3_abisim import ActionBisimExtractor, BatchedVecEnv, VecEncodeObservations

    env_id, n_envs = ("DistractorPointMaze-v0", 16) if algo == "ppo" else ("Nav2D-v0", 1)
    env: Any = make_vec_env(env_id, n_envs, seed=0, vec_env_cls=BatchedVecEnv)
    policy_kwargs: dict[str, Any] = {"net_arch": [256], "activation_fn": nn.ReLU}
    is_encoded = kind in ("encoded", "free")
    if is_encoded:
        env = VecEncodeObservations(env, f"{env_id}/abisim", device=device)
    else:
        policy_kwargs["features_extractor_class"] = ActionBisimExtractor
        policy_kwargs["features_extractor_kwargs"] = {"encoder": f"{env_id}/abisim", "freeze": kind == "frozen"}
    if kind == "free":
        env = replay(env)
    if algo == "ppo":
        env = sb3.common.vec_env.VecNormalize(env, norm_obs=False)
    policy, kwargs = ("MlpPolicy" if is_encoded else "CnnPolicy"), (PPO if algo == "ppo" else DQN)
    model_class = {"ppo": sb3.PPO, "dqn": sb3.DQN}[algo]
    return model_class(policy, env, policy_kwargs=policy_kwargs, device=device, seed=0, **kwargs)


def turns(model: Any, n_steps: int) -> Callable[[], float]:
    """A function that trains for ``n_steps`` and returns the steps per second of processor time.

    :param model: of Stable-Baselines3
    :param n_steps: of each turn; so many are taken at once, unmeasured
    """
    model.learn(n_steps)

    def run() -> float:
        start = time.process_time()
        model.learn(n_steps, reset_num_timesteps=False)
        return n_steps / (time.process_time() - start)

    return run


def row(title: str, speeds: dict[str, list[float]]) -> str:
    """A line of the table.

    :param title: algorithm and environment
    :param speeds: of each kind, one for each round
    """
    shares = [ours / bound for ours, bound in zip(speeds["encoded"], speeds["free"], strict=True)]
    ratios = [ours / pixels for ours, pixels in zip(speeds["encoded"], speeds["frozen"], strict=True)]
    cells = " | ".join(f"{statistics.median(speeds[kind]):,.0f}" for kind in KINDS)
    return (
        f"| {title} | {cells} | {statistics.median(ratios):.1f} ({min(ratios):.1f} to {max(ratios):.1f}) | "
        f"{statistics.median(shares):.0%} ({min(shares):.0%} to {max(shares):.0%}) | {LEAST_SHARE:.0%} |"
    )


def main(argv: list[str] | None = None) -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_frozen", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=9, help="turns of each contender (default: %(default)s)")
    args = parser.parse_args(argv)
    use_one_core()
    rows = []
    for algo, n_steps, title in (
        ("ppo", 16 * N_STEPS, "PPO, DistractorPointMaze-v0"),
        ("dqn", 1_000, "DQN, Nav2D-v0"),
    ):
        runs = {kind: turns(make_model(algo, kind), n_steps) for kind in KINDS}
        speeds: dict[str, list[float]] = {kind: [] for kind in KINDS}
        for _ in range(args.rounds):
            for kind, run in runs.items():
                speeds[kind].append(run())
        rows.append(row(title, speeds))
        print(rows[-1], flush=True)
    text = (
        f"`python -m benchmarks.bench_frozen` on {machine()}: steps per second of processor time, median of "
        f"{args.rounds} turns. In brackets the least and the greatest of the rounds. The ratio is to the frozen "
        "encoder through the pixels."
    )
    header = [
        "| algorithm, environment | fine-tuned | frozen, pixels | `VecEncodeObservations` | bound | ratio | "
        "share of the bound | aim |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    tail = (
        "The bound is Stable-Baselines3 with an environment and an encoder that take no time at all. What is left is",
        "its work on the embeddings (policy, buffers, scaling of rewards, and updates of the heads with Adam), which",
        "no encoder makes cheaper.",
        "",
    )
    write_page(args.output, "Speed of RL on a frozen encoder", text, header, rows, tail)


if __name__ == "__main__":
    main()
