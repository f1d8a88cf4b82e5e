"""Every command of a figure writes an image and numbers."""

import dataclasses
import json
import re
import shutil
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from zoo_inputs import write_encoder

from sb3_abisim.analysis import command as analyze
from sb3_abisim.analysis import nav2d_exact, pixels, probes, sweep
from sb3_abisim.analysis.curves import curves
from sb3_abisim.analysis.figures import FIGURES, default_encoders
from sb3_abisim.analysis.sweep import sweep_encoders
from sb3_abisim.common.paths import resource_path
from sb3_abisim.data.collect import collect
from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.networks.encoder_name import resolve_encoder
from sb3_abisim.pretraining.config import load_config

PNG = b"\x89PNG\r\n"
SIZES = {"perturbation": 1, "near-far": 6, "structures": 1, "pixels": 12, "neighbors": 6, "probes": 20, "leak": 20}


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(nav2d_exact, "_togglable", lambda: np.array([17, 81, 100, 111, 113, 142]))
    monkeypatch.setattr(nav2d_exact, "MIN_SAMPLES", 1)
    monkeypatch.setattr(pixels, "MIN_SAMPLES", 1)
    monkeypatch.setattr(probes, "PROBES", ("linear",))


def check(folder, stem):
    assert (folder / f"{stem}.png").read_bytes().startswith(PNG)
    return json.loads((folder / f"{stem}.json").read_text())


@pytest.mark.parametrize("name", FIGURES)
def test_every_figure(name, tmp_path, capsys):
    # Where it is quickest.
    env_id = FIGURES[name].env_ids[-1 if name in ("curves", "leak", "probes") else 0]
    size = ["-n", str(SIZES[name])] if name in SIZES else []
    analyze.main([name, "--env", env_id, "--images", str(tmp_path), "--trained", str(tmp_path), *size])
    results = check(tmp_path, f"{name}-{env_id}")
    assert results["figure"] == name and results["env_id"] == env_id
    assert f"{name}-{env_id}.png" in capsys.readouterr().out
    if FIGURES[name].encoders:
        for encoder in default_encoders(env_id):
            assert load_encoder(encoder).hash in json.dumps(results)


def test_a_mistyped_folder_of_encoders_is_named(tmp_path, capsys):
    with pytest.raises(SystemExit):
        analyze.main(["curves", "--env", "Nav2D-v0", "--images", str(tmp_path), "--trained", str(tmp_path / "no")])
    assert f"there is no folder --trained {tmp_path / 'no'}" in capsys.readouterr().err


def test_sweep_over_given_encoders(tmp_path):
    (tmp_path / "c_sweep").mkdir()
    shutil.copy(resource_path("encoders") / "Nav2D-v0/abisim.safetensors", tmp_path / "c_sweep/abisim_c0.9.safetensors")
    words = ["--images", str(tmp_path / "png"), "--numbers", str(tmp_path), "--trained", str(tmp_path), "-n", "1"]
    analyze.main(["sweep", "-c", "0.9", *words])
    assert set(json.loads((tmp_path / "sweep-Nav2D-v0.json").read_text())["encoders"]) == {"c = 0.9"}
    assert (tmp_path / "png/sweep-Nav2D-v0.png").read_bytes().startswith(PNG)


def test_sweep_refuses_a_wrong_name(tmp_path):
    shutil.copy(resource_path("encoders") / "Nav2D-v0/abisim.safetensors", tmp_path / "abisim_c0.75.safetensors")
    with pytest.raises(ValueError, match=r"trained with c = 0.9, its name says 0.75"):
        sweep_encoders([0.75], "Nav2D-v0/ssi", tmp_path, None, "Nav2D-v0")


def test_sweep_refuses_encoders_of_another_base(tmp_path):
    shutil.copy(resource_path("encoders") / "Nav2D-v0/abisim.safetensors", tmp_path / "abisim_c0.9.safetensors")
    with pytest.raises(ValueError, match="on another base encoder than Nav2D-v0/acro"):
        sweep_encoders([0.9], "Nav2D-v0/acro", tmp_path, None, "Nav2D-v0")


def test_sweep_pretrains_as_long_as_the_environment_says(tmp_path, monkeypatch):
    collect("Nav2D-v0", 40, tmp_path / "data", n_envs=2)
    configs = []

    def stand_in(objective, data, path, config, *rest, **kwargs):
        configs.append(config)
        shutil.copy(resource_path("encoders") / "Nav2D-v0/abisim.safetensors", path)

    monkeypatch.setattr(sweep, "pretrain", stand_in)
    sweep_encoders([0.9], "Nav2D-v0/ssi", tmp_path / "own", tmp_path / "data", "Nav2D-v0")
    sweep_encoders([0.9], "Nav2D-v0/ssi", tmp_path / "short", tmp_path / "data", "Nav2D-v0", n_updates=3)
    usual = load_config("abisim", "Nav2D-v0")
    assert [config.n_updates for config in configs] == [usual.n_updates, 3]
    assert configs[0].objective_kwargs == usual.objective_kwargs and usual.objective_kwargs["c"] == 0.9


@pytest.mark.slow
def test_sweep_pretrains_what_is_missing_once(tmp_path):
    collect("Nav2D-v0", 600, tmp_path / "data", n_envs=6)
    folder, base = tmp_path / "c_sweep", "Nav2D-v0/ssi"
    first = sweep_encoders([0.25, 0.5], base, folder, tmp_path / "data", "Nav2D-v0", n_updates=1)
    assert first[0.25].metadata["settings"]["objective_kwargs"]["c"] == 0.25
    assert first[0.25].metadata["settings"]["base_hash"] == load_encoder(base).hash
    again = sweep_encoders([0.25, 0.5], base, folder, None, "Nav2D-v0")
    assert [file.hash for file in again.values()] == [file.hash for file in first.values()]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["perturbation", "PointMaze-v0/ssi"], "observation"),
        (["perturbation", "-n", "0"], "at least 1, got 0"),
        # Not what its observations are.
        (["perturbation", "PointMaze-v0/ssi", "--env", "PointMaze-v0"], "in Nav2D alone, got 'PointMaze-v0'"),
        (["pixels", "Nav2D-v0/ssi", "--env", "CartPole-v1"], "in the point mazes alone, got 'CartPole-v1'"),
        (["near-far", "--env", "PointMaze-v0"], "in Nav2D alone, got 'PointMaze-v0'"),
        (["pixels", "--env", "Nav2D-v0"], "in the point mazes alone, got 'Nav2D-v0'"),
        (["probes", "--env", "Nav3D-v0", "Nav2D-v0/ssi"], "unknown environment 'Nav3D-v0'"),
        (["violins"], "invalid choice: 'violins'"),
        (["sweep", "-c", "0.1"], "give --data DIR"),
        (["curves", "no/such"], "no/such"),
    ],
)
def test_refuses(words, message, tmp_path, capsys):
    with pytest.raises(SystemExit):
        analyze.main([*words, "--images", str(tmp_path), "--trained", str(tmp_path)])
    assert re.search(message, capsys.readouterr().err)


def test_environment_without_shipped_encoders():
    with pytest.raises(ValueError, match="no encoder ships for ScanNavPaper-v0"):
        default_encoders("ScanNavPaper-v0")


def test_own_folder_joins_the_shipped_ones(tmp_path):
    folder = tmp_path / "Nav2DMaze-v0"
    folder.mkdir()
    write_encoder(folder / "mine.safetensors", "Nav2D-v0")
    # A copy of a shipped one would count twice.
    shutil.copy(resolve_encoder("Nav2D-v0/abisim"), folder / "abisim_0.safetensors")
    shipped = ["Nav2D-v0/ssi", "Nav2D-v0/abisim"]
    assert [name for name in default_encoders("Nav2DMaze-v0") if name in shipped] == shipped
    joined = default_encoders("Nav2DMaze-v0", tmp_path)
    assert joined == [*default_encoders("Nav2DMaze-v0"), str(folder / "mine.safetensors")]


def test_all_makes_the_usual_ones(monkeypatch, tmp_path):
    made = []
    monkeypatch.setattr(analyze, "make_figure", lambda name, files, env_id, n, *rest: made.append((name, env_id, n)))
    monkeypatch.setattr(analyze, "make_sweep", lambda values, *rest: made.append(("sweep", tuple(values), rest[3])))
    monkeypatch.setattr(analyze, "load_all", lambda names, *rest: {})
    figures = {name: dataclasses.replace(one) for name, one in FIGURES.items() if name != "probes"}
    monkeypatch.setattr(analyze, "FIGURES", figures)
    analyze.main(["all", "--images", str(tmp_path)])
    assert made[0] == ("sweep", (0.25, 0.75, 0.85, 0.99), analyze.SWEEP_LAYOUTS)
    assert made[1:] == [(name, env_id, one.size) for name, one in figures.items() for env_id in one.env_ids]


@pytest.mark.parametrize("content", ["{", "{}", "[]"])
def test_a_damaged_card_is_named(tmp_path, content):
    (tmp_path / "mine.json").write_text(content)
    with pytest.raises(ValueError, match=r"the model card .*mine\.json is damaged"):
        curves({"mine": SimpleNamespace(path=tmp_path / "mine.safetensors")})


def test_main_curves_are_those_of_the_methods():
    names = {"abisim": "eval/metric_loss", "ssi": "eval/accuracy", "beta_vae": "eval/reconstruction"}
    found = curves({name: load_encoder(f"Nav2D-v0/{name}") for name in names})["encoders"]
    assert {name: one["term"] for name, one in found.items()} == names
    # Cards were written under earlier names.
    assert not any("test/" in term for one in found.values() for term in one["curves"])


def test_a_method_that_is_not_registered_shows_its_loss(tmp_path):
    card = json.loads(resolve_encoder("Nav2D-v0/ssi").with_suffix(".json").read_text())
    (tmp_path / "mine.json").write_text(json.dumps(card))
    file = SimpleNamespace(path=tmp_path / "mine.safetensors", hash="0", metadata={"objective": "theirs"})
    assert curves({"mine": file})["encoders"]["mine"]["term"] == "train/loss"
    card["curves"] = {"n_updates": [1]}
    (tmp_path / "mine.json").write_text(json.dumps(card))
    with pytest.raises(ValueError, match=r"mine\.json holds none of the curves train/loss"):
        curves({"mine": file})


def test_every_help_has_an_example(capsys):
    with pytest.raises(SystemExit) as stopped:
        analyze.main(["--help"])
    listed = capsys.readouterr().out
    assert stopped.value.code == 0 and all(f"    {name} " in listed for name in analyze.COMMANDS)
    for name in analyze.COMMANDS:
        with pytest.raises(SystemExit):
            analyze.main([name, "--help"])
        assert f"example: sb3-abisim analyze {name} " in capsys.readouterr().out


def test_an_environment_of_another_package(tmp_path, monkeypatch, capsys):
    """Registered by --packages, with a namespace, without factors."""
    module = "import gymnasium, index_env\n"
    module += "gymnasium.register('mine/Plain-v0', entry_point=index_env.PlainEnv, max_episode_steps=6)\n"
    (tmp_path / "my_package.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(gym.registry, "mine/Plain-v0", None)
    del gym.registry["mine/Plain-v0"]
    words = ["--env", "mine/Plain-v0", "--packages", "my_package", "--images", str(tmp_path)]
    analyze.main(["leak", "-n", "40", *words])
    assert check(tmp_path, "leak-mine-Plain-v0")["audits"]["with a display of the action"]["leaks"]
    for name in ("neighbors", "probes", "curves"):
        with pytest.raises(SystemExit):
            analyze.main([name, *words])
        assert "no encoder ships for mine/Plain-v0; name the files to look at" in capsys.readouterr().err


def test_figures_leave_the_backend_of_a_notebook(tmp_path):
    import matplotlib
    import matplotlib.pyplot as plt

    before = matplotlib.get_backend()
    plt.switch_backend("svg")
    try:
        analyze.main(["curves", "--env", "Nav2D-v0", "--images", str(tmp_path)])
        assert matplotlib.get_backend() == "svg"
    finally:
        plt.switch_backend(before)
