"""Exported encoders run without this package, and give the embeddings of the encoder file."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_abisim import ActionBisimExtractor, VanillaExtractor, load_encoder
from sb3_abisim.__main__ import main
from sb3_abisim.common.extras import is_installed
from sb3_abisim.networks import export as export_module
from sb3_abisim.networks.base import preprocess
from sb3_abisim.networks.encoder_file import reference_batch
from sb3_abisim.networks.encoder_name import EncoderNotFoundError
from sb3_abisim.networks.export import export_encoder

DOCS = Path(__file__).parents[2] / "docs" / "export.md"
ENDINGS = ("pt2", "onnx")
# Of torch 2.10, once in a process, when it opens a program.
pytestmark = pytest.mark.filterwarnings("ignore:The given buffer is not writable:UserWarning")


def require(ending: str) -> None:
    for module in ("onnx", "onnxruntime", "onnxscript") if ending == "onnx" else ():
        pytest.importorskip(module)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("name", ["Nav2D-v0/abisim", "PointMaze-v0/ssi", "ScanNav-v0/abisim"])
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_embeddings_are_those_of_the_encoder(name: str, ending: str, tmp_path: Path) -> None:
    require(ending)
    path = tmp_path / "new" / f"encoder.{ending}"
    file = export_encoder(name, path)
    encoder = load_encoder(name).encoder
    space = file.metadata["observation_space"]
    observations = np.random.default_rng(0).integers(0, 256, (11, *space["shape"]), np.uint8)
    with th.no_grad():
        expected = encoder(th.as_tensor(observations).float() / 255)
    execute = export_module._run_onnx if ending == "onnx" else export_module._run_program
    embeddings = execute(path.read_bytes(), observations)
    assert embeddings.dtype == np.float32
    assert np.abs(embeddings - expected.numpy()).max() < 1e-4 * float(expected.abs().max())


def test_the_reference_batch_is_that_of_the_file() -> None:
    file = load_encoder("Nav2D-v0/abisim")
    observations, embeddings = reference_batch(file)
    with th.no_grad():
        again = file.encoder(th.as_tensor(observations).float() / 255)
    assert len(observations) == 8 and np.allclose(again.numpy(), embeddings, atol=1e-4)


def test_what_differs_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    observations, embeddings = reference_batch(load_encoder("Nav2D-v0/abisim"))
    wrong = embeddings * np.float32(1.001)
    monkeypatch.setattr("sb3_abisim.networks.encoder_file.reference_batch", lambda file: (observations, wrong))
    with pytest.raises(ValueError, match=r"e\.pt2 was not written: .* differ by up to"):
        export_encoder("Nav2D-v0/abisim", tmp_path / "e.pt2")
    assert not list(tmp_path.iterdir())


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    main(["export", "Nav2D-v0/abisim", "-o", str(tmp_path / "e.pt2")])
    assert re.search(r"uint8 \(batch, 3, 15, 15\) to float32 \(batch, \d+\), checked", capsys.readouterr().out)
    for words, message in (
        (["Nav2D-v0/abisim", "-o", "e.pth"], "must end in .onnx or .pt2, got 'e.pth'"),
        (["nothing", "-o", "e.pt2"], "no encoder file 'nothing'"),
    ):
        with pytest.raises(SystemExit, match="2"):
            main(["export", *words])
        assert message in capsys.readouterr().err
    monkeypatch.setitem(export_module._NEEDED, ".onnx", ("onnx", "no_such_module"))
    with pytest.raises(SystemExit, match="2"):
        main(["export", "Nav2D-v0/abisim", "-o", "e.onnx"])
    assert "no_such_module); run: pip install 'sb3_abisim[export]'" in capsys.readouterr().err


def test_the_examples_of_the_docs(tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
    assert len(blocks) == 3
    export_encoder("PointMaze-v0/abisim", tmp_path / "encoder.pt2")
    for block in blocks:
        if "onnxruntime" in block:
            if any(not is_installed(name) for name in export_module._NEEDED[".onnx"]):
                continue
            export_encoder("PointMaze-v0/abisim", tmp_path / "encoder.onnx")
        subprocess.run([sys.executable, "-c", block], cwd=tmp_path, check=True)


def test_weights_of_an_exported_encoder_can_be_trained(tmp_path: Path) -> None:
    export_encoder("Nav2D-v0/abisim", tmp_path / "e.pt2")
    encoder = th.export.load(tmp_path / "e.pt2").module()
    encoder(th.randint(256, (4, 3, 15, 15), dtype=th.uint8)).sum().backward()
    assert all(float(p.grad.abs().sum()) > 0 for p in encoder.parameters())


class Actor(th.nn.Module):
    def __init__(self, policy: th.nn.Module) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, x: th.Tensor) -> th.Tensor:
        if hasattr(self.policy, "q_net"):
            return self.policy.q_net(x)
        return self.policy.action_net(self.policy.mlp_extractor.forward_actor(self.policy.features_extractor(x)))


@pytest.mark.parametrize("freeze", [False, True, None], ids=["trained", "frozen", "vanilla"])
@pytest.mark.parametrize("algorithm", [PPO, DQN])
def test_a_fresh_policy_goes_through_torch_export(algorithm: type, freeze: bool | None) -> None:
    kwargs: dict = {"features_extractor_class": VanillaExtractor}
    if freeze is not None:
        extractor_kwargs = {"encoder": "Nav2D-v0/abisim", "freeze": freeze}
        kwargs = {"features_extractor_class": ActionBisimExtractor, "features_extractor_kwargs": extractor_kwargs}
    model = algorithm("CnnPolicy", make_vec_env("Nav2D-v0", 1), policy_kwargs=kwargs, device="cpu")
    actor = Actor(model.policy).eval()
    raw = model.env.reset()
    # DQN's network preprocesses by itself.
    x = th.as_tensor(raw) if algorithm is DQN else preprocess(raw, model.observation_space)
    program = th.export.export(actor, (x,))
    with th.no_grad():
        assert th.allclose(program.module()(x), actor(x), atol=1e-5)


def test_missing_weights_are_not_exported(tmp_path: Path) -> None:
    space = make_vec_env("Nav2D-v0", 1).observation_space
    extractor = ActionBisimExtractor(space, str(tmp_path / "absent.safetensors"))
    x = th.rand(1, 3, 15, 15)
    with pytest.raises(EncoderNotFoundError, match="no pretrained weights"):
        th.export.export(extractor, (x,))
    extractor.load_state_dict(ActionBisimExtractor(space, "Nav2D-v0/abisim").state_dict())
    th.export.export(extractor, (x,))
