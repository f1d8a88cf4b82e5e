"""Speed of RL on a frozen encoder: through the pixels and by ``VecEncodeObservations``, in turns within one run.

PPO on ``DistractorPointMaze-v0`` and DQN on ``Nav2D-v0`` with the hyperparameters of ``hyperparams/`` (PPO with shorter
rollouts, so that a turn holds several), in the wrappers that the zoo puts around them. The same encoder, fine-tuned, is
there for comparison. Two rows have more environments, with as many steps in a rollout and for each update.

The bound is Stable-Baselines3 with an environment and an encoder that take no time: :func:`replay` repeats what they
have returned before. :func:`floor` says how much of it could be reached with the environment's steps and the encoder's
forward passes as they are, if nothing else of ours took time. Speed is steps per second of processor time on one
thread, which load on the machine disturbs less than the clock. Shares and ratios are of turns of the same round.
``make bench``.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.tables import machine, use_one_core, write_page

RESULTS = Path(__file__).parent / "results" / "frozen.md"
# Of the bound.
LEAST_SHARE = 0.7
KINDS = ("fine-tuned", "frozen", "encoded", "free")
# Steps of each environment that the bound repeats; no turn has fewer.
N_REPLAYED = 32
PPO = {"batch_size": 256, "learning_rate": 2.5e-5}
DQN = {
    "batch_size": 32,
    "learning_rate": 1e-4,
    "exploration_initial_eps": 0.9,
    "exploration_final_eps": 0.2,
    "buffer_size": 20_000,
    "learning_starts": 100,
}


class Setting(NamedTuple):
    """A row of the table.

    :param title: algorithm and environment
    :param algo: "ppo" or "dqn"
    :param env_id: id of the environment
    :param n_envs: number of copies
    :param kwargs: of the algorithm
    :param n_steps: of a turn
    :param kinds: what is compared
    """

    title: str
    algo: str
    env_id: str
    n_envs: int
    kwargs: dict[str, Any]
    n_steps: int
    kinds: tuple[str, ...] = KINDS


SETTINGS = (
    Setting("PPO, DistractorPointMaze-v0", "ppo", "DistractorPointMaze-v0", 16, {**PPO, "n_steps": 128}, 2048),
    Setting("PPO, DistractorPointMaze-v0, 64 environments", "ppo", "DistractorPointMaze-v0", 64,
            {**PPO, "n_steps": 32}, 2048, KINDS[2:]),
    Setting("DQN, Nav2D-v0", "dqn", "Nav2D-v0", 1, DQN, 1000),
    Setting("DQN, Nav2D-v0, 8 environments", "dqn", "Nav2D-v0", 8, {**DQN, "train_freq": 1, "gradient_steps": 2}, 1000,
            KINDS[2:]),
)  # fmt: skip


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
            if len(self.steps) < N_REPLAYED:
                self.venv.step_async(actions)

        def step_wait(self) -> Any:
            if len(self.steps) < N_REPLAYED:
                self.steps.append(self.venv.step_wait())
                return self.steps[-1]
            self.position = (self.position + 1) % N_REPLAYED
            return self.steps[self.position]

    return Replay(env)


def _encoder(setting: Setting) -> str:
    return f"{setting.env_id}/abisim"


def _encoded_env(setting: Setting, device: str = "cpu") -> Any:
    from stable_baselines3.common.env_util import make_vec_env

    from sb3_abisim import BatchedVecEnv, VecEncodeObservations

    env = make_vec_env(setting.env_id, setting.n_envs, seed=0, vec_env_cls=BatchedVecEnv)
    return VecEncodeObservations(env, _encoder(setting), device=device)


def make_model(setting: Setting, kind: str, device: str = "cpu") -> Any:
    """A model of the zoo's hyperparameters on an encoder.

    :param setting: algorithm and environment
    :param kind: "fine-tuned" or "frozen" through the pixels, "encoded" by the environment, or "free" of both
    :param device: of the model and of the encoder
    """
    import stable_baselines3 as sb3
    from stable_baselines3.common.env_util import make_vec_env
    from torch import nn

    from sb3_abisim import ActionBisimExtractor, BatchedVecEnv

    policy_kwargs: dict[str, Any] = {"net_arch": [256], "activation_fn": nn.ReLU}
    encoder, is_encoded = _encoder(setting), kind in ("encoded", "free")
    if is_encoded:
        env: Any = _encoded_env(setting, device)
    else:
        env = make_vec_env(setting.env_id, setting.n_envs, seed=0, vec_env_cls=BatchedVecEnv)
        policy_kwargs["features_extractor_class"] = ActionBisimExtractor
        policy_kwargs["features_extractor_kwargs"] = {"encoder": encoder, "freeze": kind == "frozen"}
    if kind == "free":
        env = replay(env)
    if setting.algo == "ppo":
        env = sb3.common.vec_env.VecNormalize(env, norm_obs=False)
    model_class = {"ppo": sb3.PPO, "dqn": sb3.DQN}[setting.algo]
    policy = "MlpPolicy" if is_encoded else "CnnPolicy"
    return model_class(policy, env, policy_kwargs=policy_kwargs, device=device, seed=0, **setting.kwargs)


def turns(model: Any, n_steps: int) -> Callable[[], float]:
    """A function that trains for ``n_steps`` and returns the steps per second of processor time.

    :param model: of Stable-Baselines3
    :param n_steps: of each turn; so many are taken at once, unmeasured
    """
    model.learn(n_steps)

    def run() -> float:
        # A clock of processor time may take as long as a step, so it is read twice a turn and not in between.
        start = time.process_time()
        model.learn(n_steps, reset_num_timesteps=False)
        return n_steps / (time.process_time() - start)

    return run


def floor(env: Any, n_steps: int) -> Callable[[], float]:
    """A function that steps the environment and embeds observations, and gives seconds of processor time for a step.

    :param env: a :class:`~sb3_abisim.VecEncodeObservations`
    :param n_steps: of each turn, of all copies together
    """
    import numpy as np

    venv, n = env.venv, n_steps // env.num_envs
    venv.seed(0)
    venv.reset()
    actions = np.array([[venv.action_space.sample() for _ in range(env.num_envs)] for _ in range(n)])

    def run() -> float:
        start = time.process_time()
        for observations in [venv.step(step)[0] for step in actions]:
            env.encode(observations)
        return (time.process_time() - start) / n_steps

    return run


def share_of_updates(model: Any, n_steps: int) -> float:
    """The share of the time that ``model.train`` takes.

    :param model: of Stable-Baselines3
    :param n_steps: to train for
    """
    seconds, train = 0.0, model.train

    def timed_train(*args: Any, **kwargs: Any) -> None:
        nonlocal seconds
        start = time.perf_counter()
        train(*args, **kwargs)
        seconds += time.perf_counter() - start

    model.train = timed_train
    start = time.perf_counter()
    model.learn(n_steps, reset_num_timesteps=False)
    model.train = train
    return seconds / (time.perf_counter() - start)


def row(title: str, speeds: dict[str, list[float]], floors: list[float], in_updates: float) -> str:
    """A line of the table.

    :param title: algorithm and environment
    :param speeds: of each kind, one for each round
    :param floors: seconds that a step of the environment and its embedding take, one for each round
    :param in_updates: the share of the bound's time that updates take
    """
    cells = [f"{statistics.median(speeds[kind]):,.0f}" if kind in speeds else "" for kind in KINDS]
    shares = [ours / bound for ours, bound in zip(speeds["encoded"], speeds["free"], strict=True)]
    if "frozen" in speeds:
        ratios = [ours / pixels for ours, pixels in zip(speeds["encoded"], speeds["frozen"], strict=True)]
        cells.append(f"{statistics.median(ratios):.1f} ({min(ratios):.1f} to {max(ratios):.1f})")
    else:
        cells.append("")
    cells.append(f"{in_updates:.0%}")
    # In the time of a step of the bound plus that of what is not Stable-Baselines3's.
    reachable = [1 / (1 + bound * seconds) for bound, seconds in zip(speeds["free"], floors, strict=True)]
    for values in (shares, reachable):
        cells.append(f"{statistics.median(values):.0%} ({min(values):.0%} to {max(values):.0%})")
    cells.append(f"{LEAST_SHARE:.0%}")
    return f"| {title} | " + " | ".join(cells) + " |"


def main(argv: list[str] | None = None) -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_frozen", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=9, help="turns of each contender (default: %(default)s)")
    args = parser.parse_args(argv)
    use_one_core()
    rows = []
    for setting in SETTINGS:
        models = {kind: make_model(setting, kind) for kind in setting.kinds}
        runs = {kind: turns(model, setting.n_steps) for kind, model in models.items()}
        alone, floors = floor(_encoded_env(setting), setting.n_steps), []
        speeds: dict[str, list[float]] = {kind: [] for kind in runs}
        for _ in range(args.rounds):
            for kind, run in runs.items():
                speeds[kind].append(run())
            floors.append(alone())
        rows.append(row(setting.title, speeds, floors, share_of_updates(models["free"], setting.n_steps)))
        print(rows[-1], flush=True)
    text = (
        f"`python -m benchmarks.bench_frozen` on {machine()}: steps per second of processor time, median of "
        f"{args.rounds} turns. In brackets the least and the greatest of the rounds. The ratio is to the frozen "
        "encoder through the pixels."
    )
    header = [
        "| algorithm, environment | fine-tuned | frozen, pixels | `VecEncodeObservations` | bound | ratio | "
        "of the bound, updates | share of the bound | share that could be | aim |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    tail = (
        "The bound is Stable-Baselines3 with an environment and an encoder that take no time at all. What is left is",
        "its work on the embeddings (policy, buffers, scaling of rewards, and updates of the heads with Adam), which",
        "no encoder makes cheaper. With more environments, rollouts have as many steps in all (PPO), and there is one",
        "update for every four steps (DQN), as with fewer. The share that could be is the one with the environment's",
        "steps and the encoder's forward passes as they are, measured alone, and nothing else of ours.",
        "",
    )
    write_page(args.output, "Speed of RL on a frozen encoder", text, header, rows, tail)


if __name__ == "__main__":
    main()
