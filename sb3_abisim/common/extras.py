"""Optional packages: what is missing is named with the extra that brings it."""

import contextlib
import importlib.util
from collections.abc import Iterator

DISTRIBUTION = "sb3_abisim"


@contextlib.contextmanager
def needs_extra(extra: str, purpose: str) -> Iterator[None]:
    """Around the import of an optional package: where it is missing, say how to install it.

    :param extra: of ``setup.cfg``, such as "scan"
    :param purpose: what needs it, the subject of the message, such as "ScanNav"
    :raises ImportError: in place of the one within
    """
    try:
        yield
    except ImportError as error:
        raise ImportError(_message(extra, purpose, str(error)), name=error.name) from error


def require_extra(extra: str, purpose: str, *modules: str) -> None:
    """Refuse before long work what would fail behind it.

    :param extra: of ``setup.cfg``
    :param purpose: what needs it, the subject of the message
    :param modules: that the work imports, at the top level
    :raises ImportError: naming those that are missing
    """
    missing = [name for name in modules if not is_installed(name)]
    if missing:
        raise ImportError(_message(extra, purpose, f"there is no {' and no '.join(missing)}"), name=missing[0])


def is_installed(module: str) -> bool:
    """Whether a module could be imported; it is not imported.

    :param module: at the top level
    """
    return importlib.util.find_spec(module) is not None


def _message(extra: str, purpose: str, reason: str) -> str:
    return f"{purpose} needs more packages ({reason}); run: pip install '{DISTRIBUTION}[{extra}]'"
