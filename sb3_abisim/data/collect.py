"""Collect transitions into a dataset: ``sb3-abisim collect --env ID -n N -o DIR``.

To resume after a kill, to extend a dataset and to repair a damaged shard are the same thing: collect the shards that
are not there (:mod:`sb3_abisim.data.chains`). The same command gives the same bytes, whatever happened in between.
"""

import argparse
import errno
import functools
import json
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.vector import VectorEnv

from sb3_abisim.common.cli import add_trust, make_parser, parse_pairs, parse_value, run
from sb3_abisim.data.chains import ShardSource
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.environments import (
    N_BATCHED,
    N_COPIES,
    Preprocessing,
    as_made_or_reason,
    make_vector_env,
    resolve_wrapper,
)
from sb3_abisim.data.format import CONFIG_NAME, TERMINATED, TRUNCATED, DatasetError, from_json_file
from sb3_abisim.data.image_warning import warn_of_images
from sb3_abisim.data.rollout import Policy
from sb3_abisim.data.vectorized import is_vectorized
from sb3_abisim.data.writer import check_folder, open_writer

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

__all__ = ["Policy", "collect", "main"]

EntryFn = Callable[[str, str | None], dict[str, Any]]
PolicyFn = Callable[[str, float, bool], Policy]


def collect(
    env_id: "str | Callable[..., Any] | VectorEnv[Any, Any, Any] | VecEnv",
    n_transitions: int,
    folder: str | Path,
    *,
    seed: int = 0,
    n_envs: int | None = None,
    env_kwargs: dict[str, Any] | None = None,
    env_wrapper: Any = None,
    frame_stack: int = 1,
    image_key: str | None = None,
    policy: Policy | None = None,
    n_workers: int = 1,
    progress: bool = False,
) -> str:
    """Collect transitions; go on where an earlier call was stopped.

    :param env_id: a registered id; or a function that makes one environment, a ``VectorEnv`` or a ``VecEnv`` of
        Stable-Baselines3; or one of the latter two, which stays open and is collected from in one pass: the folder must
        be new
    :param n_transitions: size of the dataset, at least 1; a larger one than before extends it
    :param folder: new, empty, or begun with the same arguments
    :param seed: at least 0
    :param n_envs: environments stepped together; part of what determines the data. None for those of the folder, else
        64 of an environment that runs as one batch, and 8 of another; a vectorized environment has its own number
    :param env_kwargs: passed to the environment, JSON types
    :param env_wrapper: wrappers of the environment as in a zoo YAML: dotted paths, with or without arguments
    :param frame_stack: observations that readers of the dataset show together, as ``VecFrameStack`` does; each is
        stored once
    :param image_key: which key of a ``Dict`` of observations holds the image; None for the only one that does
    :param policy: chooses the actions; None for uniformly random ones
    :param n_workers: processes that step the environments, unless these run as one batch; the bytes do not depend on it
    :param progress: show a progress bar on stderr
    :return: the dataset's hash
    :raises ValueError: for mistakes in the arguments, naming the remedy
    :raises OSError: ``errno.ENOSPC`` for a full disk; the same call goes on once there is space
    """
    for name, value, least in (
        ("n_transitions", n_transitions, 1),
        ("seed", seed, 0),
        ("n_envs", 1 if n_envs is None else n_envs, 1),
        ("frame_stack", frame_stack, 1),
        ("n_workers", n_workers, 1),
    ):
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")
    folder = Path(folder)
    check_folder(folder)
    try:
        env_kwargs, env_wrapper = json.loads(json.dumps([env_kwargs or {}, env_wrapper or None]))
    except TypeError as error:
        raise ValueError(
            f"env_kwargs and env_wrapper must be what JSON can hold ({error}), got {env_kwargs}, {env_wrapper}"
        ) from None
    if env_wrapper is not None and not isinstance(env_wrapper, list):
        env_wrapper = [env_wrapper]
    wrapper = None if env_wrapper is None else resolve_wrapper(env_wrapper)
    preprocessing = Preprocessing(frame_stack, image_key, env_wrapper, wrapper)
    there = _identity_of(folder)
    is_object = is_vectorized(env_id)
    if is_object:
        _check_one_pass(folder, env_id, env_kwargs)
    elif n_envs is None:
        n_envs = there.get("n_envs")
    as_made, reason = False, ""
    if isinstance(env_id, str):
        as_made, reason = as_made_or_reason(env_id, env_kwargs, preprocessing)
    make_fn = functools.partial(make_vector_env, env_id, n_envs, env_kwargs, preprocessing, n_workers, as_made)
    one_pass = n_transitions if is_object else None
    source = ShardSource(make_fn, env_id, env_kwargs, seed, there, preprocessing, policy, one_pass)
    # Not beside the error of an environment that cannot be collected from at all.
    if progress and reason:
        print(
            f"{env_id}: copies are stepped one by one, without its faster vector environment: {reason}", file=sys.stderr
        )
    try:
        return _collect(source, n_transitions, folder, progress)
    finally:
        source.env.close()


def _check_one_pass(folder: Path, env: Any, env_kwargs: dict[str, Any]) -> None:
    """Refuse what needs an environment to be made again, where one is given that is there already."""
    if (folder / CONFIG_NAME).exists():
        raise ValueError(
            f"{folder} was begun before, and {env} cannot be made again to step to where that ended; remove the folder "
            "or name a new one, or give a function that makes the environment"
        )
    if env_kwargs:
        raise ValueError(f"env_kwargs {env_kwargs} come too late for {env}, which is there already; leave them out")


def _identity_of(folder: Path) -> dict[str, Any]:
    """What a folder was begun with; empty for a new one."""
    try:
        return from_json_file(folder / CONFIG_NAME)
    except (FileNotFoundError, NotADirectoryError, DatasetError):
        return {}  # the writer says what is wrong


def _collect(source: ShardSource, n_transitions: int, folder: Path, progress: bool) -> str:
    from tqdm import tqdm  # type: ignore[import-untyped, unused-ignore]

    per_shard = source.steps * source.env.num_envs
    n_shards = -(-n_transitions // per_shard)
    with (
        open_writer(folder, source.identity) as writer,
        tqdm(total=n_transitions, unit=" transitions", unit_scale=True, disable=not progress) as bar,
    ):
        if writer.n_transitions() > n_transitions:
            raise ValueError(
                f"{folder} already holds {writer.n_transitions()} transitions, more than {n_transitions}; "
                "ask for at least as many, or name a new folder"
            )
        was_finished, written = writer.is_finished, 0
        for k in range(n_shards):
            size = min(per_shard, n_transitions - k * per_shard)
            if writer.has_shard(k, size):
                bar.update(size)
                bar.initial = getattr(bar, "initial", 0) + size  # keeps the rate that of new transitions
                continue
            segments = source.shard(
                k, size, bar.update, lambda n: bar.set_postfix_str(f"stepping through {n} before them again")
            )
            bar.set_postfix_str("", refresh=False)
            writer.write_shard(k, segments)
            written += 1
        hash = writer.finish(n_shards)
        ends = writer.count_ends(n_shards)
    if not ends[TERMINATED] + ends[TRUNCATED]:
        warnings.warn(
            f"no episode ends among the {n_transitions} transitions in {folder}: they show only the first "
            f"{-(-n_transitions // source.env.num_envs)} steps; use a larger -n, fewer --n-envs, or shorter episodes "
            "(--env-kwargs max_episode_steps:K)",
            stacklevel=3,
        )
    warn_of_images(TransitionDataset(folder, verify=False), stacklevel=4)
    if progress:
        state = "already complete, nothing to do" if was_finished and not written else "complete"
        print(f"{folder}: {n_transitions} transitions of {source.identity['env_id']}, {state} (hash {hash[:16]})")
    return hash


def main(argv: Sequence[str] | None = None, entry_fn: EntryFn | None = None, policy_fn: PolicyFn | None = None) -> None:
    """The command; see ``--help``.

    :param argv: its arguments; None for those of the process
    :param entry_fn: from an id and ``--conf-file`` to ``env_wrapper``, ``frame_stack`` and ``env_kwargs``, which flags
        override; None for nothing
    :param policy_fn: from ``--policy``, ``--epsilon`` and ``--trust`` to a policy; None where there is none but chance
    """
    parser = make_parser(
        "collect",
        "Collect random-action transitions into a dataset folder. Killed at any moment, the same command "
        "goes on and ends with the same bytes; a larger -n extends the dataset.",
        "collect --env PointMaze-v0 -n 200000 -o data/pointmaze",
    )
    parser.add_argument("--env", required=True, metavar="ID", help="environment id, such as DistractorPointMaze-v0")
    parser.add_argument("-n", type=int, required=True, metavar="N", help="number of transitions")
    parser.add_argument("-o", "--output", required=True, metavar="DIR", help="the dataset's folder")
    parser.add_argument("--seed", type=int, default=0, help="of resets and actions (default: %(default)s)")
    parser.add_argument(
        "--n-envs", type=int,
        help=f"environments stepped together (default: {N_BATCHED} that run as one batch, {N_COPIES} others)",
    )  # fmt: skip
    parser.add_argument(
        "--n-workers", type=int, default=1,
        help="processes that step the environments; the data do not depend on it (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--env-kwargs", nargs="+", action="extend", default=[], metavar="NAME:VALUE",
        help="keyword arguments of the environment, such as continuous:true",
    )  # fmt: skip
    parser.add_argument(
        "--env-wrapper", nargs="+", action="extend", default=[], metavar="CLASS",
        help="dotted paths of wrappers, such as gymnasium.wrappers.GrayscaleObservation, or none (default: the zoo's "
        "for ID)",
    )  # fmt: skip
    parser.add_argument(
        "--frame-stack", type=int, metavar="N", help="observations shown together (default: the zoo's for ID, else 1)"
    )
    parser.add_argument(
        "--conf-file", metavar="FILE",
        help="zoo YAML whose env_wrapper, frame_stack and env_kwargs for ID hold (default: rl-zoo3's own)",
    )  # fmt: skip
    parser.add_argument(
        "--image-key", metavar="KEY", help="which of a Dict of observations is the image (default: the only one)"
    )
    if policy_fn is not None:
        parser.add_argument(
            "--policy", default="random", metavar="RUN",
            help="who acts: random, a run's folder (its final model) or a model's .zip in one (default: %(default)s)",
        )  # fmt: skip
        parser.add_argument(
            "--epsilon", type=float, default=0.0,
            help="probability of a random action in place of the policy's (default: %(default)s)",
        )  # fmt: skip
        add_trust(parser)
    parser.set_defaults(entry_fn=entry_fn, policy_fn=policy_fn)
    run(parser, argv, _command, "stopped; finished shards are kept, the same command goes on from there")


def _command(args: argparse.Namespace) -> None:
    # An unknown id is refused below.
    known = args.entry_fn is not None and args.env in gym.registry
    entry = args.entry_fn(args.env, args.conf_file) if known else {}
    env_kwargs = {**(entry.get("env_kwargs") or {}), **parse_pairs(args.env_kwargs, "--env-kwargs")}
    # A list as -params of train takes it, too.
    given = [parse_value(text) for text in args.env_wrapper]
    wrappers = [wrapper for one in given for wrapper in (one if isinstance(one, list) else [one])]
    policy = None
    if args.policy_fn is not None and args.policy != "random":
        policy = args.policy_fn(args.policy, args.epsilon, args.trust)
    elif args.policy_fn is not None and args.epsilon:
        raise ValueError(
            f"--epsilon {args.epsilon:g} puts random actions in place of a policy's, and all actions are random here; "
            "leave it out, or give --policy RUN"
        )
    try:
        collect(
            args.env,
            args.n,
            args.output,
            seed=args.seed,
            n_envs=args.n_envs,
            env_kwargs=env_kwargs,
            env_wrapper=None if args.env_wrapper == ["none"] else wrappers or entry.get("env_wrapper"),
            frame_stack=entry.get("frame_stack", 1) if args.frame_stack is None else args.frame_stack,
            image_key=args.image_key,
            policy=policy,
            n_workers=args.n_workers,
            progress=True,
        )
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise OSError(
            f"no space left for {args.output}: {error.strerror}; finished shards are kept: free some space and run the "
            "same command again"
        ) from error
