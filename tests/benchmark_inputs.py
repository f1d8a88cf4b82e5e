"""Run folders in the form of rl-zoo3, with curves that the test chooses."""

import csv
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_abisim.registry import get_method
from sb3_abisim.zoo.entries import ENCODING_WRAPPER
from sb3_abisim.zoo.method_record import MethodRecord

STEPS = list(range(1000, 11_000, 1000))
# The step at which a method jumps from -100 to -20, per seed; above the last step it never does.
JUMPS = {"abisim": (3000, 4000), "ssi": (6000, 8000), "vanilla": (9000, 99_000)}
N_EPISODES = 4


def write_run(
    folder: Path,
    env_id: str,
    method: str,
    seed: int,
    steps: list[int],
    returns: np.ndarray,
    algo: str = "ppo",
    final: dict[str, np.ndarray] | None = None,
    n_timesteps: int | None = None,
) -> Path:
    """``returns`` has shape (len(steps), n_episodes); ``final`` is e.g. {"deterministic/eval": array of returns}.

    ``method`` is as in ``--conf-file``, or ends in ",freeze" for an extractor that is frozen within the policy.
    """
    number = 1 + sum(1 for _ in (folder / algo).glob(f"{env_id}_*"))
    run = folder / algo / f"{env_id}_{number}"
    (run / env_id).mkdir(parents=True)
    name, _, how = method.partition(",")
    encoder = f"{name}-{seed}.safetensors" if get_method(name).is_pretrained else None
    args = {
        "algo": algo, "env": env_id, "seed": seed, "n_timesteps": n_timesteps or steps[-1], "env_kwargs": None,
        "eval_env_kwargs": None, "eval_freq": steps[0], "eval_episodes": returns.shape[1], "conf_file": method,
    }  # fmt: skip
    # As rl_zoo3.exp_manager writes them, tags included.
    (run / env_id / "args.yml").write_text(yaml.dump(OrderedDict(sorted(args.items()))))
    config: OrderedDict[str, Any] = OrderedDict(n_timesteps=7_000_000, policy="CnnPolicy")
    if how == "frozen":
        wrapper = {ENCODING_WRAPPER: {"encoder": encoder, "objective": name}}
        config |= {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [256]}, "vec_env_wrapper": [wrapper]}
    else:
        kwargs = {"features_extractor_class": f"sb3_abisim.{get_method(name).extractor}"}
        if encoder is not None:
            kwargs["features_extractor_kwargs"] = {"encoder": encoder, **({"freeze": True} if how == "freeze" else {})}
        config["policy_kwargs"] = kwargs
    (run / env_id / "config.yml").write_text(yaml.dump(config))
    record = MethodRecord(name, how in ("frozen", "freeze"), encoder, None if encoder is None else f"{seed:064}", {})
    record.write(run / env_id)
    (run / env_id / "command.txt").write_text(f"sb3-abisim train --seed {seed}")
    np.savez(run / "evaluations.npz", timesteps=steps, results=returns, ep_lengths=-returns, successes=returns > -100)
    if final:
        np.savez(run / "final_evaluations.npz", **{f"{key}/results": value for key, value in final.items()})
    return run


def write_all(folder: Path, env_ids: tuple[str, ...] = ("PointMaze-v0", "DistractorPointMaze-v0")) -> Path:
    rng = np.random.default_rng(0)
    for env_id in env_ids:
        for method, jumps in JUMPS.items():
            for seed, jump in enumerate(jumps):
                means = np.where(np.array(STEPS) >= jump, -20.0, -100.0)
                # Episodes differ, their mean is exact.
                noise = rng.normal(size=(len(STEPS), N_EPISODES))
                returns = means[:, None] + noise - noise.mean(axis=1, keepdims=True)
                final = {f"deterministic/{split}": means[-1:] - i for i, split in enumerate(("train", "eval", "clean"))}
                final |= {"stochastic/eval": means[-1:] + 5}
                write_run(folder / method, env_id, method, seed, STEPS, returns,
                          final=final if env_id.startswith("Distractor") else None)  # fmt: skip
    return folder


def read_csv(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))
