"""A Dict of observations with one image and with several: a method is for one of them, and all else is passed on."""

import json
from pathlib import Path
from typing import Any

import pytest
import toy_env  # noqa: F401  (registers environments)
from zoo_inputs import SMALL, run

from sb3_abisim.doctor import run_lines
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.rl.checks import check_trained_with, find_extractors
from sb3_abisim.rl.extractors import EncoderExtractor, VanillaExtractor
from sb3_abisim.zoo.evaluate import evaluate_final
from sb3_abisim.zoo.method_record import MethodRecord
from sb3_abisim.zoo.methods import MethodSpec
from sb3_abisim.zoo.record import record
from sb3_abisim.zoo.run_envs import final_model
from sb3_abisim.zoo.runs import _without_encoder, read_run

KEY = "wrist"


def collect_and_pretrain(folder: Path, monkeypatch: pytest.MonkeyPatch, key: str | None, env: list[str]) -> str:
    file = str(folder / "e.safetensors")
    words = ["collect", *env, "-n", "60", "--n-envs", "2", "-o", str(folder / "d")]
    run(monkeypatch, *words, *([] if key is None else ["--image-key", key]))
    run(monkeypatch, "pretrain", "--objective", "ssi", "--data", str(folder / "d"), "-o", file, "--verbose", "0",
        "-params", "n_updates:1", "batch_size:8", "log_interval:1", "checkpoint_interval:1")  # fmt: skip
    return file


def train(folder: Path, monkeypatch: pytest.MonkeyPatch, algo: str, env: list[str], *words: str) -> Path:
    """Params stand last in ``words``."""
    run(monkeypatch, "train", "--algo", algo, *env, "-n", "64", "-f", str(folder / "logs"), "--eval-freq", "-1",
        "--num-threads", "1", "--verbose", "0", *words)  # fmt: skip
    return folder / "logs" / algo / "Robot-v0_1"


def env_words(**kwargs: Any) -> list[str]:
    return ["--env", "Robot-v0", "--env-kwargs", *(f"{name}:{value}" for name, value in kwargs.items())]


@pytest.mark.parametrize(
    ("algo", "conf_file", "label", "one", "stack"),
    [
        ("ppo", "ssi={file}", "ssi", True, 1),
        ("ppo", "ssi={file},frozen", "ssi,frozen", False, 2),
        ("sac", "ssi={file},task_features_dim=5", "ssi,task_features_dim=5", False, 1),
        ("dqn", "vanilla", "vanilla", True, 1),
        ("ppo", "drq", "drq", False, 1),
        ("sac", "vanilla", "vanilla", False, 2),
        ("dqn", "vanilla,auxiliary=ssi:batch_size=8", "vanilla,auxiliary=ssi:batch_size=8", False, 1),
    ],
)
def test_from_the_command_to_an_agent(
    algo: str, conf_file: str, label: str, one: bool, stack: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    key = "camera" if one else KEY
    env = env_words(wrist=not one, continuous=algo == "sac")
    words, file = ["-params", *SMALL[algo], "normalize:False"], ""
    words += [f"frame_stack:{stack}"] if stack > 1 else []
    if "{file}" in conf_file:
        stacked = [*env, "--frame-stack", str(stack)]
        file = collect_and_pretrain(tmp_path, monkeypatch, None if one else KEY, stacked)
        assert load_encoder(file).metadata["preprocessing"]["image_key"] == key
    else:
        words = ["--image-key", key, *words]
    folder = train(tmp_path, monkeypatch, algo, env, "--conf-file", conf_file.format(file=file), *words)

    written = MethodRecord.read(folder / "Robot-v0")
    assert written is not None and written.label == label and written.preprocessing["image_key"] == key
    assert written.encoder_hash == (load_encoder(file).hash if file else None)
    model = final_model(read_run(folder))
    expected = EncoderExtractor if file else VanillaExtractor
    for name, extractor in find_extractors(model.policy):
        # The other image is no encoder of ours, and no callback finds it.
        assert name.endswith(f".extractors.{key}") and type(extractor) is expected
        assert extractor.frozen is ("frozen" in label) and (extractor.augment is not None) is (label == "drq")
    extractors = model.policy.get_submodule(name.partition(".extractors.")[0]).extractors
    assert set(extractors) == {"arm", "camera", *([] if one else ["wrist"])}
    if "auxiliary" in label:
        assert f"the encoder of q_net.{key}, weight 1" in capsys.readouterr().out
    evaluate_final(folder, 2)
    record(folder, tmp_path / "a.gif", n_episodes=1)
    assert not [line for line in run_lines(folder) if line[2]]


@pytest.mark.parametrize(
    ("conf_file", "words", "env_kwargs", "message"),
    [
        ("vanilla", [], {}, "a Dict with 2 images (camera, wrist) in Dict("),
        ("vanilla", [], {"wrist": False}, "a Dict with 1 images (camera) in Dict("),
        ("drq", ["--image-key", "eye"], {}, "a Dict with no 'eye', but 2 images (camera, wrist) in Dict("),
        ("drq,image_key=eye", ["--image-key", "camera"], {}, "says image_key already; leave --image-key out"),
        (
            "ssi={file}",
            ["--image-key", "camera"],
            {},
            "pretrained on the image 'wrist', not 'camera'; leave --image-key",
        ),
        ("ssi={file}", [], {"wrist": False}, "a Dict with no 'wrist', but 1 images (camera)"),
        ("mine.yml", ["--image-key", "camera"], {}, "is no method, which image_key need"),
    ],
)
def test_refusals_name_the_keys(
    conf_file: str, words: list[str], env_kwargs: dict[str, Any], message: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    file = collect_and_pretrain(tmp_path, monkeypatch, KEY, env_words(wrist=True)) if "{file}" in conf_file else ""
    capsys.readouterr()
    config = conf_file.format(file=file)
    with pytest.raises(SystemExit) as stopped:
        train(tmp_path, monkeypatch, "ppo", env_words(**{"wrist": True, **env_kwargs}), "--conf-file", config, *words,
              "-params", *SMALL["ppo"], "normalize:False")  # fmt: skip
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert message in line


def test_a_key_for_observations_that_are_one_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        train(tmp_path, monkeypatch, "ppo", ["--env", "Toy-v0"], "--conf-file", "vanilla", "--image-key", "camera",
              "-params", *SMALL["ppo"], "normalize:False")  # fmt: skip
    assert "the image 'camera' is one of a Dict of observations, and these are Box" in capsys.readouterr().err


def test_the_method_spec() -> None:
    spec = MethodSpec.parse("drq,image_key=a,b,task_features_dim=3")
    assert spec == MethodSpec("drq", task_features_dim=3, image_key="a,b")
    # No part of the method: labels and folders do not say it.
    assert spec.suffix == ",task_features_dim=3" and MethodSpec("ssi", None, True, image_key="a").embeds_in_env
    replaced = spec.hyperparameters({"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [7]}})
    assert replaced["policy"] == "MultiInputPolicy"
    assert replaced["policy_kwargs"] == {
        "net_arch": [7],
        "features_extractor_class": "sb3_abisim.CombinedEncoderExtractor",
        "features_extractor_kwargs": {
            "encoders": {"a,b": None}, "untrained": True, "augment": "random_shift", "task_features_dim": 3
        },
    }  # fmt: skip
    with pytest.raises(ValueError, match="no key after 'image_key='"):
        MethodSpec.parse("vanilla,image_key=")
    with pytest.raises(ValueError, match=r"MultiInputPolicy is none; choose one of the images .* with --image-key"):
        MethodSpec.parse("vanilla").hyperparameters({"policy": "MultiInputPolicy"})


def test_continuing_compares_the_extractor_of_the_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["--image-key", KEY, "-params", *SMALL["ppo"], "normalize:False"]
    folder = train(tmp_path, monkeypatch, "ppo", env_words(wrist=True), "--conf-file", "vanilla", *words)
    model: Any = final_model(read_run(folder))
    same = MethodSpec("vanilla", image_key=KEY).policy_kwargs({})
    kwargs = {**same, "features_extractor_class": type(model.policy.features_extractor)}
    check_trained_with(model, kwargs)
    for other, message in (
        (MethodSpec("drq", image_key=KEY), "of wrist, not with VanillaExtractor of wrist, augment=random_shift"),
        (MethodSpec("vanilla", image_key="camera"), "of wrist, not with VanillaExtractor of camera"),
    ):
        kwargs["features_extractor_kwargs"] = other.policy_kwargs({})["features_extractor_kwargs"]
        with pytest.raises(ValueError, match=f"it was trained with VanillaExtractor {message}"):
            check_trained_with(model, kwargs)


def test_runs_on_encoders_of_several_seeds_are_one_method() -> None:
    both = [
        {"features_extractor_kwargs": {"encoders": {"camera": f"{seed}.safetensors", "wrist": None}, "freeze": True}}
        for seed in range(2)
    ]
    first, second = (_without_encoder(kwargs, None) for kwargs in both)
    assert first == second
    assert first["features_extractor_kwargs"] == {"encoders": {"camera": True, "wrist": False}, "freeze": True}
    assert json.dumps(both[0]) != json.dumps(first)
