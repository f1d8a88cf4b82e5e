"""Method specs, and what they make of hyperparameters."""

from pathlib import Path
from typing import Any

import pytest
import torch as th
from zoo_inputs import write_encoder

from sb3_abisim.zoo.entries import ENCODER_CALLBACK, ENCODING_WRAPPER, read_entries, zoo_hyperparams
from sb3_abisim.zoo.methods import MethodSpec


def test_method_specs() -> None:
    assert MethodSpec.parse("ssi") == MethodSpec("ssi", None, False)
    assert MethodSpec.parse("abisim,frozen") == MethodSpec("abisim", None, True)
    assert MethodSpec.parse("abisim=a=b,c.safetensors") == MethodSpec("abisim", "a=b,c.safetensors", False)
    assert MethodSpec.parse("ssi=hf://o/r/f.safetensors,frozen") == MethodSpec("ssi", "hf://o/r/f.safetensors", True)
    assert MethodSpec.parse("vanilla,task_features_dim=8") == MethodSpec("vanilla", task_features_dim=8)
    with pytest.raises(ValueError, match="cannot import the augmentation 'no_such_module:f'"):
        MethodSpec.parse("vanilla,augment=no_such_module:f")
    for text in ("ssi=a=b,1,frozen,task_features_dim=8,augment=random_crop", "ssi=a=b,1,augment=random_crop,{},frozen"):
        spec = MethodSpec.parse(text.format("task_features_dim=8"))
        assert spec == MethodSpec("ssi", "a=b,1", True, 8, "random_crop")
        assert spec.suffix == ",frozen,task_features_dim=8,augment=random_crop"
        assert spec.options == {"task_features_dim": 8, "augment": "random_crop"}
    assert MethodSpec.parse("drq,task_features_dim=0").options == {}


WRONG = "acroo", "abisim,freeze", "ssi=", "ssi=,frozen", "vanilla=x", "vanilla,frozen", "drq,frozen", "abisim,task=8"
WRONG_OPTIONS = "abisim,task_features_dim=", "abisim,task_features_dim=2.5", "abisim,task_features_dim=-1"
TWICE = "abisim,frozen,frozen", "abisim,augment=random_crop,augment=random_shift"


@pytest.mark.parametrize("text", ["", *WRONG, *WRONG_OPTIONS, *TWICE])
def test_wrong_method_specs(text: str) -> None:
    with pytest.raises(ValueError, match=r"give METHOD|takes neither"):
        MethodSpec.parse(text)


def test_other_conf_files_are_no_method_specs() -> None:
    for config in ("mine.yml", "folder/mine.yaml", "mine.py", "sb3_abisim.zoo", "json"):
        assert MethodSpec.of_conf_file(config) is None
    assert MethodSpec.of_conf_file("ssi,frozen") == MethodSpec("ssi", None, True)
    for config in ("no_such_module", "no_such_module.hyperparams", "./mine", "folder/mine"):
        with pytest.raises(ValueError, match=f"'{config}' is no YAML or Python file, module or method; a method is"):
            MethodSpec.of_conf_file(config)


ENTRY: dict[str, Any] = {
    "policy": "CnnPolicy",
    "gamma": 0.9,
    "callback": ENCODER_CALLBACK,
    "policy_kwargs": {
        "features_extractor_class": "sb3_abisim.ActionBisimExtractor",
        "features_extractor_kwargs": {"encoder": "Toy-v0/abisim", "freeze": True},
        "net_arch": [7],
    },
}


def test_an_entry_of_this_package() -> None:
    assert MethodSpec("curl").hyperparameters(ENTRY) == {
        "policy": "CnnPolicy",
        "policy_kwargs": {
            "features_extractor_class": "sb3_abisim.CURLExtractor",
            "features_extractor_kwargs": {"encoder": "Toy-v0/curl"},
            "net_arch": [7],
        },
    }
    assert MethodSpec("vanilla").hyperparameters(ENTRY)["policy_kwargs"] == {
        "features_extractor_class": "sb3_abisim.VanillaExtractor",
        "net_arch": [7],
    }
    assert MethodSpec("ssi", None, True).hyperparameters(ENTRY) == {
        "policy": "MlpPolicy",
        "policy_kwargs": {"net_arch": [7]},
        "vec_env_wrapper": [{ENCODING_WRAPPER: {"encoder": "Toy-v0/ssi", "objective": "ssi"}}],
    }


def test_what_a_frozen_encoder_does_not_see_is_not_thrown_away() -> None:
    """Task features and augmentation need the observation, which ``VecEncodeObservations`` would replace."""
    for options in ({"task_features_dim": 8}, {"augment": "random_shift"}):
        spec = MethodSpec("ssi", None, True, **options)
        assert not spec.embeds_in_env and MethodSpec("ssi", None, True).embeds_in_env
        kwargs = {"encoder": "Toy-v0/ssi", "freeze": True, **options}
        assert spec.hyperparameters(ENTRY) == {
            "policy": "CnnPolicy",
            "policy_kwargs": {
                "features_extractor_class": "sb3_abisim.SSIExtractor",
                "features_extractor_kwargs": kwargs,
                "net_arch": [7],
            },
        }
        assert spec.hyperparameters({**ENTRY, "policy": "MlpPolicy"})["policy"] == "CnnPolicy"
        # The zoo stacks observations then, as for an encoder that is fine-tuned.
        assert "frame_stack" not in spec.hyperparameters({**ENTRY, "frame_stack": 4})
    drq = MethodSpec("drq", task_features_dim=8).policy_kwargs({})
    assert drq == {
        "features_extractor_class": "sb3_abisim.DrQExtractor",
        "features_extractor_kwargs": {"task_features_dim": 8},
    }


def test_an_entry_of_rl_zoo3() -> None:
    """The policy becomes one for images, the wrappers stay in front of the encoder, and the run reports its encoder."""
    entry = {"policy": "MlpLstmPolicy", "vec_env_wrapper": "some.Wrapper", "callback": "some.Callback"}
    assert MethodSpec("ssi", "f").hyperparameters(entry) == {
        "policy": "CnnLstmPolicy",
        "policy_kwargs": {
            "features_extractor_class": "sb3_abisim.SSIExtractor",
            "features_extractor_kwargs": {"encoder": "f"},
        },
        "callback": ["some.Callback", ENCODER_CALLBACK],
    }
    assert MethodSpec("ssi", "f", True).hyperparameters({**entry, "policy": "CnnLstmPolicy"}) == {
        "policy": "MlpLstmPolicy",
        "policy_kwargs": {},
        "vec_env_wrapper": ["some.Wrapper", {ENCODING_WRAPPER: {"encoder": "f", "objective": "ssi"}}],
        "callback": ["some.Callback", ENCODER_CALLBACK],
    }
    for spec in (MethodSpec("ssi"), MethodSpec("ssi", None, True)):
        with pytest.raises(ValueError, match=r"no encoder ships for this environment; .*--conf-file ssi=FILE"):
            spec.hyperparameters(entry)
    for policy in ("LinearPolicy", "MultiInputPolicy"):
        with pytest.raises(ValueError, match=f"needs a policy for one image observation, and {policy} is none"):
            MethodSpec("ssi", "f").hyperparameters({"policy": policy})
    assert MethodSpec("ssi", "f").hyperparameters({"policy": "my.Policy"})["policy"] == "my.Policy"


def test_an_entry_with_a_text() -> None:
    """As rl-zoo3 writes them: what chooses the extractor is replaced, all else stays."""
    text = "dict(net_arch=[7], activation_fn=nn.GELU, features_extractor_class=nn.Module, ortho_init=False)"
    entry = {"policy": "CnnPolicy", "policy_kwargs": text}
    kept = {"net_arch": [7], "activation_fn": "torch.nn.GELU", "ortho_init": False}
    assert MethodSpec("vanilla").hyperparameters(entry)["policy_kwargs"] == {
        **kept,
        "features_extractor_class": "sb3_abisim.VanillaExtractor",
    }
    assert MethodSpec("ssi", "f", True).hyperparameters(entry)["policy_kwargs"] == kept


def test_every_text_of_rl_zoo3s_entries_is_read() -> None:
    texts = [
        entry["policy_kwargs"]
        for path in zoo_hyperparams().glob("*.yml")
        for entry in read_entries(path).values()
        if isinstance(entry, dict) and isinstance(entry.get("policy_kwargs"), str)
    ]
    assert len(texts) > 100
    for text in texts:
        assert MethodSpec("vanilla").hyperparameters({"policy": "CnnPolicy", "policy_kwargs": text})["policy_kwargs"]


def test_what_the_user_sets_beside_a_method() -> None:
    text = {"policy": "CnnPolicy", "policy_kwargs": "dict(net_arch=[7])"}
    for spec, entry, name in (
        (MethodSpec("ssi"), ENTRY, "policy_kwargs"),
        (MethodSpec("ssi", "f"), text, "policy_kwargs"),
        (MethodSpec("ssi", "f", True), text, "policy_kwargs"),
        (MethodSpec("ssi", None, True), ENTRY, "policy"),
        (MethodSpec("ssi", None, True), ENTRY, "vec_env_wrapper"),
    ):
        with pytest.raises(ValueError, match=f"-params {name} would undo --conf-file ssi; give one of the two"):
            spec.hyperparameters(entry, {name: None})
    # Theirs are kept.
    assert "policy" not in MethodSpec("ssi").hyperparameters(ENTRY, {"policy": "p", "gamma": 1})
    assert "callback" not in MethodSpec("ssi", "f").hyperparameters(text, {"callback": "c"})


def test_a_file_with_another_network_names_it(tmp_path: Path) -> None:
    path = tmp_path / "small.safetensors"
    write_encoder(path, "Nav2D-v0", "ssi", features_dim=90)
    kwargs = MethodSpec("ssi", str(path)).policy_kwargs({})
    assert kwargs["features_extractor_kwargs"] == {
        "encoder": str(path),
        "network": "Nav2DEncoder",
        "network_kwargs": {"n_input_channels": 3, "features_dim": 90},
    }
    write_encoder(path, "Nav2D-v0", "ssi")
    state = th.random.get_rng_state()
    assert MethodSpec("ssi", str(path)).policy_kwargs({})["features_extractor_kwargs"] == {"encoder": str(path)}
    # The random numbers of the run do not depend on the look-up.
    assert th.equal(th.random.get_rng_state(), state)
