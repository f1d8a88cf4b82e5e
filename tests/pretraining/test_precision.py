"""bf16: encoders train in bfloat16, and everything else is as in float32."""

from pathlib import Path

import pytest
import torch as th
from pretrain_inputs import collect_grids, make_run, run

from sb3_abisim.networks.encoder_file import load_encoder
from sb3_abisim.pretraining.card import read_card
from sb3_abisim.pretraining.image_networks import require_bfloat16
from sb3_abisim.pretraining.pretrain import main


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = collect_grids(tmp_path_factory)
    return folder


def test_encoders_train_in_bfloat16_and_are_evaluated_in_float32(data: Path) -> None:
    made = make_run(data, precision="bf16")
    seen: dict[bool, set[th.dtype]] = {True: set(), False: set()}
    first = next(module for module in made.module.encoder.modules() if isinstance(module, th.nn.Conv2d))
    first.register_forward_hook(lambda module, inputs, output: seen[module.training].add(output.dtype))
    embeddings = []
    made.module.inverse_model.register_forward_pre_hook(lambda module, inputs: embeddings.append(inputs[0].dtype))
    made._update(next(made._batches()))
    made._evaluate()
    assert seen == {True: {th.bfloat16}, False: {th.float32}}
    assert set(embeddings) == {th.float32}
    assert {parameter.dtype for parameter in made.module.parameters()} == {th.float32}
    assert {parameter.grad.dtype for parameter in made.module.encoder.parameters()} == {th.float32}
    assert "forward" not in vars(made.module.encoder)


def test_it_is_recorded_and_its_curve_is_near(data: Path, tmp_path: Path) -> None:
    settings = {"n_updates": 5, "log_interval": 1}
    exact = run(data, tmp_path / "float32" / "ssi.safetensors", **settings)
    near = run(data, tmp_path / "bf16" / "ssi.safetensors", precision="bf16", **settings)
    assert load_encoder(near).metadata["settings"]["precision"] == "bf16"
    # Files from before there was a choice stay those of the same run.
    assert "precision" not in load_encoder(exact).metadata["settings"]
    assert 'precision:"bf16"' in read_card(near.with_suffix(".json"))["commands"][-1]
    curves = [read_card(path.with_suffix(".json"))["curves"]["train/loss"] for path in (exact, near)]
    assert curves[0] != curves[1] and curves[0] == pytest.approx(curves[1], rel=0.01)
    with pytest.raises(ValueError, match="precision: None there, 'bf16' here"):
        run(data, exact, precision="bf16", **settings)


def test_a_base_made_on_the_way_has_it_too(data: Path, tmp_path: Path) -> None:
    words = ["--objective", "abisim", "--data", str(data), "--device", "cpu", "--verbose", "0", "--precision", "bf16"]
    sizes = ["n_updates:2", "batch_size:32", "base.n_updates:2"]
    main([*words, "-o", str(tmp_path / "x.safetensors"), "-params", *sizes])
    main([*words, "-o", str(tmp_path / "y.safetensors"), "-params", *sizes, "base.precision:float32"])
    found = [load_encoder(tmp_path / name).metadata["settings"] for name in ("x.safetensors", "x.base.safetensors")]
    assert [settings["precision"] for settings in found] == ["bf16", "bf16"]
    assert "precision" not in load_encoder(tmp_path / "y.base.safetensors").metadata["settings"]


def test_mistakes(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--objective", "ssi", "--data", str(data), "-o", str(tmp_path / "x.safetensors"), "--precision", "bf16"]
    with pytest.raises(SystemExit):
        main([*words, "-params", "precision:float32"])
    assert "--precision bf16 and -params precision:float32 differ" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"precision must be one of \('float32', 'bf16'\), got 'fp8'"):
        make_run(data, precision="fp8")


def test_a_device_that_cannot_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    require_bfloat16(th.device("cpu"))
    with pytest.raises(ValueError, match="mps is neither"):
        require_bfloat16(th.device("mps"))
    monkeypatch.setattr(th.cuda, "is_bf16_supported", lambda including_emulation: False)
    with pytest.raises(ValueError, match="cuda is neither"):
        require_bfloat16(th.device("cuda"))
