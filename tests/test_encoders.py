"""The shipped encoders are what their cards and the committed settings say."""

import json

import pytest

from sb3_abisim.common.paths import resource_path
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.pretraining.config import load_config
from sb3_abisim.pretraining.pretrain import OBJECTIVE_NAMES

FILES = sorted(resource_path("encoders").glob("*/*.safetensors"))


ENV_IDS = (
    "Nav2D-v0",
    "PointMaze-v0",
    "ContinuousPointMaze-v0",
    "DistractorPointMaze-v0",
    "ContinuousDistractorPointMaze-v0",
)


def test_every_objective_for_every_environment():
    found = {(path.parent.name, path.stem) for path in FILES}
    # ScanNav's are two so far: what the plain zoo command trains on, and its base.
    scans = {("ScanNav-v0", name) for name in ("ssi", "abisim")}
    assert found == {(env_id, name) for env_id in ENV_IDS for name in OBJECTIVE_NAMES} | scans


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_shipped_encoder(path):
    file, card = load_encoder(path), json.loads(path.with_suffix(".json").read_text())
    metadata = file.metadata
    assert path.stat().st_size < 1_000_000
    assert (metadata["env_id"], metadata["objective"]) == (path.parent.name, path.stem)
    assert card["settings"] == metadata["settings"] and card["dataset"]["digest"] == metadata["dataset_digest"]
    assert card["dataset"]["n_transitions"] >= 200_000
    committed = load_config(path.stem, path.parent.name).as_settings()
    assert {key: metadata["settings"][key] for key in committed} == committed
    assert card["curves"]["n_updates"][-1] == committed["n_updates"]
    if path.stem == "abisim":
        assert metadata["settings"]["base_hash"] == load_encoder(path.with_stem("ssi")).hash


def test_the_table_is_made_of_the_cards():
    table = (resource_path("encoders") / "README.md").read_text()
    for path in FILES:
        settings = json.loads(path.with_suffix(".json").read_text())["settings"]
        (row,) = [line for line in table.splitlines() if f"`{path.parent.name}/{path.stem}`" in line]
        assert f"| {settings['n_updates']:,} |" in row
