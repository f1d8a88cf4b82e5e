"""Run folders in the form of rl-zoo3, with curves that the test chooses."""

from collections import OrderedDict
from pathlib import Path

import numpy as np
import yaml

from sb3_abisim.zoo.methods import EXTRACTORS


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
    kwargs = {"encoder": f"{name}-{seed}.safetensors", **({"freeze": True} if how == "freeze" else {})}
    shown = f", features_extractor_kwargs={kwargs!r}" if name != "vanilla" else ""
    text = f"dict(features_extractor_class=get_class_by_name('sb3_abisim.rl.extractors.{EXTRACTORS[name]}'){shown})"
    args = {
        "algo": algo, "env": env_id, "seed": seed, "n_timesteps": n_timesteps or steps[-1], "env_kwargs": None,
        "eval_env_kwargs": None, "eval_freq": steps[0], "eval_episodes": returns.shape[1], "conf_file": method,
    }  # fmt: skip
    # As rl_zoo3.exp_manager writes them, tags included.
    (run / env_id / "args.yml").write_text(yaml.dump(OrderedDict(sorted(args.items()))))
    config = OrderedDict([("n_timesteps", 7_000_000), ("policy", "CnnPolicy"), ("policy_kwargs", text)])
    if how == "frozen":
        wrapper = {"sb3_abisim.rl.vec_encode.VecEncodeObservations": {"encoder": kwargs["encoder"], "objective": name}}
        config |= {"policy": "MlpPolicy", "policy_kwargs": "dict(net_arch=[256])", "vec_env_wrapper": [wrapper]}
    (run / env_id / "config.yml").write_text(yaml.dump(config))
    (run / env_id / "command.txt").write_text(f"sb3-abisim train --seed {seed}")
    np.savez(run / "evaluations.npz", timesteps=steps, results=returns, ep_lengths=-returns, successes=returns > -100)
    if final:
        np.savez(run / "final_evaluations.npz", **{f"{key}/results": value for key, value in final.items()})
    return run
