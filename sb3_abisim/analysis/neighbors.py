"""Nearest neighbors in embedding space: what do states that an encoder takes for alike have in common?

A state's neighbor is the nearest state (L1 distance of embeddings) of any other episode, so in another layout. If the
encoder follows the agent, neighbors have it in like places. If it follows obstacles, neighbors have like surroundings.
If it follows the background, neighbors share their clip. Each is compared with random pairs of states. Of environments
whose agent and obstacles are not known, the observations of neighbors are shown.
"""

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_abisim.analysis.nav2d_exact import embed
from sb3_abisim.analysis.scenes import (
    Samples,
    agent_positions,
    eval_settings,
    local_obstacles,
    preprocessing_of,
    sample_episodes,
)
from sb3_abisim.networks.encoder_file import EncoderFile

PER_EPISODE = 10
N_SHOWN = 4


def neighbors(files: dict[str, EncoderFile], env_id: str, n_episodes: int, seed: int = 0) -> dict[str, Any]:
    """Nearest neighbors among states of new episodes, by setting (:func:`eval_settings`).

    :param files: encoders by name
    :param env_id: a registered id
    :param n_episodes: :data:`PER_EPISODE` states of each make up the pool, and every one of them is a query
    :param seed: of the episodes
    :return: ``settings``: per encoder and for random pairs ``agent`` (mean distance of the two agents, in cells or
        meters), ``obstacles`` (correlation of the surroundings, :func:`similarity`), ``same_clip`` (share), each None
        where the environment does not say, and ``examples`` of a few queries; ``observations``, not for JSON: by
        setting, the queries' and each encoder's neighbors'
    """
    settings, observations, preprocessing = {}, {}, preprocessing_of(files)
    for setting, env_kwargs in eval_settings(env_id, files).items():
        samples = sample_episodes(env_id, n_episodes, PER_EPISODE, seed, env_kwargs, preprocessing)
        settings[setting], observations[setting] = _setting(files, samples, seed)
    hashes = {name: file.hash for name, file in files.items()}
    return {"per_episode": PER_EPISODE, "hashes": hashes, "settings": settings, "observations": observations}


def _setting(
    files: dict[str, EncoderFile], samples: Samples, seed: int
) -> tuple[dict[str, Any], dict[str, NDArray[np.uint8]]]:
    generator = np.random.default_rng(seed)
    queries = generator.choice(len(samples), N_SHOWN, replace=False)
    numbers: dict[str, Any] = {}
    # Of stacks the newest frame.
    n_channels = samples.env.single_observation_space.shape[0]
    observations = {"query": samples.obs[queries, -n_channels:]}
    for name, file in files.items():
        nearest, distances = nearest_elsewhere(embed(file.encoder.eval(), samples.obs), samples.episodes)
        examples = _pair_numbers(samples, queries, nearest[queries])
        examples["distance"] = _relative(distances)[queries].tolist()
        numbers[name] = {**similarity(samples, nearest), "examples": examples}
        observations[name] = samples.obs[nearest[queries], -n_channels:]
    numbers["random pairs"] = similarity(samples, _random_elsewhere(samples.episodes, generator))
    return numbers, observations


def _relative(distances: NDArray[np.float32]) -> NDArray[np.float64]:
    """Distances in units of their mean over all queries; zeros where every state is met again exactly."""
    relative: NDArray[np.float64] = distances.astype(np.float64) / (distances.mean() or 1.0)
    return relative


def nearest_elsewhere(
    features: th.Tensor, episodes: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The nearest row of another episode for each row, and its L1 distance.

    :param features: (n, features_dim)
    :param episodes: which episode, (n,); at least two different ones
    :raises ValueError: if there is one episode only
    """
    if len(np.unique(episodes)) < 2:
        raise ValueError("neighbors are sought in other episodes, got one episode; use at least 2")
    nearest, distances = [], []
    numbers = th.as_tensor(episodes)
    for rows in th.split(th.arange(len(features)), 512):
        table = th.cdist(features[rows], features, p=1.0)
        table[numbers[rows][:, None] == numbers[None]] = th.inf
        least = table.min(dim=1)
        nearest.append(least.indices)
        distances.append(least.values)
    return th.cat(nearest).numpy(), th.cat(distances).numpy()


def similarity(samples: Samples, partners: NDArray[np.int64]) -> dict[str, float | None]:
    """What samples and their partners have in common, mean over samples.

    :param samples: of any environment
    :param partners: index of each sample's partner, (n,)
    :return: ``agent``, ``obstacles``, ``same_clip`` as in :func:`neighbors`; the surroundings are correlated as 24
        numbers 0 or 1 each less their mean over all samples, so that 0 is what chance gives
    """
    pairs = _pair_numbers(samples, np.arange(len(samples)), partners)
    means = {name: None if values is None else float(np.mean(values)) for name, values in pairs.items()}
    surroundings = local_obstacles(samples)
    if surroundings is not None:
        blocked = surroundings.astype(np.float64)
        blocked -= blocked.mean(axis=0)
        means["obstacles"] = float((blocked * blocked[partners]).sum() / (blocked**2).sum())
    return means


def _pair_numbers(samples: Samples, first: NDArray[np.int64], second: NDArray[np.int64]) -> dict[str, Any]:
    agents, blocked = agent_positions(samples), local_obstacles(samples)
    clips = samples.factors.get("clip_id")
    return {
        "agent": None if agents is None else np.linalg.norm(agents[first] - agents[second], axis=1).tolist(),
        "obstacles": None if blocked is None else (blocked[first] == blocked[second]).mean(axis=1).tolist(),
        "same_clip": None if clips is None else (clips[first] == clips[second]).tolist(),
    }


def _random_elsewhere(episodes: NDArray[np.int64], generator: np.random.Generator) -> NDArray[np.int64]:
    """A random row of another episode for each row."""
    partners = generator.integers(len(episodes), size=len(episodes))
    while (same := episodes[partners] == episodes).any():
        partners[same] = generator.integers(len(episodes), size=same.sum())
    return partners
