"""The record that a zoo run keeps of its method; reports read it."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sb3_abisim.common.files import write_atomic
from sb3_abisim.zoo.methods import suffix_of

# Beside config.yml in a run's folder.
RECORD_NAME = "method.json"


@dataclass(frozen=True)
class MethodRecord:
    """What a run used, written beside its configuration as JSON; reports read it.

    :param method: a registered name; None for a features extractor of no method
    :param frozen: whether the weights stayed as they were
    :param encoder: path or name of the encoder file; None without one
    :param encoder_hash: sha256 of the encoder file; None without one
    :param preprocessing: hyperparameters that stand between the environment and the encoder, where they are given
    :param task_features_dim: size of the trainable network beside the encoder, 0 for none
    :param augment: name of an augmentation; None for that of the method
    :param auxiliary: objective that trained the encoder, too (:mod:`sb3_abisim.zoo.auxiliary`); None for none
    """

    method: str | None
    frozen: bool
    encoder: str | None
    encoder_hash: str | None
    preprocessing: dict[str, Any]
    task_features_dim: int = 0
    augment: str | None = None
    auxiliary: str | None = None

    @property
    def label(self) -> str | None:
        """What reports call it: "abisim", "abisim,frozen,task_features_dim=64"; None for no method."""
        return None if self.method is None else self.method + suffix_of(self)

    def write(self, folder: str | Path) -> None:
        """Write it into the folder of ``config.yml``.

        :param folder: exists
        """
        # Wrappers of a Python configuration may be classes.
        text = json.dumps(asdict(self), indent=1, sort_keys=True, default=str) + "\n"
        write_atomic(Path(folder) / RECORD_NAME, lambda file: file.write(text.encode()))

    @classmethod
    def read(cls, folder: str | Path) -> "MethodRecord | None":
        """Read it; None where there is none, as in runs of plain rl-zoo3.

        :param folder: of ``config.yml``
        :raises ValueError: for a damaged file
        """
        path = Path(folder) / RECORD_NAME
        if not path.is_file():
            return None
        try:
            record = cls(**json.loads(path.read_bytes()))
            texts = record.method, record.encoder, record.encoder_hash, record.augment, record.auxiliary
            if not all(value is None or (isinstance(value, str) and value.isprintable()) for value in texts):
                raise TypeError("a name is no text")
            if not isinstance(record.frozen, bool) or not isinstance(record.preprocessing, dict):
                raise TypeError("frozen is no bool, or preprocessing no mapping")
            if type(record.task_features_dim) is not int:
                raise TypeError("task_features_dim is no whole number")
            return record
        except (ValueError, TypeError, RecursionError) as error:
            raise ValueError(f"{path} is damaged ({error}); leave the run out, or copy the file again") from error
