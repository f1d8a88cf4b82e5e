"""Encoders trained for one figure: action-bisimulation on Nav2D with several weights c of the recursive term."""

from pathlib import Path

from sb3_abisim.networks.encoder_file import EncoderFile, load_encoder
from sb3_abisim.pretraining.config import load_config
from sb3_abisim.pretraining.pretrain import pretrain, read_env_id

PAPER_C = (0.25, 0.75, 0.85, 0.99)


def sweep_encoders(
    values: list[float], base: str, folder: Path, data: Path | None, env_id: str, n_updates: int | None = None
) -> dict[float, EncoderFile]:
    """The encoders of a sweep; what ``folder`` does not hold is pretrained first, some five minutes each on one core.

    :param values: of c, each in [0, 1)
    :param base: file or name of the base encoder
    :param folder: holds ``abisim_c<c>.safetensors``
    :param data: dataset to pretrain on, needed for what is missing
    :param env_id: environment of the dataset
    :param n_updates: of each pretraining; None for the environment's setting
    :raises ValueError: for missing encoders without data, data of another environment, or encoders of another base
    """
    base_hash = load_encoder(base).hash
    files = {}
    for c in values:
        path = folder / f"abisim_c{c:g}.safetensors"
        if not path.is_file():
            if data is None:
                raise ValueError(f"{path} is not there; give --data DIR, a dataset of {env_id}, to pretrain it")
            if (found := read_env_id(data)) != env_id:
                raise ValueError(f"{data} was collected in {found}, not in {env_id}")
            folder.mkdir(parents=True, exist_ok=True)
            given = {} if n_updates is None else {"n_updates": n_updates}
            config = load_config("abisim", env_id, {"objective_kwargs.c": c, **given})
            pretrain("abisim", data, path, config, base, device="cpu", verbose=0)
        files[c] = load_encoder(path)
        found_c = files[c].metadata["settings"]["objective_kwargs"].get("c")
        if found_c != c:
            raise ValueError(f"{path} was trained with c = {found_c}, its name says {c:g}; rename or remove it")
        if (found_base := files[c].metadata["settings"]["base_hash"]) != base_hash:
            raise ValueError(
                f"{path} was trained on another base encoder than {base} (hashes {found_base[:8]}, "
                f"{base_hash[:8]}); give that one as --base, or remove the file"
            )
    return files
