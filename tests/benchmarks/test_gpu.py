"""The script for machines with a GPU runs, at the least size, on a CPU."""

from pathlib import Path

import pytest

from benchmarks import bench_pretraining, gpu


def test_it_writes_both_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (gpu, bench_pretraining):
        monkeypatch.setattr(module, "BATCH_SIZE", 16)
    ppo, dqn = (setting for setting in gpu.SETTINGS if setting.kinds == gpu.KINDS)
    small = ppo._replace(kwargs={**ppo.kwargs, "n_steps": 2, "batch_size": 32})
    monkeypatch.setattr(gpu, "SETTINGS", (small, dqn))
    # Every kind of loop: pairs of single steps, of several, sequences of actions, a base and goals.
    sizes = ["--transitions", "1500", "--rounds", "1", "--seconds", "0", "--rl-steps", "4"]
    words = ["--device", "cpu", "--env", "Nav2D-v0", "--objectives", "acro", "info_nce", "goal_progress"]
    gpu.main([*words, *sizes, "--arms", "straightforward", "float32", "bf16", "-o", str(tmp_path / "gpu.md")])
    lines = (tmp_path / "gpu.md").read_text().splitlines()
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in lines if line.startswith("|")}
    names = ["`acro`, Nav2D-v0", "`info_nce`, Nav2D-v0", "`goal_progress`, Nav2D-v0"]
    for name in (*names, ppo.title, dqn.title):
        assert len(rows[name]) == (3 if name in names else len(gpu.KINDS))
        assert all(float(cell.split()[0].replace(",", "")) > 0 for cell in rows[name])


def test_ratios_are_those_of_a_round() -> None:
    assert gpu.cells({"a": [1000.0, 10.0, 5.0], "b": [500.0, 20.0, 20.0]}, "a") == (
        "10 (1.00, 1.00 to 1.00) | 20 (2.00, 0.50 to 4.00)"
    )


def test_turns_alternate_and_count_what_a_call_does() -> None:
    calls: list[str] = []
    contenders = {name: (lambda name=name: calls.append(name)) for name in ("a", "b")}
    found = gpu.in_turns(contenders, work=5, rounds=2, seconds=0, device="cpu")
    assert calls == ["a", "b"] * 3 and [len(speeds) for speeds in found.values()] == [2, 2]


def test_without_a_gpu_it_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        gpu.main([])
    assert "give --device cpu" in capsys.readouterr().err
