"""YAML of bounded size: anchors that stand for each other many times would take any amount of memory and time."""

from pathlib import Path
from typing import Any

import yaml

MAX_BYTES = 1 << 18
MAX_NODES = 50_000


def read_yaml_file(path: Path, loader_class: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """The content of a YAML file.

    :param path: the file
    :param loader_class: what constructs it
    :raises ValueError: naming the file, when it is no YAML, has tags that the loader does not know, or is too large
    """
    try:
        data = path.read_bytes()
        if len(data) > MAX_BYTES:
            raise ValueError(f"it has {len(data)} bytes, more than {MAX_BYTES}")
        return load_yaml(data.decode(), loader_class)
    except (ValueError, TypeError, AttributeError, yaml.YAMLError, RecursionError, MemoryError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"cannot read {path} ({reason})") from error


def load_yaml(text: str, loader_class: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """The content of a text.

    :param text: YAML
    :param loader_class: what constructs it
    :raises ValueError: when it has too many nodes, those that anchors repeat counted
    :raises yaml.YAMLError: when it is no YAML, or has tags that the loader does not know
    """
    loader = loader_class(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        if _size(node, {}) > MAX_NODES:
            raise ValueError(f"it has more than {MAX_NODES} nodes")
        return loader.construct_document(node)
    finally:
        loader.dispose()


def _size(node: yaml.Node, sizes: dict[int, int]) -> int:
    """Number of nodes, each as often as it is named."""
    if id(node) not in sizes:
        # One that holds itself is without end.
        sizes[id(node)] = MAX_NODES + 1
        parts = node.value if isinstance(node, yaml.CollectionNode) else []
        flat = [part for pair in parts for part in (pair if isinstance(pair, tuple) else (pair,))]
        sizes[id(node)] = 1 + sum(_size(part, sizes) for part in flat)
    return sizes[id(node)]
