"""Where the name of an encoder leads: a path, a file of this package, or one on the Hugging Face Hub."""

import os
import re
from pathlib import Path

from sb3_abisim.common.extras import needs_extra
from sb3_abisim.common.paths import resource_path

HUB_PREFIX = "hf://"
# What a repository's encoder is called, where a name gives no file.
HUB_FILE = "model.safetensors"
_COMMIT = re.compile("[0-9a-f]{40}")


class EncoderNotFoundError(FileNotFoundError):
    """No encoder file of that name; the message lists the places searched."""


def resolve_encoder(name: str | os.PathLike[str]) -> Path:
    """Find an encoder file.

    :param name: a path; else the name of an encoder that comes with the package, such as
        "DistractorPointMaze-v0/abisim"; or ``hf://owner/repository``, downloaded from the Hugging Face Hub:
        ``model.safetensors``, or the file behind a further slash. ``hf://owner/repository@revision`` fixes the revision
    :raises EncoderNotFoundError: listing the places searched
    """
    text = os.fspath(name)
    if not text:
        raise ValueError("encoder must be a path, the name of a shipped encoder or hf://owner/repository, got ''")
    if text.startswith(HUB_PREFIX):
        return _download(text)
    folder = resource_path("encoders")
    candidates = [Path(text).expanduser().absolute(), folder / text, folder / f"{text}.safetensors"]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    searched = ", ".join(str(candidate) for candidate in dict.fromkeys(candidates))
    shipped = sorted(str(path.relative_to(folder).with_suffix("")) for path in folder.rglob("*.safetensors"))
    raise EncoderNotFoundError(
        f"no encoder file {text!r}; searched {searched}. Shipped encoders: {', '.join(shipped) or 'none'}. "
        f"Correct the name, or write the file with sb3-abisim pretrain"
    )


def pinned_name(name: str | os.PathLike[str]) -> str:
    """The name of an encoder that leads to the same file tomorrow; any name but one on the Hub stays as it is.

    :param name: as for :func:`resolve_encoder`
    :return: of a file on the Hub ``hf://owner/repository@COMMIT``, and the file behind it if it is another than
        ``model.safetensors``
    :raises EncoderNotFoundError: if the Hub does not have it
    """
    text = os.fspath(name)
    if not text.startswith(HUB_PREFIX):
        return text
    repository, _, filename = _hub_parts(text)
    # .../snapshots/COMMIT/file is how the Hub's cache lays out its files.
    path = _download(text)
    commit = path.parts[-1 - len(Path(filename).parts)]
    if not _COMMIT.fullmatch(commit):
        raise ValueError(f"{path} does not say of which commit it is; give the name as hf://{repository}@COMMIT")
    return f"{HUB_PREFIX}{repository}@{commit}" + ("" if filename == HUB_FILE else f"/{filename}")


def _download(name: str) -> Path:
    repository, revision, filename = _hub_parts(name)
    try:
        with needs_extra("hub", name):
            from huggingface_hub import hf_hub_download
    except ImportError as error:
        # As for any other file that is not there: a saved model is loaded without it.
        raise EncoderNotFoundError(str(error)) from error
    try:
        return Path(hf_hub_download(repository, filename, revision=revision))
    except (OSError, ValueError) as error:
        raise EncoderNotFoundError(f"{name} could not be downloaded: {error}") from error


def _hub_parts(name: str) -> tuple[str, str | None, str]:
    """Repository, revision and file of a name on the Hub."""
    match = re.fullmatch(r"hf://([^/@]+/[^/@]+)(?:@([^/]+))?(?:/(.+))?", name)
    if match is None:
        raise ValueError(f"a Hub name looks like hf://owner/repository[@revision][/file.safetensors], got {name!r}")
    return match[1], match[2], match[3] or HUB_FILE
