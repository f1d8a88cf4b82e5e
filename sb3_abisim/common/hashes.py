"""A file of the sha256 of others in its folder, so that a changed bit in any of them is found when they are read."""

import json
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from sb3_abisim.common.files import file_hash, write_atomic

HASHES_NAME = "hashes.json"
_KEY = "sha256"


def write_hashes(folder: Path, names: Iterable[str]) -> None:
    """Write the hashes of files, in place of those of before.

    :param folder: the folder
    :param names: of files in it, relative, with "/"
    """
    content = {_KEY: {name: file_hash(folder / name) for name in sorted(names)}}
    write_atomic(folder / HASHES_NAME, lambda file: file.write((json.dumps(content, indent=1) + "\n").encode()))


def check_hashes(folder: Path, names: Iterable[str] = (), remade: Iterable[str] = ()) -> None:
    """Refuse a folder of which a file is not what it was; one without hashes is taken as it is.

    :param folder: the folder
    :param names: of files that must be among those with a hash
    :param remade: of files that the caller makes again, whatever they are
    :raises ValueError: naming the file
    """
    path = folder / HASHES_NAME
    if not path.is_file():
        return
    try:
        content = json.loads(path.read_bytes())
        listed = content[_KEY]
        if set(content) != {_KEY} or not all(
            isinstance(value, str) and _is_below(name) for name, value in listed.items()
        ):
            raise ValueError("it does not list hashes of files below it")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged ({error}); {_remedy(path)}") from error
    for name in sorted({*listed, *names} - {*remade}):
        if name not in listed:
            raise ValueError(f"{folder / name} is not in {path}, added or renamed since; {_remedy(path)}")
        if not (folder / name).is_file():
            raise ValueError(f"{folder / name} is not there, and {path} has its hash; {_remedy(path)}")
        if file_hash(folder / name) != listed[name]:
            raise ValueError(f"{folder / name} is damaged: its sha256 is not that of {path}; {_remedy(path)}")


def _remedy(path: Path) -> str:
    return f"copy it again, or remove {path.name} if you changed the folder yourself"


def _is_below(name: str) -> bool:
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts and "\\" not in name
