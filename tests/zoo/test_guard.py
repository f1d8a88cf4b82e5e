"""enjoy and record_video execute nothing that a run folder holds, and act as rl-zoo3's own."""

import pickle
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from zoo_inputs import run

ENV_ID = "CartPole-v1"


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of plain rl-zoo3 on vectors, with normalized observations."""
    folder = tmp_path_factory.mktemp("logs")
    with pytest.MonkeyPatch.context() as patch:
        words = ["--algo", "ppo", "--env", ENV_ID, "-f", str(folder), "-n", "256", "--eval-freq", "-1"]
        run(patch, "train", *words, "--num-threads", "1", "-params", "normalize:dict(norm_obs=True, gamma=0.98)")
    return folder


def enjoy(patch: pytest.MonkeyPatch, logs: Path, *more: str) -> None:
    words = ["--algo", "ppo", "--env", ENV_ID, "-f", str(logs), "--no-render", "-n", "200", "--num-threads", "1"]
    run(patch, "enjoy", *words, *more)


def test_it_acts_as_rl_zoo3_does(
    logs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    printed = []
    for more in ([], ["--trust"]):
        enjoy(monkeypatch, logs, *more)
        printed.append(re.findall("Episode Reward: .*", capsys.readouterr().out))
    assert printed[0] == printed[1] and printed[0]


class Execute:
    """A pickle, and a YAML tag, that makes a file when it is opened."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("what", ["args tag", "config tag", "normalize", "wrapper", "import", "means"])
def test_nothing_is_executed(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], what: str
) -> None:
    shutil.copytree(logs, tmp_path / "logs")
    marker, folder = tmp_path / "executed", tmp_path / "logs" / "ppo" / f"{ENV_ID}_1" / ENV_ID
    file = folder / ("args.yml" if what == "args tag" else "vecnormalize.pkl" if what == "means" else "config.yml")
    tag = f"!!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path ['{marker}']]"
    (tmp_path / "planted_module.py").write_text(f"import pathlib; pathlib.Path({str(marker)!r}).touch()\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    config = yaml.unsafe_load((folder / "config.yml").read_text())
    if "tag" in what:
        file.write_text(f"{file.read_text()}\nextra: {tag}\n" if "args" not in what else f"env_kwargs: {tag}\n")
    elif what == "normalize":
        file.write_text(yaml.dump({**config, "normalize": f"__import__('pathlib').Path({str(marker)!r}).touch()"}))
    elif what == "wrapper":
        touch = {"subprocess.Popen": {"executable": "/bin/touch", "args": ["touch", str(marker)]}}
        file.write_text(yaml.dump({**config, "env_wrapper": [touch]}))
    elif what == "import":
        file.write_text(yaml.dump({**config, "vec_env_wrapper": "planted_module.Wrapper"}))
    else:
        file.write_bytes(pickle.dumps(Execute(marker)))
    with pytest.raises(SystemExit) as stopped:
        enjoy(monkeypatch, tmp_path / "logs")
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and error.count("\n") == 1 and not marker.exists()
    assert file.name in error


def test_a_pickle_of_curves_needs_trust(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        run(monkeypatch, "zoo", "plot_from_file", "-i", "curves.pkl")
    assert stopped.value.code == 2 and "is a pickle, which executes whatever" in capsys.readouterr().err


def test_a_tag_that_only_names_imports_nothing(logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(logs, tmp_path / "logs")
    marker, args = tmp_path / "executed", tmp_path / "logs" / "ppo" / f"{ENV_ID}_1" / ENV_ID / "args.yml"
    (tmp_path / "named_module.py").write_text(f"import pathlib; pathlib.Path({str(marker)!r}).touch(); x = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    args.write_text("algo: ppo\nenv: CartPole-v1\nseed: 0\nn_timesteps: 256\nenv_kwargs: null\neval_env_kwargs: null\n"
                    "eval_freq: -1\neval_episodes: 1\nextra: !!python/name:named_module.x ''\n")  # fmt: skip
    (args.parents[1] / "hashes.json").unlink()
    enjoy(monkeypatch, tmp_path / "logs")
    assert not marker.exists()


@pytest.mark.parametrize("name", ["env_kwargs", "seed", "n_timesteps"])
def test_a_file_that_lacks_something_is_one_sentence(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    shutil.copytree(logs, tmp_path / "logs")
    args = tmp_path / "logs" / "ppo" / f"{ENV_ID}_1" / ENV_ID / "args.yml"
    args.write_text(args.read_text().replace(f"- {name}\n", f"- {name}_\n"))
    (args.parents[1] / "hashes.json").unlink()
    with pytest.raises(SystemExit) as stopped:
        enjoy(monkeypatch, tmp_path / "logs")
    assert stopped.value.code == 2 and "args.yml was not written by rl_zoo3.train" in capsys.readouterr().err
