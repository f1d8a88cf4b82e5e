"""Settings: those of every YAML entry, and what is refused."""

import pytest
import yaml

from sb3_abisim.common.paths import resource_path
from sb3_abisim.pretraining.config import PretrainConfig, load_config
from sb3_abisim.registry import methods


@pytest.mark.parametrize("k", [0, 1.5, True, [2, 1], [0, 3], [1, 2, 3], "5"], ids=str)
def test_refuses_k_that_is_no_number_of_steps(k):
    with pytest.raises(ValueError, match="k must be a whole number"):
        PretrainConfig(k=k)


def test_learning_rate_schedule():
    config = PretrainConfig(n_updates=100, learning_rate="lin_0.002")
    assert [config.learning_rate_at(n) for n in (0, 50, 75)] == [0.002, 0.001, 0.0005]
    assert PretrainConfig(n_updates=100, learning_rate=0.3).learning_rate_at(99) == 0.3
    for wrong in ("cos_0.1", "lin_x", "lin_0", 0.0):
        with pytest.raises(ValueError, match=str(wrong)):
            PretrainConfig(learning_rate=wrong)


@pytest.mark.parametrize("objective", [name for name, method in methods().items() if method.is_pretrained])
def test_every_yaml_entry_is_valid(objective):
    entries = yaml.safe_load((resource_path("hyperparams") / "pretrain" / f"{objective}.yml").read_text())
    for env_id in entries:
        assert load_config(objective, env_id) == PretrainConfig.from_mapping(entries[env_id])
    assert load_config(objective, "Unknown-v0") == PretrainConfig.from_mapping(entries["default"])


def test_settings_replace_those_of_the_file():
    plain = load_config("abisim", "Nav2D-v0")
    changed = load_config("abisim", "Nav2D-v0", {"objective_kwargs.tau": 0.5, "k": 3})
    assert changed.objective_kwargs == {**plain.objective_kwargs, "tau": 0.5} and changed.k == 3
    with pytest.raises(ValueError, match="unknown pretraining setting holdout; known are batch_size, "):
        load_config("abisim", "Nav2D-v0", {"holdout": 0.1})
