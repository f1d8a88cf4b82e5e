"""Speed of fine-tuning an encoder through pixels, and what makes it: PPO on ``DistractorPointMaze-v0``, in turns.

The hyperparameters are those of ``hyperparams/`` with shorter rollouts. Each contender differs from what a user gets in
one thing. A round holds one turn of each, and ratios are to the plain turn of the same round. Speed is steps per
second of processor time on one thread.

The bound is what would be left of a plain turn if all but the encoder's convolutions took no time: they are run alone,
forwards and backwards, on as many minibatches as a turn has. ``make bench``.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.tables import machine, use_one_core, write_page

RESULTS = Path(__file__).parent / "results" / "finetuning.md"
ENV_ID = "DistractorPointMaze-v0"
N_ENVS, N_STEPS, BATCH_SIZE, N_EPOCHS = 16, 64, 256, 10
AIM = 1.5
# Whether each contender learns the same as the plain one, from the same numbers.
CONTENDERS = {
    "plain": "",
    "weights and observations with channels first": "to rounding",
    "observations with channels first": "the same bits",
    "`torch.autocast` to bfloat16": "no",
    "minibatches of 1,024": "no",
    "4 epochs": "no",
}


def make_model(contender: str) -> Any:
    """PPO on the shipped encoder of action-bisimulation, fine-tuned.

    :param contender: of :data:`CONTENDERS`
    """
    import torch as th
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize
    from torch import nn

    from sb3_abisim import ActionBisimExtractor, BatchedVecEnv
    from sb3_abisim.networks.base import Encoder, set_memory_format

    class BFloat16(ActionBisimExtractor):
        def forward(self, observations: th.Tensor) -> th.Tensor:
            with th.autocast("cpu", th.bfloat16):
                return super().forward(observations).float()

    is_bfloat16 = "bfloat16" in contender
    env = VecNormalize(make_vec_env(ENV_ID, N_ENVS, seed=0, vec_env_cls=BatchedVecEnv), norm_obs=False)
    policy_kwargs = {
        "net_arch": [256], "activation_fn": nn.ReLU,
        "features_extractor_class": BFloat16 if is_bfloat16 else ActionBisimExtractor,
        "features_extractor_kwargs": {"encoder": f"{ENV_ID}/abisim"},
    }  # fmt: skip
    model = PPO(
        "CnnPolicy", env, n_steps=N_STEPS, batch_size=1024 if "1,024" in contender else BATCH_SIZE,
        n_epochs=4 if contender == "4 epochs" else N_EPOCHS, learning_rate=2.5e-5, policy_kwargs=policy_kwargs,
        device="cpu", seed=0,
    )  # fmt: skip
    encoder: Any = model.policy.features_extractor.encoder
    if contender == "weights and observations with channels first":
        set_memory_format(encoder, th.contiguous_format)
    if "with channels first" in contender:
        encoder.forward = lambda observations: Encoder.forward(encoder, th.add(-1.0, observations, alpha=2.0))
    return model


def turns(contender: str) -> Callable[[], float]:
    """A function that trains for one rollout and returns the seconds of processor time.

    :param contender: of :data:`CONTENDERS`
    """
    model = make_model(contender)

    def run() -> float:
        start = time.process_time()
        model.learn(N_ENVS * N_STEPS, reset_num_timesteps=False)
        return time.process_time() - start

    run()
    return run


def convolutions() -> Callable[[], float]:
    """A function that runs the encoder's convolutions as often as a turn's updates do, and returns the seconds."""
    import torch as th
    from torch import nn

    from sb3_abisim.networks.encoder_file import load_encoder

    layers: Any = load_encoder(f"{ENV_ID}/abisim").encoder.layers
    parts = []
    x = th.rand(BATCH_SIZE, 3, 64, 64).contiguous(memory_format=th.channels_last)
    for layer in layers:
        output = layer(x)
        if isinstance(layer, nn.Conv2d):
            # The first needs no gradient of its input.
            parts.append((layer, x.detach().requires_grad_(bool(parts)), th.rand_like(output)))
        x = output.detach().clone()

    def run() -> float:
        start = time.process_time()
        for _ in range(N_EPOCHS * N_ENVS * N_STEPS // BATCH_SIZE):
            for layer, inputs, gradient in parts:
                layer(inputs).backward(gradient)
        return time.process_time() - start

    run()
    return run


def row(name: str, seconds: list[float], plain: list[float], equal: str) -> str:
    """A line of the table.

    :param name: of the contender
    :param seconds: one for each round
    :param plain: of the plain contender
    :param equal: whether it learns the same
    """
    ratios = [first / own for first, own in zip(plain, seconds, strict=True)]
    speed = f"{N_ENVS * N_STEPS / statistics.median(seconds):,.0f}"
    if seconds is plain:
        return f"| {name} | {speed} | 1 | | |"
    return f"| {name} | {speed} | {statistics.median(ratios):.2f} | {min(ratios):.2f} to {max(ratios):.2f} | {equal} |"


def main(argv: list[str] | None = None) -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench_finetuning", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="Markdown file (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=7, help="turns of each contender (default: %(default)s)")
    args = parser.parse_args(argv)
    use_one_core()
    from sb3_abisim.common.malloc import keep_freed_memory

    # As the zoo's callback does.
    keep_freed_memory()
    runs = {name: turns(name) for name in CONTENDERS} | {"bound": convolutions()}
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(args.rounds):
        for name, run in runs.items():
            seconds[name].append(run())
    rows = [row(name, seconds[name], seconds["plain"], equal) for name, equal in CONTENDERS.items()]
    rows.append(row("bound: its convolutions alone", seconds["bound"], seconds["plain"], ""))
    text = (
        f"`python -m benchmarks.bench_finetuning` on {machine()}: PPO on `{ENV_ID}`, {N_EPOCHS} epochs of minibatches "
        f"of {BATCH_SIZE}, steps per second of processor time, median of {args.rounds} turns. Ratios are to the plain "
        "turn of the same round, with the least and the greatest."
    )
    header = [
        "| fine-tuning an encoder | steps per second | ratio | all rounds | learns the same |",
        "|---|---:|---:|---:|---|",
    ]
    tail = (f"{AIM} times was asked for. The bound is the ratio if everything but convolutions took no time.", "")
    write_page(args.output, "Speed of fine-tuning through pixels", text, header, rows, tail)


if __name__ == "__main__":
    main()
