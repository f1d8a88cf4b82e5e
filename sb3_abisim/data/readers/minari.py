"""Lossless exchange with Minari.

Observations are stored without JPEG. What a Minari dataset says about its environment is only copied as text. Nothing
here makes an environment, because to open one that a stranger's file describes can run the stranger's code.

``minari.combine_datasets`` copies episodes with their infos, and so our factors, but not our block of metadata. The id
of the environment then comes from the blocks of the combined datasets, where these are in the store, else from the
``env_spec`` that an export writes where the id is registered.
"""

import contextlib
import copy
import functools
import hashlib
import json
import os
import shutil
import sys
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_abisim.common.extras import needs_extra
from sb3_abisim.common.files import find, is_of_system, naming
from sb3_abisim.common.spaces import fit_actions, space_from_json, space_to_json
from sb3_abisim.data.copies import LAST, ImageLayout
from sb3_abisim.data.dataset import TransitionDataset
from sb3_abisim.data.format import (
    CHAINED_FORMAT_VERSION,
    CONTENT_HASH_KEY,
    CUT,
    FORMAT_VERSION,
    IDENTITY_KEYS,
    RENDERED_FORMAT_VERSION,
    TERMINATED,
    TRUNCATED,
    check_factor_layout,
    check_spaces,
    describe_factors,
)
from sb3_abisim.data.importing import CHANNELS_KEY, LEFT_OUT_KEY, LOSSY_KEY
from sb3_abisim.data.recorded import recorded_layout, unread_keys
from sb3_abisim.data.writer import Segment, check_folder, write_segments
from sb3_abisim.registry import register_reader

# The key of our block in a Minari dataset's metadata.
METADATA_KEY = "sb3_abisim"
# What an array of HDF5 may unpack to: this, and more by the bytes that it takes. Deflate packs zeros a thousandfold.
MAX_UNPACKED_BYTES, UNPACKED_PER_BYTE = 1 << 20, 1100
# Infos of an exported episode: true on the last row of a segment that ended because its shard did.
CUT_KEY = "cut_by_shard_end"
FACTORS_KEY = "factors"


def export_dataset(folder: str | Path, dataset_id: str) -> None:
    """Write a dataset into Minari's local store (``MINARI_DATASETS_PATH``).

    Each segment becomes an episode. Rewards are zeros, because a dataset has none; the description says so. A segment
    cut by a shard's end is marked as truncated, and by ``infos["cut_by_shard_end"]``.

    :param folder: a dataset folder
    :param dataset_id: such as "nav2d/random-v0"; must be new
    :raises ValueError: if the folder is no dataset, or the id is malformed or taken
    :raises ImportError: without Minari, naming the command that installs it
    """
    minari = _import_minari()
    from minari.storage.datasets_root_dir import get_dataset_path

    _check_id(dataset_id)
    dataset = TransitionDataset(folder)
    source = dataset.meta["source"]
    # What else has written it may say of its source whatever it likes.
    channels_last = isinstance(source, dict) and (source.get(CHANNELS_KEY) == LAST or bool(source.get("channels_last")))
    space = dataset.observation_space
    if channels_last:
        space = _move_channels(space, 0, -1)
    place = get_dataset_path(dataset_id)
    is_taken = place.exists()
    content = hashlib.sha256()
    # Without its sum while episodes are missing: a kill leaves a dataset that is not taken for a whole one.
    ours = {key: dataset.meta[key] for key in IDENTITY_KEYS} | {"rewards_recorded": False, "content_sha256": None}
    try:
        with naming(place):
            stored = _create(minari, dataset_id, dataset, space)
            stored.storage.update_metadata({METADATA_KEY: ours} | _env_spec(dataset))
            stored.storage.update_episodes(_to_episode(s, channels_last) for s in _hashed(_segments(dataset), content))
            stored.storage.update_metadata({METADATA_KEY: ours | {"content_sha256": content.hexdigest()}})
    except BaseException:
        if not is_taken:
            shutil.rmtree(place, ignore_errors=True)
        raise


def _create(minari: Any, dataset_id: str, dataset: TransitionDataset, space: gym.Space[Any]) -> Any:
    """An empty dataset of Minari's."""
    with warnings.catch_warnings():
        # Minari warns about each piece of metadata that is left out.
        warnings.simplefilter("ignore", UserWarning)
        return minari.create_dataset_from_buffers(
            dataset_id,
            buffer=[],
            observation_space=space,
            action_space=dataset.action_space,
            algorithm_name=f"{dataset.meta['policy']} policy",
            description=f"Transitions of {dataset.env_id}, made by sb3_abisim. Rewards were not recorded: all are 0.",
            # True, the default, stores observations of 32 x 32 and more as JPEG, which alters them.
            jpeg_encoding=False,
        )


def _env_spec(dataset: TransitionDataset) -> dict[str, str]:
    """Minari's own record of the environment, where it is registered and can be written as text."""
    if dataset.env_id not in gym.registry:
        return {}
    spec = copy.deepcopy(gym.registry[dataset.env_id])
    spec.kwargs |= dataset.env_kwargs
    try:
        return {"env_spec": spec.to_json()}
    except (TypeError, ValueError):
        return {}  # its entry point is an object


def _check_id(dataset_id: str) -> None:
    """Minari would make a folder first, and one with a malformed name stops it from listing any dataset."""
    from minari.dataset.minari_dataset import parse_dataset_id

    try:
        parse_dataset_id(dataset_id)
    except (ValueError, TypeError):  # TypeError without a version
        raise ValueError(
            f"{dataset_id!r} is not a name of a Minari dataset; give one such as nav2d/random-v0"
        ) from None


def import_dataset(
    dataset_id: str, folder: str | os.PathLike[str], *, env_id: str | None = None, image_key: str | None = None
) -> str:
    """Make a dataset folder from Minari's local store; rewards are dropped.

    Observations must be uint8 images (channels first, channels last or gray) or a ``Dict`` with one, and actions as
    ``collect`` takes them.

    :param dataset_id: of a dataset that is already in the local store
    :param folder: new or empty
    :param env_id: recorded with the dataset; None for what Minari's dataset says
    :param image_key: which key of a ``Dict`` of observations is the image; None for the only one. Others become factors
    :return: the hash of the new dataset
    :raises ValueError: if there is no such dataset, or it does not fit
    :raises ImportError: without Minari, naming the command that installs it
    """
    _import_minari()
    folder = Path(folder)
    check_folder(folder)
    storage, metadata = _open_storage(dataset_id)
    layout = recorded_layout(storage.observation_space, image_key, f"Minari dataset {dataset_id}")
    identity = _identity(dataset_id, storage, metadata, layout, env_id)
    episodes = _episodes(storage, dataset_id)
    segments = (_segment(episode, identity, layout) for episode in episodes)
    return write_segments(folder, _verified(segments, dataset_id, metadata), identity)


def _verified(segments: Iterable[Segment], dataset_id: str, metadata: dict[str, Any]) -> Iterator[Segment]:
    """Pass segments on, and after the last one compare their content with what our export has recorded."""
    content, again = hashlib.sha256(), f"remove it with `minari delete {dataset_id}` and export it again"
    n_segments = 0
    for segment in _hashed(segments, content):
        yield segment
        n_segments += 1
    if not n_segments:
        raise ValueError(f"Minari dataset {dataset_id} has no episodes; {again}")
    if metadata.get(METADATA_KEY, {}).get("content_sha256", content.hexdigest()) != content.hexdigest():
        raise ValueError(
            f"Minari dataset {dataset_id} is damaged, was changed since its export or was not exported to its end; "
            f"{again}"
        )


def _import_minari() -> Any:
    with needs_extra("minari", "Minari's format"):
        import h5py  # noqa: F401
        import minari
    return minari


def _move_channels(space: spaces.Box, origin: int, destination: int) -> spaces.Box:
    low, high = (np.moveaxis(bound, origin, destination) for bound in (space.low, space.high))
    return spaces.Box(low, high, dtype=np.uint8)


def _segments(dataset: TransitionDataset) -> Iterator[Segment]:
    ends, first = dataset.ends, 0
    for last in np.flatnonzero(ends).tolist():
        index = np.arange(first, last + 1)
        yield Segment(dataset.frames(index), dataset.actions(index[:-1]), int(ends[last]), dataset.factors(index))
        first = last + 1


def _to_episode(segment: Segment, channels_last: bool) -> Any:
    from minari.data_collector import EpisodeBuffer

    n = len(segment.actions)
    at_end = np.arange(n) == n - 1
    infos: dict[str, Any] = {CUT_KEY: (np.arange(n + 1) == n) & (segment.end == CUT)}
    if segment.factors:
        infos[FACTORS_KEY] = segment.factors
    return EpisodeBuffer(
        observations=np.moveaxis(np.asarray(segment.frames), 1, -1) if channels_last else segment.frames,
        actions=segment.actions,
        rewards=np.zeros(n),
        terminations=at_end & (segment.end == TERMINATED),
        truncations=at_end & (segment.end != TERMINATED),
        infos=infos,
    )


def _hashed(segments: Iterable[Segment], content: Any) -> Iterator[Segment]:
    """Pass segments on and their content into a hash: HDF5 itself notices no damage."""
    for segment in segments:
        for array in (segment.frames, segment.actions, *(segment.factors[name] for name in sorted(segment.factors))):
            content.update(np.ascontiguousarray(array).data)
        content.update(bytes([segment.end]))
        yield segment


def _open_storage(dataset_id: str) -> tuple[Any, dict[str, Any]]:
    """Minari's reader of the arrays, without the parts of Minari that look at the environment."""
    from minari.dataset.minari_storage import MinariStorage
    from minari.storage.datasets_root_dir import get_dataset_path

    path = get_dataset_path(dataset_id) / "data"
    if not path.is_dir():
        raise ValueError(f"no Minari dataset {dataset_id!r} at {path}; fetch it first: minari download {dataset_id}")
    for file in find(path, "**/*.hdf5"):
        _check_hdf5(file)
    metadata = MinariStorage.read_raw_metadata(path)
    # Where a space is missing, Minari would make the environment to ask it, and with it run what the file names.
    for key in ("observation_space", "action_space"):
        if not isinstance(metadata.get(key), str):
            raise ValueError(f"Minari dataset {dataset_id} does not record its {key}; datasets of Minari 0.5 do")
    return MinariStorage.read(path), metadata


def _episodes(storage: Any, where: str) -> Iterator[dict[str, Any]]:
    """What Minari reads; whatever it raises for a damaged file is one sentence."""
    try:
        with _jpeg_alone(storage):
            yield from storage.get_episodes(range(storage.total_episodes))
    except Exception as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ValueError(f"Minari dataset {where} cannot be read ({reason}); fetch it again") from error


@contextlib.contextmanager
def _jpeg_alone(storage: Any) -> Iterator[None]:
    """Minari lets Pillow guess what its images are, and Pillow starts Ghostscript for some."""
    module: Any = sys.modules[type(storage).__module__]
    pillow = module.Image
    jpeg = SimpleNamespace(open=functools.partial(pillow.open, formats=("JPEG",)), fromarray=pillow.fromarray)
    module.Image = jpeg
    try:
        yield
    finally:
        module.Image = pillow


def _check_hdf5(path: Path) -> None:
    """Refuse what leads to other files, and arrays that unpack to far more than they take, before they are read.

    :param path: of a file of HDF5
    :raises ValueError: naming it
    """
    import h5py

    def check(name: str, group: Any) -> None:
        for key in group:
            where, link = f"{name}/{key}", group.get(key, getlink=True)
            if not isinstance(link, h5py.HardLink):
                raise ValueError(f"{where} is a link")
            entry = group[key]
            if isinstance(entry, h5py.Group):
                check(where, entry)
            elif entry.is_virtual or entry.external:
                raise ValueError(f"{where} lies in another file")
            elif entry.nbytes > MAX_UNPACKED_BYTES + UNPACKED_PER_BYTE * entry.id.get_storage_size():
                raise ValueError(f"{where} declares {entry.nbytes} bytes in {entry.id.get_storage_size()}")

    try:
        with h5py.File(path, "r") as file:
            check("", file)
    except (OSError, RuntimeError, KeyError, ValueError, RecursionError) as error:
        if is_of_system(error):
            raise
        raise ValueError(f"{path} is damaged or no file of Minari's ({error}); fetch it again") from error


def _identity(
    dataset_id: str, storage: Any, metadata: dict[str, Any], layout: ImageLayout, env_id: str | None
) -> dict[str, Any]:
    check_spaces(layout.space, storage.action_space)
    source: dict[str, Any] = {
        "minari": dataset_id,
        CHANNELS_KEY: layout.channels,
        LOSSY_KEY: _lossy(dataset_id, storage, layout),
        LEFT_OUT_KEY: ["rewards", *unread_keys(storage.observation_space, layout)],
    }
    identity: dict[str, Any] = {
        "format_version": FORMAT_VERSION,
        "env_id": None,
        "observation_space": space_to_json(layout.space),
        "action_space": space_to_json(storage.action_space),
        "source": source,
        "env_kwargs": {},
        "factors": describe_factors({name: np.zeros((1, *shape), d) for name, (d, shape) in layout.layouts.items()}),
        CONTENT_HASH_KEY: None,
        "policy": "unknown",
        "seed": None,
        "n_envs": None,
        "steps_per_shard": None,
    }
    if METADATA_KEY in metadata:
        ours = _our_block(dataset_id, metadata)
        identity |= {key: ours[key] for key in ("env_id", "env_kwargs", "factors", CONTENT_HASH_KEY, "policy", "seed")}
        source["collected"] = {key: ours[key] for key in ("n_envs", "steps_per_shard")}
    elif isinstance(metadata.get("combined_datasets"), list):
        parts = source["combined"] = [str(part) for part in metadata["combined_datasets"]]
        agreed = _recorded_env(metadata) | _agreed(parts)
        identity |= agreed
        _warn_of_lost(dataset_id, [key for key in ("env_id", "env_kwargs") if key not in agreed], env_id)
        common, others = _factors_of_episodes(storage)
        identity["factors"] |= common
        source[LEFT_OUT_KEY] += [f"factor {name!r}, not alike in all episodes" for name in others]
    identity["env_id"] = env_id or identity["env_id"] or _recorded_env(metadata).get("env_id") or dataset_id
    return identity


def _warn_of_lost(dataset_id: str, lost: list[str], env_id: str | None) -> None:
    if env_id is None and lost:
        what = "id and arguments" if "env_id" in lost else "arguments"
        warnings.warn(
            f"the {what} of the environment are lost: Minari dataset {dataset_id} combines others, which are not in "
            "the store or do not agree on them; name it with --env ID, or download what it combines",
            stacklevel=4,
        )


def _our_block(dataset_id: str, metadata: dict[str, Any]) -> dict[str, Any]:
    """What an export of ours has written, checked."""
    ours = metadata[METADATA_KEY]
    if (
        not isinstance(ours, dict)
        or not set(IDENTITY_KEYS) <= ours.keys()
        or ours["format_version"] not in (FORMAT_VERSION, RENDERED_FORMAT_VERSION, CHAINED_FORMAT_VERSION)
    ):
        raise ValueError(f"Minari dataset {dataset_id} was exported by another version of sb3_abisim")
    check_factor_layout(ours["factors"])
    return ours


def _agreed(parts: list[str]) -> dict[str, Any]:
    """What the blocks of combined datasets, and of those that they combine, agree on; empty if one is not there."""
    from minari.dataset.minari_storage import MinariStorage
    from minari.storage.datasets_root_dir import get_dataset_path

    blocks, waiting, seen = [], list(parts), set()
    while waiting:
        part = waiting.pop()
        if part in seen:
            continue
        seen.add(part)
        try:
            _check_id(part)
        except ValueError:
            return {}  # a forged one, which could lead out of the store
        path = get_dataset_path(part) / "data"
        metadata = MinariStorage.read_raw_metadata(path) if path.is_dir() else {}
        if METADATA_KEY in metadata:
            blocks.append(_our_block(part, metadata))
        elif isinstance(metadata.get("combined_datasets"), list):
            waiting += [str(other) for other in metadata["combined_datasets"]]
        else:
            return {}
    keys = ("env_id", "env_kwargs", CONTENT_HASH_KEY, "policy") if blocks else ()
    return {key: blocks[0][key] for key in keys if all(block[key] == blocks[0][key] for block in blocks)}


def _factors_of_episodes(storage: Any) -> tuple[dict[str, Any], list[str]]:
    """The factors that all episodes have alike, and the names of others.

    Whoever combined datasets kept them, but not what announced them.
    """
    layouts = []
    for episode in _episodes(storage, str(storage.data_path)):
        rows = (episode["infos"] or {}).get(FACTORS_KEY)
        n = len(episode["terminations"]) + 1
        rows = rows if isinstance(rows, dict) else {}
        layouts.append(describe_factors({k: v for k, v in rows.items() if isinstance(v, np.ndarray) and len(v) == n}))
    names = sorted({name for layout in layouts for name in layout})
    common = [name for name in names if all(name in one and one[name] == layouts[0].get(name) for one in layouts)]
    return {name: layouts[0][name] for name in common}, [name for name in names if name not in common]


def _lossy(dataset_id: str, storage: Any, layout: ImageLayout) -> str | None:
    """What altered the observations before the import; None for nothing."""
    space = storage.observation_space
    if not (storage.jpeg_encoding and _is_jpeg(space if layout.key is None else space[layout.key])):
        return None
    warnings.warn(f"Minari dataset {dataset_id} holds JPEG images: not what the environment showed", stacklevel=4)
    return "JPEG images"


def _is_jpeg(space: spaces.Box) -> bool:
    from minari.dataset.minari_storage import is_image_space

    return bool(is_image_space(space))


def _recorded_env(metadata: dict[str, Any]) -> dict[str, Any]:
    """The environment's id and arguments as pieces of text; nothing is made from them."""
    try:
        spec = json.loads(metadata["env_spec"])
        return {"env_id": str(spec["id"]), "env_kwargs": dict(spec["kwargs"])}
    except (KeyError, ValueError, TypeError):
        return {}


def _segment(episode: dict[str, Any], identity: dict[str, Any], layout: ImageLayout) -> Segment:
    where = f"episode {episode['id']} of Minari dataset {identity['source']['minari']}"
    terminations, truncations = (np.asarray(episode[key]) for key in ("terminations", "truncations"))
    try:
        frames, factors = layout.images(episode["observations"]), layout.rests(episode["observations"])
    except (ValueError, KeyError) as error:
        raise ValueError(f"{where}: {error}") from None
    n = len(terminations)
    if n < 1 or len(frames) != n + 1 or len(truncations) != n or len(episode["actions"]) != n:
        raise ValueError(
            f"{where} has {len(frames)} observations, {len(episode['actions'])} actions and {n} terminations; "
            "n transitions need n + 1 observations"
        )
    if (terminations | truncations)[:-1].any():
        raise ValueError(f"{where} goes on after an end of an episode; split it there first")
    infos = episode["infos"] or {}
    if terminations[-1]:
        end = TERMINATED
    elif truncations[-1] and not np.any(infos.get(CUT_KEY, False)):
        end = TRUNCATED
    else:
        end = CUT
    factors |= {
        name: _factor(infos, name, row, where)
        for name, row in identity["factors"].items()
        if name not in layout.factors
    }
    actions = fit_actions(episode["actions"], space_from_json(identity["action_space"]), where)
    return Segment(frames, actions, end, factors)


def _factor(infos: dict[str, Any], name: str, layout: dict[str, Any], where: str) -> NDArray[Any]:
    try:
        return np.asarray(infos[FACTORS_KEY][name], dtype=layout["dtype"])
    except (KeyError, TypeError):
        raise ValueError(f"{where} lacks factor {name!r} that the dataset's metadata announces") from None


register_reader("minari", import_dataset, help="the id of a dataset in Minari's local store")
