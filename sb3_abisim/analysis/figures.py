"""The table of figures: how each is computed and plotted, and how it is made from encoder names."""

import dataclasses
import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from sb3_abisim.analysis import curves, leak, neighbors, perturbation, pixels, plots, plots_pixels, probes, sweep
from sb3_abisim.analysis.nav2d_exact import check_nav2d
from sb3_abisim.analysis.scenes import eval_settings, preprocessing_of
from sb3_abisim.common.files import write_atomic
from sb3_abisim.common.paths import resource_path
from sb3_abisim.data.environments import Preprocessing, make_vector_env
from sb3_abisim.networks.encoder_file import EncoderFile, load_encoder
from sb3_abisim.registry import get_traits

Compute = Callable[[dict[str, EncoderFile], str, int], dict[str, Any]]
Plot = Callable[[dict[str, Any], Path], None]


@dataclass(frozen=True)
class Figure:
    """One figure.

    :param help: what it shows, in a line
    :param env_ids: where ``all`` makes it, the default first; it can be made wherever ``compute`` does not refuse
    :param size: default of the number that ``compute`` takes last
    :param unit: what that number counts
    :param compute: from encoders by name, environment id and size to the numbers
    :param plot: from the numbers to the PNG
    :param trained: whether encoders of a custom folder join the shipped ones by default
    :param encoders: whether it looks at encoders at all
    :param as_pretrained: whether encoders are shown what they have recorded: wrappers, stacks, the image of a Dict
    :param require: refuses environments that it cannot be made of, before anything is loaded
    :param of_data: from a dataset's folder and size to the numbers, in place of new episodes; None where there is no
        such way
    """

    help: str
    env_ids: tuple[str, ...]
    size: int
    unit: str
    compute: Compute
    plot: Plot
    trained: bool = False
    encoders: bool = True
    as_pretrained: bool = False
    require: Callable[[str], None] = lambda env_id: None
    of_data: Callable[[Path, int], dict[str, Any]] | None = None


FIGURES = {
    "perturbation": Figure(
        "perturbation maps on Nav2D: single-step and multi-step", ("Nav2D-v0",), 10, "layouts, four seconds each",
        perturbation.nav2d_maps, plots.plot_maps, require=check_nav2d,
    ),
    "near-far": Figure(
        "violins of near and far obstacles on Nav2D, with the regions", ("Nav2D-v0",), 1000, "layouts",
        perturbation.near_and_far, plots.plot_near_and_far, require=check_nav2d,
    ),
    "structures": Figure(
        "sensitivity within and beyond the reachable part of corridor and maze",
        ("Nav2DCorridor-v0", "Nav2DMaze-v0"), 8, "layouts", perturbation.structure_maps, plots.plot_structures,
        trained=True, require=check_nav2d,
    ),
    "pixels": Figure(
        "perturbation maps of the point mazes: an obstacle moved, the clip swapped",
        ("PointMaze-v0", "DistractorPointMaze-v0"), 1500, "states", pixels.pixel_maps, plots_pixels.plot_pixel_maps,
        require=pixels.check_point_maze,
    ),
    "neighbors": Figure(
        "nearest neighbors in embedding space", ("DistractorPointMaze-v0",), 500, "episodes", neighbors.neighbors,
        plots_pixels.plot_neighbors, as_pretrained=True,
    ),
    "probes": Figure(
        "what probes read from embeddings, and the distractor-invariance ratio",
        ("DistractorPointMaze-v0", "PointMaze-v0", "Nav2D-v0"), 300, "episodes to learn from", probes.probes,
        plots_pixels.plot_probes, trained=True, as_pretrained=True,
    ),
    "curves": Figure(
        "pretraining curves, from the model cards",
        ("DistractorPointMaze-v0", "PointMaze-v0", "ContinuousPointMaze-v0", "Nav2D-v0"), 1, "changes nothing here",
        lambda files, env_id, size: curves.curves(files), plots_pixels.plot_curves, as_pretrained=True,
    ),
    "leak": Figure(
        "whether the action can be read from a few pixels", ("DistractorPointMaze-v0", "Nav2D-v0"), 300, "episodes",
        lambda files, env_id, size: leak.leak_maps(env_id, size), plots_pixels.plot_leak, encoders=False,
        of_data=leak.leak_maps_of_data,
    ),
}  # fmt: skip


def default_encoders(env_id: str, trained: Path | None = None) -> list[str]:
    """All encoders that ship for an environment, and those of a custom folder, copies of shipped ones left out.

    :param env_id: a registered id
    :param trained: holds ``<env_id>/*.safetensors``; None for the shipped ones alone
    :raises ValueError: if there is none
    """
    shipped = resource_path("encoders") / (get_traits(env_id).same_observations_as or env_id)
    names = [f"{path.parent.name}/{path.stem}" for path in sorted(shipped.glob("*.safetensors"), reverse=True)]
    if trained is not None:
        there = {load_encoder(name).hash for name in names}
        paths = sorted((trained / env_id).glob("*.safetensors"), reverse=True)
        names += [str(path) for path in paths if load_encoder(str(path)).hash not in there]
    if not names:
        raise ValueError(f"no encoder ships for {env_id}; name the files to look at")
    return names


def load_all(
    names: list[str], env_id: str, as_pretrained: bool = False, image_key: str | None = None
) -> dict[str, EncoderFile]:
    """Encoders by name, checked against the environment's observations.

    :param names: files or names
    :param env_id: a registered id
    :param as_pretrained: see :class:`Figure`
    :param image_key: the image of a ``Dict`` to show to encoders of recordings, whose files do not know the
        environment's names; None for what the files know
    :raises ValueError: for an unknown id, or encoders of other observations
    """
    files = {name: _with_image_key(load_encoder(name), image_key) for name in names}
    preprocessing = preprocessing_of(files) if as_pretrained else Preprocessing()
    env_kwargs = next(iter(eval_settings(env_id, files).values())) if as_pretrained else {}
    env = make_vector_env(env_id, 1, env_kwargs, preprocessing)
    n_channels, *size = env.single_observation_space.shape or ()
    env.close()
    for file in files.values():
        file.check(Box(0, 255, (preprocessing.frame_stack * n_channels, *size), np.uint8))
    return files


def _with_image_key(file: EncoderFile, image_key: str | None) -> EncoderFile:
    preprocessing = file.metadata["preprocessing"]
    known = preprocessing.get("image_key")
    if image_key is None or image_key == known:
        return file
    if known is not None:
        raise ValueError(f"{file.path} was pretrained on the image {known!r}, not {image_key!r}; leave --image-key out")
    return dataclasses.replace(
        file, metadata={**file.metadata, "preprocessing": {**preprocessing, "image_key": image_key}}
    )


def make_figure(
    name: str,
    files: dict[str, EncoderFile],
    env_id: str,
    size: int,
    images: Path,
    numbers: Path,
    data: Path | None = None,
) -> Path:
    """Compute a figure; write its numbers, then the PNG.

    :param name: a key of :data:`FIGURES`
    :param files: encoders by name
    :param env_id: a registered id
    :param size: see :class:`Figure`, at least 1
    :param images: folder for ``<name>-<env_id>.png``
    :param numbers: folder for ``<name>-<env_id>.json``
    :param data: a dataset's folder to look at in place of new episodes, for figures that can
    :return: the PNG
    :raises ValueError: for a size below 1, and what the figure refuses
    """
    if size < 1:
        raise ValueError(f"-n must be at least 1, got {size}")
    # Now, not after minutes of computing.
    plots.pyplot()
    figure = FIGURES[name]
    if data is not None and figure.of_data is not None:
        results = figure.of_data(data, size)
    else:
        results = figure.compute(files, env_id, size)
    settings = {"figure": name, "env_id": env_id, "size": size, "size_counts": figure.unit}
    return write_figure(settings | results, figure.plot, images, numbers)


def make_sweep(
    values: list[float], base: str, folder: Path, data: Path | None, size: int, images: Path, numbers: Path
) -> Path:
    """The sweep over c beside the exact metric; pretrains what is missing.

    :param values: of c
    :param base: file or name of the single-step encoder
    :param folder: of the sweep's encoders
    :param data: dataset of Nav2D-v0 for what is missing
    :param size: layouts, a minute each
    :param images: folder for the PNG
    :param numbers: folder for the JSON
    :return: the PNG
    """
    if size < 1:
        raise ValueError(f"-n must be at least 1, got {size}")
    plots.pyplot()
    env_id = FIGURES["perturbation"].env_ids[0]
    (base_file,) = load_all([base], env_id).values()
    files = sweep.sweep_encoders(values, base, folder, data, env_id)
    results = perturbation.sweep_maps(files, base_file.encoder.eval(), env_id, size)
    settings = {"figure": "sweep", "env_id": env_id, "size": size, "base": base, "base_hash": base_file.hash}
    return write_figure(settings | results, plots.plot_sweep, images, numbers)


def write_figure(results: dict[str, Any], plot: Plot, images: Path, numbers: Path) -> Path:
    """Write a figure's numbers as JSON and plot it.

    :param results: with ``figure`` and ``env_id``, which name the files; ``observations`` are plotted only
    :param plot: see :class:`Figure`
    :param images: folder for the PNG
    :param numbers: folder for the JSON
    """
    # Ids may have a namespace, as in my/Toy-v0.
    stem = f"{results['figure']}-{results['env_id'].replace('/', '-')}"
    shown = {key: value for key, value in results.items() if key == "observations"}
    plain = _plain({key: value for key, value in results.items() if key != "observations"})
    text = json.dumps(plain, indent=1, allow_nan=False)
    # Each innermost list on one line: a map has hundreds of numbers.
    text = re.sub(r"\[[^][{}]*\]", lambda found: " ".join(found[0].split()), text) + "\n"
    numbers.mkdir(parents=True, exist_ok=True)
    write_atomic(numbers / f"{stem}.json", lambda file: file.write(text.encode()))
    # From the numbers as they were written, so that the file alone gives the same figure.
    plot(plain | shown, images / f"{stem}.png")
    return images / f"{stem}.png"


def _plain(value: Any) -> Any:
    """JSON types, floats with six digits, None for what is not a number."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
