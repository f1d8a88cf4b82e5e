"""The three commands on environments that nothing here names: what is done, what is refused, and what it takes.

Each is run as a user would type it, in a process of its own, with budgets that show that it works and nothing else.
Seconds are of processor time, memory is the process's largest. The packages are no dependencies of this one, and
dm_control does not load beside MuJoCo 4. ``make test-envs`` installs them and runs this:

    pip install minigrid ale-py "gymnasium[box2d]" dm_control shimmy opencv-python-headless "mujoco<4"
    MUJOCO_GL=egl python -m benchmarks.any_pixels

A case that is done is kept in ``--work`` and not run again. ``--curves`` prints the commands of the comparison of each
documented environment with learning from scratch, which take hours and are not run here.
"""

import argparse
import dataclasses
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.tables import machine, write_page

RESULTS = Path(__file__).parent / "results" / "any_pixels.md"
RENDER = "gymnasium.wrappers.AddRenderObservation"
RESIZE = "rl_zoo3.wrappers.YAMLCompatResizeObservation: {shape: [64, 64]}"
GRAY = "gymnasium.wrappers.GrayscaleObservation: {keep_dim: true}"
# Of rl-zoo3's entries for Atari.
ATARI = "stable_baselines3.common.atari_wrappers.AtariWrapper"
COLLECT = ["-n", "400", "--n-envs", "2"]
PRETRAIN = ["n_updates:20", "batch_size:32", "log_interval:10", "checkpoint_interval:20"]
SMALL = {
    "ppo": ["n_envs:2", "n_steps:32", "batch_size:32", "n_epochs:1"],
    "ppo_lstm": ["n_envs:2", "n_steps:32", "batch_size:32", "n_epochs:1"],
    "trpo": ["n_envs:2", "n_steps:32", "batch_size:32"],
    "a2c": ["n_envs:2", "n_steps:16"],
    **{name: ["n_envs:1", "buffer_size:500", "learning_starts:60", "batch_size:16"] for name in ("dqn", "qrdqn")},
    **{name: ["n_envs:1", "buffer_size:500", "learning_starts:100"] for name in ("sac", "td3", "tqc")},
}


@dataclasses.dataclass(frozen=True)
class Case:
    """An environment and what a user adds to the commands.

    :param env_id: registered by ``package``
    :param package: for ``--packages``; "" where Gymnasium registers it by itself
    :param wrappers: for ``--env-wrapper``; empty takes those of rl-zoo3's entry
    :param env_kwargs: for ``--env-kwargs``
    :param stack: for ``--frame-stack``; None takes that of rl-zoo3's entry
    :param params: more for ``-params`` of ``train``
    :param frozen: whether the encoder is
    :param refused: what a refusal says that is right; "" where none is
    :param algo: of ``train``
    """

    env_id: str
    package: str = ""
    wrappers: tuple[str, ...] = ()
    env_kwargs: tuple[str, ...] = ()
    stack: int | None = None
    params: tuple[str, ...] = ()
    frozen: bool = False
    refused: str = ""
    algo: str = "ppo"

    def commands(self, folder: Path) -> dict[str, list[str]]:
        """The three commands by name.

        :param folder: for what they write
        """
        packages = ["--packages", self.package] if self.package else []
        kwargs = ["--env-kwargs", *self.env_kwargs] if self.env_kwargs else []
        env = ["--env", self.env_id, *packages]
        collect = ["collect", *env, *COLLECT, *kwargs, "-o", str(folder / "data")]
        params = [*SMALL[self.algo], *self.params]
        if self.wrappers:
            collect += ["--env-wrapper", *self.wrappers]
            params.append(f"env_wrapper:[{', '.join(f'{{{w}}}' if ': ' in w else w for w in self.wrappers)}]")
        if self.stack is not None:
            collect += ["--frame-stack", str(self.stack)]
            params.append(f"frame_stack:{self.stack if self.stack > 1 else None}")
        encoder = str(folder / "encoder.safetensors")
        pretrain = ["pretrain", *packages, "--objective", "ssi", "--data", str(folder / "data"), "-o", encoder]
        pretrain += ["-params", *PRETRAIN, "--verbose", "0"]
        train = ["train", "--algo", self.algo, *env, "--conf-file", f"ssi={encoder}{',frozen' * self.frozen}", *kwargs]
        train += ["-n", "128", "-f", str(folder / "logs"), "--eval-freq", "64", "--eval-episodes", "1"]
        train += ["--n-eval-envs", "1", "--num-threads", "1", "--verbose", "0", "-params", *params]
        return {"collect": collect, "pretrain": pretrain, "train": train}


SHORT = "max_episode_steps:50"
NO_NORM = "normalize:{norm_obs: false, norm_reward: true}"
RENDERED: dict[str, Any] = {"wrappers": (RENDER, RESIZE), "env_kwargs": ("render_mode:rgb_array", SHORT)}
GRID: dict[str, Any] = {"package": "minigrid", "env_kwargs": (SHORT,)}
CASES = (
    Case("ALE/Pong-v5", "ale_py", env_kwargs=(SHORT,)),
    Case("ALE/Breakout-v5", "ale_py", env_kwargs=(SHORT,), frozen=True),
    Case("ALE/MontezumaRevenge-v5", "ale_py", env_kwargs=(SHORT,), stack=1),
    Case("SpaceInvadersNoFrameskip-v4", "ale_py", (RESIZE,), (SHORT,), stack=2),
    Case("MiniGrid-FourRooms-v0", wrappers=("minigrid.wrappers.ImgObsWrapper",), params=(NO_NORM,), **GRID),
    Case(
        "MiniGrid-DoorKey-5x5-v0",
        params=(NO_NORM,),
        frozen=True,
        **GRID,
        wrappers=("minigrid.wrappers.RGBImgPartialObsWrapper", "minigrid.wrappers.ImgObsWrapper"),
    ),
    Case(
        "MiniGrid-Empty-Random-6x6-v0",
        **GRID,
        wrappers=("gymnasium.wrappers.FilterObservation: {filter_keys: [image, direction]}",),
    ),
    Case("BabyAI-GoToRedBallGrey-v0", refused=r"mission \(\w+\) have no numbers; .*FilterObservation", **GRID),
    Case("MiniGrid-KeyCorridorS3R1-v0", refused="uint8 images .*takes the place of the zoo's", **GRID),
    Case("CarRacing-v3", env_kwargs=(SHORT,)),
    # The tuned entry is for its continuous actions.
    Case(
        "CarRacing-v3",
        wrappers=(RESIZE,),
        env_kwargs=("continuous:false", SHORT),
        stack=3,
        frozen=True,
        params=("use_sde:False",),
    ),
    Case("LunarLander-v3", **RENDERED),
    Case("BipedalWalker-v3", **RENDERED, params=(NO_NORM,)),
    Case("dm_control/cartpole-swingup-v0", "shimmy", **RENDERED),
    Case("dm_control/reacher-easy-v0", "shimmy", **RENDERED, stack=3, frozen=True),
    Case("dm_control/walker-walk-v0", "shimmy", **RENDERED),
    Case("AdroitHandDoor-v1", "gymnasium_robotics", **RENDERED),
    Case("PointMaze_UMaze-v3", "gymnasium_robotics", **RENDERED),
    Case("CartPole-v1", refused="AddRenderObservation --env-kwargs render_mode:rgb_array"),
    Case("Pendulum-v1", wrappers=(RENDER, RESIZE, GRAY), env_kwargs=RENDERED["env_kwargs"], stack=2),
    Case("FrozenLake-v1", **RENDERED, params=(NO_NORM,)),
    Case("HalfCheetah-v5", **RENDERED, params=(NO_NORM,)),
)
# Three environments, and the algorithms of Stable-Baselines3 and its contrib package that take their actions.
_ANY, _DISCRETE, _BOX = ("ppo", "a2c", "trpo", "ppo_lstm"), ("dqn", "qrdqn"), ("sac", "td3", "tqc")
ALGORITHMS = (
    (Case("ALE/Pong-v5", "ale_py", (ATARI,), (SHORT,), stack=4), _ANY + _DISCRETE),
    (
        Case(
            "MiniGrid-FourRooms-v0",
            wrappers=("minigrid.wrappers.ImgObsWrapper",),
            stack=1,
            params=("normalize:False",),
            **GRID,
        ),
        _ANY + _DISCRETE,
    ),
    (Case("CarRacing-v3", "", (RESIZE,), (SHORT,), stack=2, params=("normalize:False",)), _ANY + _BOX),
)
# In docs/your_environment.md.
DOCUMENTED = ("ALE/Pong-v5", "MiniGrid-FourRooms-v0", "CarRacing-v3", "dm_control/cartpole-swingup-v0")


def run_command(words: list[str], folder: Path) -> dict[str, Any]:
    """Run a command; its exit code, what it took, and the end of what it said.

    :param words: after ``sb3-abisim``
    :param folder: to run in
    """
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryFile("w+") as said:
        start = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-m", "sb3_abisim", *words], cwd=folder, env=env, stdout=said, stderr=subprocess.STDOUT
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        lines = said.read().splitlines()
    errors = [line for line in lines if "error: " in line]
    return {
        "code": process.returncode,
        "seconds": usage.ru_utime + usage.ru_stime,
        "wall": time.monotonic() - start,
        "mib": usage.ru_maxrss / 1024,
        "said": (errors or lines or [""])[-1],
    }


def run_case(case: Case, work: Path, algos: tuple[str, ...] = (), dry: bool = False) -> dict[str, Any] | None:
    """The three commands of a case, or what they gave before.

    :param case: see :class:`Case`
    :param work: a folder for all cases
    :param algos: train with each of these instead
    :param dry: None instead of running anything
    """
    words = re.sub(r"\W+", "_", f"{case.env_id} {case.env_kwargs} {case.wrappers} {case.stack} {algos}")
    folder = work / words
    folder.mkdir(parents=True, exist_ok=True)
    found = folder / "outcome.json"
    outcome: dict[str, Any] = json.loads(found.read_bytes()) if found.is_file() else {}
    if dry:
        return outcome or None
    outcome.setdefault("spaces", _spaces(case))
    commands = case.commands(folder)
    for algo in algos or (case.algo,):
        commands[algo if algos else "train"] = dataclasses.replace(case, algo=algo).commands(folder)["train"]
    for name in [name for name in commands if name != "train" or not algos]:
        if outcome.get(name, {}).get("code") != 0:
            outcome[name] = run_command(commands[name], folder)
            print(f"{case.env_id} {name}: {outcome[name]['code']}, {outcome[name]['said'][:300]}", flush=True)
            found.write_text(json.dumps(outcome, indent=1))
        if outcome[name]["code"] and name in ("collect", "pretrain"):
            break
    return outcome


def _spaces(case: Case) -> list[str]:
    """As they are without wrappers."""
    import gymnasium as gym

    from sb3_abisim.common.cli import import_packages, parse_pairs

    import_packages([case.package] if case.package else [])
    env = gym.make(case.env_id, **parse_pairs([word for word in case.env_kwargs if word != SHORT], "env_kwargs"))
    texts = [" ".join(str(space).split()) for space in (env.observation_space, env.action_space)]
    env.close()
    texts = [
        re.sub(r"MissionSpace\(.*?\)(?=[,)])", "MissionSpace", re.sub(r"\[[^]]*\]", "[...]", text)) for text in texts
    ]
    return [text if len(text) <= 90 else text[:87] + "..." for text in texts]


def is_right(case: Case, outcome: dict[str, Any]) -> bool:
    """Whether everything was done, or refused as it should be.

    :param case: see :class:`Case`
    :param outcome: of :func:`run_case`
    """
    failed = [one for name, one in outcome.items() if name != "spaces" and one["code"]]
    if not case.refused:
        return not failed and "train" in outcome
    return len(failed) == 1 and failed[0]["code"] == 2 and re.search(case.refused, failed[0]["said"]) is not None


def _word(one: dict[str, Any] | None) -> str:
    return "-" if one is None else {0: "done", 2: "refused"}.get(one["code"], "failed")


def row(case: Case, outcome: dict[str, Any]) -> str:
    """A line of the table."""
    said, seconds, mib = [], [], []
    for name in ("collect", "pretrain", "train"):
        one = outcome.get(name)
        said.append(_word(one))
        seconds.append("-" if one is None else f"{one['seconds']:.0f}")
        mib.append("-" if one is None else f"{one['mib']:.0f}")
    added = "; ".join(
        [re.sub(r"[\w.]+\.(\w+)(: )?", r"\1 ", word).strip() for word in case.wrappers]
        + [word for word in case.env_kwargs if word != SHORT]
        + ([f"stack {case.stack}"] if case.stack is not None else [])
        + ["frozen"] * case.frozen
    )
    spaces = [text.replace("|", "") for text in outcome["spaces"]]
    cells = [f"`{case.env_id}`", added, *spaces, *(", ".join(words) for words in (said, seconds, mib))]
    return f"| {' | '.join(cells)} |"


def curves(name: str) -> list[str]:
    """The commands that compare a documented environment's encoders with learning from scratch, on three seeds.

    :param name: its id
    """
    case = next(one for one in CASES if one.env_id == name)
    words = [
        "benchmark",
        "-o",
        f"curves/{name.replace('/', '-')}",
        "--env",
        name,
        "--methods",
        "abisim",
        "ssi",
        "vanilla",
    ]
    words += ["--seeds", "0", "1", "2", "--n-transitions", "100000", "-n", "1000000", "--final-episodes", "20"]
    words += ["--packages", case.package] if case.package else []
    params = [word for word in case.params if word.startswith("normalize")]
    if case.wrappers:
        params.append(f"env_wrapper:[{', '.join(f'{{{w}}}' if ': ' in w else w for w in case.wrappers)}]")
    kwargs = [word.replace(":", ": ") for word in case.env_kwargs if word != SHORT]
    params += [f"env_kwargs:{{{', '.join(kwargs)}}}"] if kwargs else []
    return words + (["--params", *params] if params else [])


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("build/any_pixels"), help="(default: %(default)s)")
    parser.add_argument("--only", default="", help="ids that hold this text, and no page")
    parser.add_argument("--curves", action="store_true", help="print commands of comparisons, and stop")
    parser.add_argument("--page", action="store_true", help="write the page of what has been run, and run nothing")
    args = parser.parse_args()
    if args.curves:
        for name in DOCUMENTED:
            print(shlex.join(["sb3-abisim", *curves(name)]))
        return
    work = args.work.absolute()
    chosen = [case for case in CASES if args.only in case.env_id]
    pairs = [pair for pair in ALGORITHMS if args.only in pair[0].env_id]
    found = [(case, run_case(case, work, dry=args.page)) for case in chosen]
    found_algos = [(case, algos, run_case(case, work, algos, args.page)) for case, algos in pairs]
    outcomes = [(case, outcome) for case, outcome in found if outcome is not None]
    trained = [(case, algos, outcome) for case, algos, outcome in found_algos if outcome is not None]
    wrong = [case.env_id for case, outcome in outcomes if not is_right(case, outcome)]
    # 2 is a refusal.
    wrong += [
        f"{case.env_id} {a}" for case, algos, o in trained for a in algos if o.get(a, {}).get("code") not in (0, 2)
    ]
    if not args.only:
        _write(outcomes, trained)
    if wrong:
        sys.exit(f"not as it should be: {', '.join(wrong)}")


def _write(outcomes: list[Any], trained: list[Any]) -> None:
    refusals = ["", "Refusals:", ""]
    for case, outcome in [*outcomes, *((case, outcome) for case, _, outcome in trained)]:
        refusals += [
            f"* `{case.env_id}`, `{k}`: {one['said'].partition('error: ')[2]}"
            for k, one in outcome.items()
            if k != "spaces" and one["code"]
        ]
    names = list(dict.fromkeys(algo for _, algos, _ in trained for algo in algos))
    missing = [case.env_id for case in CASES if case not in [one for one, _ in outcomes]]
    refusals += ["", f"Not run yet: {', '.join(f'`{name}`' for name in missing)}."] if missing else []
    table = ["", "Algorithms, each with `train` on the same encoder:", ""]
    table += ["| environment | " + " | ".join(names) + " |", "|---|" + "---|" * len(names)]
    for case, algos, outcome in trained:
        words = ["other actions" if a not in algos else _word(outcome.get(a)) for a in names]
        table.append(f"| `{case.env_id}` | " + " | ".join(words) + " |")
    write_page(
        RESULTS,
        "The three commands on environments that nothing here names",
        f"`MUJOCO_GL=egl python -m benchmarks.any_pixels` on {machine()}: `collect` of 400 transitions, `pretrain` "
        "(SSI) of 20 updates, `train` (PPO) of 128 steps, each in a process of its own, other work beside them. "
        "Seconds are of processor time, MiB the largest memory of each, both with the start of Python and its "
        "libraries. What was added to the commands is in the second column; where it is empty, wrappers and stacks are "
        "those of rl-zoo3's entry.",
        [
            "| id | added | observations | actions | collect, pretrain, train | seconds | MiB |",
            "|---|---|---|---|---|---:|---:|",
        ],
        [row(case, outcome) for case, outcome in outcomes],
        (*refusals, *table, ""),
    )


if __name__ == "__main__":
    main()
