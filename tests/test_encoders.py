"""The shipped encoders are what their cards and the committed settings say."""

import shlex

import pytest

from sb3_abisim.common.cli import parse_pairs
from sb3_abisim.common.paths import resource_path
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.pretraining.card import read_card
from sb3_abisim.pretraining.config import load_config
from sb3_abisim.registry import get_method, methods

FILES = sorted(resource_path("encoders").glob("*/*.safetensors"))
ENV_IDS = (
    "Nav2D-v0",
    "PointMaze-v0",
    "ContinuousPointMaze-v0",
    "DistractorPointMaze-v0",
    "ContinuousDistractorPointMaze-v0",
)


def test_a_method_ships_for_every_environment_or_for_none():
    found = {(path.parent.name, path.stem) for path in FILES}
    # ScanNav's are two so far: what the plain zoo command trains on, and its base.
    partial = {("ScanNav-v0", name) for name in ("ssi", "abisim")}
    names = {name for _, name in found}
    assert {"ssi", "acro", "beta_vae", "curl", "info_nce", "abisim", "goal_progress"} <= names
    assert names <= {name for name, method in methods().items() if method.is_pretrained}
    assert found == {(env_id, name) for env_id in ENV_IDS for name in names} | partial


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_shipped_encoder(path):
    file, card = load_encoder(path), read_card(path.with_suffix(".json"))
    metadata = file.metadata
    assert path.stat().st_size < 2_500_000
    assert (metadata["env_id"], metadata["objective"]) == (path.parent.name, path.stem)
    assert card["settings"] == metadata["settings"] and card["dataset"]["hash"] == metadata["dataset_hash"]
    assert card["dataset"]["n_transitions"] >= 200_000
    committed = load_config(path.stem, path.parent.name).as_settings()
    assert {key: metadata["settings"][key] for key in committed} == committed
    assert card["curves"]["n_updates"][-1] == committed["n_updates"]
    if path.stem in ("abisim", "goal_progress"):
        assert metadata["settings"]["base_hash"] == load_encoder(path.with_stem("ssi")).hash


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_the_command_on_a_card_has_its_settings(path):
    card = read_card(path.with_suffix(".json"))
    words = shlex.split(card["commands"][-1])
    assert words[:2] == ["sb3-abisim", "pretrain"]
    given = parse_pairs(words[words.index("-params") + 1 :], "-params")
    settings = load_config(path.stem, path.parent.name, given).as_settings()
    assert {key: card["settings"][key] for key in settings} == settings


def test_the_table_is_made_of_the_cards():
    table = (resource_path("encoders") / "README.md").read_text()
    for path in FILES:
        card = read_card(path.with_suffix(".json"))
        (row,) = [line for line in table.splitlines() if f"`{path.parent.name}/{path.stem}`" in line]
        assert f"| {card['settings']['n_updates']:,} |" in row
        for name in get_method(path.stem).results:
            assert f"{name} {card['metrics'][f'eval/{name}']:.3g}" in row
