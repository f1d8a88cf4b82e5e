"""The demo runs end to end and leaves what it promises."""

import importlib.util

import pytest
from PIL import Image

from sb3_abisim.demo import main, newest_run
from sb3_abisim.zoo.record import PIXELS


def test_demo_leaves_a_curve_a_gif_and_a_run(tmp_path, capfd):
    main(["-o", str(tmp_path), "--n-transitions", "600", "--n-updates", "5", "--n-timesteps", "2048"])
    out = capfd.readouterr().out
    for name in ("data/meta.json", "ssi.safetensors", "goal_progress.safetensors", "learning_curve.png", "agent.gif"):
        assert (tmp_path / name).is_file(), name
    assert str(tmp_path) in out and "learning curve" in out
    source = str(tmp_path / "goal_progress.safetensors")
    assert f"source {source}" in out, "PPO must train on the encoder that was just made"
    run = newest_run(tmp_path)
    assert (run / "DistractorPointMaze-v0.zip").is_file()
    with Image.open(tmp_path / "agent.gif") as gif:
        # Each episode has at least one frame and its last one stays for a second.
        assert gif.n_frames > 2 * 4
        assert gif.size == (PIXELS, PIXELS)
    with Image.open(tmp_path / "learning_curve.png") as image:
        assert len(image.convert("RGB").getcolors(1 << 24)) > 10, "the curve must be visible"


def test_what_is_missing_is_reported_before_the_work(tmp_path, capsys, monkeypatch):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "PIL" else find_spec(name))
    with pytest.raises(SystemExit) as stopped:
        main(["-o", str(tmp_path / "demo")])
    assert stopped.value.code == 2 and "pip install 'sb3_abisim[plots]'" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()


def test_a_failing_command_stops_the_demo(tmp_path, capfd):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "something_else.txt").write_text("mine")
    with pytest.raises(SystemExit) as stopped:
        main(["-o", str(tmp_path), "--n-transitions", "600"])
    said = capfd.readouterr().err
    assert stopped.value.code == 2 and said.startswith("sb3-abisim collect: error: ") and said.count("\n") == 1
    assert (tmp_path / "data" / "something_else.txt").read_text() == "mine"
    assert not (tmp_path / "ssi.safetensors").exists()
