"""Without an optional package, whatever needs it names the extra that brings it, and nothing else needs it."""

import configparser
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_abisim.common.extras import needs_extra, require_extra

ROOT = Path(__file__).parents[1]
# What is imported under another name than it is installed under.
IMPORT_NAMES = {
    "POT": "ot", "scikit-learn": "sklearn", "pillow": "PIL", "opencv-python-headless": "cv2", "ale-py": "ale_py",
}  # fmt: skip
# Extras of developers, and what only the user's own line imports (--packages ale_py).
OTHERS = {"docs", "tests", "all", "atari"}
# rl-zoo3 cannot be imported without.
ALWAYS_THERE = {"optuna"}
# Module that is hidden: what is run, and the extra that is named. Each runs in a process of its own.
CALLS: dict[str, list[tuple[str, str]]] = {
    "PIL": [
        ("scan", "gym.make('ScanNav-v0')"),
        ("pages", "main(['data', 'show', 'folder', '-o', 'new.html'])"),
        ("plots", "main(['demo', '-o', 'new'])"),
        ("plots", "main(['record', 'run', '-o', 'new.gif'])"),
        ("video", "gym.make('DistractorPointMaze-v0', videos='clips')"),
    ],
    "av": [
        ("video", "gym.make('DistractorPointMaze-v0', videos='clips')"),
        ("lerobot", "main(['data', 'import', 'lerobot', 'folder', '-o', 'new'])"),
    ],
    "h5py": [("minari", "main(['data', 'import', 'minari', 'a/b-v0', '-o', 'new'])")],
    "huggingface_hub": [
        ("hub", "main(['export', 'hf://owner/repository/file.safetensors', '-o', 'new.pt2'])"),
        ("hub", "main(['push', 'Nav2D-v0/ssi', 'owner/name', '--no-evidence'])"),
        ("hub", "main(['push', 'Nav2D-v0/ssi', 'owner/name', '--no-evidence', '-o', 'new'])"),
    ],
    "jinja2": [
        ("benchmark", "main(['benchmark', '-o', 'new'])"),
        ("pages", "main(['data', 'show', 'folder', '-o', 'new.html'])"),
    ],
    "matplotlib": [
        ("plots", "main(['demo', '-o', 'new'])"),
        ("plots", "main(['analyze', 'perturbation', '--images', 'new', '-n', '1'])"),
        ("benchmark", "main(['benchmark', 'report', 'run'])"),
    ],
    "minari": [("minari", "main(['data', 'import', 'minari', 'a/b-v0', '-o', 'new'])")],
    "onnx": [("export", "main(['export', 'Nav2D-v0/ssi', '-o', 'new.onnx'])")],
    "onnxruntime": [("export", "main(['export', 'Nav2D-v0/ssi', '-o', 'new.onnx'])")],
    "onnxscript": [("export", "main(['export', 'Nav2D-v0/ssi', '-o', 'new.onnx'])")],
    "ot": [("analysis", "from sb3_abisim.analysis.exact_metric import action_bisim_metric as m; import numpy as np; "
            "m(np.eye(2), np.full((2, 1, 2), 0.5), c=0.5)")],
    "pyarrow": [("lerobot", "main(['data', 'import', 'lerobot', 'folder', '-o', 'new'])")],
    "ray": [("distributed", "main(['benchmark', '--engine', 'ray', '--no-report', '-o', 'new'])")],
    "rliable": [("benchmark", "main(['benchmark', 'report', 'run'])")],
    "scipy": [
        ("scan", "gym.make('ScanNav-v0')"),
        ("analysis", "main(['analyze', 'readouts', 'PointMaze-v0/ssi', '--env', 'PointMaze-v0', '-n', '2'])"),
        ("benchmark", "main(['benchmark', 'report', 'run'])"),
        ("benchmark", "main(['push', 'Nav2D-v0/ssi', 'owner/name', '--benchmark', 'run', '-o', 'new'])"),
    ],
    "sklearn": [
        ("analysis", "main(['analyze', 'probes', '--env', 'Nav2D-v0', 'Nav2D-v0/ssi', '-n', '20'])"),
        ("analysis", "main(['analyze', 'leak', '--env', 'Nav2D-v0', '-n', '20', '--images', 'new'])"),
    ],
    "timm": [("timm", "from sb3_abisim.networks.base import make_encoder; "
            "make_encoder(gym.spaces.Box(0, 255, (3, 32, 32), 'uint8'), 'timm/resnet18')")],
    "wandb": [("track", "main(['pretrain', '--objective', 'ssi', '--data', 'd', '-o', 'new.safetensors', '--track'])")],
}  # fmt: skip
# The heavy imports once, then a process for each hidden module.
RUNNER = r"""
import contextlib, importlib.util, io, json, os, sys, traceback
import gymnasium as gym
import rl_zoo3, stable_baselines3

def hide(hidden):
    class Hide:
        def find_spec(self, name, path=None, target=None):
            if name.partition(".")[0] == hidden:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)
    # Stable-Baselines3 itself imports some of them.
    for name in list(sys.modules):
        if name.partition(".")[0] == hidden:
            del sys.modules[name]
    sys.meta_path.insert(0, Hide())
    find_spec = importlib.util.find_spec
    importlib.util.find_spec = lambda name, *rest: None if name.partition(".")[0] == hidden else find_spec(name, *rest)

def run(calls):
    import sb3_abisim
    from sb3_abisim.__main__ import main
    for call in calls:
        err = io.StringIO()
        try:
            with contextlib.redirect_stderr(err), contextlib.redirect_stdout(io.StringIO()):
                exec(call)
            yield "nothing"
        except SystemExit as stop:
            yield f"{stop.code} {err.getvalue()}"
        except ImportError as error:
            yield f"2 {error}"
        except Exception:
            yield traceback.format_exc()

cases = json.loads(sys.argv[1])
for hidden, calls in cases.items():
    if not os.fork():
        hide(hidden)
        with open(f"{hidden}.json", "w") as file:
            json.dump(list(run(calls)), file)
        os._exit(0)
    os.wait()
"""


def extras() -> dict[str, set[str]]:
    """Extra to the modules that it brings."""
    config = configparser.ConfigParser(interpolation=None)
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    found: dict[str, set[str]] = {}
    for extra, text in config["options.extras_require"].items():
        names = [re.split(r"[\[<>=!;]", line)[0].strip() for line in text.splitlines() if line.strip()]
        names = [name for name in names if not name.startswith(("#", "%"))]
        found[extra] = {IMPORT_NAMES.get(name, name) for name in names}
    return found


def test_every_optional_module_is_hidden_once() -> None:
    modules = {module for extra, modules in extras().items() if extra not in OTHERS for module in modules}
    # h5py comes with minari.
    assert modules - ALWAYS_THERE == set(CALLS) - {"h5py"}


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Hidden module to what each of its calls ended with."""
    folder = tmp_path_factory.mktemp("extras")
    (folder / "clips").mkdir()
    for name in ("a.mp4", "b.mp4"):
        (folder / "clips" / name).write_bytes(name.encode())
    (folder / "folder").mkdir()
    cases = {hidden: [call for _, call in calls] for hidden, calls in CALLS.items()}
    words = [sys.executable, "-W", "ignore", "-c", RUNNER, json.dumps(cases)]
    subprocess.run(words, cwd=folder, capture_output=True, check=True)
    assert not [path.name for path in folder.iterdir() if path.name.startswith("new")]
    return {hidden: json.loads((folder / f"{hidden}.json").read_text()) for hidden in CALLS}


@pytest.mark.parametrize("hidden", CALLS)
def test_what_needs_a_hidden_module_names_its_extra(hidden: str, said: dict[str, list[str]]) -> None:
    for (extra, call), message in zip(CALLS[hidden], said[hidden], strict=True):
        assert message.startswith("2 "), (call, message)
        assert f"pip install 'sb3_abisim[{extra}]'" in message, (call, message)
        assert hidden in message, (call, message)
        assert len(message.strip().splitlines()) == 1, (call, message)


def test_messages_name_what_is_missing() -> None:
    with (
        pytest.raises(ImportError, match=r"a thing needs more packages \(No module .*no_such_a"),
        needs_extra("x", "a thing"),
    ):
        import no_such_a  # type: ignore[import-not-found]  # noqa: F401
    with pytest.raises(ImportError, match=r"no no_such_a and no no_such_b\); run: pip install 'sb3_abisim\[x\]'"):
        require_extra("x", "a thing", "json", "no_such_a", "no_such_b")
    with needs_extra("x", "a thing"):
        import json as there
    assert there
